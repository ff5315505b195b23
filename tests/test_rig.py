"""Rigs: the errors of many noise seeds against the stated covariance and the Cramer-Rao bound, and what users get wrong."""

import itertools
import math
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import torch
from rig_views import (
    FISHEYE_220,
    PINHOLE,
    RigScene,
    back_to_back,
    boards_at,
    chain_rig,
    looking_along,
    mixed_rig,
    outward_rig,
    pair,
    renumbered,
    scene,
    setups,
    worst_pose_error,
)

import omnilines as ol
from camera_models import GeometryError, InputError
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.near import CornerNoise
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.views import RigViews
from omnilines.least_squares import solve
from omnilines.pages.limits import rig_advice
from omnilines.pipelines.calibrate_rig import RigSetup
from omnilines.records import Corners

NOISE_PX = 0.2
NORMAL_95 = 1.959964


def bound_of(rig: RigScene) -> torch.Tensor:
    """The Cramer-Rao bound of everything that is estimated but the boards' poses, for corners with NOISE_PX, at the truth."""
    views = RigViews.of(rig.corners, rig.names, "fixed")
    count, bases = len(rig.names), tuple(model.calibration_basis() for model in rig.models)
    relative = np.ones(len(rig.corners))
    data = RigData(
        views, tuple(range(count)), (0,), bases, (CornerNoise(NOISE_PX, NOISE_PX, 0.0),) * count, relative, rig.corners.board_m
    )
    points, _, _ = data.points(np.arange(len(views.camera)))
    frames = torch.tensor([int(frame) for frame in views.frames])
    truth = RigState(rig.models, rig.cam_from_rig, Pose.identity(1), rig.rig_from_board[frames])
    return solve(data.problem(points), truth, max_iterations=1).kept_covariance()


def errors_of(result: RigCalibration, rig: RigScene) -> tuple[torch.Tensor, torch.Tensor, int]:
    """Errors of the parameters along their bases and of the camera poses (left), their covariance, and how many of them are
    parameters."""
    bases = [model.calibration_basis() for model in rig.models]
    off = []
    for member, truth, basis in zip(result.members, rig.models, bases, strict=True):
        off.append(torch.linalg.lstsq(basis, (member.model.parameters - truth.parameters)[:, None]).solution[:, 0])
    parameters = sum(len(part) for part in off)
    for c, member in enumerate(result.members[1:], 1):
        off.append((member.cam_from_rig @ rig.cam_from_rig[c].inverse()).log())
    spread = torch.block_diag(*bases, torch.eye(6 * len(bases) - 6, dtype=torch.float64))
    inverse = torch.linalg.pinv(spread)
    return torch.cat(off), inverse @ torch.as_tensor(result.covariance) @ inverse.mT, parameters


RIGS = {
    "outward": lambda: outward_rig(60),
    "mixed": lambda: mixed_rig(60),
    "chain": lambda: chain_rig(8),
    "360 scaramuzza": lambda: back_to_back("scaramuzza"),
    "360 double-sphere": lambda: back_to_back("double-sphere"),
    "360 scaramuzza, narrow rim": lambda: back_to_back("scaramuzza", in_rim=6, reach_deg=95.0),
    "360 double-sphere, narrow rim": lambda: back_to_back("double-sphere", in_rim=6, reach_deg=95.0),
}
SEEDS = [pytest.param("360 scaramuzza", 10, marks=pytest.mark.slow)]
SEEDS += [pytest.param(name, 200 if name == "chain" else 50, marks=pytest.mark.full) for name in RIGS]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seeds"), SEEDS)
def test_at_the_bound_and_honest_about_it(name, seeds):
    """All parameters and poses within the truth jointly; poses of the cameras at the bound; 95 percent intervals cover."""
    rig = RIGS[name]()
    bound = bound_of(rig)
    kinds = setups(rig)
    squares, inside, outside, farthest = [], [], 0, 0.0
    for seed in range(seeds):
        result = calibrate_rig(rig.noisy(NOISE_PX, 200 + seed), kinds)
        assert len(result.members) == len(rig.models) and all(view.used for view in result.views)
        off, covariance, parameters = errors_of(result, rig)
        z = off / covariance.diagonal().sqrt()
        outside += float(off @ torch.linalg.solve(covariance, off)) > scipy.stats.chi2.ppf(0.999, len(off))
        farthest = max(farthest, float(z.abs().max()))
        inside.append((z.abs() <= NORMAL_95).numpy())
        pose, of_poses = off[parameters:], bound[parameters:, parameters:]
        squares.append(float(pose @ torch.linalg.solve(of_poses, pose)) / len(pose))
    mean, error = np.mean(squares), np.std(squares, ddof=1) / math.sqrt(seeds)
    ratio, ratio_error = math.sqrt(mean), 0.5 * error / math.sqrt(mean)
    # Of few seeds their own spread says little: that of chi-square too.
    by_chance = math.sqrt(0.5 / (seeds * 6 * (len(rig.models) - 1)))
    covered = np.mean(inside, 0)
    print(f"{name}, {seeds} seeds: poses {ratio:.3f} +- {ratio_error:.3f} of the bound; {covered.mean():.3f} covered, items "
          f"{covered.min():.2f} to {covered.max():.2f}")  # fmt: skip
    # Of 200 seeds one or two may lie outside by chance.
    assert outside <= (0 if seeds < 200 else 2) and farthest < (4.5 if seeds < 200 else 5.0)
    assert ratio <= 1 + max(0.05, 2 * ratio_error, 2 * by_chance)
    assert 0.91 <= covered.mean() <= 0.985 if seeds < 50 else 0.93 <= covered.mean() <= 0.97
    if seeds >= 200:
        assert 0.90 <= covered.min() and covered.max() <= 0.99


