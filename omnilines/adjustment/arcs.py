"""Observed arcs of matched lines: pixels taken to bearings once; after this nothing knows which camera it was."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from camera_models.wording import listed
from omnilines.costs._cost import NODES, ArcNodes
from omnilines.geometry.sphere import angle_between, arc_normal, points_on_arc
from omnilines.records import ImagePoses, Segments


@dataclass(frozen=True)
class Observed:
    """Where arcs come from, so that they can be formed anew with other camera parameters."""

    pixels: Float[Tensor, "n 2 2"]
    camera: Int[Tensor, " n"]
    """Index into the cameras of the calibration, in its order."""


@dataclass(frozen=True)
class MatchedArcs:
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
    nodes: ArcNodes | None = None
    """Places along the image of each arc, for costs that integrate over it."""
    observed: Observed | None = None
    """Where the arcs come from, where cameras may be refined."""

    def __len__(self) -> int:
        return len(self.image)

    def rows(self, chosen: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> "MatchedArcs":
        """The chosen rows, by a mask or by their numbers; images and tracks keep their numbers."""
        nodes, observed = self.nodes, self.observed
        if nodes is not None:
            nodes = ArcNodes(nodes.share, nodes.by_pixel[chosen], nodes.length_px[chosen])
        if observed is not None:
            observed = Observed(observed.pixels[chosen], observed.camera[chosen])
        return replace(
            self,
            image=self.image[chosen],
            track=self.track[chosen],
            bearings=self.bearings[chosen],
            by_pixel=self.by_pixel[chosen],
            covariance_px2=self.covariance_px2[chosen],
            nodes=nodes,
            observed=observed,
        )

    def photos(self) -> Int[Tensor, " t"]:
        """Number of photos that show each track, in however many pieces."""
        return torch.bincount(torch.unique(self.track * self.images + self.image) // self.images, minlength=self.tracks)

    def seen_by(self, models: Sequence[CameraModel]) -> "MatchedArcs":
        """The same pixels through cameras with other parameters. Raises InputError where the arcs do not know their pixels."""
        if self.observed is None:
            raise InputError("Arcs that know their pixels were expected to refine cameras; make them with arcs_from_segments.")
        bearings, _, by_pixel = _unproject(self.observed, models)
        return replace(self, bearings=bearings, by_pixel=by_pixel, nodes=_nodes(self.observed, bearings, models))

    def orthogonal_px(self, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
        """Signed orthogonal distance (px) of both ends from the projected line: (V_i . Mh) / |J_i' Mh|."""
        unit = (normal / normal.norm(dim=-1, keepdim=True))[:, None, :, None]
        across = (self.bearings[..., None, :] @ unit)[..., 0, 0]
        return across / (self.by_pixel.mT @ unit)[..., 0].norm(dim=-1)


@dataclass(frozen=True)
class ArcTable:
    """Arcs with the rows of the segments that they come from, and why the others were left out."""

    arcs: MatchedArcs
    rows: Int[np.ndarray, " n"]
    """Row of `Segments` of every arc."""
    left_out: tuple[str, ...]
    """One sentence per reason, with counts."""

    def of_rows(self, chosen: Bool[Tensor, " n"]) -> "ArcTable":
        """Some of the arcs."""
        return replace(self, arcs=self.arcs.rows(chosen), rows=self.rows[chosen.numpy()])


def arcs_from_segments(
    segments: Segments, poses: ImagePoses, cameras: Mapping[str, CameraModel], *, with_nodes: bool = True
) -> ArcTable:
    """Bearings of all matched segments in photos with a pose, and places along them for costs that integrate over arcs.

    Raises InputError when a photo's camera cannot be decided or when nothing is left.
    """
    place = {name: k for k, name in enumerate(poses.images)}
    image = np.array([place.get(name, -1) for name in segments.images], dtype=np.int64)[segments.image]
    camera_of = cameras_of_images(segments, poses, cameras)
    matched, posed = segments.track >= 0, image >= 0
    rows = np.flatnonzero(matched & posed)
    order = list(cameras)
    place_of = np.array([order.index(name) for name in camera_of], dtype=np.int64)
    observed = Observed(torch.as_tensor(segments.endpoints_px[rows]), torch.as_tensor(place_of[segments.image[rows]]))
    models = [cameras[name] for name in order]
    bearings, seen, by_pixel = _unproject(observed, models)
    ends_differ = arc_normal(bearings[:, 0], bearings[:, 1]).norm(dim=-1) > 0.5
    usable = (seen.all(-1) & ends_differ).numpy()
    left_out = _sentences(
        (int((~matched).sum()), "segments belong to no track"),
        (int((matched & ~posed).sum()), "segments lie in photos without a pose"),
        (int((~seen.all(-1)).sum()), "segments have an end outside the field of view of the camera model"),
        (int((seen.all(-1) & ~ends_differ).sum()), "segments have no length"),
    )
    if len(segments) and not matched.any():
        raise InputError(
            f"Segments with the name of their line in the column track were expected, found none in {len(segments)}; unmatched "
            "segments are matched beside their photos: give these too (in Python `given_arcs`)."
        )
    if not usable.any():
        raise InputError(
            "No segment can be used: matched segments in photos with a pose were expected, found none ("
            + ("; ".join(left_out) or "the file has no rows")
            + "); check the columns image and track against poses.csv."
        )
    kept = rows[usable]
    covariance, known = _covariance_px2(segments, kept)
    observed = Observed(observed.pixels[usable], observed.camera[usable])
    arcs = MatchedArcs(
        image=torch.as_tensor(image[kept]),
        track=torch.as_tensor(segments.track[kept]),
        images=len(poses.images),
        tracks=len(segments.tracks),
        bearings=bearings[usable],
        by_pixel=by_pixel[usable],
        covariance_px2=covariance,
        sigma_known=known,
        nodes=_nodes(observed, bearings[usable], models) if with_nodes else None,
        observed=observed,
    )
    return ArcTable(arcs, kept, left_out)


