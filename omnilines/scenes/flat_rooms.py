"""Rooms of a flat and what stands in each of them, clear of the doors and of the way between them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from omnilines.scenes.building import Builder, Frame, Opening
from omnilines.scenes.furniture import (
    FABRIC,
    STONE,
    WOOD,
    bookshelf,
    chair,
    cupboard,
    door,
    lamp,
    other_hue,
    picture,
    radiator,
    sofa,
    table,
    tone,
    wood,
)
from omnilines.scenes.room import Wall

_BEFORE_WALL_M = 0.02
"""Furniture stands before the skirting."""


@dataclass(frozen=True)
class Room:
    """A rectangle of the plan with its walls: north (high y), east, south, west, each as seen from within."""

    low_m: Float[np.ndarray, "2"]
    high_m: Float[np.ndarray, "2"]
    walls: list[Wall]
    window_wall: int
    windows: tuple[Opening, ...]

    @property
    def height_m(self) -> float:
        """Of the ceiling."""
        return self.walls[0][2]

    def along(self, wall: int, point_m: Float[np.ndarray, "2"]) -> float:
        """How far along a wall a point of the plan lies, from the left end as seen from within."""
        frame = self.walls[wall][0]
        return float((np.append(point_m, 0.0) - frame.origin_m) @ frame.rotation[:, 0])


def _before(room: Room, wall: int) -> Frame:
    """The frame of a wall, moved to where furniture stands."""
    return room.walls[wall][0].tilted((0.0, -_BEFORE_WALL_M, 0.0), 2, 0.0)


def _rug(build: Builder, floor: int, rng: np.random.Generator, at: Frame, half_m: tuple[float, float]) -> None:
    """A rectangle with a border of one brightness."""
    cloth, last = tone(rng, 70.0, 150.0, 35.0), None
    outline = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half_m, 0.0]
    for share, shade in ((1.0, cloth), (0.85, other_hue(rng, cloth, 45.0))):
        last = build.paint_shape(floor, at.world(outline * share), shade, FABRIC, over=last if last is not None else floor)


def _ceiling_light(build: Builder, room: Room, rng: np.random.Generator) -> None:
    """A flat box under the middle of the ceiling."""
    middle = 0.5 * (room.low_m + room.high_m) + rng.uniform(-0.2, 0.2, 2)
    at = Frame.at(float(middle[0]), float(middle[1]), room.height_m)
    build.box(at, (-0.3, -0.15, -0.08), (0.3, 0.15, 0.0), 1.3 * tone(rng, 190.0, 215.0, 6.0))


def _radiators(build: Builder, room: Room, rng: np.random.Generator) -> None:
    for place in room.windows:
        radiator(build, room.walls[room.window_wall][0], rng, place[0] + 0.1, place[2] - place[0] - 0.2)


def _living_room(build: Builder, room: Room, rng: np.random.Generator, floor: int, doors: dict[int, Opening]) -> None:
    """A sofa under pictures, a low table on a rug, a cupboard beside the door and a bookshelf."""
    _radiators(build, room, rng)
    left, width = rng.uniform(0.9, 1.1), rng.uniform(1.7, 2.0)
    sofa(build, _before(room, 3), rng, left, width)
    for k in range(2):
        at, t0 = left + 0.1 + k * 0.5 * width, rng.uniform(1.25, 1.4)
        picture(build, room.walls[3][0], rng, (at, t0, at + rng.uniform(0.5, 0.7), t0 + rng.uniform(0.4, 0.6)))
    low = Frame.at(room.low_m[0] + 1.35, room.low_m[1] + left + 0.5 * width, 0.0, 90.0 + rng.uniform(-5.0, 5.0))
    _rug(build, floor, rng, low, (1.1, 0.65))
    table(build, low, rng, 0.9, 0.5, height=0.45)
    door_left = doors[2][0]
    cupboard(build, _before(room, 2), rng, 0.2, min(1.2, door_left - 0.5), height=rng.uniform(0.7, 0.9))
    picture(build, room.walls[2][0], rng, (0.35, 1.4, 0.95, rng.uniform(1.8, 2.0)))
    length = room.walls[1][1]
    bookshelf(build, _before(room, 1), rng, 0.15, min(1.1, 0.5 * length - 0.95), height=rng.uniform(1.7, 2.0))
    lamp(build, float(low.origin_m[0]), float(low.origin_m[1]), room.height_m, rng)


def _study(build: Builder, room: Room, rng: np.random.Generator, floor: int, doors: dict[int, Opening]) -> None:
    """A desk under the window, a bookshelf, a cupboard."""
    wall = _before(room, 2)
    middle = room.walls[2][1] - rng.uniform(1.2, 1.5)
    table(build, wall.tilted((middle, -0.45, 0.0), 2, 0.0), rng, 1.3, 0.62, height=0.74)
    chair(build, wall.tilted((middle, -0.72, 0.0), 2, 180.0 + rng.uniform(-8.0, 8.0)), rng, wood(rng, 60.0, 150.0))
    bookshelf(build, _before(room, 3), rng, rng.uniform(1.3, 1.45), rng.uniform(1.0, 1.2), height=rng.uniform(1.8, 2.1))
    cupboard(build, _before(room, 0), rng, 0.25, min(1.1, doors[0][0] - 0.55), height=rng.uniform(0.8, 1.1))
    picture(build, room.walls[0][0], rng, (0.35, 1.45, 0.85, rng.uniform(1.8, 2.1)))
    s0 = doors[1][2] + 0.25
    picture(build, room.walls[1][0], rng, (s0, 1.3, s0 + rng.uniform(0.4, 0.6), rng.uniform(1.7, 1.95)))
    _ceiling_light(build, room, rng)


def _hall(build: Builder, room: Room, rng: np.random.Generator, floor: int, doors: dict[int, Opening]) -> None:
    """The door of the flat, tiles of two hues of one brightness, a cupboard under pictures."""
    side, (x, y) = rng.uniform(0.45, 0.55), (room.high_m - room.low_m).tolist()
    tile = tone(rng, 110.0, 170.0, 35.0)
    for i in range(int(x / side)):
        for j in range(int(y / side)):
            if (i + j) % 2:
                build.paint(floor, (i * side, j * side, (i + 1) * side, (j + 1) * side), tile, STONE)
    door(build, room.walls[2][0], rng, doors[2])
    length = room.walls[0][1]
    cupboard(build, _before(room, 0), rng, 0.5 * length - 0.8, 1.6, height=rng.uniform(0.85, 1.0))
    for s0 in (0.5 * length - 0.75, 0.5 * length + 0.1):
        t0 = rng.uniform(1.4, 1.5)
        picture(build, room.walls[0][0], rng, (s0, t0, s0 + rng.uniform(0.45, 0.65), t0 + rng.uniform(0.4, 0.6)))
    _ceiling_light(build, room, rng)


def _bed(build: Builder, wall: Frame, rng: np.random.Generator, left: float) -> None:
    """A frame with a head at the wall, a mattress, a blanket and two pillows."""
    width, long = 1.4, 2.0
    timber, sheet, blanket = wood(rng, 70.0, 170.0), tone(rng, 190.0, 220.0, 8.0), tone(rng, 70.0, 170.0, 40.0)
    build.box(wall, (left, -0.05, 0.0), (left + width, 0.0, rng.uniform(0.85, 1.0)), timber, WOOD)
    build.box(wall, (left, -long, 0.12), (left + width, -0.05, 0.26), timber * 0.9, WOOD)
    build.box(wall, (left + 0.03, -0.7, 0.26), (left + width - 0.03, -0.05, 0.46), sheet, FABRIC)
    build.box(wall, (left - 0.02, -long - 0.02, 0.26), (left + width + 0.02, -0.7, 0.5), blanket, FABRIC)
    for k in range(2):
        s0 = left + 0.1 + 0.63 * k
        build.box(wall, (s0, -0.55, 0.46), (s0 + 0.55, -0.1, 0.58), sheet * 1.05, FABRIC)
    build.keep_out(wall, (left, -long, 0.0), (left + width, 0.0, 0.95))


def _bedroom(build: Builder, room: Room, rng: np.random.Generator, floor: int, doors: dict[int, Opening]) -> None:
    """A bed under a picture, a bedside table and a wardrobe."""
    _radiators(build, room, rng)
    length = room.walls[1][1]
    wall, left = _before(room, 1), length - 1.4 - rng.uniform(0.25, 0.35)
    _bed(build, wall, rng, left)
    build.box(wall, (left - 0.5, -0.4, 0.0), (left - 0.08, 0.0, 0.5), wood(rng, 60.0, 190.0), WOOD)
    picture(build, room.walls[1][0], rng, (left + 0.3, 1.3, left + 1.1, rng.uniform(1.75, 1.95)))
    wall, s0 = _before(room, 0), doors[0][2] + 0.25
    cupboard(build, wall, rng, s0, min(1.5, room.walls[0][1] - s0 - 0.15), height=rng.uniform(1.85, 2.05))
    picture(build, room.walls[3][0], rng, (0.25, 1.3, 0.75, rng.uniform(1.7, 1.95)))
    _ceiling_light(build, room, rng)


def _dining_room(build: Builder, room: Room, rng: np.random.Generator, floor: int, doors: dict[int, Opening]) -> None:
    """A table with chairs on a rug, a sofa, a cupboard and a bookshelf."""
    _radiators(build, room, rng)
    x, y = room.high_m[0] - 1.15, room.high_m[1] - rng.uniform(1.35, 1.45)
    at = Frame.at(x, y, 0.0, rng.uniform(-5.0, 5.0))
    _rug(build, floor, rng, at, (0.95, 1.1))
    table(build, at, rng, 1.3, 0.8, height=0.74)
    body = wood(rng, 50.0, 150.0)
    for i, j in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        turned = (0.0 if j > 0 else 180.0) + rng.uniform(-10.0, 10.0)
        chair(build, at.tilted((i * 0.32, j * rng.uniform(0.68, 0.74), 0.0), 2, turned), rng, body)
    lamp(build, x, y, room.height_m, rng)
    south, (left, _, right, _) = _before(room, 2), doors[2]
    cupboard(build, south, rng, 0.2, min(1.3, left - 0.6), height=rng.uniform(0.7, 0.95))
    picture(build, room.walls[2][0], rng, (0.3, 1.4, 0.9, rng.uniform(1.8, 2.0)))
    width = rng.uniform(1.7, 1.9)
    sofa(build, south, rng, right + 0.25, width)
    for s0 in (right + 0.4, right + 0.5 + 0.5 * width):
        picture(build, room.walls[2][0], rng, (s0, 1.3, s0 + rng.uniform(0.4, 0.65), rng.uniform(1.7, 2.0)))
    length = room.walls[3][1]
    bookshelf(build, _before(room, 3), rng, length - 1.15, min(1.0, 0.5 * length - 0.95), height=rng.uniform(1.7, 2.0))
    picture(build, room.walls[1][0], rng, (length - 1.6, 1.35, length - 0.9, rng.uniform(1.75, 2.0)))


FURNISHED: tuple[Callable[[Builder, Room, np.random.Generator, int, dict[int, Opening]], None], ...] = (
    _living_room,
    _study,
    _hall,
    _bedroom,
    _dining_room,
)
"""What furnishes each room of the plan, given the surface of its floor and the openings of its doors by wall."""
