"""Places in the image, poses of the board and what limits a calibration, in words for who holds the board."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.calibration.by_views import LEAST_VIEWS
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.image_field import ImageField
from omnilines.calibration.pose_candidates import Candidates, SeenBoards
from omnilines.calibration.thresholds import ShootingThresholds

SIDES = ("right", "lower right", "lower", "lower left", "left", "upper left", "upper", "upper right")
"""Of the image, from u towards v."""
MIDDLE_SHARE, RIM_SHARE = 0.2, 0.85
"""Of the way from the centre to the edge of what the image shows: up to there it is the middle, from there the rim."""
SQUARE_SHARE = 0.1
"""Sides of a board that differ by less are not told apart."""


def px_words(value_px: float) -> str:
    """A number of pixels with two digits."""
    return f"{value_px:.0f}" if value_px >= 10 else rounded(value_px)


def sigma_words(sigma_px: float, most_px: float) -> str:
    """A standard deviation of the projection; above `most_px` it is not one (`most_stated_px`)."""
    return f"{px_words(sigma_px)} px" if sigma_px <= most_px else "not known"


def fall_words(now_px: float, then_px: float, most_px: float) -> str:
    """What a photo does to the largest standard deviation of the projection."""
    if then_px > most_px:
        return "the largest uncertainty would still not be known"
    if now_px > most_px:
        return f"the largest uncertainty, not known now, would be {px_words(then_px)} px"
    return f"the largest uncertainty would fall from {px_words(now_px)} to {px_words(then_px)} px"


def side_words(direction: Float[Tensor, "2"]) -> str:
    """The side of the image that a direction points to."""
    return SIDES[int(_side(direction[None]))]


def place_words(field: ImageField, place_px: Float[Tensor, "2"], corners_px: Float[Tensor, "n 2"] | None = None) -> str:
    """Where in the image a place is, or a board whose middle is there and whose corners may reach further."""
    share = float(field.shares_of_the_way(place_px[None]))
    if share < MIDDLE_SHARE:
        return "in the middle of the image"
    side = side_words(place_px - field.model.centre_px.detach())
    outermost = share if corners_px is None else float(field.shares_of_the_way(corners_px).max())
    return f"at the {side} rim of the image" if outermost > RIM_SHARE else f"half way to the {side} rim of the image"


def pose_words(field: ImageField, board_m: Float[Tensor, "n 3"], boards: Candidates, chosen: int) -> str:
    """Where and how to hold the board."""
    pose, place = boards.poses[chosen], boards.places_px[chosen]
    pixels, valid = field.model.project(pose.transform(board_m))
    parts = [place_words(field, place, pixels[valid & field.shows(pixels)])]
    middle = pose.transform(board_m.mean(0, keepdim=True))
    _, _, by_point, _ = field.model.project_with_jacobians(middle)
    width, height = (board_m.amax(0) - board_m.amin(0))[:2].tolist()
    if abs(width - height) > SQUARE_SHARE * max(width, height):
        across = by_point[0] @ pose.rotation[:, 0 if width > height else 1]
        parts.append(f"its long side {'level' if abs(float(across[0])) > abs(float(across[1])) else 'upright'}")
    tilt = float(boards.tilt_deg[chosen])
    if tilt > 0:
        side = side_words(by_point[0] @ boards.nearer[chosen])
        parts.append(f"tilted by {tilt:.0f} degrees with its {side} side nearer to the camera")
    else:
        parts.append("facing the camera")
    return ", ".join([*parts, f"about {_length(float(middle.norm()))} away"])


def _length(length_m: float) -> str:
    return f"{rounded(100 * length_m)} cm" if length_m < 0.995 else f"{rounded(length_m)} m"


def limits_of(
    field: ImageField,
    corners_px: Float[Tensor, "n 2"],
    poses: Pose,
    seen: SeenBoards,
    corner_sigma_px: float,
    thresholds: ShootingThresholds,
) -> tuple[str, ...]:
    """What limits a calibration from corners in these places by boards in these poses, one sentence each."""
    middles = poses.transform(seen.board_m.mean(0).expand(len(poses), 1, 3))[:, 0]
    straight = (middles * poses.rotation[..., 2]).sum(-1).abs() / middles.norm(dim=-1).clamp_min(1e-300)
    most_deg = math.degrees(float(torch.acos(straight.clamp(max=1)).max()))
    told = _uncovered(field, corners_px, thresholds.uncovered_share)
    if most_deg < thresholds.facing_deg:
        told += (f"All boards face the camera: none is tilted by more than {most_deg:.0f} degrees.",)
    if len(poses) < thresholds.few_views:
        untold = "" if len(poses) >= LEAST_VIEWS else ", too few to tell whether they contradict each other"
        told += (f"There are only {len(poses)} views{untold}.",)
    if corner_sigma_px > thresholds.noisy_px:
        told += (
            f"Corners are good to {px_words(corner_sigma_px)} px only: blurred or noisy photos, a board that is not flat, or "
            "a model that does not suit the lens.",
        )
    return told or ("Nothing stands out: the noise of the corners and the number of photos.",)


def _uncovered(field: ImageField, corners_px: Float[Tensor, "n 2"], uncovered_share: float) -> tuple[str, ...]:
    """How far the corners reach, where that is not to the rim."""
    sides = range(len(SIDES))
    centre = field.model.centre_px.detach()
    edge_deg = torch.rad2deg(angles_off_axis(field.model, field.edge_px))
    of_edge, of_corner = _side(field.edge_px - centre), _side(corners_px - centre)
    shares, angles = field.shares_of_the_way(corners_px), torch.rad2deg(angles_off_axis(field.model, corners_px))
    far_deg = [float(edge_deg[of_edge == k].median()) for k in sides]
    reach = [max(shares[of_corner == k].tolist(), default=0.0) for k in sides]
    bare = sorted((k for k in sides if 1 - reach[k] > uncovered_share), key=lambda k: reach[k])
    if not bare:
        return ()
    if len(bare) == len(SIDES):
        within = f"beyond {float(angles.max()):.0f} degrees off axis, where the image reaches to {max(far_deg):.0f}"
        return (f"No corner lies {within}.",)
    worst, *others = bare
    own = angles[of_corner == worst].tolist()
    where = f"beyond {max(own):.0f} degrees off axis" if own else "at all"
    named = [SIDES[k] for k in others]
    listed = " and ".join(filter(None, [", ".join(named[:-1]), *named[-1:]]))
    too = f"; the {listed} rim {'lack' if len(named) > 1 else 'lacks'} corners too" if named else ""
    reaches = f", which reaches to {far_deg[worst]:.0f}" if own else ""
    return (f"No corner lies {where} at the {SIDES[worst]} rim of the image{reaches}{too}.",)


def _side(directions: Float[Tensor, "n 2"]) -> Int[Tensor, " n"]:
    """Which of SIDES directions point to."""
    turn = torch.atan2(directions[:, 1], directions[:, 0]) / (2 * math.pi)
    return torch.round(turn * len(SIDES)).long() % len(SIDES)
