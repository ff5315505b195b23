"""A room with large plain pieces of furniture: whatever has two sides, they lie 0.1 m or more apart. Drawn from a seed.

The furnished room is full of edges a few pixels apart, as rooms are: books, slats, frames. This one has none of these: what a
method loses here it does not lose to neighbouring edges.
"""

import numpy as np
from jaxtyping import Float

from omnilines.scenes.building import Builder, Colour, Frame, Opening, colour
from omnilines.scenes.furniture import FABRIC, LEAF_HUE_DEG, PLAIN, PLASTER, SKY_HUE_DEG, STONE, WOOD, other_hue, tone, wood
from omnilines.scenes.polygon_scene import PolygonScene
from omnilines.scenes.room import FROM_WALLS_M, ROOM_M, Wall, checked_size, room_lamps, room_textures, room_walls
from omnilines.synthetic.targets import generator

THINNEST_M = 0.1
"""Least distance between two parallel edges of one piece."""


def plain_room(seed: int, size_m: tuple[float, float, float] = ROOM_M) -> PolygonScene:
    """A room between the origin and `size_m`, z up. Raises InputError for a size that the furniture does not fit."""
    size = checked_size(size_m)
    rng = generator(seed, "plain room")
    build = Builder(room_textures(rng))
    walls = room_walls(size, int(rng.integers(4)))
    paint = tone(rng, 150.0, 205.0, 14.0)
    floor = _floor_and_ceiling(build, size, rng)
    _door_wall(build, walls[0], rng, paint)
    _window_wall(build, walls[1], rng, paint)
    _shelf_wall(build, walls[2], rng, paint)
    _sofa_wall(build, walls[3], rng, paint)
    _middle(build, size, rng, floor)
    outside = np.stack([colour(200.0), colour(200.0)])
    return build.scene(room_lamps(walls[1], size), outside, np.full(3, FROM_WALLS_M), size - FROM_WALLS_M)


def _contrasting(rng: np.random.Generator, with_tone: Colour) -> Colour:
    """A colour that differs from another one: in brightness, and one time in four in hue only."""
    if rng.uniform() < 0.25:
        return other_hue(rng, with_tone, 60.0)
    grey = float(with_tone.mean())
    darker = rng.uniform() < (grey - 40.0) / 180.0
    return tone(rng, 40.0, max(45.0, grey - 40.0), 40.0) if darker else tone(rng, min(215.0, grey + 40.0), 225.0, 30.0)


def _hanging(build: Builder, wall: int, rng: np.random.Generator, place: Opening, paint: Colour) -> None:
    """A picture on the wall: a rectangle in a rectangle."""
    s0, t0, s1, t1 = place
    rim = rng.uniform(THINNEST_M, 0.15)
    mount = _contrasting(rng, paint)
    last = build.paint(wall, place, mount)
    build.paint(wall, (s0 + rim, t0 + rim, s1 - rim, t1 - rim), _contrasting(rng, mount), over=last)


def _door_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    """A door in a recess with two panels, and a cupboard with painted doors."""
    frame, length, height = wall
    at = rng.uniform(0.25, 0.6)
    opening = (at, 0.0, at + 0.9, 2.02)
    plaster = build.upright(frame, (0.0, 0.0, length, height), 0.0, paint, PLASTER, openings=[opening])
    build.recess(frame, opening, 0.0, 0.14, tone(rng, 120.0, 215.0, 10.0), texture=PLAIN)
    leaf_tone = wood(rng, 80.0, 190.0)
    leaf = build.upright(frame, opening, 0.14, leaf_tone, WOOD)
    panel = _contrasting(rng, leaf_tone)
    for low, high in ((0.15, 0.95), (1.1, 1.9)):
        build.paint(leaf, (0.15, low, 0.75, high), panel, WOOD)
    left, wide = at + 1.3, min(length - at - 1.6, rng.uniform(1.1, 1.5))
    depth, tall, body = rng.uniform(0.4, 0.55), rng.uniform(0.8, 1.1), tone(rng, 60.0, 215.0, 30.0)
    front = build.box(frame, (left, -depth, 0.0), (left + wide, -0.002, tall), body, WOOD)[2]
    doors, shade = max(2, round(wide / 0.6)), _contrasting(rng, body)
    for k in range(doors):
        build.paint(front, (k * wide / doors + 0.08, 0.15, (k + 1) * wide / doors - 0.08, tall - 0.15), shade, WOOD)
    t0 = rng.uniform(1.5, 1.65)
    _hanging(build, plaster, rng, (left + 0.1, t0, left + 0.1 + rng.uniform(0.6, 0.9), t0 + rng.uniform(0.6, 0.9)), paint)


