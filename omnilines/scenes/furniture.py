"""Pieces of furniture. A frame at a wall has local x along it to the right, y into it, z up: the room is where y < 0.

A frame on the floor has its origin in the middle of the piece. All draws come from the generator that is handed in.
"""

import numpy as np

from omnilines.scenes.building import Builder, Colour, Frame, Opening, colour
from omnilines.scenes.polygon_scene import GREY_WEIGHTS

PLAIN, PLASTER, WOOD, FABRIC, STONE = range(5)
"""Index of each texture."""
LEAF_HUE_DEG, SKY_HUE_DEG = 315.0, 60.0


def tone(rng: np.random.Generator, low_grey: float, high_grey: float, chroma: float = 12.0) -> Colour:
    """A colour of a grey level in a range and any hue, up to that far from neutral."""
    return colour(rng.uniform(low_grey, high_grey), rng.uniform(0.0, 360.0), rng.uniform(0.3, 1.0) * chroma)


def wood(rng: np.random.Generator, low_grey: float = 70.0, high_grey: float = 170.0) -> Colour:
    """A brown."""
    grey = rng.uniform(low_grey, high_grey)
    red_to_blue = np.array([1.0, 0.0, -1.0])
    return np.clip(grey + 0.22 * grey * (red_to_blue - red_to_blue @ GREY_WEIGHTS), 6.0, 250.0)


def other_hue(rng: np.random.Generator, like: Colour, chroma: float = 45.0) -> Colour:
    """A colour of the same grey level: a grey camera does not see where the two meet."""
    return colour(float(like @ GREY_WEIGHTS), rng.uniform(0.0, 360.0), rng.uniform(0.6, 1.0) * chroma)


def picture(build: Builder, wall: Frame, rng: np.random.Generator, place: Opening) -> None:
    """A framed painting of rectangles, every second one as bright as the canvas."""
    s0, t0, s1, t1 = place
    rim = rng.uniform(0.025, 0.05)
    inner = (s0 + rim, t0 + rim, s1 - rim, t1 - rim)
    build.ring(wall, place, [inner], -0.03, -0.01, tone=wood(rng, 40.0, 200.0))
    ground = tone(rng, 120.0, 210.0, 30.0)
    canvas = last = build.upright(wall, inner, -0.01, ground, PLAIN)
    width, height = inner[2] - inner[0], inner[3] - inner[1]
    for k in range(int(rng.integers(2, 5))):
        a, b = np.sort(rng.uniform(0.06, 0.94, (2, 2)), 0)
        if (b - a > 0.15).all():
            paint = other_hue(rng, ground, 60.0) if k % 2 else tone(rng, 30.0, 220.0, 60.0)
            last = build.paint(canvas, (a[0] * width, a[1] * height, b[0] * width, b[1] * height), paint, over=last)


def window(build: Builder, wall: Frame, rng: np.random.Generator, place: Opening) -> None:
    """Panes in a recess of 16 cm, bars between them, a sill; outside a sky over a dark hill."""
    s0, t0, s1, t1 = place
    frame_tone = tone(rng, 200.0, 230.0, 5.0)
    build.recess(wall, place, 0.0, 0.16, frame_tone, texture=PLAIN)
    # Brighter than any paint: it shines by itself.
    outside = build.upright(wall, place, 0.16, 1.4 * colour(220.0, SKY_HUE_DEG, 10.0), PLAIN)
    horizon = rng.uniform(0.2, 0.4) * (t1 - t0)
    build.paint(outside, (0.0, 0.0, s1 - s0, horizon), colour(rng.uniform(120.0, 160.0), LEAF_HUE_DEG, 40.0), FABRIC)
    columns, rows = (2 if s1 - s0 < 1.3 else 3), int(rng.integers(1, 3))
    bar, width, height = 0.05, (s1 - s0) / columns, (t1 - t0) / rows
    panes = [
        (s0 + i * width + bar, t0 + j * height + bar, s0 + (i + 1) * width - bar, t0 + (j + 1) * height - bar)
        for i in range(columns)
        for j in range(rows)
    ]
    build.ring(wall, place, panes, 0.10, 0.16, tone=frame_tone, texture=PLAIN)
    build.box(wall, (s0 - 0.06, -0.12, t0 - 0.04), (s1 + 0.06, 0.0, t0), tone(rng, 190.0, 220.0, 6.0), STONE)


