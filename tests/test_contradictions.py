"""Photos whose corners are wrong together: what is stated of a camera and of a rig holds all the same."""

import numpy as np
import pytest
import torch
from omnidir_pair import omnidir_pair

import omnilines as ol
from omnilines.calibration.rig.links import relative_pose, translation_covariance
from omnilines.least_squares.groups import Groups
from omnilines.least_squares.variance import contradiction, variance_factor
from omnilines.records import Corners

DOUBT = 0.01


def grouped(groups: int, shared: float, seed: int) -> tuple[Groups, np.ndarray, float, int, torch.Tensor]:
    """A straight line (zero) through groups of 30 points with noise of 1, each group with an own line of standard deviation
    `shared` on top: its groups, the estimate, squares and freedom of the residuals, and S^-1."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (groups, 30))
    design = np.stack([np.ones_like(x), x], -1)
    values = rng.normal(size=x.shape) + (design @ rng.normal(0, shared, (groups, 2))[..., None])[..., 0]
    flat = design.reshape(-1, 2)
    found, squares, *_ = np.linalg.lstsq(flat, values.ravel(), rcond=None)
    residual = values - design @ found
    matrix, gradient = np.einsum("gni,gnj->gij", design, design), np.einsum("gni,gn->gi", design, residual)
    unit = torch.linalg.inv(torch.as_tensor(matrix.sum(0)))
    return Groups(torch.as_tensor(matrix), torch.as_tensor(gradient)), found, float(squares[0]), flat.shape[0] - 2, unit


def test_groups_that_agree_are_seldom_said_to_contradict_each_other():
    said = 0
    for seed in range(400):
        groups, _, squares, freedom, _ = grouped(8, 0.0, seed)
        assert groups.between[1] == 14
        said += contradiction(variance_factor(squares, freedom, None, DOUBT), squares, freedom, groups, DOUBT) is not None
    assert said <= 12


@pytest.mark.parametrize("count", [6, 20])
def test_groups_that_contradict_each_other(count):
    """The estimate's spread over sets of groups is what is stated; noise alone would state half of it."""
    errors, stated, alone, ratios, missed = [], [], [], [], 0
    for seed in range(200):
        groups, found, squares, freedom, unit = grouped(count, 0.6, seed)
        noise = variance_factor(squares, freedom, None, DOUBT)
        said = contradiction(noise, squares, freedom, groups, DOUBT)
        if said is None:
            missed += 1
            continue
        assert said.factor.freedom == count - 1
        ratios.append(said.ratio)
        errors.append(found)
        stated.append((unit * said.factor.value).diagonal() + groups.jackknife().diagonal())
        alone.append((unit * noise.value).diagonal())
    # Of 30 points an own line adds 30 and 10 times its variance of 0.36 to that of the noise, 1.
    assert missed <= 8 and np.median(ratios) == pytest.approx(np.sqrt((1 + 10.8 + 1 + 3.6) / 2), rel=0.15)
    truth = np.square(errors).mean(0)
    share = np.sqrt(truth / np.stack(stated).mean(0))
    assert (share > 0.6).all() and (share < 0.9).all()
    assert (np.sqrt(truth / np.stack(alone).mean(0)) > 1.8).all()


def test_what_the_solution_holds_is_free_here():
    """Groups are compared at the minimum, wherever they were linearised."""
    groups, *_ = grouped(8, 0.6, 1)
    moved = Groups(groups.matrix, groups.gradient + (groups.matrix @ torch.tensor([0.3, -2.0], dtype=torch.float64)))
    assert moved.between[0] == pytest.approx(groups.between[0])
    assert torch.allclose(moved.jackknife(), groups.jackknife())


def halves(corners: Corners, seed: int) -> list[Corners]:
    """The corners of random halves of the frames."""
    frames = sorted(set(corners.frames or ()))
    order = np.random.default_rng(seed).permutation(frames)
    return [of_frames(corners, set(order[k::2].tolist())) for k in range(2)]


def of_frames(corners: Corners, frames: set[str]) -> Corners:
    """The corners of some frames."""
    assert corners.frames is not None and corners.cameras is not None
    views = [v for v, frame in enumerate(corners.frames) if frame in frames]
    place = np.full(len(corners.frames), -1)
    place[views] = np.arange(len(views))
    rows = place[corners.view] >= 0
    names = tuple(corners.view_names[v] for v in views)
    return Corners(
        place[corners.view[rows]],
        names,
        names,
        corners.board_m[rows],
        corners.pixels[rows],
        cameras=tuple(corners.cameras[v] for v in views),
        frames=tuple(corners.frames[v] for v in views),
    )


@pytest.mark.full
def test_halves_of_a_real_rig_agree_as_stated(shared_data):
    """OpenCV's stereo pair: parameters of random halves differ by what is stated; noise alone states a third of it."""
    corners, *_ = omnidir_pair(shared_data / "calibration/omnidir_corners")
    sizes, z = {"cam0": (704, 576), "cam1": (704, 576)}, []
    for seed in range(4):
        one, other = (ol.calibrate_rig(half, sizes, model="scaramuzza", degree=4) for half in halves(corners, seed))
        assert any("contradict each other" in note for note in one.notes)
        values = [np.concatenate([c.parameters.numpy() for c in half.cameras.values()]) for half in (one, other)]
        count = len(values[0])
        sigma = np.sqrt(one.covariance.diagonal()[:count] + other.covariance.diagonal()[:count])
        z += ((values[1] - values[0])[sigma > 0] / sigma[sigma > 0]).tolist()
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.mean(np.abs(z) < 1.96) > 0.9


def test_photos_of_a_real_camera_contradict_each_other(shared_data):
    corners = ol.read_corners(shared_data / "calibration/fisheye1/corners.csv")
    found = ol.calibrate(corners, (1032, 778), model="scaramuzza", degree=4)
    assert 3 < found.fit.beyond_noise < 8
    assert any("contradict each other" in note for note in found.notes)


def test_the_place_of_a_camera_is_as_certain_whichever_way_it_is_said():
    """In the frame of the rig's first camera the place of another is its centre (Monte Carlo)."""
    pose = ol.Pose.exp(torch.tensor([[0.0] * 6, [0.4, -0.9, 0.2, 0.7, -0.3, 1.1]], dtype=torch.float64))
    spread = torch.zeros(12, 12, dtype=torch.float64)
    factor = torch.as_tensor(np.random.default_rng(3).normal(0, 1e-3, (6, 6)))
    spread[6:, 6:] = factor @ factor.mT
    drawn = torch.as_tensor(np.random.default_rng(4).normal(size=(20000, 6))) @ factor.mT
    centre = (ol.Pose.exp(drawn) @ pose[1]).inverse().translation
    relative, covariance = relative_pose(pose, spread, 0, 1)
    assert torch.allclose(translation_covariance(relative, covariance), torch.cov(centre.mT), rtol=0.05, atol=5e-8)