@pytest.mark.slow
def test_uncertainty_grows_along_a_chain():
    """The pose of each camera is less certain than that of the one before; neighbours are known equally well all along."""
    result = calibrate_rig(chain_rig(12).noisy(NOISE_PX, 1), setups(chain_rig(12)))
    turn = [math.sqrt(np.linalg.eigvalsh(member.pose_covariance[:3, :3])[-1]) for member in result.members]
    assert all(a < b for a, b in itertools.pairwise(turn))
    neighbours = [link.rotation_sigma_deg for link in result.links if link.second == link.first + 1]
    assert len(neighbours) == 7 and max(neighbours) < 3 * min(neighbours)
    assert math.degrees(turn[-1]) > 2 * np.median(neighbours)


@pytest.mark.slow
def test_distortion_that_corners_do_not_support_is_held_in_every_camera():
    """What is held in the first camera stays so while that of the second is looked at."""
    lens = Pinhole([2600.0, 2600.0, 650.0, 470.0, 0, -0.1, 0, 0, 0, 0, 0, 0, 0], (1300, 980))
    for seed in range(2):
        rng = np.random.default_rng(seed)
        directions = np.array([0.0, 0.0, 1.0]) + 0.08 * rng.standard_normal((5, 3)) * [1.0, 1.0, 0.0]
        boards = boards_at(directions, rng.uniform(0.9, 2.0, 5), rng)
        axes = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        rig = scene((lens, lens), looking_along(axes, np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]])), boards)
        result = calibrate_rig(rig.noisy(0.3, seed), setups(rig))
        notes = [note for note in result.notes if "held at 0" in note]
        assert len(notes) == 2
        for member, note in zip(result.members, notes, strict=True):
            named = re.search(rf"Camera {member.name}: the distortion ([kp0-9 ]+) is held.*chi-square ([-0-9.]+) of", note)
            assert named and "k3" in named[1] and float(named[2]) >= 0.0
            values = member.model.named_parameters()
            assert all(values[name] == 0.0 for name in named[1].split()) and abs(values["k1"] + 0.1) < 0.1


