"""Which stretches of its edges a photo of a scene sees, and how strongly they stand out.

Every edge is tried at points half a pixel apart or less. A point is seen where it is in the image and, of two rays 0.05 px to
either side of the edge, one meets a face whose plane holds the point (it is not hidden) and both meet different surfaces (there
is something to see). Where the answer changes between two points, the place is found by bisection.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models.pose import Pose
from omnilines.files.true_edges import Stretches
from omnilines.scenes.appearance import colours
from omnilines.scenes.photo import Eye, TileFaces, faces_of_tiles, vignette
from omnilines.scenes.polygon_scene import GREY_WEIGHTS, PolygonScene
from omnilines.scenes.viewpoint import NO_FACE, Viewpoint, first_faces

BESIDE_PX = (0.05, 1.0)
"""Distances from the edge at which both sides are compared. The contrast is the smaller of the differences there: what is left of
a strip too thin to be told from a line does not count."""
CONTRAST_LEVELS = np.array([5.0, 10.0, 20.0, 40.0, 80.0])
"""A stretch ends where one of its contrasts passes one of these grey levels."""
STEP_PX = 0.5
SHORTEST_PX = 1.0
_BISECTIONS = 7
_ON_PLANE_M = 1e-5
_COARSE = 16
_MARGIN_PX = 40.0
_RESERVE = 1.3
"""The pace between two points may be higher than at both."""
_MOST_POINTS = 4_000
"""Of a piece of an edge."""
_HIDDEN = -1
_SMALLEST_ARC_RAD = 1e-7
_ROWS = 200_000
"""Points tried at a time."""


@dataclass(frozen=True)
class _Seen:
    """What became of points of edges: the class of contrast or _HIDDEN, both contrasts, and the pixel."""

    kind: Int[np.ndarray, " n"]
    contrast: Float[np.ndarray, "n 2"]
    pixel: Float[np.ndarray, "n 2"]


class _Arcs:
    """Edges in the frame of a camera."""

    def __init__(self, ends_m: Float[np.ndarray, "e 2 3"], pose: Pose) -> None:
        rotation, translation = pose.rotation.detach().numpy(), pose.translation.detach().numpy()
        self.ends = ends_m @ rotation.T + translation
        self.reach = np.linalg.norm(self.ends, axis=-1)
        unit = self.ends / self.reach[..., None]
        normal = np.cross(unit[:, 0], unit[:, 1])
        sine = np.linalg.norm(normal, axis=-1)
        self.angle = np.arctan2(sine, (unit[:, 0] * unit[:, 1]).sum(-1))
        self.normal = normal / np.maximum(sine, _SMALLEST_ARC_RAD)[:, None]
        """Unit normals of the planes through the camera and each edge."""

    def fractions(self, edge: Int[np.ndarray, " n"], share: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Fraction t of the edge at a share of its angle: (1 - t) |a| to t |b| as sin((1 - share) angle) to sin(share angle)."""
        angle, (a, b) = self.angle[edge], self.reach[edge].T
        far, near = a * np.sin(share * angle), b * np.sin((1.0 - share) * angle)
        return far / (far + near)

    def points(self, edge: Int[np.ndarray, " n"], t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        return self.ends[edge, 0] + t[:, None] * (self.ends[edge, 1] - self.ends[edge, 0])


class _Look:
    """One photo of a scene: answers what is seen at points of edges."""

    def __init__(
        self, scene: PolygonScene, camera: Eye, pose: Pose, ends_m: Float[np.ndarray, "e 2 3"], vignetting: float
    ) -> None:
        self.scene, self.camera = scene, camera
        self.view = Viewpoint(scene, pose)
        self.tiles: TileFaces = faces_of_tiles(self.view, camera)
        self.arcs = _Arcs(ends_m, pose)
        self.exposure = vignette(camera, vignetting)

    def tile(self, pixel: Float[np.ndarray, "n 2"]) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Tile of each pixel, and whether the image shows anything there."""
        height, width = self.camera.rays.shape
        u, v = np.floor(pixel + 0.5).T
        if self.camera.model.PERIODIC:
            u = u % width
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        column, row = np.where(inside, u, 0).astype(np.int64), np.where(inside, v, 0).astype(np.int64)
        inside &= self.camera.rays.seen[row, column]
        return self.camera.fine_tile(row, column), inside

    def at(self, edge: Int[np.ndarray, " n"], t: Float[np.ndarray, " n"]) -> _Seen:
        """What is seen of points of edges."""
        parts = [self._at(edge[k : k + _ROWS], t[k : k + _ROWS]) for k in range(0, max(len(edge), 1), _ROWS)]
        return _Seen(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("kind", "contrast", "pixel")))

    def _at(self, edge: Int[np.ndarray, " n"], t: Float[np.ndarray, " n"]) -> _Seen:
        point = self.arcs.points(edge, t)
        pixel, valid, along_px, across_px = self.steps(edge, point)
        ray, across = point / np.linalg.norm(point, axis=-1, keepdims=True), self.arcs.normal[edge]
        length = np.linalg.norm(along_px, axis=-1)
        gain = np.abs(along_px[:, 0] * across_px[:, 1] - along_px[:, 1] * across_px[:, 0]) / np.maximum(length, 1e-12)
        tile, inside = self.tile(pixel)
        # A tile that one face fills has no edge.
        inside &= self.tiles.whole[tile] == NO_FACE
        usable = np.flatnonzero(valid & inside & (length > 1e-9) & (gain > 1e-9))
        kind, contrast = np.full(len(edge), _HIDDEN), np.zeros((len(edge), 2))
        if len(usable):
            unit, normal, rate = ray[usable], across[usable], gain[usable]
            near, colour = self._sides(unit, normal, BESIDE_PX[0] / rate, pixel[usable], across_px[usable])
            seen = self._shows(near, point[usable])
            rows = usable[seen]
            _, farther = self._sides(unit[seen], normal[seen], BESIDE_PX[1] / rate[seen], pixel[rows], across_px[rows])
            u, v = np.floor(pixel[rows] + 0.5).astype(np.int64).T
            exposure = self.exposure[v, u % self.exposure.shape[1]]
            contrast[rows] = np.minimum(_differences(colour[:, seen]), _differences(farther)) * exposure[:, None]
            levels = np.searchsorted(CONTRAST_LEVELS, contrast[rows], side="right")
            kind[rows] = levels[:, 0] * (len(CONTRAST_LEVELS) + 1) + levels[:, 1]
        return _Seen(kind, contrast, pixel)

    def steps(
        self, edge: Int[np.ndarray, " n"], point: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Pixels of points on edges, whether they are, and pixels per radian of the ray along and across the edge."""
        with torch.no_grad():
            projected = self.camera.model.project_with_jacobians(torch.as_tensor(point))
        pixel, valid, jacobian = (part.numpy() for part in projected[:3])
        distance = np.linalg.norm(point, axis=-1, keepdims=True)
        across = self.arcs.normal[edge]
        turns = np.stack([np.cross(across, point), across * distance], -1)
        along_px, across_px = np.moveaxis(jacobian @ turns, -1, 0)
        return pixel, valid, along_px, across_px

    def _sides(
        self,
        ray: Float[np.ndarray, "n 3"],
        across: Float[np.ndarray, "n 3"],
        angle: Float[np.ndarray, " n"],
        pixel: Float[np.ndarray, "n 2"],
        across_px: Float[np.ndarray, "n 2"],
    ) -> tuple[Int[np.ndarray, "2 n"], Float[np.ndarray, "2 n 3"]]:
        """Faces and colours on both sides of an edge at that angle from it; `across_px` is pixels per radian across it."""
        own, _ = self.tile(pixel)
        faces, colour = [], []
        for sign in (-1.0, 1.0):
            step = (sign * angle)[:, None]
            place, inside = self.tile(pixel + step * across_px)
            # Past the end of the image, the faces of the edge's own tile may be what the ray meets.
            place = np.where(inside, place, own)
            beside = ray + step * across
            met = first_faces(self.view, self.tiles.pairs.of_cells(place, len(self.tiles.whole)), beside)
            filled = self.tiles.whole[place]
            faces.append(np.where(filled == NO_FACE, met, filled))
            colour.append(colours(self.view, faces[-1], beside))
        return np.stack(faces), np.stack(colour).astype(np.float64)

    def _shows(self, faces: Int[np.ndarray, "2 n"], point: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether one of both faces holds the point, and both are of different surfaces."""
        world = self.view.centre_m + point @ self.view.world_from_cam.T
        off = np.einsum("kni,kni->kn", self.view.normal[faces], world - self.scene.corners_m[faces, 0])
        holds = (np.abs(off) < _ON_PLANE_M) & (faces != NO_FACE)
        surface = np.where(faces == NO_FACE, NO_FACE, self.scene.surface[faces])
        return holds.any(0) & (surface[0] != surface[1])


def _differences(colour: Float[np.ndarray, "2 n 3"]) -> Float[np.ndarray, "n 2"]:
    """Difference in grey level, and in the channel that differs most."""
    difference = colour[1] - colour[0]
    return np.stack([np.abs(difference @ GREY_WEIGHTS), np.abs(difference).max(-1)], -1)


def visible_stretches(
    scene: PolygonScene, camera: Eye, cam_from_world: Pose, ends_m: Float[np.ndarray, "e 2 3"], vignetting: float = 0.0
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Stretches of the edges that one photo sees: edge, (t1, t2), length in pixels, and (grey, rgb) contrast in grey levels.

    Sorted by edge and t1. Those shorter than SHORTEST_PX are left out.
    """
    look = _Look(scene, camera, cam_from_world, ends_m, vignetting)
    edge, share = _points_along(look)
    t = look.arcs.fractions(edge, share)
    seen = look.at(edge, t)
    starts = np.ones(len(edge), dtype=bool)
    starts[1:] = (edge[1:] != edge[:-1]) | (seen.kind[1:] != seen.kind[:-1])
    run = np.cumsum(starts) - 1
    first, last = np.flatnonzero(starts), np.flatnonzero(np.append(starts[1:], True))
    between = np.flatnonzero(edge[last[:-1]] == edge[first[1:]])
    border = _bisected(
        look, edge[first[1:]][between], seen.kind[last[:-1]][between], share[last[:-1]][between], share[first[1:]][between]
    )
    low, high = np.zeros(len(first)), np.ones(len(first))
    high[between], low[between + 1] = border, border
    pace = np.linalg.norm(_step_px(look, seen.pixel), axis=-1)
    pace[1:][edge[1:] != edge[:-1]] = 0.0
    points = last - first + 1
    # A run of n points spans n - 1 steps between them; its ends add the rest in proportion to its share of the arc.
    inner = np.add.reduceat(np.where(starts, 0.0, pace), first) if len(first) else np.zeros(0)
    spanned = share[last] - share[first]
    length = np.where(points > 1, inner * (high - low) / np.maximum(spanned, 1e-12), STEP_PX)
    contrast = np.stack([np.bincount(run, seen.contrast[:, k], len(first)) for k in range(2)], -1) / points[:, None]
    kept = (seen.kind[first] != _HIDDEN) & (length >= SHORTEST_PX)
    owner = edge[first][kept]
    fractions = np.stack([look.arcs.fractions(owner, side[kept]) for side in (low, high)], -1)
    return owner, fractions, length[kept], contrast[kept]


def _step_px(look: _Look, pixel: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    step = np.diff(pixel, axis=0, prepend=pixel[:1])
    if look.camera.model.PERIODIC:
        width = look.camera.rays.shape[1]
        step[:, 0] -= width * np.round(step[:, 0] / width)
    return step


def _points_along(look: _Look) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Points to try: edge and share of its angle, at most about STEP_PX apart in the image and half a step from the ends.

    An edge is cut into _COARSE pieces; those that are not near the image, nor beside one that is, are left out.
    """
    arcs = look.arcs
    usable = np.flatnonzero((np.minimum(arcs.angle, math.pi - arcs.angle) > _SMALLEST_ARC_RAD) & (arcs.reach > 1e-9).all(-1))
    edge, place = np.repeat(usable, _COARSE + 1), np.tile(np.arange(_COARSE + 1) / _COARSE, len(usable))
    pixel, valid, along_px, _ = look.steps(edge, arcs.points(edge, arcs.fractions(edge, place)))
    pixel, pace = pixel.reshape(-1, _COARSE + 1, 2), np.linalg.norm(along_px, axis=-1).reshape(-1, _COARSE + 1)
    valid = valid.reshape(-1, _COARSE + 1)
    near = _near_image(look, pixel, valid)
    # The faster of both ends sets the pace, where it is in the image or just outside.
    size = np.array(look.camera.model.image_size)
    known = valid & ((pixel > -_MARGIN_PX) & (pixel < size + _MARGIN_PX)).all(-1)
    fastest = np.where(known, pace, 0.0)
    fastest = np.maximum(fastest[:, 1:], fastest[:, :-1])
    fastest = np.where(fastest > 0, fastest, fastest.max(-1, keepdims=True))
    count = np.ceil(_RESERVE * fastest * arcs.angle[usable, None] / _COARSE / STEP_PX)
    count = np.where(near, np.clip(count, 2, _MOST_POINTS), 0).astype(np.int64).ravel()
    piece = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    return usable[piece // _COARSE], (piece % _COARSE + (number + 0.5) / count[piece]) / _COARSE


def _near_image(look: _Look, pixel: Float[np.ndarray, "e k 2"], valid: Bool[np.ndarray, "e k"]) -> Bool[np.ndarray, "e pieces"]:
    """Pieces between neighbouring points of edges that may reach into the image, by the box round both ends, and those beside."""
    if look.camera.model.PERIODIC:
        return np.ones((len(pixel), pixel.shape[1] - 1), dtype=bool)
    low, high = np.minimum(pixel[:, 1:], pixel[:, :-1]), np.maximum(pixel[:, 1:], pixel[:, :-1])
    size = np.array(look.camera.model.image_size)
    meets = ((high > -_MARGIN_PX) & (low < size + _MARGIN_PX)).all(-1)
    known = valid[:, 1:] & valid[:, :-1] & meets
    beside = np.pad(known, ((0, 0), (1, 1)))
    return known | beside[:, 2:] | beside[:, :-2]


def _bisected(
    look: _Look,
    edge: Int[np.ndarray, " n"],
    kind: Int[np.ndarray, " n"],
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Where, between two shares of the angle, the kind of the first one ends."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = look.at(edge, look.arcs.fractions(edge, middle)).kind == kind
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def stretches_of_photos(images: tuple[str, ...], found: list[tuple]) -> Stretches:
    """The table of what `visible_stretches` found in each of the photos."""
    count = [len(one[0]) for one in found]
    edge, t, length, contrast = (np.concatenate([one[k] for one in found]) for k in range(4))
    return Stretches(images, np.repeat(np.arange(len(found)), count), edge, t, length, contrast[:, 0], contrast[:, 1])
