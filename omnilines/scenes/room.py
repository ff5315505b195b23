"""A furnished room of 5 x 4 x 3 m: walls with a door, windows and pictures, and furniture, all of it drawn from a seed."""

import numpy as np
from jaxtyping import Float

from camera_models import InputError
from omnilines.scenes.appearance import texture
from omnilines.scenes.building import Builder, Colour, Frame, Opening, colour
from omnilines.scenes.furniture import (
    FABRIC,
    PLASTER,
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
    window,
    wood,
)
from omnilines.scenes.polygon_scene import Lamps, PolygonScene, Texture
from omnilines.synthetic.targets import generator

ROOM_M = (5.0, 4.0, 3.0)
SMALLEST_M, LARGEST_M = (4.0, 4.0, 2.5), (12.0, 12.0, 5.0)
SMALLEST_FLOOR_M2 = 18.0
FROM_WALLS_M = 0.45
"""Least distance of a camera from walls, floor and ceiling."""


def furnished_room(seed: int, size_m: tuple[float, float, float] = ROOM_M) -> PolygonScene:
    """A room between the origin and `size_m`, z up. Raises InputError for a size that the furniture does not fit."""
    size = checked_size(size_m)
    rng = generator(seed, "room")
    build = Builder(room_textures(rng))
    walls = room_walls(size, int(rng.integers(4)))
    paint = tone(rng, 165.0, 205.0, 14.0)
    floor = _floor_and_ceiling(build, size, rng)
    _door_wall(build, walls[0], rng, paint)
    _window_wall(build, walls[1], rng, paint)
    _shelf_wall(build, walls[2], rng, paint)
    _sofa_wall(build, walls[3], rng, paint)
    _dining_place(build, size, rng, floor, [walls[0][0], walls[1][0]])
    return build.scene(
        room_lamps(walls[1], size),
        np.stack([colour(200.0), colour(200.0)]),
        np.full(3, FROM_WALLS_M),
        size - FROM_WALLS_M,
    )


Wall = tuple[Frame, float, float]
"""Frame at the lower left corner as seen from the room, length and height in metres."""


def checked_size(size_m: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    """Width, depth and height as an array; raises InputError for a size that the furniture does not fit."""
    within = all(low <= value <= high for low, value, high in zip(SMALLEST_M, size_m, LARGEST_M, strict=True))
    if not within or size_m[0] * size_m[1] < SMALLEST_FLOOR_M2:
        found = " x ".join(f"{value:g}" for value in size_m)
        raise InputError(
            f"A room of 4 x 4 x 2.5 to 12 x 12 x 5 m with 18 m2 of floor or more was expected, found {found} m; take another."
        )
    return np.array(size_m, dtype=np.float64)


def room_textures(rng: np.random.Generator) -> list[Texture]:
    """Of paint, plaster, wood, fabric and stone, in the order of their numbers."""
    return [
        texture(rng, 0.006, 0.4, 0.02),
        texture(rng, 0.012, 0.8, 0.01, waves=12),
        texture(rng, 0.022, 0.3, 0.008, stretch=4.0, waves=10),
        texture(rng, 0.03, 0.1, 0.006, waves=10),
        texture(rng, 0.02, 0.3, 0.01, waves=10),
    ]


def room_walls(size: Float[np.ndarray, "3"], first: int, corner_m: tuple[float, float] = (0.0, 0.0)) -> list[Wall]:
    """The four walls in the order in which they follow to the right, beginning with any of them.

    `corner_m` is the one of least x and y.
    """
    (x, y, z), (x0, y0) = size.tolist(), corner_m
    walls = [
        (Frame.at(x0, y0 + y, 0.0, 0.0), x, z),
        (Frame.at(x0 + x, y0 + y, 0.0, 270.0), y, z),
        (Frame.at(x0 + x, y0, 0.0, 180.0), x, z),
        (Frame.at(x0, y0, 0.0, 90.0), y, z),
    ]
    return walls[first:] + walls[:first]


def _plain_wall(
    build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour, openings: list[Opening], band: bool = False
) -> None:
    """Plaster with openings, and perhaps a band of another hue as bright as the wall."""
    frame, length, height = wall
    surface = build.upright(frame, (0.0, 0.0, length, height), 0.0, paint, PLASTER, openings=openings)
    if band:
        low = rng.uniform(2.15, 2.25)
        build.paint(surface, (0.0, low, length, low + 0.14), other_hue(rng, paint, 40.0), PLASTER)


def _door_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    frame, length, height = wall
    at = rng.uniform(0.25, 0.6)
    opening = (at, 0.0, at + 0.9, 2.02)
    _plain_wall(build, wall, rng, paint, [opening])
    door(build, frame, rng, opening)
    left = at + 1.2
    cupboard(build, frame, rng, left, min(length - left - 0.2, rng.uniform(1.1, 1.5)), height=rng.uniform(0.8, 1.2))
    for low, high in ((left + 0.05, left + 0.55), (left + 0.75, left + 1.35)):
        t0 = rng.uniform(1.5, 1.65)
        if high < length - 0.1:
            picture(build, frame, rng, (low, t0, high, min(t0 + rng.uniform(0.4, 0.7), height - 0.3)))


def _window_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    frame, length, height = wall
    sill, head = rng.uniform(0.85, 0.95), min(rng.uniform(2.1, 2.4), height - 0.3)
    width = rng.uniform(1.0, 1.4)
    gap = (length - 2 * width) / 3
    places = [(gap, sill, gap + width, head), (2 * gap + width, sill, 2 * gap + 2 * width, head)]
    _plain_wall(build, wall, rng, paint, places)
    for place in places:
        window(build, frame, rng, place)
        radiator(build, frame, rng, place[0] + 0.1, width - 0.2)


def _shelf_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    frame, length, height = wall
    _plain_wall(build, wall, rng, paint, [])
    left = rng.uniform(0.15, 0.3)
    width = min(rng.uniform(1.3, 1.7), length - left - 1.75)
    bookshelf(build, frame, rng, left, width, height=min(rng.uniform(1.8, 2.2), height - 0.4))
    at, end = left + width + 0.25, length - 0.2
    desk = min(1.3, end - at)
    table(build, frame.tilted((at + desk / 2, -0.36, 0.0), 2, 0.0), rng, desk, 0.62, height=0.74)
    chair(build, frame.tilted((at + 0.5 * desk, -0.62, 0.0), 2, 180.0 + rng.uniform(-8, 8)), rng, wood(rng, 60.0, 150.0))
    t0 = rng.uniform(1.3, 1.45)
    picture(build, frame, rng, (at + 0.1, t0, at + 0.6, t0 + rng.uniform(0.5, 0.8)))
    for k in range(2):
        low = t0 + 0.1 + 0.35 * k
        build.box(frame, (at + 0.75, -0.2, low), (at + 1.25, 0.0, low + 0.025), wood(rng))
        for slot in (0.78, 1.0):
            s = at + slot + rng.uniform(0.0, 0.06)
            size = rng.uniform([0.06, 0.08, 0.08], [0.14, 0.14, 0.22])
            build.box(
                frame,
                (s, -0.02 - size[1], low + 0.025),
                (s + size[0], -0.02, low + 0.025 + size[2]),
                tone(rng, 40.0, 220.0, 50.0),
            )


def _sofa_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    frame, length, _ = wall
    _plain_wall(build, wall, rng, paint, [], band=True)
    width = rng.uniform(1.7, 2.0)
    # Beside the desk in the corner to the left.
    left = rng.uniform(1.05, max(1.1, length - width - 0.35))
    sofa(build, frame, rng, left, width)
    at = left + 0.05
    for _ in range(3):
        w, h = rng.uniform(0.35, 0.55), rng.uniform(0.35, 0.75)
        if at + w < length - 0.15:
            t0 = rng.uniform(1.2, 1.35)
            picture(build, frame, rng, (at, t0, at + w, min(t0 + h, 2.1)))
        at += w + rng.uniform(0.1, 0.2)


def _floor_and_ceiling(build: Builder, size: Float[np.ndarray, "3"], rng: np.random.Generator) -> int:
    """Tiles of two hues of one brightness, and a ceiling with a cornice; the surface of the floor."""
    x, y, z = size.tolist()
    ground = wood(rng, 110.0, 160.0)
    floor = build.wall(np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=np.float64), ground, WOOD)
    side, other = rng.uniform(0.4, 0.6), other_hue(rng, ground, 40.0)
    for i in range(int(x / side)):
        for j in range(int(y / side)):
            if (i + j) % 2:
                build.paint(floor, (i * side, j * side, (i + 1) * side, (j + 1) * side), other, STONE)
    build.wall(np.array([[0, y, z], [x, y, z], [x, 0, z], [0, 0, z]], dtype=np.float64), tone(rng, 215.0, 235.0, 5.0), PLASTER)
    trim = tone(rng, 195.0, 225.0, 6.0)
    for k, (frame, length, height) in enumerate(room_walls(size, 0)):
        # Butt joints: every second one ends at its neighbours.
        end = 0.06 * (k % 2)
        build.box(frame, (end, -0.06, height - 0.06), (length - end, 0.0, height), trim)
    return floor


