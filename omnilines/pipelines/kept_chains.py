"""Chains of edge points that were found in photos, kept from one run to the next."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from camera_models import CameraModel
from omnilines.extraction.smooth_chains import SmoothChains
from omnilines.files import Photo
from omnilines.geometry.chains import Chains
from omnilines.pipelines.kept_corners import said_of
from omnilines.pipelines.kept_results import inputs_of, keep_arrays, kept_arrays, kept_folder

MADE_BY = (
    "camera_models",
    "omnilines.extraction",
    "omnilines.geometry",
    "omnilines.photo_file",
    "omnilines.photo_size",
    "omnilines.files.masks",
    "omnilines.pipelines.arc_chains",
    "omnilines.pipelines.chains",
    __name__,
)
"""Whose source decides what the chains of a photo are."""
FOLDER = "chains"

Smooth: TypeAlias = tuple[tuple[int, int], SmoothChains] | str
"""Size of a photo and its smooth curves, or why it has none."""


@dataclass(frozen=True)
class KeptSmoothChains:
    """Smooth curves of photos, which no camera leads to."""

    folder: Path
    asked: str
    """All that decides which there are, beside the photo."""

    @staticmethod
    def within(work: str | Path, asked: object) -> "KeptSmoothChains":
        """Those of a folder, which is made. Raises InputError as `work_folder` does."""
        return KeptSmoothChains(kept_folder(work, FOLDER), repr(asked))

    def known(self, item: tuple[Photo, str | None]) -> tuple[str | None, Smooth | None]:
        """What those of one photo are kept by, and they, where they are."""
        photo, left_out = item
        inputs = None if left_out is not None else inputs_of(photo, f"{self.asked} {photo.levels}", *MADE_BY)
        arrays = kept_arrays(self.folder, inputs)
        if arrays is None:
            return inputs, None
        circle = arrays["circle"].tolist()
        width, height = arrays["size"].tolist()
        return inputs, ((width, height), SmoothChains(*_points(arrays), circle=tuple(circle) if circle else None))

    def write(self, inputs: str | None, found: Smooth) -> None:
        """Keep those of a photo that was looked at."""
        if inputs is not None and not isinstance(found, str):
            size, chains = found
            beside = {"size": np.array(size), "circle": np.array(chains.circle or ())}
            keep_arrays(self.folder, inputs, _arrays(chains) | beside)


@dataclass(frozen=True)
class KeptArcChains:
    """Edge points along the arcs of photos, which a camera leads to."""

    model: CameraModel
    folder: Path
    asked: str
    """As of `KeptSmoothChains`."""

    @staticmethod
    def within(work: str | Path, model: CameraModel, asked: object) -> "KeptArcChains":
        """As that of `KeptSmoothChains`."""
        return KeptArcChains(model, kept_folder(work, FOLDER), repr((said_of(model), asked)))

    def known(self, photo: Photo) -> tuple[str | None, Chains | str | None]:
        """What those of one photo are kept by, and they, where they are."""
        inputs = inputs_of(photo, f"{self.asked} {photo.levels}", *MADE_BY)
        arrays = kept_arrays(self.folder, inputs)
        if arrays is None:
            return inputs, None
        return inputs, Chains((photo.name,), self.model.image_size, arrays["image"], *_points(arrays))

    def write(self, inputs: str | None, found: Chains | str) -> None:
        """Keep those of a photo that was looked at."""
        if inputs is not None and not isinstance(found, str):
            keep_arrays(self.folder, inputs, _arrays(found) | {"image": found.image})


_NAMES = ("chain", "pixels", "normals", "sigma_px")


def _arrays(chains: SmoothChains | Chains) -> dict[str, np.ndarray]:
    return {name: getattr(chains, name) for name in _NAMES}


def _points(arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    chain, pixels, normals, sigma_px = (arrays[name] for name in _NAMES)
    return chain, pixels, normals, sigma_px
