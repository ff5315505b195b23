"""Observed arcs of matched lines: pixels taken to bearings once; after this nothing knows which camera it was."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from omnilines.geometry.sphere import arc_normal
from omnilines.records import ImagePoses, Segments


@dataclass(frozen=True)
class Arcs:
    """n observed arcs, one row each."""

    image: Int[Tensor, " n"]
    track: Int[Tensor, " n"]
    images: int
    tracks: int
    bearings: Float[Tensor, "n 2 3"]
    """End bearings, unit, camera frame."""
    by_pixel: Float[Tensor, "n 2 3 2"]
    """d bearing / d pixel of both ends."""
    covariance_px2: Float[Tensor, "n 2 2 2"]
    """Of both end points; sigma_px squared times the identity where only that is known, 1 px where nothing is."""
    sigma_known: bool
    """False where the noise of the end points was not given and is estimated from the residuals."""

    def __len__(self) -> int:
        return len(self.image)

    def rows(self, chosen: Bool[Tensor, " n"]) -> "Arcs":
        """The chosen rows; images and tracks keep their numbers."""
        return Arcs(
            self.image[chosen],
            self.track[chosen],
            self.images,
            self.tracks,
            self.bearings[chosen],
            self.by_pixel[chosen],
            self.covariance_px2[chosen],
            self.sigma_known,
        )

    def orthogonal_px(self, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
        """Signed orthogonal distance (px) of both ends from the projected line: (V_i . Mh) / |J_i' Mh|."""
        unit = (normal / normal.norm(dim=-1, keepdim=True))[:, None, :, None]
        across = (self.bearings[..., None, :] @ unit)[..., 0, 0]
        return across / (self.by_pixel.mT @ unit)[..., 0].norm(dim=-1)


@dataclass(frozen=True)
class ArcTable:
    """Arcs with the rows of the segments that they come from, and why the others were left out."""

    arcs: Arcs
    rows: Int[np.ndarray, " n"]
    """Row of `Segments` of every arc."""
    left_out: tuple[str, ...]
    """One sentence per reason, with counts."""


def arcs_from_segments(segments: Segments, poses: ImagePoses, cameras: Mapping[str, CameraModel]) -> ArcTable:
    """Bearings of all matched segments in photos with a pose. Raises InputError when a photo's camera cannot be decided or
    when nothing is left."""
    place = {name: k for k, name in enumerate(poses.images)}
    image = np.array([place.get(name, -1) for name in segments.images], dtype=np.int64)[segments.image]
    camera_of = _cameras_of_images(segments, poses, cameras)
    matched, posed = segments.track >= 0, image >= 0
    rows = np.flatnonzero(matched & posed)
    bearings, seen, by_pixel = _unproject(segments, rows, camera_of, cameras)
    ends_differ = arc_normal(bearings[:, 0], bearings[:, 1]).norm(dim=-1) > 0.5
    usable = (seen.all(-1) & ends_differ).numpy()
    left_out = _sentences(
        (int((~matched).sum()), "segments belong to no track"),
        (int((matched & ~posed).sum()), "segments lie in photos without a pose"),
        (int((~seen.all(-1)).sum()), "segments have an end outside the field of view of the camera model"),
        (int((seen.all(-1) & ~ends_differ).sum()), "segments have no length"),
    )
    if not usable.any():
        raise InputError(
            "No segment can be used: matched segments in photos with a pose were expected, found none ("
            + ("; ".join(left_out) or "the file has no rows")
            + "); check the columns image and track against poses.csv."
        )
    kept = rows[usable]
    covariance, known = _covariance_px2(segments, kept)
    arcs = Arcs(
        torch.as_tensor(image[kept]),
        torch.as_tensor(segments.track[kept]),
        len(poses.images),
        len(segments.tracks),
        bearings[usable],
        by_pixel[usable],
        covariance,
        known,
    )
    return ArcTable(arcs, kept, left_out)


def _sentences(*counts: tuple[int, str]) -> tuple[str, ...]:
    return tuple(f"{count} {text}" for count, text in counts if count)


def _cameras_of_images(segments: Segments, poses: ImagePoses, cameras: Mapping[str, CameraModel]) -> list[str]:
    """Camera of every photo of `segments`: from either file, or the only camera of the calibration."""
    by_pose = dict(zip(poses.images, poses.cameras or [""] * len(poses.images), strict=True))
    names = []
    for k, image in enumerate(segments.images):
        name = (segments.cameras[k] if segments.cameras else "") or by_pose.get(image, "")
        if not name and len(cameras) == 1:
            name = next(iter(cameras))
        if name not in cameras:
            found = f"camera '{name}'" if name else "no camera"
            raise InputError(
                f"Photo {image} needs one of the cameras {', '.join(cameras)} of the calibration, found {found}; "
                "fill the camera column of poses.csv."
            )
        names.append(name)
    return names


def _unproject(
    segments: Segments, rows: Int[np.ndarray, " m"], camera_of: list[str], cameras: Mapping[str, CameraModel]
) -> tuple[Tensor, Tensor, Tensor]:
    pixels = torch.as_tensor(segments.endpoints_px[rows])
    bearings = pixels.new_zeros(len(rows), 2, 3)
    seen = torch.zeros(len(rows), 2, dtype=torch.bool)
    by_pixel = pixels.new_zeros(len(rows), 2, 3, 2)
    names = np.array(camera_of)[segments.image[rows]]
    for name in dict.fromkeys(camera_of):
        mine = torch.as_tensor(np.flatnonzero(names == name))
        bearings[mine], seen[mine] = cameras[name].unproject(pixels[mine])
        by_pixel[mine] = cameras[name].unproject_jacobian(pixels[mine])
    return bearings, seen, by_pixel


def _covariance_px2(segments: Segments, rows: Int[np.ndarray, " m"]) -> tuple[Tensor, bool]:
    if segments.covariance_px2 is not None:
        return torch.as_tensor(segments.covariance_px2[rows]), True
    eye = torch.eye(2, dtype=torch.float64).expand(len(rows), 2, 2, 2)
    if segments.sigma_px is not None:
        return torch.as_tensor(segments.sigma_px[rows] ** 2)[:, None, None, None] * eye, True
    return eye.clone(), False


def poses_of(arcs: Arcs, cam_from_world: Pose) -> Pose:
    """The pose of every row."""
    return cam_from_world[arcs.image]