def _dining_place(
    build: Builder, size: Float[np.ndarray, "3"], rng: np.random.Generator, floor: int, clear_walls: list[Frame]
) -> None:
    """A rug, a table with chairs and a lamp near the middle of the room, a little towards the walls that are clearer."""
    middle = 0.5 * size + sum(0.1 * frame.rotation[:, 1] for frame in clear_walls)
    x, y = (middle[:2] + rng.uniform(-0.05, 0.05, 2)).tolist()
    turn = rng.uniform(-6.0, 6.0) + (0.0 if size[0] >= size[1] else 90.0)
    at = Frame.at(x, y, 0.0, turn)
    cloth = tone(rng, 70.0, 150.0, 35.0)
    edge, last = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [1.2, 0.95, 0.0], None
    for share, shade in ((1.0, cloth), (0.88, other_hue(rng, cloth, 45.0)), (0.6, cloth * 1.2)):
        last = build.paint_shape(floor, at.world(edge * share), shade, FABRIC, over=floor + 1 if last is None else last)
    width, depth = rng.uniform(1.2, 1.5), rng.uniform(0.75, 0.85)
    table(build, at, rng, width, depth, height=0.74)
    body = wood(rng, 50.0, 150.0)
    for i, j in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        turned = (0.0 if j > 0 else 180.0) + rng.uniform(-10.0, 10.0)
        chair(build, at.tilted((i * width / 4, j * (depth / 2 + rng.uniform(0.28, 0.36)), 0.0), 2, turned), rng, body)
    lamp(build, x, y, float(size[2]), rng)


def room_lamps(window_wall: Wall, size: Float[np.ndarray, "3"]) -> Lamps:
    """A lamp under the ceiling and the daylight of the windows."""
    frame, length, _ = window_wall
    daylight = frame.world(np.array([0.5 * length, 0.6, 1.7]))
    return Lamps(
        position_m=np.stack([[0.5 * size[0], 0.5 * size[1], size[2] - 0.35], daylight]),
        strength=np.array([0.5, 0.55]),
        reach_m=np.array([3.5, 3.5]),
        ambient=0.68,
        up=0.06,
        side=np.array([0.05, 0.035]),
    )
