"""Corners that photos were found to show, kept from one run to the next."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from calib_patterns import Detection
from omnilines.files import Photo
from omnilines.files.folders import output_folder, work_folder
from omnilines.files.kept import read_kept, write_kept
from omnilines.pipelines.kept_results import inputs_of

Looked: TypeAlias = tuple[Detection, str | None, tuple[int, int] | None]
"""What one photo shows of the target, why it was skipped, and its size, None where it was not looked at."""
MADE_BY = (
    "calib_patterns",
    "camera_models",
    "omnilines.photo_file",
    "omnilines.photo_size",
    "omnilines.pipelines.camera_search",
    "omnilines.pipelines.detect",
    __name__,
)
"""Whose source decides what a photo is found to show."""


@dataclass(frozen=True)
class KeptCorners:
    """Those of photos in files, also that a photo shows none, for which it is searched the longest."""

    folder: Path
    asked: str
    """The target and all else that decides what is found."""

    @staticmethod
    def within(work: str | Path, asked: object) -> "KeptCorners":
        """Those of a folder, which is made. Raises InputError as `work_folder` does."""
        return KeptCorners(output_folder(work_folder(work) / "corners"), repr(asked))

    def known(self, item: tuple[Photo, str | None]) -> tuple[str | None, Looked | None]:
        """What the corners of one photo are kept by, and they, where they are."""
        photo, left_out = item
        inputs = None if left_out is not None else inputs_of(photo, self.asked, *MADE_BY)
        arrays = None if inputs is None else read_kept(self.folder / f"{inputs}.npz", inputs)
        if arrays is None:
            return inputs, None
        width, height = arrays["size"].tolist()
        reason = str(arrays["reason"]) or None
        return inputs, (
            Detection(arrays["ids"], arrays["pixels"], arrays["sigma_px"], arrays.get("blur_px")),
            reason,
            (width, height),
        )

    def write(self, inputs: str | None, looked: Looked) -> None:
        """Keep those of a photo that was looked at."""
        found, reason, size = looked
        if inputs is None or size is None:
            return
        arrays = {"ids": found.ids, "pixels": found.pixels, "sigma_px": found.sigma_px}
        arrays |= {"size": np.array(size), "reason": np.array(reason or "")}
        arrays |= {} if found.blur_px is None else {"blur_px": found.blur_px}
        write_kept(self.folder / f"{inputs}.npz", inputs, arrays)
