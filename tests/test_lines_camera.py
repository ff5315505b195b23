"""A camera from straight lines against edges drawn with known noise: exact derivatives, honest covariances, an honest check."""

import math
from dataclasses import fields, replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from drawn_chains import FISHEYE, OPTIONS, disturbed, level_chains, true_chains

import omnilines as ol
from camera_models import MODELS, CameraModel, ExtendedUnified, Pinhole, model_class
from omnilines.calibration.held_out import HeldOut, ViewTerms
from omnilines.calibration.lines.camera import LineAdjustment, LineCamera, focal_length, in_mirror, line_camera
from omnilines.calibration.lines.problem import Families
from omnilines.calibration.lines.readings import EdgeReadings, Offsets, offsets
from omnilines.calibration.lines.select import LineTrial, candidates_of, chosen_camera, chosen_trial, trial_of
from omnilines.calibration.lines.start import ShapeStart
from omnilines.calibration.lines.straight import RadialShape
from omnilines.calibration.lines.weighting import WeightedChains, weighted_chains
from omnilines.calibration.select import Candidate
from omnilines.calibration.thresholds import HeldOutThresholds
from omnilines.evaluation.cameras import bearing_error_deg
from omnilines.geometry.chains import Chains
from omnilines.pipelines import line_camera as line_camera_module
from omnilines.pipelines.calibrate import CalibrationResult
from omnilines.pipelines.chain_starts import CameraStart
from omnilines.pipelines.line_camera import adjusted_camera, prior_with_boards, readjusted_camera
from omnilines.pipelines.line_families import chain_circles
from omnilines.pipelines.line_options import LinesOptions
from omnilines.pipelines.line_scale import scaled, with_scale_of_all, without_doubtful_angles
from omnilines.structure.circles import Circles

CALIBRATED = [model for name, _ in MODELS for model in model_class(name).examples() if model.CALIBRATED]


@pytest.mark.parametrize("model", CALIBRATED, ids=lambda model: model.NAME)
def test_derivatives_of_distances_are_those_of_the_condition_that_holds_at_the_curve(model: CameraModel) -> None:
    rng = torch.Generator().manual_seed(0)
    size = torch.tensor(model.image_size, dtype=torch.float64)
    place = (0.25 + 0.5 * torch.rand(40, 2, generator=rng, dtype=torch.float64)) * size
    bearing, _ = model.unproject(place)
    normal = torch.nn.functional.normalize(torch.linalg.cross(bearing[:20], bearing[20:]), dim=-1)
    gradient = (normal[:, None] @ model.unproject_jacobian(place[:20]))[:, 0]
    across = torch.nn.functional.normalize(gradient, dim=-1)
    points, chain = place[:20] + 0.7 * across, torch.arange(20)
    one = torch.ones(20, dtype=torch.float64)
    readings = EdgeReadings(torch.zeros(20, dtype=torch.long), 1, chain, points, across, one, one)
    found = offsets(model, readings, normal)
    assert bool(found.valid.all()) and float((found.px + 0.7).abs().max()) < 0.05

    def off(parameters: torch.Tensor, circle: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        seen, _ = model.with_parameters(parameters).unproject(points + t[:, None] * across)
        return (seen * circle).sum(-1)

    by_parameter, by_circle, by_t = torch.autograd.functional.jacobian(off, (model.parameters, normal, found.px))
    slope = by_t.diagonal()[:, None]
    assert float(off(model.parameters, normal, found.px).abs().max()) < 1e-9
    torch.testing.assert_close(found.by_parameter, -by_parameter / slope, rtol=1e-8, atol=1e-8 * float(by_parameter.abs().max()))
    torch.testing.assert_close(found.by_circle, -by_circle.diagonal(dim1=0, dim2=1).mT / slope, rtol=1e-8, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in range(1, 6))])
