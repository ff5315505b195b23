"""A scene of polygons as one point sees it, where all is linear in the ray.

From a centre C, a convex face is a convex polygon on the sphere: a ray d meets it where E_k . d >= 0 for the normals E_k of the
planes through C and its sides, at a depth whose inverse is w . d, with w = n / (n . (corner - C)). So a face covers a cone of
rays, misses it, or hides another face over all of it exactly where a linear function of d does not change its sign there.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models.pose import Pose
from omnilines.scenes.polygon_scene import PolygonScene

NO_FACE = -1
"""Index of what a ray meets where it meets no face: the sky."""
_GRAZING_M = 1e-6
"""Of a face whose plane passes nearer to the centre nothing is seen."""
_SHORTEST = 1e-14
"""Sine of an angle below which it counts as zero."""


@dataclass(frozen=True)
class Pairs:
    """Faces that may be seen in some cells (tiles, pixels, single rays): one row for each cell and face, sorted by cell."""

    cell: Int[np.ndarray, " m"]
    face: Int[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.cell)

    def keep(self, rows: Bool[np.ndarray, " m"]) -> "Pairs":
        """Some of the rows."""
        return Pairs(self.cell[rows], self.face[rows])

    def of_cells(self, parents: Int[np.ndarray, " n"], cells: int) -> "Pairs":
        """The pairs of n new cells, each with the faces of its parent, which is one of `cells` cells."""
        counts = np.bincount(self.cell, minlength=cells)
        first = np.cumsum(counts) - counts
        each = counts[parents]
        child = np.repeat(np.arange(len(parents)), each)
        place = np.arange(len(child)) - np.repeat(np.cumsum(each) - each, each)
        return Pairs(child, self.face[first[parents][child] + place])


class Viewpoint:
    """The front faces of a scene as linear functions of a ray in the frame of a camera. Faces are numbered as in the scene."""

    def __init__(self, scene: PolygonScene, cam_from_world: Pose) -> None:
        self.scene = scene
        self.world_from_cam: Float[np.ndarray, "3 3"] = cam_from_world.rotation.detach().numpy().T
        self.centre_m: np.ndarray = cam_from_world.centre.detach().numpy()
        corners = scene.corners_m - self.centre_m
        first = scene.corners_m[:, 0]
        normal = np.cross(scene.corners_m[:, 1] - first, scene.corners_m[:, 2] - first)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        # One plane for all faces that lie in it: their inverse depths are then equal to the last bit.
        _, representative = np.unique(scene.plane, return_index=True)
        same = representative[scene.plane]
        self.normal = normal[same]
        """(p, 3) outward unit normals in the world."""
        distance = (self.normal * (first[same] - self.centre_m)).sum(-1)
        self.front: Bool[np.ndarray, " p"] = distance < -_GRAZING_M
        self.inverse_depth = (self.normal / np.where(self.front, distance, -1.0)[:, None]) @ self.world_from_cam
        """(p, 3): 1 / t = w . d where centre + t d lies in the face's plane."""
        # Exactly opposite for the two faces at a side, whichever way they run: no ray slips between them.
        sides = np.cross(np.roll(corners, -1, 1), corners)
        length = np.linalg.norm(sides, axis=-1, keepdims=True)
        # The side of no length of a triangle: its first one once more.
        sides = np.where(length > _SHORTEST, sides / np.maximum(length, _SHORTEST), sides[:, :1] / length[:, :1])
        self.sides: Float[np.ndarray, "p 4 3"] = sides @ self.world_from_cam
        """Unit normals of the planes through the centre and each side, positive inside."""

    @cached_property
    def front_faces(self) -> Int[np.ndarray, " f"]:
        """Faces whose front is towards the centre."""
        return np.flatnonzero(self.front)

    def points_m(
        self, faces: Int[np.ndarray, " n"], rays: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Where rays (camera frame) meet the planes of faces, in the world, and the factor t of each; precision as of `rays`."""
        kind = rays.dtype
        scale = 1.0 / np.einsum("ni,ni->n", self.inverse_depth.astype(kind)[faces], rays)
        return self.centre_m.astype(kind) + (scale[:, None] * rays) @ self.world_from_cam.T.astype(kind), scale


def in_front(
    view: Viewpoint, a: Int[np.ndarray, " n"], b: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """The linear function g with g . d > 0 where face a is nearer than face b, and +1, -1 or 0 where the layers decide instead.

    That is in one plane, where g is zero: +1 where a is painted over b.
    """
    nearer = view.inverse_depth[a] - view.inverse_depth[b]
    same = view.scene.plane[a] == view.scene.plane[b]
    layers = np.where(same, np.sign(view.scene.layer[a] - view.scene.layer[b]), 0)
    return nearer, layers


@dataclass(frozen=True)
class Cones:
    """A cone of rays round each of n axes (unit), with the sine of its half angle (1 from 90 degrees on)."""

    axis: Float[np.ndarray, "n 3"]
    sine: Float[np.ndarray, " n"]


def faces_in_cones(view: Viewpoint, pairs: Pairs, cones: Cones) -> tuple[Pairs, Int[np.ndarray, " n"]]:
    """The faces that may be seen in each cone, and the face that covers all of it where that is the only one, else `NO_FACE`.

    A face is left out where it lies outside the cone or behind another one that covers the cone.
    """
    covers = np.ones(len(pairs), dtype=bool)
    for side in range(4):
        # Side by side, so that what lies outside one is not asked about the next.
        sine = cones.sine[pairs.cell]
        inside = np.einsum("mi,mi->m", view.sides[pairs.face, side], cones.axis[pairs.cell])
        touches = inside >= -sine
        covers = (covers & (inside > sine))[touches]
        pairs = pairs.keep(touches)
    kept = ~_hidden(view, pairs, covers, cones)
    pairs, covers = pairs.keep(kept), covers[kept]
    alone = np.bincount(pairs.cell, minlength=len(cones.axis)) == 1
    whole = np.full(len(cones.axis), NO_FACE)
    rows = covers & alone[pairs.cell]
    whole[pairs.cell[rows]] = pairs.face[rows]
    return pairs, whole


def _hidden(view: Viewpoint, pairs: Pairs, covers: Bool[np.ndarray, " m"], cones: Cones) -> Bool[np.ndarray, " m"]:
    """Which faces lie behind the one that, of those covering the whole cone, is nearest on its axis."""
    rows = np.flatnonzero(covers)
    cell, face = pairs.cell[rows], pairs.face[rows]
    depth = np.einsum("mi,mi->m", view.inverse_depth[face], cones.axis[cell])
    order = np.lexsort((view.scene.layer[face], depth, cell))
    nearest = np.full(len(cones.axis), NO_FACE)
    nearest[cell[order]] = face[order]
    cover = nearest[pairs.cell]
    known = np.flatnonzero((cover != NO_FACE) & (cover != pairs.face))
    nearer, layers = in_front(view, cover[known], pairs.face[known])
    cell = pairs.cell[known]
    over_all = np.einsum("mi,mi->m", nearer, cones.axis[cell]) > cones.sine[cell] * np.linalg.norm(nearer, axis=-1)
    hidden = np.zeros(len(pairs), dtype=bool)
    hidden[known] = over_all | (layers > 0)
    return hidden


def first_faces(view: Viewpoint, pairs: Pairs, rays: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """The face that each ray meets first, of those paired with it, or `NO_FACE`."""
    for side in range(4):
        pairs = pairs.keep(np.einsum("mi,mi->m", view.sides[pairs.face, side], rays[pairs.cell]) >= 0)
    depth = np.einsum("mi,mi->m", view.inverse_depth[pairs.face], rays[pairs.cell])
    order = np.lexsort((view.scene.layer[pairs.face], depth, pairs.cell))
    first = np.full(len(rays), NO_FACE)
    first[pairs.cell[order]] = pairs.face[order]
    return first
