"""What a calibration may hold in place of `cam_from_rig`: told by the poses of photos of one instant."""

from jaxtyping import Float
from torch import Tensor

from camera_models import InputError
from camera_models.pose import Pose

CONTRADICTS = 0.1
"""Turn (rad), and move as a share of the baseline, of half of the pairs, up to which poses and rig agree."""
FAR_BETTER = 4.0
"""Times as near as what the rig says another reading of it has to be to what the poses say."""

AT_ODDS, SCATTER = 0.5, 0.2
"""Share of a baseline by which poses and rig are at odds, and that the baselines of poses differ by where they are precise."""
LEAST_PAIRS = 3


def refuse_rig_reading(by_poses: Pose, by_rig: Pose) -> None:
    """`by_poses` and `by_rig` are second_from_first of n pairs of photos of one instant each, by either.

    Raises InputError where half of the pairs are far nearer to the extrinsics read in another way than to what they say, and
    where poses agree on other baselines than those of the rig.
    """
    baseline = float(by_rig.translation.norm(dim=-1).median())
    if baseline:
        _refuse_reading(by_poses, by_rig, baseline)
    found = by_poses.translation.norm(dim=-1)
    middle = float(found.median())
    at_odds = float((by_poses.translation - by_rig.translation).norm(dim=-1).median())
    precise = len(found) >= LEAST_PAIRS and float((found - middle).abs().median()) < SCATTER * middle
    if precise and at_odds > AT_ODDS * max(middle, baseline):
        raise InputError(
            f"Poses and rig of the same cameras were expected, found cameras of one instant {middle:.3g} m apart by their "
            f"poses and {baseline:.3g} m by the rig, or on other sides of each other; give both in metres."
        )


def _refuse_reading(by_poses: Pose, by_rig: Pose, baseline: float) -> None:
    """Raises InputError where another reading of the rig is far nearer to the poses."""
    turn, move = by_rig.rotation, by_rig.translation
    readings = (
        ("inverted (rig_from_cam)", "invert them", by_rig.inverse()),
        ("to hold the camera's centre for t", "give t = -R C", Pose(turn, -(turn @ move[..., None])[..., 0])),
        ("to hold rotations that are transposed", "transpose them", Pose(turn.mT, move)),
        ("to be in millimetres", "divide their translations by 1000", Pose(turn, move / 1000)),
        ("to be in centimetres", "divide their translations by 100", Pose(turn, move / 100)),
    )
    apart = _apart(by_poses, by_rig, baseline)
    found = [_apart(by_poses, read, float(read.translation.norm(dim=-1).median())) for _, _, read in readings]
    best = min(range(len(found)), key=lambda k: found[k])
    if apart > CONTRADICTS and FAR_BETTER * found[best] < apart:
        looks, remedy, _ = readings[best]
        raise InputError(
            f"The extrinsics of the rig look {looks}: read so, the poses of photos of one instant agree with them. "
            f"X_cam = R X_rig + t in metres was expected; {remedy}."
        )


def _apart(by_poses: Pose, by_rig: Pose, baseline: float) -> float:
    """Turn (rad) and move (baselines) together, of the median pair."""
    apart: Float[Tensor, "n 6"] = (by_poses @ by_rig.inverse()).log()
    return float((apart[:, :3].norm(dim=-1) + apart[:, 3:].norm(dim=-1) / baseline).median())