def test_camera_comes_back_from_a_disturbed_start_within_its_covariance(seed: int) -> None:
    chains = true_chains(FISHEYE, seed)
    start = disturbed(FISHEYE, fx=6.0, fy=6.0, cx=-5.0, cy=4.0, k1=0.01)
    done = adjusted_camera(start, chains)
    fit = line_camera(done, chains.images, OPTIONS)
    assert done.settled and not fit.open_terms and done.families.frames == 6
    rms_deg, _ = bearing_error_deg(fit.model, FISHEYE, math.radians(90.0))
    assert rms_deg < 0.1 < bearing_error_deg(start, FISHEYE, math.radians(90.0))[0]
    # Of 8 degrees of freedom; once in 1e4.
    assert mahalanobis(fit, FISHEYE) < 32.0
    # What is known of right angles before takes a small share.
    assert 0.9 < sum(photo.leverage for photo in fit.photos) < 1.001


ROUGH = replace(OPTIONS, rounds=1)
NO_SHAPE = ShapeStart(RadialShape(np.zeros(2), np.zeros(3), 1.0), 1.0, 0.0, 0.0, np.zeros(0, dtype=bool), 0.0)
NO_SCALE = CameraStart(NO_SHAPE, 0.0, math.inf, 0.0, FISHEYE.image_size)
GUIDE = Candidate(FISHEYE.NAME, {})


@pytest.mark.full
def test_a_camera_at_a_wrong_scale_is_brought_to_that_of_the_right_angles_of_all_photos() -> None:
    """Lines are as straight there, and families meet as well; none of them is at right angles."""
    chains, factor = true_chains(FISHEYE, 0), 1.4
    wrong = scaled(FISHEYE, factor, math.radians(95.0))
    rays = torch.nn.functional.normalize(torch.tensor([[0.3, -0.2, 1.0], [1.0, 0.5, 0.1]], dtype=torch.float64), dim=-1)
    stretched = rays * torch.tensor([1.0, 1.0, factor], dtype=torch.float64)
    assert float((wrong.project(stretched)[0] - FISHEYE.project(rays)[0]).norm(dim=-1).max()) < 2.0
    done = adjusted_camera(wrong, chains, ROUGH)
    assert not done.families.frames and bearing_error_deg(done.model, FISHEYE, math.radians(90.0))[0] > 2.0
    start, found = with_scale_of_all(NO_SCALE, done, chains, GUIDE, LinesOptions())
    assert found.families.frames == 6 and found.settled and abs(math.log(start.focal_px / 230.4)) < 0.2
    assert mahalanobis(line_camera(found, chains.images, OPTIONS), FISHEYE) < 32.0
    assert with_scale_of_all(start, found, chains, GUIDE, LinesOptions()) == (start, found)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.1, pytest.param(0.9, marks=pytest.mark.full)])
def test_walls_at_85_degrees_are_not_taken_for_right_angles(factor: float) -> None:
    """Photos in which both walls show agree on a focal length 10 percent off, as if their angle were a right one."""
    chains = level_chains(WIDE, 0, 85.0)
    held = adjusted_camera(scaled(WIDE, factor, math.radians(50.0)), chains)
    off, sigma = focal_off(held, chains)
    assert held.families.frames and abs(off) > 0.05 and abs(off) > 20.0 * sigma
    _, done, lines, doubts = without_doubtful_angles(NO_SCALE, held, chains, GUIDE, LinesOptions())
    off, sigma = focal_off(done, chains)
    assert not done.families.frames and abs(off) < 2.0 * sigma
    assert not lines.adjustment.right_angles and len(doubts) == 1 and "Right angles are not used" in doubts[0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in range(1, 6))])
