"""Options of a guided calibration."""

from dataclasses import dataclass

from camera_models import InputError


@dataclass(frozen=True)
class GuideOptions:
    """Which frames of a guided calibration are kept, and when it is over."""

    until_px: float | None = None
    """The guide ends once the largest standard deviation of the projection, anywhere in the image, is at most this; None: it goes
    on until it is stopped or its source ends."""
    first_frames: int = 6
    """Frames of different poses kept before the camera is calibrated for the first time."""
    apart_share: float = 0.02
    """A frame differs from another where their common corners lie this share of the image's longer side apart, on the mean."""
    least_gain: float = 0.01
    """A frame is kept where it is expected to lower the uncertainty, the largest or the mean, by more than this share."""
    blurred_factor: float = 1.8
    """Frames whose edges are blurred more than this many times as much as those of the kept ones are not kept."""
    frames_per_s: float = 5.0
    """Of a video, the frames that are looked at."""

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        if self.until_px is not None and not self.until_px > 0:
            raise InputError(f"`until` was expected to be more than 0 px, found {self.until_px:g}; give one like 0.1.")
        if not self.frames_per_s > 0:
            raise InputError(f"`frames_per_s` was expected to be more than 0, found {self.frames_per_s:g}; give one like 5.")
