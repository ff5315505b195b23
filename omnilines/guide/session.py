"""A guided calibration: frames are offered, those that tell something are kept, and the camera is calibrated anew from them.

It knows neither where frames come from nor who looks on. `offer` and `refit` may be called from two threads.
"""

import re
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt

from calib_patterns import DetectionOptions, Pattern
from camera_models import InputError
from camera_models.errors import OmnilinesError
from omnilines.calibration.image_field import KnownProjection
from omnilines.calibration.next_pose import NextViews
from omnilines.calibration.options import AUTO, CalibrationOptions
from omnilines.files import PhotoRef, read_photo, write_png
from omnilines.files.folders import check_results, written
from omnilines.files.sets import claimed
from omnilines.guide.frames import Frame, gain, information_of, refusal
from omnilines.guide.options import GuideOptions
from omnilines.pipelines.calibrate import GUIDE, CalibrationResult
from omnilines.pipelines.calibrate_one import calibrate
from omnilines.pipelines.photo_corners import PhotoCorners

FRAMES = "frames"
RESULTS = ("calibration.yaml", "corners.csv", "report.html")


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the camera by now."""

    result: CalibrationResult
    advice: NextViews
    projection: KnownProjection
    """With the frames that were kept since."""


class Session:
    """Frames in, frames kept and a calibration in a folder, advice out."""

    def __init__(
        self,
        pattern: Pattern,
        out: Path,
        options: GuideOptions = GuideOptions(),
        calibration: CalibrationOptions = CalibrationOptions(),
        detection: DetectionOptions = DetectionOptions(),
        *,
        inputs: Sequence[Path] = (),
    ) -> None:
        """Frames that the same command kept in the folder before are taken up. Raises InputError where results may not be
        written there."""
        self.pattern, self.out, self.options = pattern, out, options
        self.calibration = replace(calibration, shooting=calibration.shooting._replace(least_gain=0.0))
        self.detection, self.inputs = detection, tuple(inputs)
        self.kept: list[Frame] = []
        self.names: list[str] = []
        self.offered = 0
        self.message = "show the board to the camera"
        self.last: Frame | None = None
        self.known: Known | None = None
        self.stale = False
        self.over = threading.Event()
        self._lock = threading.Lock()
        self._needed = options.first_frames
        check_results(out, RESULTS, inputs)
        before = sorted(name for name in written(out) if re.fullmatch(FRAMES + r"/[0-9]{4,8}\.png", name))
        self._number = 1 + max((int(Path(name).stem) for name in before), default=-1)
        for name in before:
            frame = self._looked_at(read_photo(out / name)) if (out / name).is_file() else None
            if frame is not None and self._judged(frame)[1]:
                self.kept.append(frame)
                self.names.append(name)
        self.stale = len(self.kept) >= self._needed

    def offer(self, pixels: UInt[np.ndarray, "h w *channels"]) -> bool:
        """Look at a frame; whether it is kept, and written. `message` then says what came of it."""
        frame = self._looked_at(pixels)
        with self._lock:
            self.offered += 1
            self.last = frame
            self.message, keep = self._judged(frame)
            if keep:
                self._keep(frame)
            return keep

    def _looked_at(self, pixels: UInt[np.ndarray, "h w *channels"]) -> Frame:
        found, _ = self.pattern.detect(pixels, mirrored=self.calibration.mirror, options=self.detection)
        return Frame(pixels, found)

    def _judged(self, frame: Frame) -> tuple[str, bool]:
        if not len(frame.found):
            return "no board is found", False
        if self.kept and frame.pixels.shape[:2] != self.kept[0].pixels.shape[:2]:
            return "a frame of another size than those before", False
        if len(frame.found) < self.calibration.views.least_corners:
            return "too little of the board is found", False
        reason = refusal(frame, self.kept, self.options)
        if reason is not None:
            return reason, False
        if self.known is None:
            if self.stale:
                return "the camera is being calibrated", False
            return f"kept, {len(self.kept) + 1} of the first {self._needed}: tilt the board, show it all over the image", True
        projection = self.known.projection
        told = information_of(frame, self.pattern, projection, self.known.advice.view_sigma_px)
        if told is None or gain(projection, told) <= self.options.least_gain:
            return "it would add little", False
        self.known = replace(self.known, projection=projection.with_view(told)[0])
        return f"kept: it lowers the uncertainty by about {100 * gain(projection, told):.0f} percent", True

    def _keep(self, frame: Frame) -> None:
        name = f"{FRAMES}/{self._number:04d}.png"
        self._number += 1
        with claimed(self.out, [name], self.inputs, by=f"guide {name}"):
            write_png(self.out / name, frame.pixels)
        self.kept.append(frame)
        self.names.append(name)
        self.stale = len(self.kept) >= self._needed

    def refit(self, *, final: bool = False) -> None:
        """Calibrate from the frames that are kept, and write it. `final`: with the corners that the camera leads to."""
        with self._lock:
            kept, names = list(self.kept), list(self.names)
            self.stale = False
        if not kept:
            return
        seen = [(PhotoRef(self.out / name, name), frame.found) for name, frame in zip(names, kept, strict=True)]
        height, width = kept[0].pixels.shape[:2]
        found = PhotoCorners.of_detections(
            seen, (width, height), self.pattern, self.out, mirrored=self.calibration.mirror, options=self.detection
        )
        options = self.calibration
        if not final:
            # All models are compared once, at the end.
            options = replace(options, searches=0, model=GUIDE if options.model == AUTO else options.model)
        try:
            result = calibrate(found, options=options)
            advice = result.next_views
        except OmnilinesError as error:
            with self._lock:
                self._needed = len(kept) + 2
                self.message = str(error)
            return
        assert advice is not None
        with claimed(self.out, RESULTS, self.inputs, by="guide"):
            result.save(self.out)
            result.report(self.out / RESULTS[-1])
        with self._lock:
            self.known = Known(result, advice, advice.known)
        if self.options.until_px is not None and advice.worst_px <= self.options.until_px:
            self.over.set()

    def finish(self) -> CalibrationResult:
        """The calibration from all that was kept, written. Raises InputError where that is too little."""
        self.refit(final=True)
        if self.known is None:
            raise InputError(
                f"Frames that calibrate a camera were expected, found {len(self.kept)} that show the board in poses of its own; "
                f"the last reason: {self.message.rstrip('.')}; show it longer."
            )
        return self.known.result