def door(build: Builder, wall: Frame, rng: np.random.Generator, place: Opening) -> None:
    """A leaf in a recess of 12 cm, with panels, a handle and an architrave."""
    s0, _, s1, t1 = place
    trim = tone(rng, 150.0, 215.0, 10.0)
    build.recess(wall, place, 0.0, 0.12, trim, texture=PLAIN)
    leaf_tone = wood(rng, 90.0, 200.0)
    leaf = build.upright(wall, place, 0.12, leaf_tone, WOOD)
    panel = other_hue(rng, leaf_tone, 25.0) if rng.uniform() < 0.4 else leaf_tone * rng.uniform(0.72, 0.85)
    for low, high in ((0.15, 0.95), (1.1, 1.9)):
        build.paint(leaf, (0.14, low, s1 - s0 - 0.14, high), panel, WOOD)
    build.box(wall, (s0 + 0.06, 0.06, 1.03), (s0 + 0.2, 0.09, 1.06), colour(70.0, 0.0, 5.0))
    outer = (s0 - 0.08, 0.0, s1 + 0.08, t1 + 0.08)
    # Open at the floor: the opening reaches the lower side of the board.
    build.ring(wall, outer, [(s0, 0.0, s1, t1)], -0.02, 0.0, tone=trim, texture=PLAIN)


def bookshelf(build: Builder, wall: Frame, rng: np.random.Generator, left: float, width: float, *, height: float) -> None:
    """Compartments full of books: spines of one brightness and many hues."""
    depth, board = rng.uniform(0.26, 0.34), 0.025
    body = wood(rng, 60.0, 190.0)
    columns, rows = max(1, round(width / 0.7)), max(2, round(height / 0.38))
    step, rise = width / columns, height / rows
    cells = [
        (left + i * step + board, j * rise + board, left + (i + 1) * step - board, (j + 1) * rise - board)
        for i in range(columns)
        for j in range(rows)
    ]
    place = (left, 0.0, left + width, height)
    build.ring(wall, place, cells, -depth, -0.01, tone=body, texture=WOOD)
    build.upright(wall, place, -0.01, body * 0.8, WOOD)
    build.keep_out(wall, (left, -depth, 0.0), (left + width, 0.0, height))
    spine_grey = rng.uniform(90.0, 150.0)
    for s0, t0, s1, t1 in cells:
        at, full = s0 + 0.02, s0 + rng.uniform(0.3, 1.0) * (s1 - s0)
        while at < full - 0.08:
            thick = rng.uniform(0.035, 0.08)
            same = rng.uniform() < 0.5
            cover = colour(spine_grey, rng.uniform(0, 360), 55.0) if same else tone(rng, 30.0, 215.0, 45.0)
            top = t0 + rng.uniform(0.6, 0.9) * (t1 - t0)
            build.box(wall, (at, -depth + rng.uniform(0.02, 0.08), t0), (at + thick, -0.03, top), cover, solid=False)
            at += thick + (rng.uniform(0.02, 0.12) if rng.uniform() < 0.25 else 0.0)


def cupboard(build: Builder, wall: Frame, rng: np.random.Generator, left: float, width: float, *, height: float) -> None:
    """A body on a plinth with doors, handles and something on top."""
    depth, body = rng.uniform(0.4, 0.55), tone(rng, 110.0, 215.0, 20.0)
    build.box(wall, (left + 0.03, -depth + 0.05, 0.0), (left + width - 0.03, 0.0, 0.08), body * 0.45)
    build.box(wall, (left, -depth, 0.08), (left + width, -0.002, height), body, WOOD)
    doors = max(2, round(width / 0.5))
    front = other_hue(rng, body, 30.0) if rng.uniform() < 0.5 else body * rng.uniform(0.8, 0.9)
    for k in range(doors):
        s0, s1 = left + k * width / doors + 0.01, left + (k + 1) * width / doors - 0.01
        build.box(wall, (s0, -depth - 0.02, 0.1), (s1, -depth, height - 0.02), front, WOOD)
        grip = s1 - 0.06 if k % 2 == 0 else s0 + 0.04
        middle = min(0.55 * height, 1.0)
        build.box(wall, (grip, -depth - 0.05, middle), (grip + 0.02, -depth - 0.02, middle + 0.16), colour(60.0))
    for k in range(int(rng.integers(1, 3))):
        size = rng.uniform(0.14, 0.26, 3)
        at = wall.tilted((left + (k + 0.5) * 0.5 * width, -0.5 * depth, height), 2, rng.uniform(-25.0, 25.0))
        build.box(at, (-size[0] / 2, -size[1] / 2, 0.0), (size[0] / 2, size[1] / 2, 0.8 * size[2]), tone(rng, 50.0, 220.0, 50.0))