def _sentences(*counts: tuple[int, str]) -> tuple[str, ...]:
    return tuple(f"{count} {text}" for count, text in counts if count)


def cameras_of_images(segments: Segments, poses: ImagePoses | None, cameras: Mapping[str, CameraModel]) -> list[str]:
    """Camera of every photo of `segments`: from either table, or the only camera of the calibration. Raises InputError where that
    does not decide it, or the tables contradict each other."""
    by_pose = {} if poses is None else dict(zip(poses.images, poses.cameras or [""] * len(poses.images), strict=True))
    names = []
    for k, image in enumerate(segments.images):
        by_table = {"segments.csv": segments.cameras[k] if segments.cameras else "", "poses.csv": by_pose.get(image, "")}
        named = {table: name for table, name in by_table.items() if name}
        needs = f"Photo {image} needs one of the cameras {listed(cameras)} of the calibration"
        for table, name in named.items():
            if name not in cameras:
                raise InputError(f"{needs}, found camera '{name}'; correct the camera column of {table}.")
        if len(set(named.values())) > 1:
            found = " and ".join(f"'{name}' in {table}" for table, name in named.items())
            raise InputError(f"Photo {image} was expected to be of one camera, found {found}; correct the one that is wrong.")
        if not named and len(cameras) > 1:
            table = "segments.csv" if poses is None else "poses.csv"
            raise InputError(f"{needs}, found no camera; fill the camera column of {table}.")
        names.append(next(iter(named.values() if named else cameras)))
    return names


def _unproject(observed: Observed, models: Sequence[CameraModel]) -> tuple[Tensor, Tensor, Tensor]:
    """Bearings of both ends, where they are defined, and d bearing / d pixel."""
    pixels = observed.pixels
    bearings = pixels.new_zeros(len(pixels), 2, 3)
    seen = torch.zeros(len(pixels), 2, dtype=torch.bool)
    by_pixel = pixels.new_zeros(len(pixels), 2, 3, 2)
    for index, model in enumerate(models):
        mine = torch.nonzero(observed.camera == index).flatten()
        if len(mine):
            bearings[mine], seen[mine] = model.unproject(pixels[mine])
            by_pixel[mine] = model.unproject_jacobian(pixels[mine])
    return bearings, seen, by_pixel


def _nodes(observed: Observed, bearings: Float[Tensor, "n 2 3"], models: Sequence[CameraModel]) -> ArcNodes:
    """Gauss-Legendre nodes over the pixel length of the image of each arc: ds = |d pixel / d V (N x V)| d theta."""
    abscissa, weight = (torch.as_tensor(values) for values in np.polynomial.legendre.leggauss(NODES))
    share = 0.5 * (abscissa + 1)
    places = points_on_arc(bearings[:, 0], bearings[:, 1], share)
    normal = arc_normal(bearings[:, 0], bearings[:, 1])[:, None].expand_as(places)
    forward = torch.linalg.cross(normal, places)
    phi = angle_between(bearings[:, 0], bearings[:, 1])
    by_pixel = places.new_zeros(len(places), NODES, 3, 2)
    speed = places.new_zeros(len(places), NODES)
    for index, model in enumerate(models):
        mine = torch.nonzero(observed.camera == index).flatten()
        if len(mine):
            # At a pole of a panorama, where pixels have no derivative, bearings have one.
            by_pixel[mine] = model.unproject_jacobian(model.project(places[mine])[0])
            speed[mine] = (torch.linalg.pinv(by_pixel[mine]) @ forward[mine][..., None])[..., 0].norm(dim=-1)
    return ArcNodes(share, by_pixel, 0.5 * weight * phi[:, None] * speed)


def _covariance_px2(segments: Segments, rows: Int[np.ndarray, " m"]) -> tuple[Tensor, bool]:
    if segments.covariance_px2 is not None:
        return torch.as_tensor(segments.covariance_px2[rows]), True
    eye = torch.eye(2, dtype=torch.float64).expand(len(rows), 2, 2, 2)
    if segments.sigma_px is not None:
        return torch.as_tensor(segments.sigma_px[rows] ** 2)[:, None, None, None] * eye, True
    return eye.clone(), False


def poses_of(arcs: MatchedArcs, cam_from_world: Pose) -> Pose:
    """The pose of every row."""
    return cam_from_world[arcs.image]
