"""What a frame shows of the board, and whether it tells more than the frames that are kept."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt
from torch import Tensor

from calib_patterns import Detection, Pattern
from camera_models.pose import Pose
from omnilines.calibration.image_field import KnownProjection
from omnilines.calibration.pose_candidates import view_information
from omnilines.guide.options import GuideOptions
from omnilines.pipelines.camera_search import resected


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame and the corners found in it."""

    pixels: UInt[np.ndarray, "h w *channels"]
    found: Detection

    @property
    def blur_px(self) -> float | None:
        """Median over the corners of the more blurred of their two edges."""
        return None if self.found.blur_px is None else float(np.median(self.found.blur_px.max(-1)))

    def apart_px(self, other: "Frame") -> float:
        """Mean distance of the corners that both show; infinite where there are none."""
        _, own, its = np.intersect1d(self.found.ids, other.found.ids, return_indices=True)
        if not len(own):
            return float("inf")
        return float(np.linalg.norm(self.found.pixels[own] - other.found.pixels[its], axis=-1).mean())


def refusal(frame: Frame, kept: list[Frame], options: GuideOptions) -> str | None:
    """Why a frame is not kept whatever the camera is, for who holds the board; None where nothing speaks against it."""
    blurs = [blur for other in kept if (blur := other.blur_px) is not None]
    blur = frame.blur_px
    if blur is not None and blurs and blur > options.blurred_factor * float(np.median(blurs)):
        return "blurred: hold the board still"
    side = max(frame.pixels.shape[:2])
    if any(frame.apart_px(other) < options.apart_share * side for other in kept):
        return "like a frame that is kept: move the board"
    return None


def information_of(frame: Frame, pattern: Pattern, known: KnownProjection, view_sigma_px: float) -> Float[Tensor, "r r"] | None:
    """What the corners of a frame tell of the unknowns of a camera; None where the camera does not say where the board is."""
    pose = resected(pattern, known.field.model, frame.found)
    if pose is None:
        return None
    board = torch.as_tensor(pattern.points_m[frame.found.ids])
    told = view_information(known.field, Pose(pose.rotation[None], pose.translation[None]), board)[0] / view_sigma_px**2
    return known.factor.mT @ told @ known.factor


def gain(known: KnownProjection, information: Float[Tensor, "r r"]) -> float:
    """By which share the largest or the mean uncertainty (of its logarithm) falls with a view, whichever falls more."""
    before, after = known.sigma_px, known.sigma_after_px(information[None])[0]
    return 1 - min(float(after.max() / before.max()), float((after / before).log().mean().exp()))