def table(build: Builder, at: Frame, rng: np.random.Generator, width: float, depth: float, *, height: float) -> None:
    """A top on four legs with aprons, and boxes and books lying on it."""
    top, leg, x, y = wood(rng, 90.0, 200.0), 0.06, width / 2, depth / 2
    build.box(at, (-x, -y, height - 0.035), (x, y, height), top, WOOD)
    for i in (-1, 1):
        for j in (-1, 1):
            cx, cy = i * (x - 0.08), j * (y - 0.08)
            build.box(at, (cx - leg / 2, cy - leg / 2, 0.0), (cx + leg / 2, cy + leg / 2, height - 0.035), top * 0.8, WOOD)
        build.box(
            at, (-x + 0.11, i * (y - 0.08) - 0.01, height - 0.12), (x - 0.11, i * (y - 0.08) + 0.01, height - 0.035), top * 0.75
        )
        build.box(
            at, (i * (x - 0.08) - 0.01, -y + 0.11, height - 0.12), (i * (x - 0.08) + 0.01, y - 0.11, height - 0.035), top * 0.75
        )
    for k in range(-1, 2):
        spot = at.tilted((k * width / 3.2, rng.uniform(-0.3, 0.3) * y, height), 2, rng.uniform(0.0, 180.0))
        cover = tone(rng, 40.0, 225.0, 50.0) if k else other_hue(rng, top, 50.0)
        size = rng.uniform([0.08, 0.06, 0.02], [0.13, 0.09, 0.12])
        build.box(spot, (-size[0], -size[1], 0.0), (size[0], size[1], size[2]), cover)
    build.keep_out(at, (-x, -y, 0.0), (x, y, height))


def chair(build: Builder, at: Frame, rng: np.random.Generator, body: Colour) -> None:
    """Four legs, a seat and a back that leans away from -y."""
    half, seat, leg = 0.21, 0.45, 0.035
    for i in (-1, 1):
        for j in (-1, 1):
            cx, cy = i * (half - 0.03), j * (half - 0.03)
            build.box(at, (cx - leg / 2, cy - leg / 2, 0.0), (cx + leg / 2, cy + leg / 2, seat - 0.03), body, WOOD)
    build.box(at, (-half, -half, seat - 0.03), (half, half, seat + 0.01), body * 1.1, FABRIC)
    # Behind the seat: a leaning post on it would run into it with one edge.
    back = at.tilted((0.0, half + 0.018, seat - 0.06), 0, -rng.uniform(6.0, 12.0))
    for i in (-1, 1):
        build.box(back, (i * (half - 0.02) - leg / 2, -0.015, 0.0), (i * (half - 0.02) + leg / 2, 0.015, 0.53), body, WOOD)
    for low in (0.19, 0.37):
        build.box(back, (-half + 0.04, -0.01, low), (half - 0.04, 0.01, low + 0.1), body * 0.85, WOOD)
    build.keep_out(at, (-half, -half, 0.0), (half, half + 0.1, 0.95))


def sofa(build: Builder, wall: Frame, rng: np.random.Generator, left: float, width: float) -> None:
    """Base, arms, back and cushions."""
    cloth = tone(rng, 60.0, 170.0, 40.0)
    arm = 0.18
    build.box(wall, (left, -0.85, 0.06), (left + arm, -0.04, 0.6), cloth, FABRIC)
    build.box(wall, (left + width - arm, -0.85, 0.06), (left + width, -0.04, 0.6), cloth, FABRIC)
    build.box(wall, (left + arm, -0.82, 0.06), (left + width - arm, -0.04, 0.3), cloth * 0.9, FABRIC)
    build.box(wall, (left + arm, -0.28, 0.3), (left + width - arm, -0.04, 0.85), cloth, FABRIC)
    seats = max(2, round((width - 2 * arm) / 0.65))
    step = (width - 2 * arm) / seats
    for k in range(seats):
        s0 = left + arm + k * step
        build.box(wall, (s0 + 0.004, -0.84, 0.3), (s0 + step - 0.004, -0.28, 0.44), cloth * 1.12, FABRIC)
    pillow = wall.tilted((left + arm + 0.3, -0.48, 0.46), 0, -18.0)
    build.box(pillow, (-0.2, -0.06, 0.0), (0.2, 0.06, 0.36), other_hue(rng, cloth, 55.0), FABRIC)
    build.keep_out(wall, (left, -0.85, 0.0), (left + width, 0.0, 0.85))


def radiator(build: Builder, wall: Frame, rng: np.random.Generator, left: float, width: float) -> None:
    """Flat panels side by side under a window."""
    body = tone(rng, 195.0, 225.0, 5.0)
    panels = max(3, round(width / 0.14))
    step = width / panels
    for k in range(panels):
        build.box(wall, (left + k * step + 0.012, -0.09, 0.12), (left + (k + 1) * step - 0.012, -0.03, 0.68), body)
        if k:
            for low in (0.2, 0.56):
                build.box(wall, (left + k * step - 0.012, -0.075, low), (left + k * step + 0.012, -0.04, low + 0.04), body * 0.85)


def lamp(build: Builder, x: float, y: float, ceiling: float, rng: np.random.Generator) -> None:
    """A shade on a rod under the ceiling."""
    drop = rng.uniform(0.45, 0.7)
    at = Frame.at(x, y, ceiling, rng.uniform(0.0, 90.0))
    build.box(at, (-0.008, -0.008, -drop), (0.008, 0.008, 0.0), colour(60.0))
    build.frustum(at, 6, (0.22, 0.1), (-drop - 0.2, -drop), tone(rng, 170.0, 230.0, 30.0), texture=FABRIC)
