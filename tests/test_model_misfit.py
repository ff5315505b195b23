"""Models that do not follow a lens: residuals that all photos have in common, and what is said of them."""

import json

import numpy as np
import pytest

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from omnilines.calibration.model_misfit import LEAST_PHOTOS, RINGS, ModelMisfit, model_misfit
from omnilines.calibration.single import calibrate_camera
from omnilines.pages.calibration import calibration_data, calibration_summaries
from omnilines.records import Corners
from omnilines.synthetic.targets import board_angle_rad, example_camera, simulate_corners

SIZE = (640, 480)
BOARD = pattern("checkerboard:8x6:30mm")
ALPHA = 1e-3
CENTRE = np.array([319.5, 239.5])


def simulated(model: str, fov_deg: float, seed: int, sigma_px: float = 0.05) -> Corners:
    """Corners of 12 boards as an example camera sees them, with what is stated of them."""
    camera = example_camera(model, fov_deg, SIZE, seed)
    poses = random_board_poses(BOARD, camera, 12, board_angle_rad(fov_deg), seed=seed)
    return simulate_corners(camera, BOARD, poses, sigma_px, seed)


def drawn(seed: int, common_px: float, photos: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Views, pixels and residuals of corners all over the image: noise, a shift of each photo's own, and a wave of the radius."""
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(photos), 40)
    pixels = rng.uniform(0, 1, (len(view), 2)) * SIZE
    offset = pixels - CENTRE
    radius = np.linalg.norm(offset, axis=1, keepdims=True)
    own = rng.normal(0.0, 0.3, (photos, 2))[view]
    return view, pixels, own + rng.normal(0.0, 0.2, pixels.shape) + common_px * np.sin(radius / 40.0) * offset / radius


def test_what_photos_have_in_common_is_told_from_what_they_do_not() -> None:
    """1000 sets without it are said to have it as often as the significance says; sets with it have its size."""
    alarms = sum(model_misfit(*drawn(seed, 0.0), CENTRE, None, 0.02) is not None for seed in range(1000))
    assert 5 <= alarms <= 40
    for seed in range(5):
        found = model_misfit(*drawn(seed, 1.0), CENTRE, None, ALPHA)
        assert found is not None and found.chance < 1e-6 and 0.6 < found.largest_px < 1.3
        assert len(found.outward_px) == RINGS and (np.diff(found.radii_px) > 0).all()


def test_what_is_too_few_tells_nothing() -> None:
    view, pixels, residual = drawn(0, 1.0)
    few = view < LEAST_PHOTOS - 1
    assert model_misfit(view[few], pixels[few], residual[few], CENTRE, None, ALPHA) is None
    same = np.zeros_like(pixels) + CENTRE
    assert model_misfit(view, same, residual, CENTRE, None, ALPHA) is None


def test_a_rejected_corner_counts_no_more_than_the_limit() -> None:
    view, pixels, residual = drawn(3, 0.0)
    residual[view == 0] *= 1000.0
    assert model_misfit(view, pixels, residual, CENTRE, 1.0, ALPHA) is None


@pytest.mark.slow
@pytest.mark.parametrize(("lens", "model"), [("opencv-fisheye", "pinhole"), ("opencv-fisheye", "double-sphere")])
def test_a_model_that_cannot_follow_the_lens(lens: str, model: str) -> None:
    """It is said first, no single figure is given as the camera's, and the advice is another model."""
    corners = simulated(lens, 150.0, 3, 0.01)
    result = ol.calibrate(corners, model=model, image_size=SIZE)
    fit = result.fit
    assert fit.misfit is not None and fit.misfit.chance < ALPHA
    said = " ".join(fit.notes)
    assert f"The {model} model does not follow this lens" in said and "holds all the same" not in said
    first = calibration_summaries(result)[0]
    assert first.verdict is not None and first.verdict.startswith(f"The {model} model does not follow this lens")
    assert "Only if it did would hold: the camera is known to" in first.verdict
    assert [advice.do for advice in first.advice] == ["Try `model` auto, which compares all."]
    assert "What to shoot next" not in [summary.title for summary in calibration_summaries(result)]
    data = json.loads(json.dumps(calibration_data(result)))["misfit"]
    assert data["p"] < ALPHA and len(data["radii_px"]) == len(data["outward_px"]) + 1 == RINGS + 1


@pytest.mark.slow
def test_a_degree_that_no_photos_determine() -> None:
    """More photos are not the only remedy."""
    with pytest.raises(ol.GeometryError, match=r"leave a\d+ open; a lower `degree` may do, or add photos"):
        ol.calibrate(simulated("scaramuzza", 150.0, 3), model="scaramuzza", image_size=SIZE, degree=12)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [6, pytest.param(60, marks=pytest.mark.full)])
def test_a_model_that_follows_the_lens_is_not_blamed(seeds: int) -> None:
    """Nor where corners of one photo at the rim are wrong."""
    for seed in range(seeds):
        model = ("opencv-fisheye", "double-sphere", "unified")[seed % 3]
        corners = simulated(model, 160.0, seed)
        radius = np.linalg.norm(corners.pixels - CENTRE, axis=1)
        last = corners.view == int(corners.view[np.argmax(radius)])
        corners.pixels[last & (radius > 0.8 * radius.max())] += 3.0
        fit = calibrate_camera(corners, SIZE, model)
        assert fit.misfit is None and "does not follow" not in " ".join(fit.notes), (seed, fit.misfit)


@pytest.mark.slow
def test_real_lenses(shared_data) -> None:
    """A pinhole camera with eight terms does not follow a fisheye lens; the models made for it do."""
    corners = ol.read_corners(shared_data / "calibration/fisheye1/corners.csv")
    size = tuple(json.loads((shared_data / "calibration/fisheye1/reference.json").read_text())["image_size"])
    pinhole = calibrate_camera(corners, size, "pinhole").misfit
    assert isinstance(pinhole, ModelMisfit) and pinhole.largest_px > 0.5
    for model in ("opencv-fisheye", "scaramuzza", "double-sphere"):
        assert calibrate_camera(corners, size, model).misfit is None