def test_walls_at_88_degrees_tell_the_focal_length_as_far_as_both_explanations_agree(seed: int) -> None:
    chains = level_chains(FISHEYE, seed, 88.0, tilt_rad=0.1)
    held = adjusted_camera(FISHEYE, chains)
    start, done, lines, doubts = without_doubtful_angles(NO_SCALE, held, chains, GUIDE, LinesOptions())
    off, sigma = focal_off(done, chains)
    assert not done.families.frames and not lines.adjustment.right_angles
    assert abs(off) < 3.0 * sigma < 0.2 and start.focal_sigma == done.prior.scale_sigma
    assert "tell the focal length to" in doubts[0]
    begun = disturbed(FISHEYE, fx=5.0, fy=5.0)
    other = readjusted_camera(begun, done, OPTIONS)
    assert other.prior.scale_sigma == start.focal_sigma
    assert abs(focal_length(other.model)[0] / focal_length(begun)[0] - 1.0) < 2.0 * start.focal_sigma


@pytest.mark.slow
def test_right_angles_that_are_decisive_stay() -> None:
    chains = level_chains(FISHEYE, 0, 90.0, tilt_rad=0.15)
    done, lines = adjusted_camera(FISHEYE, chains), LinesOptions()
    assert without_doubtful_angles(NO_SCALE, done, chains, GUIDE, lines) == (NO_SCALE, done, lines, ())
    off, sigma = focal_off(done, chains)
    assert abs(off) < 4.0 * sigma < 0.01


def focal_off(done: LineAdjustment, chains: Chains) -> tuple[float, float]:
    """Error and standard deviation of the focal length, as shares of that of the true camera of this kind."""
    fit = line_camera(done, chains.images, OPTIONS)
    true = float({"pinhole": WIDE, "opencv-fisheye": FISHEYE}[fit.model.NAME].parameters[0])
    return float(fit.model.parameters[0]) / true - 1.0, fit.sigma["fx"] / true


def mahalanobis(fit: LineCamera, truth: CameraModel) -> float:
    """Squared error over covariance: chi-square of 8 degrees of freedom for this fisheye."""
    change = fit.model.parameters - truth.parameters
    return float(change @ torch.linalg.solve(torch.as_tensor(fit.covariance), change))


@pytest.mark.slow
def test_right_angles_that_are_off_are_in_the_covariance() -> None:
    """All photos show a building alike whose right angles are off by 0.3 degrees: so is the focal length, and that is known."""
    done, fits = [], []
    for off_rad in (0.0, 0.005):
        chains = true_chains(FISHEYE, 2, photos=4, lines=50, off_rad=off_rad, spread=0.2)
        done.append(adjusted_camera(FISHEYE, chains))
        fits.append(line_camera(done[-1], chains.images, OPTIONS))
        assert mahalanobis(fits[-1], FISHEYE) < 32.0
    assert max(done[0].problem.angles.shared) < 1e-3 < min(done[1].problem.angles.shared) < 0.01
    assert fits[1].sigma["fx"] > 2.0 * fits[0].sigma["fx"]
    assert any("Right angles" in note for note in fits[1].notes) and not any("Right angles" in note for note in fits[0].notes)


@pytest.mark.slow
def test_what_boards_say_counts_as_if_it_were_adjusted_with_the_lines() -> None:
    """Photos of one half stand for boards: camera and covariance. With the lines of the other they are all photos at once."""
    both = true_chains(FISHEYE, 4, lines=40)
    early = both.image < 3
    first, second = both.of_chains(early), both.of_chains(~early)
    boards = line_camera(adjusted_camera(FISHEYE, first), both.images, OPTIONS)
    alone = line_camera(adjusted_camera(FISHEYE, second), both.images, OPTIONS)
    prior = prior_with_boards(boards.model, torch.as_tensor(boards.covariance), second, OPTIONS)
    joint = line_camera(adjusted_camera(boards.model, second, prior=prior), both.images, OPTIONS)
    whole = line_camera(adjusted_camera(FISHEYE, both), both.images, OPTIONS)
    off = joint.model.parameters - whole.model.parameters
    # Covariances are by the scatter of chains: halves do not weigh quite as the whole has them.
    assert float(off @ torch.linalg.solve(torch.as_tensor(whole.covariance), off)) < 8.0
    for name, sigma in joint.sigma.items():
        assert sigma < 1.05 * min(boards.sigma[name], alone.sigma[name])
    assert mahalanobis(joint, FISHEYE) < 32.0