def _window_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    """Two windows of one pane in recesses, the horizon behind them."""
    frame, length, height = wall
    sill, head, width = rng.uniform(0.85, 0.95), min(rng.uniform(2.1, 2.4), height - 0.3), rng.uniform(1.0, 1.4)
    gap = (length - 2 * width) / 3
    places = [(gap, sill, gap + width, head), (2 * gap + width, sill, 2 * gap + 2 * width, head)]
    build.upright(frame, (0.0, 0.0, length, height), 0.0, paint, PLASTER, openings=places)
    for place in places:
        build.recess(frame, place, 0.0, 0.18, tone(rng, 170.0, 215.0, 8.0), texture=PLAIN)
        sky = build.upright(frame, place, 0.18, 1.4 * colour(220.0, SKY_HUE_DEG, 10.0), PLAIN)
        horizon = rng.uniform(0.2, 0.4) * (head - sill)
        build.paint(sky, (0.0, 0.0, width, horizon), colour(rng.uniform(110.0, 160.0), LEAF_HUE_DEG, 40.0), FABRIC)


def _shelf_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    """A shelf with open compartments, a crate in some of them, and a desk with a block on it."""
    frame, length, height = wall
    plaster = build.upright(frame, (0.0, 0.0, length, height), 0.0, paint, PLASTER)
    left, width, tall = rng.uniform(0.15, 0.3), rng.uniform(1.3, 1.6), min(rng.uniform(1.7, 2.1), height - 0.4)
    depth, body, board = rng.uniform(0.3, 0.4), wood(rng, 60.0, 190.0), THINNEST_M
    step, rise = (width - board) / 2, (tall - board) / 3
    cells = [
        (left + board + i * step, board + j * rise, left + (i + 1) * step, (j + 1) * rise) for i in range(2) for j in range(3)
    ]
    place = (left, 0.0, left + width, tall)
    build.ring(frame, place, cells, -depth, -0.002, tone=body, texture=WOOD)
    build.upright(frame, place, -0.002, _contrasting(rng, body), WOOD)
    build.keep_out(frame, (left, -depth, 0.0), (left + width, 0.0, tall))
    for s0, t0, s1, t1 in cells:
        if rng.uniform() < 0.6:
            thick, high = rng.uniform(0.15, 0.3), rng.uniform(0.15, 0.75 * (t1 - t0))
            at = rng.uniform(s0 + 0.05, s1 - 0.05 - thick)
            low = (at, -depth + 0.08, t0)
            build.box(frame, low, (at + thick, -0.05, t0 + high), _contrasting(rng, body), solid=False)
    at = left + width + 0.25
    desk = min(1.4, length - 0.2 - at)
    _table(build, frame.tilted((at + desk / 2, -0.4, 0.0), 2, 0.0), rng, desk, 0.7)
    t0 = rng.uniform(1.35, 1.5)
    _hanging(build, plaster, rng, (at + 0.2, t0, at + 0.2 + rng.uniform(0.6, 0.9), t0 + rng.uniform(0.6, 0.9)), paint)


def _sofa_wall(build: Builder, wall: Wall, rng: np.random.Generator, paint: Colour) -> None:
    """A sofa of five blocks, and a picture over it."""
    frame, length, height = wall
    plaster = build.upright(frame, (0.0, 0.0, length, height), 0.0, paint, PLASTER)
    width, cloth, arm = rng.uniform(1.7, 2.0), tone(rng, 60.0, 180.0, 40.0), 0.2
    left = rng.uniform(1.1, max(1.15, length - width - 0.35))
    seat = _contrasting(rng, cloth)
    for low, high in ((left, left + arm), (left + width - arm, left + width)):
        build.box(frame, (low, -0.9, 0.0), (high, -0.002, 0.6), cloth, FABRIC)
    build.box(frame, (left + arm, -0.3, 0.0), (left + width - arm, -0.002, 0.85), cloth * 0.8, FABRIC)
    middle = left + 0.5 * width
    for low, high, shade in ((left + arm, middle, seat), (middle, left + width - arm, seat * 0.8)):
        build.box(frame, (low, -0.9, 0.0), (high, -0.3, 0.42), shade, FABRIC)
    build.keep_out(frame, (left, -0.9, 0.0), (left + width, 0.0, 0.85))
    at, t0 = left + rng.uniform(0.1, 0.3), rng.uniform(1.15, 1.3)
    _hanging(build, plaster, rng, (at, t0, at + rng.uniform(0.9, 1.3), t0 + rng.uniform(0.6, 0.8)), paint)


