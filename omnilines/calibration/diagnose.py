"""What a set of board views can and cannot determine: degenerate sets are named, and the field of view that the data support."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel, GeometryError
from camera_models.pose import Pose
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.thresholds import DegeneracyThresholds

AZIMUTHS = 72


def board_spread_deg(cam_from_board: Pose) -> float:
    """Largest angle (degrees) between a board's normal and the mean normal of all boards."""
    normals = cam_from_board.rotation[..., 2]
    _, _, vt = torch.linalg.svd(normals)
    mean = vt[0]
    away = torch.atan2(torch.linalg.cross(normals, mean.expand_as(normals)).norm(dim=-1), (normals @ mean).abs())
    return math.degrees(float(away.max()))


def refuse_parallel_boards(cam_from_board: Pose, limit_deg: float) -> None:
    """Raise GeometryError when all boards are parallel up to this angle: focal length and distance cannot then be told apart."""
    widest = board_spread_deg(cam_from_board)
    if widest < limit_deg:
        raise GeometryError(
            f"Boards tilted against each other were expected, found all boards parallel: {len(cam_from_board)} views within "
            f"{widest:.1f} degrees of each other; add photos with the board tilted by 20 to 45 degrees about different axes."
        )


def tilt_notes(cam_from_board: Pose, limit_deg: float) -> tuple[str, ...]:
    """A sentence where all boards are tilted about one axis: their normals lie in one plane, though not along one line."""
    normals = cam_from_board.rotation[..., 2]
    _, _, vt = torch.linalg.svd(normals)
    from_plane = math.degrees(float(torch.asin((normals @ vt[2]).abs().clamp(max=1)).max()))
    if from_plane > limit_deg:
        return ()
    return (
        f"All boards are tilted about one axis: the normals of {len(cam_from_board)} views lie within {from_plane:.1f} degrees "
        "of one plane, and what the photos say across it is weak; add photos with the board tilted about other axes.",
    )


def refuse_open_camera(
    model: CameraModel,
    covariance: Float[Tensor, "p p"],
    pixels: Float[Tensor, "n 2"],
    cam_from_board: Pose,
    thresholds: DegeneracyThresholds,
) -> None:
    """Raise GeometryError when the angle off axis of the corners is uncertain by more than `open_share` of itself."""
    radius = (pixels - model.centre_px).norm(dim=-1)
    outer = pixels[radius >= radius.median()]
    bearings, _ = model.unproject(outer)
    _, _, _, by_parameter = model.project_with_jacobians(bearings)
    by_parameter = model.unproject_jacobian(outer) @ by_parameter
    spread = (by_parameter @ covariance @ by_parameter.mT).diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0).sqrt()
    share = float((spread / angles_off_axis(model, outer).clamp_min(1e-12)).median())
    if not share <= thresholds.open_share:
        refuse_parallel_boards(cam_from_board, thresholds.nearly_parallel_deg)
        found = f"an uncertainty of {100 * share:.0f} percent" if math.isfinite(share) else "that they do not"
        raise GeometryError(
            f"The corners of {len(cam_from_board)} views were expected to determine the angles of the camera, found {found}; "
            "add photos with the board at other tilts and nearer to the rim."
        )


def refuse_unexplained(points: BoardPoints, residual_px: Float[Tensor, "n 2"], limit_share: float) -> None:
    """Raise GeometryError when the camera leaves more than this share of the spread of the corners in their views."""
    spread = points.pixels - points.mean_by_view(points.pixels)[points.view]
    left_px = float(residual_px.square().sum(-1).mean().sqrt())
    if not left_px <= limit_share * float(spread.square().sum(-1).mean().sqrt()):
        raise GeometryError(
            f"The corners of {points.views} views were expected to be those of one board and one camera, found them "
            f"{left_px:.3g} px (root mean square) from where any camera would see them; check the pattern, the columns of the "
            "table, and that all photos are of one camera."
        )


def angles_off_axis(model: CameraModel, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """Angle (rad) of every pixel's bearing from the bearing of the centre pixel."""
    bearings, _ = model.unproject(pixels)
    axis, _ = model.unproject(model.centre_px)
    sideways = torch.linalg.cross(bearings, axis.expand_as(bearings)).norm(dim=-1)
    return torch.atan2(sideways, (bearings * axis).sum(-1))


def supported_angles_deg(model: CameraModel, pixels: Float[Tensor, "n 2"]) -> tuple[float, float]:
    """Smallest and largest angle off axis (degrees) at which corners were seen; the smallest is 0 unless a blind
    centre is wider than a tenth of the largest."""
    angles = angles_off_axis(model, pixels)
    low, high = math.degrees(float(angles.min())), math.degrees(float(angles.max()))
    return (low if low > 0.1 * high else 0.0), high


def has_blind_centre(model: CameraModel, pixels: Float[Tensor, "n 2"]) -> bool:
    """Whether no corner lies near the centre, for how far they reach: a mirror shows its own camera there."""
    radius = (pixels - model.centre_px).norm(dim=-1)
    return float(radius.min()) > 1 / 3 * float(radius.max())


def coverage_notes(model: CameraModel, pixels: Float[Tensor, "n 2"], image_size: tuple[int, int]) -> tuple[str, ...]:
    """Sentences on parts of the image without corners."""
    radius = (pixels - model.centre_px).norm(dim=-1)
    shorter = min(image_size) / 2
    notes: tuple[str, ...] = ()
    if has_blind_centre(model, pixels):
        notes = (
            f"No corner lies within {float(radius.min()):.0f} px of the centre: the calibration is extrapolated there, and "
            "single parameters, which describe the centre, say little by themselves. Add photos with the board in the middle, "
            "unless a mirror shows the camera there.",
        )
    if float(radius.max()) < 2 / 3 * shorter:
        notes += (
            f"No corner lies in the outer third of the image (the farthest is {float(radius.max()):.0f} px from the centre of "
            f"{shorter:.0f} px): the calibration is extrapolated there; add photos with the board near the rim.",
        )
    return notes


def lost_rim(radius_px: Float[Tensor, " n"], kept: Bool[Tensor, " n"], significance: float) -> tuple[str, ...]:
    """A sentence where all outermost corners were rejected, more in a row than chance explains: gross errors lie anywhere."""
    outward = kept[radius_px.argsort(descending=True)].long()
    count, share = int((outward.cumsum(0) == 0).sum()), 1 - float(outward.double().mean())
    if count == 0 or share**count > significance:
        return ()
    return (
        f"All {count} corners that lie more than {float(radius_px[kept].max()):.0f} px from the centre of the lens are among "
        "them: the model hardly follows the lens there, and ends before its rim; try another --model.",
    )


def grows_beyond(model: CameraModel, pixels: Float[Tensor, "n 2"], beyond_factor: float) -> bool:
    """Whether the model is one-to-one up to `beyond_factor` times the radius of the outermost pixel, within the image."""
    radius = beyond_factor * float((pixels - model.centre_px).norm(dim=-1).max())
    azimuth = 2 * torch.pi * torch.arange(AZIMUTHS, dtype=torch.float64) / AZIMUTHS
    ring = model.centre_px + radius * torch.stack([torch.cos(azimuth), torch.sin(azimuth)], -1)
    limit = torch.tensor(model.image_size, dtype=torch.float64)
    ring = torch.minimum(ring.clamp_min(-0.5), limit - 0.5)
    return bool(model.unproject(ring)[1].all())
