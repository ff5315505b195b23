"""How far poses put the cameras of a rig from their places in the calibration, instant by instant."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.posing.options import GivenOptions

LEAST_INSTANTS = 3
"""From which a camera's place in the rig is told, and how well."""

NO_SCATTER = 1e-3
"""Standard deviation, as a share of what it is of, that is not worth a word."""


@dataclass(frozen=True)
class RigOffsets:
    """Of every camera but that of most photos, which it is beside."""

    first: str
    """The camera of most photos."""
    off: Mapping[str, Float[Tensor, "n 6"]]
    """Of each of the others, at each instant that both took: log of (second_from_first by poses) (the same by the rig)^-1, which
    is its left perturbation (rad, m)."""
    told: Mapping[str, Pose]
    """cam_from_rig of every camera in the median of the instants; that of the first is as given."""

    @property
    def tell_all(self) -> bool:
        """Whether enough instants tell the place of each."""
        return bool(self.off) and min(map(len, self.off.values())) >= LEAST_INSTANTS

    def places(self) -> list[str]:
        """In words: the median of the instants, and how uncertain it is by their spread."""
        return [
            f"{name} {_with_sigma(off[:, :3].rad2deg())} degrees and {_with_sigma(1e3 * off[:, 3:])} mm"
            for name, off in self.off.items()
            if len(off) >= LEAST_INSTANTS
        ]

    def contradict(self, options: GivenOptions, least_rad: float, least_m: float) -> bool:
        """Whether a camera is farther off than `rig_sigmas` standard deviations of that median, and than these lengths."""
        for off in self.off.values():
            if len(off) < LEAST_INSTANTS:
                continue
            for part, least in ((off[:, :3], least_rad), (off[:, 3:], least_m)):
                middle, sigma = _median(part)
                if middle > max(options.rig_sigmas * sigma, least):
                    return True
        return False


def photos_beside(
    cameras: Sequence[str], frames: Sequence[int], seen: Sequence[bool]
) -> tuple[str, dict[str, list[tuple[int, int]]]]:
    """The camera of most photos, and of each of the others its photos (second) with those of that camera at the same instants
    (first); photos are counted that are `seen`."""
    at = {(cameras[k], frames[k]): k for k in range(len(cameras)) if seen[k]}
    count = {name: sum(camera == name for camera, _ in at) for name in dict.fromkeys(cameras)}
    first = max(count, key=lambda name: count[name])
    pairs = {
        name: [(at[first, frame], own) for (camera, frame), own in at.items() if camera == name and (first, frame) in at]
        for name in count
        if name != first
    }
    return first, pairs


def rig_offsets(
    cam_from_world: Pose, cam_from_rig: Pose, cameras: Sequence[str], first: str, pairs: Mapping[str, Sequence[tuple[int, int]]]
) -> RigOffsets:
    """Of photos with poses, and with the place of their cameras in the rig as the calibration has it."""
    first_from_rig = cam_from_rig[cameras.index(first)]
    off, told = {}, {first: first_from_rig}
    for name, own in pairs.items():
        by_rig = second_from_first(cam_from_rig, own) if own else Pose.identity(0)
        off[name] = (second_from_first(cam_from_world, own) @ by_rig.inverse()).log() if own else torch.zeros(0, 6).double()
        told[name] = (
            Pose.exp(off[name].median(0).values) @ by_rig[0] @ first_from_rig if own else cam_from_rig[cameras.index(name)]
        )
    return RigOffsets(first, off, told)


def second_from_first(poses: Pose, pairs: Sequence[tuple[int, int]]) -> Pose:
    """Of each pair of photos."""
    first, second = (list(rows) for rows in zip(*pairs, strict=True))
    return poses[second] @ poses[first].inverse()


def _median(off: Float[Tensor, "n 3"]) -> tuple[float, float]:
    """Length of the median of some vectors, and its standard deviation."""
    return float(off.median(0).values.norm()), float(off.std(0).norm()) / math.sqrt(len(off))


def _with_sigma(off: Float[Tensor, "n 3"]) -> str:
    middle, sigma = _median(off)
    # Poses that another rig gave do not scatter.
    return f"{rounded(middle)} (± {rounded(sigma, 1)})" if sigma > NO_SCATTER * middle else rounded(middle)
