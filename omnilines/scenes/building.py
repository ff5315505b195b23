"""Faces, walls with openings, boxes and paint put together into a `PolygonScene`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from omnilines.scenes.polygon_scene import GREY_WEIGHTS, Boxes, Lamps, PolygonScene, Texture

Colour = Float[np.ndarray, "3"]
Opening = tuple[float, float, float, float]
"""(low s, low t, high s, high t) in metres along the sides of a rectangle."""
DARKEST, BRIGHTEST = 6.0, 250.0
_BOX_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (2, 3, 7, 6), (1, 2, 6, 5), (3, 0, 4, 7))
"""Corners of the bottom, top, front (low y), back, right (high x) and left face, counter-clockwise from outside."""


def colour(grey: float, hue_deg: float = 0.0, chroma: float = 0.0) -> Colour:
    """RGB of exactly that grey level, `chroma` grey levels away from neutral in one of the directions of equal brightness.

    Two colours of one grey level differ for a colour camera only. The chroma is reduced where it would leave 6 to 250.
    """
    across = np.linalg.svd(GREY_WEIGHTS[None])[2][1:]
    angle = math.radians(hue_deg)
    direction = math.cos(angle) * across[0] + math.sin(angle) * across[1]
    room = np.where(direction > 0, BRIGHTEST - grey, grey - DARKEST) / np.maximum(np.abs(direction), 1e-9)
    return grey + min(chroma, float(room.min())) * direction


@dataclass(frozen=True)
class Frame:
    """Where a piece of furniture stands: world point = origin + local point turned by the rotation."""

    rotation: Float[np.ndarray, "3 3"]
    origin_m: Float[np.ndarray, "3"]

    @staticmethod
    def at(x_m: float, y_m: float, z_m: float = 0.0, yaw_deg: float = 0.0) -> "Frame":
        """Upright at a point, turned about the vertical."""
        return Frame(_turn(2, yaw_deg), np.array([x_m, y_m, z_m]))

    def world(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Local points in the world."""
        return self.origin_m + points @ self.rotation.T

    def tilted(self, local_origin: Sequence[float], axis: int, degrees: float) -> "Frame":
        """A frame at a local point, turned about a local axis."""
        return Frame(self.rotation @ _turn(axis, degrees), self.world(np.array(local_origin, dtype=np.float64)))


def _turn(axis: int, degrees: float) -> Float[np.ndarray, "3 3"]:
    angle = math.radians(degrees)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[[i, j], [i, j]] = math.cos(angle)
    rotation[i, j], rotation[j, i] = -math.sin(angle), math.sin(angle)
    return rotation


@dataclass(frozen=True)
class _Face:
    corners_m: Float[np.ndarray, "4 3"]
    plane: int
    layer: int
    surface: int
    shows: tuple[bool, bool, bool, bool]
    albedo: Colour
    texture: int


