"""The edge points along the arcs of many photos of one camera: `arc_chains_of`."""

from pathlib import Path

import numpy as np

from camera_models import CameraModel, InputError
from omnilines.extraction import ExtractionOptions
from omnilines.extraction.edge_chains import arc_chains
from omnilines.extraction.extract import EVERYWHERE
from omnilines.files import Photo, Photos, of_one_range, photos_of
from omnilines.files.masks import looked_at
from omnilines.geometry.chains import Chains
from omnilines.pipelines.arcs import BYTES_PER_PIXEL, none_usable
from omnilines.pipelines.chains import joined_chains
from omnilines.pipelines.copies import copies
from omnilines.pipelines.kept_chains import KeptArcChains
from omnilines.pipelines.kept_results import look_at_rest
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Detail


def arc_chains_of(
    photos: Photos,
    model: CameraModel,
    options: ExtractionOptions = ExtractionOptions(),
    *,
    known_rad: tuple[float, float] = EVERYWHERE,
    work: str | Path | None = None,
    progress: ProgressCallback = silent,
) -> tuple[Chains, tuple[Detail, ...]]:
    """The chains of all photos, where their masks are true, and those that are left out with the reason: they cannot be read,
    have not the size of the camera, or are copies. Those of each photo are kept in the folder `work`, where one is given. Raises
    InputError where there is no photo, or none can be used."""
    refs = of_one_range(photos_of(photos), progress)

    def look(photo: Photo) -> Chains | str:
        """The chains of one photo, or why it has none."""
        try:
            image = photo.read()
            return arc_chains(image, model, photo.name, looked_at(photo, image.shape[1::-1]), known_rad, options)
        except InputError as error:
            return str(error)

    found = look_at_rest(
        look,
        refs,
        refs,
        "extracting arcs",
        None if work is None else KeptArcChains.within(work, model, (known_rad, options.stated)),
        executor=None,
        bytes_per_pixel=BYTES_PER_PIXEL,
        progress=progress,
    )
    empty = np.zeros((0, 2))
    alike = copies([photo.name for photo in refs], [empty if isinstance(one, str) else one.pixels for one in found])
    found = [one if why is None else why for one, why in zip(found, alike, strict=True)]
    used = [(photo.name, one) for photo, one in zip(refs, found, strict=True) if isinstance(one, Chains)]
    left_out = tuple(
        Detail(photo.name, f"{photo.name} is skipped: {one}")
        for photo, one in zip(refs, found, strict=True)
        if isinstance(one, str)
    )
    if not used:
        raise none_usable([str(one) for one in found], "photos and calibration")
    return joined_chains(used, model.image_size), left_out
