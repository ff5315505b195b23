"""What to shoot next, of photos of a target and the camera that was calibrated from them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt

from calib_patterns import Pattern
from camera_models import CameraModel, InputError
from omnilines.calibration.next_pose import NextViews, next_views
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.thresholds import ShootingThresholds
from omnilines.files import Photo
from omnilines.records import Corners

LOOKED_AT = 6
"""Photos in which the rim of the lens is looked for."""
RAYS = 180
"""From the centre outwards."""
STEPS = 400
"""Along the longest ray."""
LEAST_RAYS = 0.25
"""Share of the rays that must still be in the image for a ring to tell."""


def next_views_of(
    fit: CameraCalibration,
    corners: Corners,
    photos: Sequence[Photo],
    pattern: Pattern | None = None,
    thresholds: ShootingThresholds = ShootingThresholds(),
) -> NextViews | None:
    """Of a calibration from these corners. Where no photo is at hand, the lens is taken to show the world as far as the nearest
    border of the image, or as the outermost corner."""
    if not fit.covariance.any():
        return None
    model = fit.model
    centre, reach = model.centre_px.detach().numpy(), _reach_px(model, corners.pixels[fit.kept])
    rings = _brightest_rings(photos, model)
    if rings is None:
        to_border = min(*(centre + 0.5), *(np.array(model.image_size) - 0.5 - centre))
        rim: float | None = max(reach, float(to_border))
    else:
        rim = lens_rim_px(*rings, reach, thresholds.rim_share)
    board = None if pattern is None else pattern.points_m
    return next_views(fit, corners, rim_px=rim, rim_seen=rings is not None, board_m=board, thresholds=thresholds)


def rim_in_photos(
    photos: Sequence[Photo],
    model: CameraModel,
    seen_px: Float[np.ndarray, "n 2"],
    rim_share: float = ShootingThresholds().rim_share,
) -> float | None:
    """`lens_rim_px` of a camera in its photos, which saw the world at some pixels; None also where no photo can be read."""
    rings = _brightest_rings(photos, model)
    return None if rings is None else lens_rim_px(*rings, _reach_px(model, seen_px), rim_share)


def _reach_px(model: CameraModel, seen_px: Float[np.ndarray, "n 2"]) -> float:
    return float(np.linalg.norm(seen_px - model.centre_px.detach().numpy(), axis=-1).max())


def lens_rim_px(
    radii_px: Float[np.ndarray, " r"], brightness: Float[np.ndarray, " r"], reach_px: float, rim_share: float
) -> float | None:
    """The least distance from the centre, beyond that of the outermost corner, at which photos are dark: below this share of the
    median within; None where they are bright up to the border."""
    dark = (radii_px > reach_px) & (brightness < rim_share * np.median(brightness[radii_px <= reach_px]))
    return float(radii_px[dark.argmax()]) if dark.any() else None


def _brightest_rings(
    photos: Sequence[Photo], model: CameraModel
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]] | None:
    """Distances from the centre and, at each, the median over all directions of the largest value in any of some photos: what is
    dark in all of them is no part of the world. None where none of them can be read."""
    width, height = model.image_size
    radii = np.linspace(0, model.image_radius_px, STEPS + 1)[1:]
    turn = 2 * np.pi * np.arange(RAYS) / RAYS
    places = model.centre_px.detach().numpy() + radii[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    inside = ((places >= 0) & (places <= np.array([width, height]) - 1)).all(-1)
    column, row = (np.where(inside, places[..., k], 0).round().astype(int) for k in (0, 1))
    brightest = None
    for k in np.unique(np.linspace(0, len(photos) - 1, LOOKED_AT).astype(int)) if photos else ():
        try:
            pixels: UInt[np.ndarray, "h w *channels"] = photos[k].read()
        except InputError:
            continue
        if pixels.shape[1::-1] == model.image_size:
            own = pixels[row, column].reshape(*inside.shape, -1).max(-1).astype(np.float64)
            brightest = own if brightest is None else np.maximum(brightest, own)
    if brightest is None:
        return None
    told = inside.mean(-1) >= LEAST_RAYS
    return radii[told], np.nanmedian(np.where(inside, brightest, np.nan)[told], axis=-1)