@pytest.mark.slow
def test_models_that_were_chosen_are_named_with_why():
    rig = pair(8)
    corners, size = rig.noisy(NOISE_PX, 0), {name: model.image_size for name, model in zip(rig.names, rig.models, strict=True)}
    stages = Counter[str]()
    found = ol.calibrate_rig(
        corners, size, models={"cam0": "auto", "cam1": "opencv-fisheye"}, progress=lambda stage, *_: stages.update([stage])
    )
    # Twelve models were fitted in silence, and what follows the fit was called the fit.
    assert stages["calibrating cam0 alone"] > 5 * stages["calibrating cam1 alone"] > 0 and stages["judging the rig"]
    (note,) = (note for note in found.notes if "was taken" in note)
    model = found.cameras["cam0"].NAME
    assert note.startswith(f"Camera cam0: {model}") and "error of held-out views" in note
    # A second fit, with the same corners a little better, takes the same models and says the same.
    setup = RigSetup(ol.CalibrationOptions("auto"), {}, "fixed", {}, False).as_chosen(found.fit, size)
    assert {name: one.model for name, one in setup.cameras(size).items()} == {"cam0": model, "cam1": "opencv-fisheye"}
    assert setup.cameras(size)["cam0"].chosen in note and setup.cameras(size)["cam1"].chosen == ""
    # A camera of which more corners were found is asked again.
    again = RigSetup(ol.CalibrationOptions("auto"), {}, "fixed", {}, False).as_chosen(found.fit, ["cam1"])
    assert {name: one.model for name, one in again.cameras(size).items()} == {"cam0": "auto", "cam1": "opencv-fisheye"}
    # Where corners lie farther off than is stated, all models are to be compared only of a camera of which they were not.
    of_camera = np.array(found.fit.corners.cameras)[found.fit.corners.view]
    for worst, asked in (("cam0", False), ("cam1", True)):
        stated = replace(found.fit.corners, sigma_px=np.where(of_camera == worst, 1e-3, 1.0))
        advice = [one for one in rig_advice(replace(found.fit, corners=stated), {}) if one.limit.startswith(f"{worst}: corners")]
        assert len(advice) == 1 and ("`model` auto" in advice[0].do) == asked


def test_exact_corners_give_the_exact_rig():
    rig = outward_rig(30)
    result = calibrate_rig(rig.corners, setups(rig))
    off, _, _ = errors_of(result, rig)
    assert float(off.abs().max()) < 1e-4 and result.rms_px_per_axis < 1e-6
    assert result.frames == tuple(dict.fromkeys(rig.corners.frames))
    truth = rig.rig_from_board[[int(frame) for frame in result.frames]]
    assert float((result.rig_from_target @ truth.inverse()).log().abs().max()) < 1e-6


@pytest.mark.slow
def test_a_camera_that_shares_no_view_is_reported_and_calibrated_alone():
    rig = outward_rig(40)
    frames = tuple(f"late {f}" if c == "cam2" else f for c, f in zip(rig.corners.cameras, rig.corners.frames, strict=True))
    result = calibrate_rig(replace(rig.noisy(0.1, 1), frames=frames), setups(rig))
    assert [member.name for member in result.members] == ["cam0", "cam1", "cam3"]
    assert "in no frame in which another camera" in result.left_out["cam2"]
    assert any("Camera cam2 is not of the rig" in note for note in result.notes)
    assert abs(float(result.left_out_alone["cam2"].model.parameters[0]) - float(rig.models[2].parameters[0])) < 1
    assert all(not view.used and "not of the rig" in view.reason for view in result.views if view.camera == "cam2")
    assert result.member("cam1").sigma["fx"] > 0
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.1 and shift < 1e-3


def test_cameras_that_never_meet_are_refused():
    rig = pair(12)
    frames = tuple(f"{camera} {frame}" for camera, frame in zip(rig.corners.cameras, rig.corners.frames, strict=True))
    with pytest.raises(GeometryError, match="no two of cam0, cam1 that hang together"):
        calibrate_rig(replace(rig.noisy(0.1, 1), frames=frames), setups(rig))


@pytest.mark.slow
def test_cameras_may_begin_from_calibrations_held_or_refined():
    rig = pair(14)
    noisy = rig.noisy(0.1, 1)
    off = torch.tensor([8.0, 8.0, 4.0, -3.0, 0.0, 0, 0, 0], dtype=torch.float64)
    kinds = {
        "cam0": CameraSetup(PINHOLE.image_size, start=PINHOLE, hold=True),
        "cam1": CameraSetup(FISHEYE_220.image_size, start=FISHEYE_220.with_parameters(FISHEYE_220.parameters + off)),
    }
    result = calibrate_rig(noisy, kinds)
    held, refined = result.members
    assert torch.equal(held.model.parameters, PINHOLE.parameters) and not held.covariance.any() and held.held
    assert abs(refined.model.parameters[0] - FISHEYE_220.parameters[0]) < 4.5 * refined.sigma["fx"]
    anew = calibrate_rig(noisy, setups(rig))
    assert refined.sigma["fx"] < anew.member("cam1").sigma["fx"]
    wrong = CameraSetup(FISHEYE_220.image_size, start=PINHOLE.with_parameters(PINHOLE.parameters * 0.5), hold=True)
    with pytest.raises(GeometryError, match="found no two of"):
        calibrate_rig(noisy, {**kinds, "cam1": wrong})


