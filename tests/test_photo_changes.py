"""What differs between photos is told from what they share: zoom, crops, rolling shutters, boards that bend in the hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from board_views import BOARD, board_corners, board_views

from camera_models import OpenCVFisheye, Pinhole
from camera_models.pose import rotation_from_vector
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.photo_changes import MEANT
from omnilines.calibration.refine import CameraAndBoards
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.views import board_points
from omnilines.pages.limits import board_advice
from omnilines.records import Corners

VIEWS, NOISE_PX = 14, 0.03
FISHEYE = OpenCVFisheye([420.0, 420.0, 530.0, 364.0, 0.01, -0.005, 0.001, 0.0], (1024, 768)), 75.0
PINHOLE = Pinhole([600.0, 600.0, 530.0, 364.0, 0.0, -0.28, 0.09, *[0.0] * 6], (1024, 768)), 38.0
LENSES = pytest.mark.parametrize(("lens", "reach_deg"), [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])


def seen(lens: OpenCVFisheye | Pinhole, reach_deg: float, seed: int, **changes: float) -> Corners:
    """Photos of a board with noise as stated, and each with a change of its own: standard deviations of `focal` (relative), of
    `centre` (px), of `turn` while all rows are read (rad), of `bend`, and a `shared` bend (m)."""
    rng = np.random.default_rng(seed)
    poses = board_views(lens, reach_deg, VIEWS, seed)
    corners = board_corners(lens, poses, 0.0, 0)
    flat = BoardShape.to_refine(("flatness",), torch.as_tensor(BOARD))
    pixels = corners.pixels.copy()
    for view in range(VIEWS):
        rows = corners.view == view
        bend = torch.as_tensor(changes.get("bend", 0.0) * rng.standard_normal(3))
        bend[0] += changes.get("shared", 0.0)
        state = CameraAndBoards(lens, poses[[view]], flat.moved(flat.free @ bend))
        at = state.seen(board_points(corners, rows, [view]))
        turn = torch.as_tensor(changes.get("turn", 0.0) * rng.standard_normal(3))
        found = lens.project(at)[0]
        for _ in range(5):
            row = (found[:, 1:] + 0.5) / lens.image_size[1] - 0.5
            found = lens.project((rotation_from_vector(row * turn) @ at[..., None])[..., 0])[0]
        larger, moved = 1 + changes.get("focal", 0.0) * rng.standard_normal(), changes.get("centre", 0.0) * rng.standard_normal(2)
        centre = lens.centre_px.numpy()
        pixels[rows] = centre + larger * (found.numpy() - centre) + moved
    pixels = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
    return replace(corners, pixels=pixels, sigma_px=np.full(len(corners), NOISE_PX))


@LENSES
@pytest.mark.parametrize(
    ("change", "size", "kinds"),
    [("focal", 0.02, ("focal",)), ("centre", 8.0, ("centre",)), ("turn", 0.015, ("turn", "motion")), ("bend", 2e-3, ("bend",))],
)
def test_what_differs_between_photos_is_named(
    lens: OpenCVFisheye | Pinhole, reach_deg: float, change: str, size: float, kinds: tuple[str, ...]
) -> None:
    """Photos contradict each other, and nothing said why."""
    corners = seen(lens, reach_deg, 3, **{change: size})
    fit = calibrate_camera(corners, lens.image_size, lens.NAME)
    assert fit.change is not None and fit.change.kind in kinds and fit.change.note in fit.notes
    assert fit.change.before_px > 1.3 * NOISE_PX and fit.change.after_px < 1.5 * NOISE_PX
    if change in ("focal", "centre"):
        assert 0.5 * size < fit.change.size < 1.5 * size
    advice = board_advice(fit, None, corners, compared=False)
    assert advice[0].do == MEANT[fit.change.kind][1]


@LENSES
@pytest.mark.parametrize("shared", [0.0, 2e-3])
def test_what_photos_share_is_no_difference(lens: OpenCVFisheye | Pinhole, reach_deg: float, shared: float) -> None:
    """Nothing at all, and a bend that a term of each photo's own would take up as well."""
    for seed in range(3):
        assert calibrate_camera(seen(lens, reach_deg, seed, shared=shared), lens.image_size, lens.NAME).change is None


def test_what_differs_is_not_told_beyond_the_noise() -> None:
    """Of a lens and a board with other faults, terms of each photo's own take up a part."""
    lens, reach_deg = FISHEYE
    corners = seen(lens, reach_deg, 3, focal=0.02)
    assert calibrate_camera(replace(corners, sigma_px=None), lens.image_size, lens.NAME).change is None
    faint = replace(corners, sigma_px=np.full(len(corners), NOISE_PX / 4))
    assert calibrate_camera(faint, lens.image_size, lens.NAME).change is None


def test_photos_unlike_the_others_are_named_and_left_out() -> None:
    """Two that were cropped and one that was zoomed: "wrong detection or numbering" was said of them."""
    lens, reach_deg = FISHEYE
    corners = seen(lens, reach_deg, 3)
    shifts, larger = {2: (20.0, -12.0), 9: (-15.0, -18.0)}, {5: 1.06}
    centre = lens.centre_px.numpy()
    pixels = corners.pixels.copy()
    for view in {**shifts, **larger}:
        rows = corners.view == view
        pixels[rows] = centre + larger.get(view, 1.0) * (pixels[rows] - centre) + shifts.get(view, (0.0, 0.0))
    inside = ((pixels > 0) & (pixels < np.array(lens.image_size) - 1)).all(1)
    cut = Corners(
        corners.view[inside],
        corners.view_names,
        corners.images,
        corners.board_m[inside],
        pixels[inside],
        np.full(inside.sum(), NOISE_PX),
    )
    fit = calibrate_camera(cut, lens.image_size, lens.NAME)
    reasons = {k: view.reason for k, view in enumerate(fit.views) if not view.used}
    assert reasons == {
        2: "beside the others its image is shifted by 20 px to the right and 12 px up; give it uncropped",
        9: "beside the others its image is shifted by 15 px to the left and 18 px up; give it uncropped",
        5: "beside the others its image is 6 percent larger; give photos of one zoom and focus",
    }
    assert fit.change is None
