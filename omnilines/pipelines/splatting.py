"""A scene for trainers of Gaussian splats: a COLMAP model with the photos' own cameras, and masks of what these see.

sparse/0/cameras.txt, images.txt    native cameras (OPENCV_FISHEYE and others): nothing is undistorted
sparse/0/points3D.txt               points along the lines, to begin from
masks/PHOTO.png                     black where a photo shows no scene, or more than COLMAP's cameras hold
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models import CameraModel, InputError
from camera_models.formats import format_named
from omnilines.extraction.image_circle import image_circle
from omnilines.files.colmap_scene import COLMAP_FILES, colmap_cameras, write_colmap_scene
from omnilines.files.photos import write_png
from omnilines.files.scene_folder import SceneTables
from omnilines.photo_file import eight_bits, read_photo

MODEL, MASKS = "sparse/0", "masks"
LOOKED_AT = 8
"""Photos of each camera in which its image circle is looked for."""
POINTS = 20_000
"""Along all lines together."""


def splatting_files(scene: SceneTables) -> tuple[str, ...]:
    """What may be written of a scene."""
    return (*(f"{MODEL}/{name}" for name in COLMAP_FILES), *(f"{MASKS}/{image}.png" for image in scene.poses.images))


def write_splatting(folder: Path, scene: SceneTables, photos: Path | None = None) -> tuple[str, ...]:
    """Write the model, and a mask for each photo that is not seen whole; what is fitted or lost.

    The image circle of a camera is found in its `photos`; without them masks know only where its model ends. Raises InputError
    where COLMAP does not hold a camera or the name of a photo, there is no pose, or a photo is missing or of another size.
    """
    if not len(scene.poses):
        raise InputError(f"{folder}: poses of photos were expected, found none; reconstruct the scene first.")
    cameras, said = colmap_cameras(scene.cameras)
    write_colmap_scene(folder / MODEL, cameras, scene.poses, remarks=said, points_m=_along(scene.lines.ends_m[scene.lines.known]))
    names = scene.poses.cameras or (next(iter(cameras)),) * len(scene.poses)
    for name, model in cameras.items():
        own = [image for image, camera in zip(scene.poses.images, names, strict=True) if camera == name]
        seen = _seen(model, [photos / image for image in own] if photos is not None else [])
        if not seen.all():
            for image in own:
                write_png(folder / MASKS / f"{image}.png", np.where(seen, 255, 0).astype(np.uint8))
    unseen = () if photos is not None else ("image circles, which `photos` would show",)
    return (*said, *unseen, "lines, but for points along them", "uncertainties")


def _along(ends_m: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "k 3"]:
    """Points along lines, as far apart on all."""
    length = np.linalg.norm(ends_m[:, 1] - ends_m[:, 0], axis=-1)
    step = float(length.sum()) / POINTS
    counts = np.maximum(2, np.ceil(length / step).astype(int) if step > 0 else np.full(len(length), 2))
    parts = [a + np.linspace(0.0, 1.0, count)[:, None] * (b - a) for (a, b), count in zip(ends_m, counts, strict=True)]
    return np.concatenate([np.zeros((0, 3)), *parts])


def _seen(model: CameraModel, photos: Sequence[Path]) -> Bool[np.ndarray, "h w"]:
    """Pixels that show the scene and that COLMAP's camera has a ray for."""
    width, height = model.image_size
    column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    with torch.no_grad():
        bearings, valid = model.unproject(torch.as_tensor(np.stack([column, row], -1)))
    ends_deg = format_named("colmap").exact_form(model).ends_deg
    # Beyond a right angle a camera that divides by z sees nothing.
    seen = valid.numpy() & ((bearings[..., 2] > 0).numpy() | (ends_deg > 90.0))
    circles = [circle for path in _spread(photos) if (circle := _circle(path, model)) is not None]
    if len(circles) > len(_spread(photos)) // 2:
        u, v, radius = np.median(circles, axis=0)
        seen &= (column - u) ** 2 + (row - v) ** 2 <= radius**2
    return seen


def _circle(path: Path, model: CameraModel) -> tuple[float, float, float] | None:
    photo = read_photo(path)
    if photo.shape[1::-1] != model.image_size:
        expected, found = ("x".join(map(str, size)) for size in (model.image_size, photo.shape[1::-1]))
        raise InputError(f"The photo {path} was expected to be {expected} px as its camera, found {found}; give its own photos.")
    return image_circle(eight_bits(photo), model)


def _spread(photos: Sequence[Path]) -> list[Path]:
    """A few of them, evenly."""
    return [photos[k] for k in sorted({round(k) for k in np.linspace(0, len(photos) - 1, LOOKED_AT).tolist()})] if photos else []