def _table(build: Builder, at: Frame, rng: np.random.Generator, width: float, depth: float) -> None:
    """A thick top on four thick legs, with a block lying on it."""
    top, leg, x, y = wood(rng, 80.0, 200.0), THINNEST_M, width / 2, depth / 2
    build.box(at, (-x, -y, 0.64), (x, y, 0.74), top, WOOD)
    for i in (-1, 1):
        for j in (-1, 1):
            cx, cy = i * (x - 0.12), j * (y - 0.12)
            build.box(at, (cx - leg / 2, cy - leg / 2, 0.0), (cx + leg / 2, cy + leg / 2, 0.64), top * 0.75, WOOD)
    spot = at.tilted((rng.uniform(-0.4, 0.4) * x, rng.uniform(-0.2, 0.2) * y, 0.74), 2, rng.uniform(0.0, 180.0))
    half = rng.uniform(0.08, 0.14, 3)
    build.box(spot, (-half[0], -half[1], 0.0), (half[0], half[1], 2 * half[2]), _contrasting(rng, top))
    build.keep_out(at, (-x, -y, 0.0), (x, y, 0.74))


def _middle(build: Builder, size: Float[np.ndarray, "3"], rng: np.random.Generator, floor: int) -> None:
    """A rug with a border, a table with four stools, and a lamp under the ceiling."""
    x, y = (0.5 * size[:2] + rng.uniform(-0.1, 0.1, 2)).tolist()
    at = Frame.at(x, y, 0.0, rng.uniform(-8.0, 8.0) + (0.0 if size[0] >= size[1] else 90.0))
    outline = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
    cloth = tone(rng, 70.0, 150.0, 35.0)
    last = build.paint_shape(floor, at.world(outline * [1.2, 0.95, 0.0]), cloth, FABRIC, over=floor + 1)
    build.paint_shape(floor, at.world(outline * [1.0, 0.75, 0.0]), _contrasting(rng, cloth), FABRIC, over=last)
    width = rng.uniform(1.2, 1.5)
    _table(build, at, rng, width, 0.8)
    for i in (-1, 1):
        for j in (-1, 1):
            place = (i * width / 4, j * rng.uniform(0.68, 0.76), 0.0)
            stool = at.tilted(place, 2, rng.uniform(-12.0, 12.0))
            build.box(stool, (-0.2, -0.2, 0.0), (0.2, 0.2, 0.45), wood(rng, 60.0, 180.0), WOOD)
    drop = rng.uniform(0.3, 0.5)
    hung = Frame.at(x, y, float(size[2]), rng.uniform(0.0, 90.0))
    build.frustum(hung, 4, (0.3, 0.16), (-drop, 0.0), tone(rng, 110.0, 200.0, 30.0), texture=FABRIC)


def _floor_and_ceiling(build: Builder, size: Float[np.ndarray, "3"], rng: np.random.Generator) -> int:
    """Large tiles of two hues of one brightness, and a plain ceiling; the surface of the floor."""
    x, y, z = size.tolist()
    ground = wood(rng, 100.0, 150.0)
    floor = build.wall(np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=np.float64), ground, WOOD)
    side, other = rng.uniform(0.8, 1.0), other_hue(rng, ground, 40.0)
    for i in range(int(x / side)):
        for j in range(int(y / side)):
            if (i + j) % 2:
                build.paint(floor, (i * side, j * side, (i + 1) * side, (j + 1) * side), other, STONE)
    build.wall(np.array([[0, y, z], [x, y, z], [x, 0, z], [0, 0, z]], dtype=np.float64), tone(rng, 215.0, 235.0, 5.0), PLASTER)
    return floor