def test_gross_errors_are_rejected_and_views_too_small_alone_are_used():
    """A twentieth of the corners far off; views of three corners or of one row at the rim of the other camera's."""
    rig = pair(20, seed=4)
    corners = rig.noisy(0.1, 1)
    rng = np.random.default_rng(2)
    keep = np.ones(len(corners), dtype=bool)
    small = []
    for v, camera in enumerate(corners.cameras):
        rows = np.flatnonzero(corners.view == v)
        if camera == "cam1" and v % 4 == 0:
            keep[rows[3:] if v % 8 == 0 else rows[np.abs(corners.board_m[rows, 1] - corners.board_m[rows[0], 1]) > 1e-9]] = False
            small.append(v)
    wrong = rng.random(len(corners)) < 0.05
    wrong &= ~np.isin(corners.view, small)
    pixels = corners.pixels + np.where(wrong[:, None], rng.uniform(-40, 40, corners.pixels.shape), 0.0)
    corners = replace(corners, view=corners.view[keep], board_m=corners.board_m[keep], pixels=pixels[keep])
    result = calibrate_rig(corners, setups(rig))
    assert len(small) == 5 and all(result.views[v].used for v in small)
    missed = result.kept & wrong[keep] & (np.linalg.norm(pixels[keep] - rig.corners.pixels[keep], axis=1) > 1.0)
    assert not missed.any() and (result.kept | wrong[keep]).mean() > 0.995
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.1 and shift < 1e-3


@pytest.mark.parametrize("factors", [(1.0, 5.0), (5.0, 1.0), (1.0, 0.2)])
@pytest.mark.slow
def test_what_one_camera_states_wrongly_spoils_no_corners_of_another(factors: tuple[float, float]) -> None:
    """One scale for all cameras rejected a fifth of the good corners beside one whose noise is stated five times too large."""
    rig = pair(30)
    corners, rng = rig.noisy(NOISE_PX, 1), np.random.default_rng(0)
    camera = np.array([int(name[3:]) for name in rig.corners.cameras or ()])[corners.view]
    false = rng.uniform(size=len(corners)) < 0.02
    angle, length = rng.uniform(0, 2 * math.pi, false.sum()), rng.uniform(1.5, 4.0, false.sum())
    corners.pixels[false] += np.column_stack([length * np.cos(angle), length * np.sin(angle)])
    sigma_px = NOISE_PX * np.array(factors)[camera]
    found = calibrate_rig(replace(corners, sigma_px=sigma_px), setups(rig))
    assert not found.kept[false].any() and false.sum() > 50
    # Of normal residuals one in 25,000 is that far off.
    assert (~found.kept[~false]).mean() < 1e-3
    said = [note for note in found.notes if "times as far from where it sees them" in note]
    assert len(said) == 1 and f"cam{int(np.argmax(np.abs(np.log(factors))))}" in said[0]


def test_malformed_rigs_are_refused():
    rig = pair(6)
    with pytest.raises(InputError, match="Boards are fixed, known, moving, found 'glued'"):
        calibrate_rig(rig.corners, setups(rig), relation="glued")
    with pytest.raises(InputError, match="found views of 'cam1'"):
        calibrate_rig(rig.corners, {"cam0": CameraSetup(PINHOLE.image_size, "pinhole")})
    with pytest.raises(InputError, match=r"found cam0/000.png and cam0/001.png"):
        calibrate_rig(replace(rig.corners, frames=("000", "000", *rig.corners.frames[2:])), setups(rig))
    with pytest.raises(InputError, match="'board' lie on a line or out of a plane"):
        bent = renumbered(rig.corners, [0], lambda board: board + [0, 0, 0.1] * (board[:, :1] > 0.1))
        calibrate_rig(bent, setups(rig), relation="known")
    few = rig.corners.view < 2
    with pytest.raises(GeometryError, match="No camera of the rig can be calibrated"):
        names = rig.corners.view_names[:2]
        calibrate_rig(
            Corners(rig.corners.view[few], names, names, rig.corners.board_m[few], rig.corners.pixels[few]),
            {"cam0": CameraSetup(PINHOLE.image_size, "pinhole")},
        )