@pytest.mark.slow
def test_right_angles_that_only_a_later_round_shows_count_as_if_the_first_had(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos of discs and few lines: no frame stands out under the start, and one does once the camera is nearly right."""
    chains, looks, found = true_chains(FISHEYE, 0), Mock(), line_camera_module.families_of

    def nothing_at_first(model: CameraModel, weighted: WeightedChains, *arguments: Any) -> Families:
        looks()
        return Families.none(weighted.blocks.chains) if looks.call_count == 1 else found(model, weighted, *arguments)

    monkeypatch.setattr(line_camera_module, "families_of", nothing_at_first)
    done = adjusted_camera(disturbed(FISHEYE, fx=6.0, fy=6.0), chains)
    assert looks.call_count > 1 and done.families.frames == 6
    assert mahalanobis(line_camera(done, chains.images, OPTIONS), FISHEYE) < 32.0


WIDE = Pinhole([320.0, 320.5, 322.5, 238.0, 0.0, -0.22, 0.05, 4e-4, -3e-4, -0.004, 0, 0, 0], (640, 480))
RATIONAL = Pinhole([320.0, 320.5, 322.5, 238.0, 0.0, 0.9, 0.05, -1e-4, 2e-4, 0.001, 1.2, 0.22, 0.01], (640, 480), 8)


@pytest.mark.slow
@pytest.mark.parametrize("lens", [WIDE, FISHEYE], ids=lambda lens: lens.NAME)
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in range(1, 6))])
def test_without_right_angles_the_scale_stays_open_and_is_said(lens: CameraModel, seed: int) -> None:
    """Of a lens whose terms follow any scale, and of one whose terms do so for a while only: noise drew its focal length from 230
    px down to 171, where it seemed to be known to 6."""
    chains = true_chains(lens, seed, axes=1)
    begun = disturbed(lens, fx=9.0, fy=9.0)
    done = adjusted_camera(begun, chains)
    fit = line_camera(done, chains.images, OPTIONS)
    assert done.settled and any("fx" in names and "fy" in names for names in fit.open_terms)
    assert "focal length" in fit.notes[0]
    assert focal_length(fit.model)[0] == pytest.approx(focal_length(begun)[0], rel=0.005)
    assert fit.sigma["fx"] > 0.1 * float(lens.parameters[0])
    other = readjusted_camera(disturbed(lens, fx=-9.0, fy=-9.0), done, OPTIONS)
    assert other.leaves_scale_open(OPTIONS.open_share)
    assert focal_length(other.model)[0] == pytest.approx(float(lens.parameters[0]) - 9.0, rel=0.005)


@pytest.mark.parametrize("lost", [0, 3, -1])
def test_a_chain_that_the_camera_sees_nowhere_has_a_circle_of_which_nothing_is_known(lost: int) -> None:
    chains = weighted_chains(WIDE, EdgeReadings.of(true_chains(WIDE, 1, photos=3, lines=12)), OPTIONS)
    gone = chains.blocks.chain != lost % chains.blocks.chains
    at = Offsets(*(getattr(chains.at, field.name)[gone] for field in fields(Offsets)))
    whole, rest = (chain_circles(WIDE, one) for one in (chains, replace(chains, blocks=chains.blocks.of_points(gone), at=at)))
    others = np.arange(chains.blocks.chains) != lost % chains.blocks.chains
    for field in fields(Circles):
        axis = 1 if field.name in ("noise", "ends") else 0
        both = (np.compress(others, getattr(one, field.name), axis) for one in (whole, rest))
        np.testing.assert_allclose(*both, rtol=1e-12, atol=1e-12)
    assert np.linalg.norm(rest.noise[:, lost], axis=-1).min() > 100 * np.linalg.norm(whole.noise[:, lost], axis=-1).max()


@pytest.mark.slow
@pytest.mark.parametrize(("lens", "taken"), [(WIDE, 5), pytest.param(RATIONAL, 8, marks=pytest.mark.full)])
def test_the_larger_variant_is_taken_where_the_lens_has_it(lens: Pinhole, taken: int) -> None:
    chains = true_chains(lens, 0, photos=8, lines=90)
    plain, thresholds = [320.0, 320.0, 322.0, 239.0, 0.0, -0.2, 0.03], HeldOutThresholds()
    done = adjusted_camera(Pinhole([*plain, *([0.0] * 6)], lens.image_size), chains)
    near = Pinhole(disturbed(lens, fx=3.0, fy=3.0).parameters, lens.image_size, 8)
    both = zip(candidates_of("pinhole", {}), (done, readjusted_camera(near, done, OPTIONS)), strict=True)
    selection = chosen_trial(
        [trial_of(candidate, one, thresholds.beyond_factor, OPTIONS.open_share) for candidate, one in both], thresholds
    )
    assert selection.chosen.candidate.options == {"coefficients": taken}
    assert selection.chosen.model is not None
    assert bearing_error_deg(selection.chosen.model, lens, math.radians(40.0))[0] < 0.1


@pytest.mark.parametrize(
    ("saved", "taken"),
    [
        pytest.param([-0.2, -1.9, 3.0, 2.7, 4.9, 2.2, 0.0], 5, id="chance"),
        pytest.param([-60.0, 90.0, 80.0, -50.0, 120.0, 20.0, -10.0], 5, id="much-but-chance"),
        pytest.param([3.1, 2.7, 3.0, 2.7, 3.9, 2.2, 3.3], 8, id="in-all-photos"),
    ],
)
def test_a_larger_variant_is_taken_for_what_all_photos_gain_alone(saved: list[float], taken: int) -> None:
    """The first are the gains of rational distortion in seven photos of `york`: k1 49 +- 90, k4 49 +- 90."""
    left = torch.tensor([940.0, 620.0, 1290.0, 630.0, 1200.0, 950.0, 810.0], dtype=torch.float64)
    counts = 2.0 * left
    trials = [
        LineTrial(one, None, Pinhole(WIDE.parameters, WIDE.image_size, k), HeldOut(9 + k - 5, squares, counts), 0.08, 0.11)
        for one, k, squares in zip(
            candidates_of("pinhole", {}), (5, 8), (left, left - torch.tensor(saved, dtype=torch.float64)), strict=True
        )
    ]
    selection = chosen_trial(trials, HeldOutThresholds())
    assert selection.chosen.candidate.options == {"coefficients": taken}
    assert ("k4 k5 k6 are held at 0" in selection.reason) is (taken == 5)


def test_what_is_known_before_stays_when_a_photo_is_left_out() -> None:
    """Against ridge regression without each view."""
    generator = torch.Generator().manual_seed(0)
    rows, values = (torch.randn(5, 6, k, generator=generator, dtype=torch.float64) for k in (3, 1))
    ridge = torch.diag(torch.tensor([1.0, 50.0, 5.0], dtype=torch.float64))

    def fitted(kept: list[int]) -> torch.Tensor:
        """By some of the views and the ridge."""
        a, b = rows[kept].reshape(-1, 3), values[kept].reshape(-1)
        return torch.linalg.solve(a.mT @ a + ridge, a.mT @ b)

    every = list(range(5))
    at = fitted(every)
    error = (rows @ at)[..., None] - values
    terms = ViewTerms(
        rows.mT @ rows,
        (rows.mT @ error)[..., 0],
        error.square().sum((1, 2)),
        torch.full((5,), 6.0, dtype=torch.float64),
        (ridge, ridge @ at),
    )
    expected = [((rows[v] @ fitted([k for k in every if k != v]))[:, None] - values[v]).square().sum() for v in every]
    torch.testing.assert_close(terms.held_out().squares_px2, torch.stack(expected))


@pytest.mark.parametrize("model", CALIBRATED, ids=lambda model: model.NAME)
def test_the_focal_length_is_the_scale_at_the_centre(model: CameraModel) -> None:
    focal, derivative = focal_length(model)
    names = model.named_parameters()
    if model.NAME != "scaramuzza":
        assert focal == pytest.approx(names["fx"] / (1.0 + names.get("xi", 0.0)), rel=1e-4)
    for k, value in enumerate(model.parameters.tolist()):
        step = torch.zeros(len(derivative), dtype=torch.float64)
        step[k] = 1e-4 * max(abs(value), 1e-3)
        up, down = (focal_length(model.with_parameters(model.parameters + way * step))[0] for way in (1.0, -1.0))
        assert float(derivative[k]) * 2.0 * float(step[k]) == pytest.approx(up - down, rel=1e-3, abs=1e-6 * abs(focal))


@pytest.mark.slow
def test_a_model_is_not_taken_of_which_lines_leave_a_parameter_open() -> None:
    """A lens without distortion is an `extended-unified` camera of alpha 0, whatever beta is."""
    lens = Pinhole([420.0, 420.5, 322.5, 238.0, *([0.0] * 9)], (640, 480))
    chains, thresholds = true_chains(lens, 0, photos=8, lines=90), HeldOutThresholds()
    done = adjusted_camera(Pinhole(disturbed(lens, fx=3.0, fy=3.0).parameters, lens.image_size), chains)
    other = readjusted_camera(ExtendedUnified([420.0, 420.0, 320.0, 240.0, 0.1, 1.0], lens.image_size), done, OPTIONS)
    plain, small = (
        trial_of(Candidate(one.model.NAME, {}), one, thresholds.beyond_factor, OPTIONS.open_share) for one in (done, other)
    )
    assert small.parameters < plain.parameters and small.open_terms and not plain.open_terms
    assert plain.error is not None
    small = replace(small, error=replace(plain.error, parameters=small.parameters))
    taken = chosen_trial([plain, small], thresholds)
    assert taken.chosen is plain and "extended-unified predicts as well, but lines leave open its alpha" in taken.reason
    closed = replace(small, open_terms=())
    assert chosen_trial([plain, closed], thresholds).chosen is closed
    # Adjusted by itself it leaves more open than in the trial.
    selection, camera = chosen_camera(
        [plain, closed], thresholds, lambda trial: other if trial is closed else done, OPTIONS.open_share
    )
    assert selection.chosen is plain and camera is done and selection.reason == taken.reason


@pytest.mark.full
def test_a_mirror_is_the_lens_reflected() -> None:
    """Lines seen by a mirror: the lens that they are straight in, looking the other way, is within its covariance."""
    truth = model_class("scaramuzza")([320.0, 242.0, 1.002, 0.0, 0.0, -140.0, 0.003, -7e-6, 3.4e-8], (640, 480))
    chains = true_chains(truth.reversed(), 5)
    lens = line_camera(adjusted_camera(disturbed(truth.reversed(), cx=2.0, a0=1.5), chains), chains.images, OPTIONS)
    mirror = in_mirror(lens)
    assert lens.model.unproject(lens.model.centre_px)[0][2] > 0 > mirror.model.unproject(mirror.model.centre_px)[0][2]
    change, covariance = mirror.model.parameters - truth.parameters, torch.as_tensor(mirror.covariance)
    free = [0, 1, 2, 3, 5, 6, 7, 8]  # e is d
    assert float(change[free] @ torch.linalg.solve(covariance[free][:, free], change[free])) < 32.0
    assert bearing_error_deg(mirror.model, truth, math.radians(85.0))[0] < 0.1


@pytest.mark.parametrize(("model", "words"), [("opencv-fisheye", "use `model` scaramuzza"), ("scaramuzza", "either alone")])
def test_mirrors_that_are_not_calibrated_from_lines_are_refused(model: str, words: str) -> None:
    boards = None if model != "scaramuzza" else Mock(spec=CalibrationResult)
    with pytest.raises(ol.InputError, match=words):
        ol.calibrate("photos/", "lines", model=model, mirror=True, boards=boards)
