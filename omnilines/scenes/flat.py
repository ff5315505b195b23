"""A flat of five rooms in a chain of doorways, with textureless walls, drawn from a seed; photos are walked through it.

The study, the hall and the bedroom lie side by side along y = 0, the living room and the dining room behind them. Doors lead from
the living room to the study, the hall, the bedroom and the dining room; in some flats another one from there to the living room.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from omnilines.scenes.building import Builder, Frame, Opening, colour
from omnilines.scenes.flat_rooms import FURNISHED, Room
from omnilines.scenes.furniture import PLAIN, PLASTER, STONE, WOOD, other_hue, tone, window, wood
from omnilines.scenes.polygon_scene import Lamps, PolygonScene, Texture
from omnilines.scenes.room import room_textures, room_walls
from omnilines.synthetic.targets import generator

THICK_M = 0.15
"""Of the walls."""
DOOR_M = (0.9, 2.02)
ARCHITRAVE_M = 0.08
ENTRANCE: Opening = (0.5, 0.0, 1.4, 2.02)
"""Of the flat, in the hall."""
EYE_M = 1.5
"""Height of the walk above the floor."""
LIVING, STUDY, HALL, BEDROOM, DINING = range(5)
NORTH, EAST, SOUTH, WEST = range(4)
"""Walls of a room, in the order of `room_walls`."""


@dataclass(frozen=True)
class _Doorway:
    """An opening from one room into the next, in which its leaf stands open."""

    rooms: tuple[int, int]
    wall: int
    """Of the first room; in the second it is the opposite one."""
    middle_m: Float[np.ndarray, "2"]
    hinge: int
    """Side of the leaf, seen from the second room: -1 left, +1 right."""

    def openings(self, rooms: list[Room]) -> tuple[Opening, Opening]:
        """The place in the wall of each of both rooms."""
        middles = (rooms[room].along(wall, self.middle_m) for room, wall in zip(self.rooms, self.walls, strict=True))
        first, second = ((s - 0.5 * DOOR_M[0], 0.0, s + 0.5 * DOOR_M[0], DOOR_M[1]) for s in middles)
        return first, second

    @property
    def walls(self) -> tuple[int, int]:
        """In both rooms."""
        return self.wall, (self.wall + 2) % 4


def flat(seed: int) -> PolygonScene:
    """A flat of about 11 x 8 m with a corner at the origin, z up."""
    rng = generator(seed, "flat")
    textures = room_textures(rng)
    textures[PLASTER] = Texture(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    build = Builder(textures)
    height = rng.uniform(2.5, 2.75)
    rooms = _rooms(rng, height)
    doorways = _doorways(rng, rooms)
    closed = int(rng.integers(len(doorways)))
    for k, room in enumerate(rooms):
        doors = _doors_of(k, rooms, doorways)
        floor = _shell(build, room, rng, doors)
        FURNISHED[k](build, room, rng, floor, doors)
    for k, doorway in enumerate(doorways):
        _frame(build, rooms, doorway, rng, leaf=k != closed)
    high = np.append(np.max([room.high_m for room in rooms], 0), height)
    scene = build.scene(_lamps(rooms, height), np.stack([colour(200.0)] * 2), np.zeros(3), high)
    return replace(scene, walk_m=_walk(rooms, doorways))


def _rooms(rng: np.random.Generator, height: float) -> list[Room]:
    """The plan: three rooms in front, two behind them."""
    front = rng.uniform([3.6, 2.8, 3.8], [4.2, 3.3, 4.3])
    depth, behind, left = rng.uniform(3.4, 3.8), rng.uniform(4.0, 4.4), rng.uniform(4.6, 5.2)
    x = np.concatenate([[0.0], np.cumsum(front + THICK_M)])
    y0, y1, end = depth + THICK_M, depth + THICK_M + behind, x[3] - THICK_M
    plan = [
        (0.0, y0, left, y1),
        *((x[k], 0.0, x[k + 1] - THICK_M, depth) for k in range(3)),
        (left + THICK_M, y0, end, y1),
    ]
    windows = {LIVING: (NORTH, 2), STUDY: (SOUTH, 1), BEDROOM: (SOUTH, 1), DINING: (NORTH, 2)}
    rooms = []
    for k, (low_x, low_y, high_x, high_y) in enumerate(plan):
        low, high = np.array([low_x, low_y]), np.array([high_x, high_y])
        walls = room_walls(np.append(high - low, height), 0, (low_x, low_y))
        places: list[Opening] = []
        if k in windows:
            wall, count = windows[k]
            width, sill, head = rng.uniform(1.0, 1.3), rng.uniform(0.85, 0.95), rng.uniform(2.0, 2.2)
            gap = (walls[wall][1] - count * width) / (count + 1)
            places = [(gap + i * (gap + width), sill, (i + 1) * (gap + width), head) for i in range(count)]
        rooms.append(Room(low, high, walls, windows.get(k, (NORTH, 0))[0], tuple(places)))
    return rooms


def _doorways(rng: np.random.Generator, rooms: list[Room]) -> list[_Doorway]:
    """Those of the chain, in the order of the walk, and in half of the flats the one that closes it to a ring."""
    depth, bed = rooms[STUDY].high_m[1], rooms[BEDROOM].low_m[0]
    study_y = depth * rng.uniform(0.42, 0.48)
    hall_y = study_y + rng.uniform(0.05, 0.3)
    chain = [
        _Doorway((LIVING, STUDY), SOUTH, np.array([rng.uniform(2.0, 2.6), depth]), 1),
        _Doorway((STUDY, HALL), EAST, np.array([rooms[STUDY].high_m[0], study_y]), -1),
        _Doorway((HALL, BEDROOM), EAST, np.array([rooms[HALL].high_m[0], hall_y]), -1),
        _Doorway((BEDROOM, DINING), NORTH, np.array([bed + rng.uniform(1.3, 1.6), depth]), -1),
    ]
    middle = 0.5 * (rooms[DINING].low_m[1] + rooms[DINING].high_m[1]) + rng.uniform(-0.2, 0.2)
    back = _Doorway((DINING, LIVING), WEST, np.array([rooms[DINING].low_m[0], middle]), 1)
    return [*chain, back] if rng.uniform() < 0.5 else chain


def _doors_of(room: int, rooms: list[Room], doorways: list[_Doorway]) -> dict[int, Opening]:
    """Openings of the doors of a room by its walls, each of which has one at most; the door of the flat is shut."""
    doors = {
        doorway.walls[side]: doorway.openings(rooms)[side]
        for doorway in doorways
        for side in range(2)
        if doorway.rooms[side] == room
    }
    return {**doors, SOUTH: ENTRANCE} if room == HALL else doors


def _shell(build: Builder, room: Room, rng: np.random.Generator, doors: dict[int, Opening]) -> int:
    """Walls, floor, ceiling, windows and skirting; the surface of the floor."""
    paint, trim = tone(rng, 160.0, 215.0, 16.0), tone(rng, 190.0, 225.0, 6.0)
    for k, (frame, length, height) in enumerate(room.walls):
        own = [doors[k]] if k in doors else []
        windows = list(room.windows) if k == room.window_wall else []
        build.upright(frame, (0.0, 0.0, length, height), 0.0, paint, PLASTER, openings=own + windows)
        for place in windows:
            window(build, frame, rng, place)
        _skirting(build, room, k, doors, trim)
        cuts = [0.0, *(own[0][::2] if own else ()), length]
        for a, b in zip(cuts[::2], cuts[1::2], strict=True):
            build.keep_out(frame, (a, 0.0, 0.0), (b, THICK_M, height))
    (x0, y0), (x1, y1), z = room.low_m, room.high_m, room.height_m
    ceiling = np.array([[x0, y1, z], [x1, y1, z], [x1, y0, z], [x0, y0, z]])
    build.wall(ceiling, tone(rng, 215.0, 235.0, 5.0), PLASTER)
    floor = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
    return build.wall(floor, wood(rng, 90.0, 160.0), WOOD)


def _skirting(build: Builder, room: Room, wall: int, doors: dict[int, Opening], trim: Float[np.ndarray, "3"]) -> None:
    """A board along a wall but for its doors; butt joints: every second one ends at its neighbours."""
    thick = 0.015
    frame, length, _ = room.walls[wall]
    end = thick * (wall % 2)
    gap = (doors[wall][0] - ARCHITRAVE_M, doors[wall][2] + ARCHITRAVE_M) if wall in doors else ()
    cuts = [end, *gap, length - end]
    for a, b in zip(cuts[::2], cuts[1::2], strict=True):
        build.box(frame, (a, -thick, 0.0), (b, 0.0, 0.08), trim, solid=False)


def _frame(build: Builder, rooms: list[Room], doorway: _Doorway, rng: np.random.Generator, leaf: bool) -> None:
    """Jambs through the wall, a threshold, architraves on both sides, and the open leaf in the second room."""
    trim = tone(rng, 150.0, 215.0, 10.0)
    frames = [rooms[room].walls[wall][0] for room, wall in zip(doorway.rooms, doorway.walls, strict=True)]
    openings = doorway.openings(rooms)
    build.recess(frames[0], openings[0], 0.0, THICK_M, trim, texture=PLAIN, threshold=False)
    s0, _, s1, _ = openings[0]
    step = np.array([[s0, 0.0, 0.0], [s1, 0.0, 0.0], [s1, THICK_M, 0.0], [s0, THICK_M, 0.0]])
    build.face(frames[0].world(step), wood(rng, 60.0, 130.0), STONE)
    for frame, (a, low, b, high) in zip(frames, openings, strict=True):
        outer = (a - ARCHITRAVE_M, low, b + ARCHITRAVE_M, high + ARCHITRAVE_M)
        build.ring(frame, outer, [(a, low, b, high)], -0.02, 0.0, tone=trim, texture=PLAIN)
    if leaf:
        _leaf(build, frames[1], rng, openings[1], doorway.hinge)


def _leaf(build: Builder, wall: Frame, rng: np.random.Generator, opening: Opening, hinge: int) -> None:
    """A leaf with two panels and a handle on each side, opened by a little more than a right angle."""
    thick, opened = 0.04, rng.uniform(92.0, 105.0)
    pivot = opening[0] if hinge < 0 else opening[2]
    at = wall.tilted((pivot, -0.03, 0.0), 2, -opened if hinge < 0 else 180.0 + opened)
    low, high = (0.0, thick) if hinge < 0 else (-thick, 0.0)
    width, top = DOOR_M[0] - 0.02, DOOR_M[1] - 0.01
    body = wood(rng, 90.0, 200.0)
    sides = build.box(at, (0.01, low, 0.01), (width, high, top), body, WOOD)[2:4]
    panel = other_hue(rng, body, 25.0) if rng.uniform() < 0.4 else body * rng.uniform(0.72, 0.85)
    for side in sides:
        for below, above in ((0.15, 0.95), (1.1, 1.85)):
            build.paint(side, (0.14, below, width - 0.15, above), panel, WOOD)
    for y0, y1 in ((low - 0.05, low), (high, high + 0.05)):
        build.box(at, (width - 0.2, y0, 1.02), (width - 0.06, y1, 1.05), colour(70.0, 0.0, 5.0), solid=False)


def _walk(rooms: list[Room], doorways: list[_Doorway]) -> Float[np.ndarray, "k 3"]:
    """The way of the photographer: straight through each doorway of the chain, and across the rooms between them."""
    living, dining = rooms[LIVING], rooms[DINING]
    depth = living.high_m[1] - living.low_m[1]
    points = [np.array([living.high_m[0] - 1.2, living.low_m[1] + 0.7 * depth])]
    for doorway in doorways[:4]:
        outward = rooms[doorway.rooms[0]].walls[doorway.wall][0].rotation[:2, 1]
        points += [doorway.middle_m - 0.6 * outward, doorway.middle_m + (THICK_M + 0.6) * outward]
    points += [points[-1] + [0.0, 1.0], np.array([dining.low_m[0] + 1.2, dining.low_m[1] + 0.5 * depth])]
    return np.column_stack([np.stack(points), np.full(len(points), EYE_M)])


def _lamps(rooms: list[Room], height: float) -> Lamps:
    """One under the ceiling of each room, and the daylight of the windows; light passes through walls, as all of it does here."""
    middles = [np.append(0.5 * (room.low_m + room.high_m), height - 0.35) for room in rooms]
    daylight = [
        room.walls[room.window_wall][0].world(np.array([0.5 * (place[0] + place[2]), 0.5, 1.6]))
        for room in rooms
        for place in room.windows
    ]
    strength = np.array([0.35] * len(middles) + [0.25] * len(daylight))
    reach = np.array([2.0] * len(middles) + [1.6] * len(daylight))
    return Lamps(np.stack(middles + daylight), strength, reach, 0.66, 0.06, np.array([0.05, 0.035]))
