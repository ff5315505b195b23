"""Poses of photos from a COLMAP model, text or binary, with rigs and frames or without."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from camera_models import InputError
from camera_models.pose import Pose
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.colmap_binary import require_whole
from omnilines.posing.photo_poses import PhotoPoses, image_poses
from omnilines.records import LARGEST_M

PLACES = ("", "sparse/0", "sparse", "0")
"""Where a model may lie below the folder that is given, the folder itself first."""
FILES = ("cameras", "images", "points3D")


def poses_from_colmap(folder: str | Path, photos: Sequence[str], camera_of: Mapping[str, str]) -> PhotoPoses:
    """`cam_from_world` of photos that a COLMAP model knows; its cameras and points are not used.

    Names (paths relative to the photo folder) are matched as they stand; else by the longest run of folders and file name at the
    end that they have in common with one image alone (`a/left/1.png` and `left/1.png`); else by the file's name without its
    ending. Images without a pose are as good as absent. The unit of length is that of the model.

    Raises InputError where the folder holds no model or a damaged one, or it has none of the photos.
    """
    model = read_model(Path(folder))
    known = {image.name: image for image in model.images.values() if image.has_pose}
    if not known:
        raise InputError(f"{folder}: a COLMAP model with images that have poses was expected, found none; run its mapper again.")
    found: list[tuple[str, str]] = []
    lost = {}
    for photo in photos:
        name, reason = _match(photo, list(known))
        if name is None:
            lost[photo] = f"{photo} has no pose: {reason}."
        else:
            found.append((photo, name))
    twice = {name for _, name in found if sum(name == other for _, other in found) > 1}
    lost |= {
        photo: f"{photo} has no pose: several photos are like the model's image {name}." for photo, name in found if name in twice
    }
    found = [(photo, name) for photo, name in found if name not in twice]
    if not found:
        raise InputError(
            f"{folder}: images named like the photos ({photos[0] if photos else 'none given'}, ...) were expected in the COLMAP "
            f"model, found {', '.join(list(known)[:3])}; give the folder of photos that COLMAP was run on."
        )
    poses = [pose_of(known[name].cam_from_world()) for _, name in found]
    images = [photo for photo, _ in found]
    return PhotoPoses(image_poses(images, poses, [camera_of[photo] for photo in images]), lost)


def read_model(folder: Path) -> Any:
    """The reconstruction (pycolmap's) in a folder or where COLMAP puts it below; raises InputError where there is none."""
    module = pycolmap()
    for place in PLACES:
        at = folder / place
        for ending in (".bin", ".txt"):
            if all((at / f"{name}{ending}").is_file() for name in FILES):
                if ending == ".bin":
                    require_whole(at)
                model = module.Reconstruction()
                try:
                    (model.read_binary if ending == ".bin" else model.read_text)(str(at))
                    _ = [image.name for image in model.images.values()]  # they are decoded as they are asked for
                except (RuntimeError, ValueError, IndexError) as error:
                    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                    raise InputError(
                        f"{at}: a COLMAP model was expected, found a damaged one ({reason}); export it again."
                    ) from error
                return model
    raise InputError(
        f"{folder}: cameras, images and points3D (.bin or .txt) of a COLMAP model were expected there or in sparse/0 below, "
        "found none; give the model's folder."
    )


def pose_of(rigid: Any) -> Pose:
    """Of pycolmap's Rigid3d. Raises InputError where it is none."""
    if not 0.5 < float(np.linalg.norm(rigid.rotation.quat)) < 2 or not (np.abs(rigid.translation) <= LARGEST_M).all():
        raise InputError(
            f"A COLMAP model with unit quaternions and translations up to {LARGEST_M:g} was expected, found "
            f"{np.asarray(rigid.rotation.quat)} (x, y, z, w) and {np.asarray(rigid.translation)}; export it again."
        )
    matrix = np.asarray(rigid.matrix(), dtype=np.float64)
    return Pose.of(matrix[:, :3].copy(), matrix[:, 3].copy())


def _match(photo: str, names: Sequence[str]) -> tuple[str | None, str]:
    """The image of a photo, or None and why."""
    if photo in names:
        return photo, ""
    parts = PurePosixPath(photo).parts
    shared = {name: _common_end(parts, PurePosixPath(name.replace("\\", "/")).parts) for name in names}
    longest = max(shared.values(), default=0)
    if longest:
        best = [name for name in names if shared[name] == longest]
        return (best[0], "") if len(best) == 1 else (None, f"{len(best)} images of the COLMAP model are named like it")
    stem = PurePosixPath(photo).stem
    best = [name for name in names if PurePosixPath(name).stem == stem]
    if len(best) == 1:
        return best[0], ""
    return None, f"{len(best)} images of the COLMAP model are named like it" if best else "the COLMAP model has no such image"


def _common_end(a: Sequence[str], b: Sequence[str]) -> int:
    count = 0
    for x, y in zip(reversed(a), reversed(b), strict=False):
        if x != y:
            break
        count += 1
    return count
