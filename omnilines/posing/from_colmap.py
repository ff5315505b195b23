"""Poses of photos from a COLMAP model, text or binary, with rigs and frames or without."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import InputError
from camera_models.pose import Pose
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.colmap_binary import require_whole
from omnilines.posing.photo_names import matched_names
from omnilines.posing.photo_poses import PhotoPoses, image_poses
from omnilines.records import LARGEST_M

PLACES = ("", "sparse/0", "sparse", "0")
"""Where a model may lie below the folder that is given, the folder itself first."""
FILES = ("cameras", "images", "points3D")


def poses_from_colmap(folder: str | Path, photos: Sequence[str], camera_of: Mapping[str, str]) -> PhotoPoses:
    """`cam_from_world` of photos that a COLMAP model knows; its cameras and points are not used.

    Names are matched as `photo_names.py` does it. Images without a pose are as good as absent. The unit of length is that of the
    model.

    Raises InputError where the folder holds no model or a damaged one, or it has none of the photos.
    """
    model = read_model(Path(folder))
    known = {image.name: image for image in model.images.values() if image.has_pose}
    if not known:
        raise InputError(f"{folder}: a COLMAP model with images that have poses was expected, found none; run its mapper again.")
    found, lost = matched_names(photos, list(known), "the COLMAP model")
    if not found:
        raise InputError(
            f"{folder}: images named like the photos ({photos[0] if photos else 'none given'}, ...) were expected in the COLMAP "
            f"model, found {', '.join(list(known)[:3])}; give the folder of photos that COLMAP was run on."
        )
    poses = [pose_of(known[name].cam_from_world()) for name in found.values()]
    return PhotoPoses(image_poses(list(found), poses, [camera_of[photo] for photo in found]), lost)


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