class Builder:
    """Collects faces; `scene` turns them into arrays. Every method that adds a face answers with the number of its surface."""

    def __init__(self, textures: Sequence[Texture]) -> None:
        self.textures = tuple(textures)
        self._faces: list[_Face] = []
        self._boxes: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._planes = 0
        self._rectangles: list[tuple[Float[np.ndarray, "4 3"], int, int]] = []

    def _add(
        self,
        pieces: Sequence[tuple[Float[np.ndarray, "4 3"], tuple[bool, bool, bool, bool]]],
        outline: Float[np.ndarray, "4 3"],
        plane: int,
        layer: int,
        tone: Colour,
        texture: int,
    ) -> int:
        surface = len(self._rectangles)
        self._rectangles.append((outline, plane, layer))
        self._faces += [_Face(corners, plane, layer, surface, shows, tone, texture) for corners, shows in pieces]
        return surface

    def _new_plane(self) -> int:
        self._planes += 1
        return self._planes - 1

    def face(self, corners_m: Sequence[Sequence[float]] | Float[np.ndarray, "k 3"], tone: Colour, texture: int = 0) -> int:
        """A convex face of three or four corners in one plane, counter-clockwise from its front."""
        corners = np.array(corners_m, dtype=np.float64)
        corners = corners[[0, 1, 2, len(corners) - 1]]
        return self._add([(corners, (True,) * 4)], corners, self._new_plane(), 0, tone, texture)

    def wall(self, corners_m: Float[np.ndarray, "4 3"], tone: Colour, texture: int = 0, openings: Sequence[Opening] = ()) -> int:
        """A rectangle with rectangular openings that do not touch each other: cut into pieces whose seams are no edges.

        Coordinates of the openings run from the first corner to the second (s) and to the fourth (t).
        """
        width, height = (float(np.linalg.norm(corners_m[k] - corners_m[0])) for k in (1, 3))
        # To the nanometre, so that openings in a row share their cuts.
        holes = [tuple(round(x, 9) for x in opening) for opening in openings]
        s = sorted({0.0, round(width, 9), *(x for hole in holes for x in hole[::2])})
        t = sorted({0.0, round(height, 9), *(x for hole in holes for x in hole[1::2])})
        solid = np.ones((len(s) - 1, len(t) - 1), dtype=bool)
        for low_s, low_t, high_s, high_t in holes:
            solid[s.index(low_s) : s.index(high_s), t.index(low_t) : t.index(high_t)] = False
        pieces = []
        for i, j in np.argwhere(solid).tolist():
            shows = tuple(not _solid_at(solid, i + di, j + dj) for di, dj in ((0, -1), (1, 0), (0, 1), (-1, 0)))
            pieces.append((rectangle_on(corners_m, (s[i], t[j], s[i + 1], t[j + 1])), shows))
        return self._add(pieces, corners_m, self._new_plane(), 0, tone, texture)  # type: ignore[arg-type]

    def paint(self, surface: int, place: Opening, tone: Colour, texture: int = 0, over: int | None = None) -> int:
        """A rectangle painted on a rectangular surface, in metres along its sides from its first corner.

        Paint that lies over other paint on the same surface names the last of it.
        """
        return self.paint_shape(surface, rectangle_on(self._rectangles[surface][0], place), tone, texture, over)

    def paint_shape(
        self, surface: int, corners_m: Float[np.ndarray, "4 3"], tone: Colour, texture: int = 0, over: int | None = None
    ) -> int:
        """A convex shape painted on a surface, its corners in the world."""
        plane, layer = self._rectangles[surface if over is None else over][1:]
        return self._add([(corners_m, (True,) * 4)], corners_m, plane, layer + 1, tone, texture)

    def box(
        self, frame: Frame, low: Sequence[float], high: Sequence[float], tone: Colour, texture: int = 0, *, solid: bool = True
    ) -> list[int]:
        """A closed box between two local corners: its bottom, top, front (low y), back, right (high x) and left face."""
        x0, y0, z0 = low
        x1, y1, z1 = high
        corners = frame.world(
            np.array(
                [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0], [x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]]
            )
        )
        if solid:
            self.keep_out(frame, low, high)
        return [self.face(corners[list(face)], tone, texture) for face in _BOX_FACES]

    def recess(
        self,
        frame: Frame,
        opening: Opening,
        front_y: float,
        back_y: float,
        tone: Colour,
        *,
        texture: int = 0,
        threshold: bool = True,
    ) -> None:
        """The four sides of an opening, which runs along local y from the front to the back; the lower one may be left out."""
        (s0, t0, s1, t1), y0, y1 = opening, front_y, back_y
        sides = [
            [[s0, y0, t0], [s0, y1, t0], [s0, y1, t1], [s0, y0, t1]],
            [[s1, y1, t0], [s1, y0, t0], [s1, y0, t1], [s1, y1, t1]],
            [[s0, y1, t1], [s1, y1, t1], [s1, y0, t1], [s0, y0, t1]],
            [[s0, y0, t0], [s1, y0, t0], [s1, y1, t0], [s0, y1, t0]],
        ]
        for corners in sides if threshold else sides[:3]:
            self.face(frame.world(np.array(corners)), tone, texture)

    def upright(
        self, frame: Frame, place: Opening, y: float, tone: Colour, texture: int = 0, *, openings: Sequence[Opening] = ()
    ) -> int:
        """A rectangle in a plane of local y, seen from low y; openings are given in the frame, as its own place is."""
        s0, t0, s1, t1 = place
        corners = frame.world(np.array([[s0, y, t0], [s1, y, t0], [s1, y, t1], [s0, y, t1]]))
        # From the corner, to the last bit where sides meet.
        inner = [(a - s0, b - t0, c - s0, d - t0) for a, b, c, d in openings]
        return self.wall(corners, tone, texture, inner)

    def ring(
        self,
        frame: Frame,
        place: Opening,
        openings: Sequence[Opening],
        front_y: float,
        back_y: float,
        *,
        tone: Colour,
        texture: int = 0,
    ) -> None:
        """A board with openings, such as the frame of a picture or a window: its front, outer and inner sides.

        An opening that reaches the lower side, as of a door, has no threshold.
        """
        self.upright(frame, place, front_y, tone, texture, openings=openings)
        for opening in openings:
            self.recess(frame, opening, front_y, back_y, tone, texture=texture, threshold=opening[1] > place[1])
        (s0, t0, s1, t1), y0, y1 = place, front_y, back_y
        for corners in (
            [[s0, y1, t0], [s0, y0, t0], [s0, y0, t1], [s0, y1, t1]],
            [[s1, y0, t0], [s1, y1, t0], [s1, y1, t1], [s1, y0, t1]],
            [[s0, y1, t0], [s1, y1, t0], [s1, y0, t0], [s0, y0, t0]],
            [[s0, y0, t1], [s1, y0, t1], [s1, y1, t1], [s0, y1, t1]],
        ):
            self.face(frame.world(np.array(corners)), tone, texture)

    def frustum(
        self,
        frame: Frame,
        sides: int,
        radii: tuple[float, float],
        heights: tuple[float, float],
        tone: Colour,
        *,
        texture: int = 0,
    ) -> None:
        """A closed column of equal sides round local z, of one radius at its foot and another at its head."""
        angle = 2.0 * math.pi * np.arange(sides) / sides
        circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], -1)
        foot, head = (frame.world(r * circle + [0.0, 0.0, z]) for r, z in zip(radii, heights, strict=True))
        for k in range(sides):
            j = (k + 1) % sides
            self.face(np.stack([foot[k], foot[j], head[j], head[k]]), tone, texture)
        for ring in (foot[::-1], head):
            fan = [(ring[[0, k, k + 1, k + 1]], (k == 1, True, False, k == sides - 2)) for k in range(1, sides - 1)]
            self._add(fan, ring[:4], self._new_plane(), 0, tone, texture)
        reach = max(radii)
        self.keep_out(frame, (-reach, -reach, heights[0]), (reach, reach, heights[1]))

    def keep_out(self, frame: Frame, low: Sequence[float], high: Sequence[float]) -> None:
        """A box in which no camera stands."""
        ends = np.array([low, high], dtype=np.float64)
        self._boxes.append((frame.world(ends.mean(0)), frame.rotation.T, 0.5 * (ends[1] - ends[0])))

    def scene(
        self,
        lamps: Lamps,
        sky: Float[np.ndarray, "2 3"],
        low_m: Float[np.ndarray, "3"],
        high_m: Float[np.ndarray, "3"],
    ) -> PolygonScene:
        """The faces so far; cameras stand between the two corners."""
        faces = self._faces
        numbers = np.array([[f.plane, f.layer, f.surface, f.texture] for f in faces], dtype=np.int64)
        return PolygonScene(
            corners_m=np.stack([f.corners_m for f in faces]),
            plane=numbers[:, 0],
            layer=numbers[:, 1],
            surface=numbers[:, 2],
            shows=np.array([f.shows for f in faces], dtype=bool),
            albedo=np.stack([f.albedo for f in faces]),
            texture=numbers[:, 3],
            textures=self.textures,
            lamps=lamps,
            sky=sky,
            boxes=Boxes(*(np.stack(part) for part in zip(*self._boxes, strict=True))),
            low_m=low_m,
            high_m=high_m,
        )


def _solid_at(solid: Bool[np.ndarray, "m n"], i: int, j: int) -> bool:
    return 0 <= i < solid.shape[0] and 0 <= j < solid.shape[1] and bool(solid[i, j])


def rectangle_on(outline: Float[np.ndarray, "4 3"], place: Opening) -> Float[np.ndarray, "4 3"]:
    """Corners of a rectangle given in metres along the sides of another one."""
    along, up = ((outline[k] - outline[0]) / np.linalg.norm(outline[k] - outline[0]) for k in (1, 3))
    s0, t0, s1, t1 = place
    return outline[0] + np.array([[s0, t0], [s1, t0], [s1, t1], [s0, t1]]) @ np.stack([along, up])
