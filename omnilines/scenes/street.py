"""A street 40 m long between two rows of houses: walls with windows, doors, sills and cornices, drawn from a seed."""

import numpy as np

from omnilines.scenes.appearance import texture
from omnilines.scenes.building import Builder, Colour, Frame, Opening, colour
from omnilines.scenes.furniture import PLAIN, PLASTER, SKY_HUE_DEG, STONE, WOOD, other_hue, tone, wood
from omnilines.scenes.polygon_scene import Lamps, PolygonScene
from omnilines.synthetic.targets import generator

LENGTH_M, WIDTH_M = 40.0, 12.0
PAVEMENT_M = 2.2
LOWEST_M, HIGHEST_M = 1.3, 4.0
"""Of a camera above the road."""
FLOOR_M = 3.1


def street(seed: int) -> PolygonScene:
    """Houses along the x axis on both sides of y = 0, z up, the road at z = 0."""
    rng = generator(seed, "street")
    build = Builder(
        [
            texture(rng, 0.006, 1.0, 0.05),
            texture(rng, 0.015, 2.0, 0.03, waves=12),
            texture(rng, 0.022, 0.6, 0.02, stretch=4.0, waves=10),
            texture(rng, 0.03, 0.3, 0.02, waves=10),
            texture(rng, 0.03, 1.5, 0.03, waves=12),
        ]
    )
    _ground(build, rng)
    for frame in (Frame.at(0.0, WIDTH_M / 2), Frame.at(LENGTH_M, -WIDTH_M / 2, 0.0, 180.0)):
        left = 0.0
        while left < LENGTH_M - 1e-6:
            width = rng.uniform(6.0, 10.0)
            # What is left over is no house of its own.
            width = LENGTH_M - left if LENGTH_M - left - width < 6.0 else width
            _house(build, frame, rng, left, width)
            left += width
    return build.scene(
        _daylight(rng),
        np.stack([colour(225.0, SKY_HUE_DEG, 12.0), colour(170.0, SKY_HUE_DEG, 40.0)]),
        np.array([3.0, -WIDTH_M / 2 + 1.5, LOWEST_M]),
        np.array([LENGTH_M - 3.0, WIDTH_M / 2 - 1.5, HIGHEST_M]),
    )


def _ground(build: Builder, rng: np.random.Generator) -> None:
    """Road with a dashed line, pavements with kerbs."""
    far, half = 30.0, WIDTH_M / 2
    corners = np.array([[-far, -half, 0], [LENGTH_M + far, -half, 0], [LENGTH_M + far, half, 0], [-far, half, 0]])
    road = build.wall(corners, tone(rng, 70.0, 110.0, 5.0), STONE)
    for k in range(int((LENGTH_M + 2 * far) / 4)):
        build.paint(road, (4.0 * k, half - 0.08, 4.0 * k + 2.0, half + 0.08), colour(205.0))
    slab = tone(rng, 130.0, 165.0, 8.0)
    for frame in (Frame.at(-far, half), Frame.at(LENGTH_M + far, -half, 0.0, 180.0)):
        length = LENGTH_M + 2 * far
        top = build.box(frame, (0.0, -PAVEMENT_M, 0.0), (length, 0.0, 0.14), slab, STONE, solid=False)[1]
        build.paint(top, (0.0, 0.0, length, 0.18), slab * 1.2, STONE)


def _house(build: Builder, frame: Frame, rng: np.random.Generator, left: float, width: float) -> None:
    """A front with rows of windows over a ground floor with a door, a cornice and a roof."""
    floors = int(rng.integers(2, 5))
    foot, height = 0.14, 0.14 + FLOOR_M * floors + 0.5
    paint, trim = tone(rng, 110.0, 205.0, 28.0), tone(rng, 150.0, 225.0, 10.0)
    columns = max(2, int(width / rng.uniform(2.0, 2.6)))
    step, wide, tall = width / columns, rng.uniform(0.95, 1.2), rng.uniform(1.4, 1.75)
    door_column = int(rng.integers(columns))
    openings: list[Opening] = []
    for j in range(floors):
        for i in range(columns):
            middle = left + (i + 0.5) * step
            if j == 0 and i == door_column:
                openings.append((middle - 0.55, foot, middle + 0.55, foot + 2.3))
            else:
                sill = foot + j * FLOOR_M + 0.95
                openings.append((middle - wide / 2, sill, middle + wide / 2, sill + tall))
    build.upright(frame, (left, foot, left + width, height), 0.0, paint, PLASTER, openings=openings)
    shutters, leaf = rng.uniform() < 0.5, other_hue(rng, paint, 50.0)
    for opening in openings:
        if opening[1] == foot:
            _entrance(build, frame, rng, opening, trim)
        else:
            _facade_window(build, frame, rng, opening, trim)
            if shutters:
                _shutters(build, frame, opening, leaf)
    for j in range(1, floors):
        level = foot + j * FLOOR_M + 0.25
        build.box(frame, (left, -0.05, level), (left + width, 0.0, level + 0.14), trim, STONE)
    build.box(frame, (left, -0.3, height - 0.25), (left + width, 0.0, height), trim, STONE)
    _roof(build, frame, rng, left, width, height, paint)


def _facade_window(build: Builder, wall: Frame, rng: np.random.Generator, place: Opening, trim: Colour) -> None:
    s0, t0, s1, t1 = place
    build.recess(wall, place, 0.0, 0.2, trim * 0.95, texture=PLASTER)
    glass = colour(rng.uniform(40.0, 95.0), SKY_HUE_DEG, 15.0)
    pane = build.upright(wall, place, 0.2, glass, PLAIN)
    if rng.uniform() < 0.5:
        build.paint(pane, (0.0, rng.uniform(0.4, 0.7) * (t1 - t0), s1 - s0, t1 - t0), tone(rng, 120.0, 200.0, 20.0), PLAIN)
    bar, middle, cross = 0.07, 0.5 * (s0 + s1), t0 + 0.66 * (t1 - t0)
    panes = [
        (a + bar, b + bar, c - bar, d - bar)
        for a, c in ((s0, middle + bar / 2), (middle - bar / 2, s1))
        for b, d in ((t0, cross + bar / 2), (cross - bar / 2, t1))
    ]
    build.ring(wall, place, panes, 0.14, 0.2, tone=trim, texture=PLAIN)
    build.box(wall, (s0 - 0.1, -0.14, t0 - 0.08), (s1 + 0.1, 0.0, t0), trim, STONE)


def _shutters(build: Builder, wall: Frame, opening: Opening, leaf: Colour) -> None:
    s0, t0, s1, t1 = opening
    for a, b in ((s0 - 0.5, s0 - 0.03), (s1 + 0.03, s1 + 0.5)):
        front = build.box(wall, (a, -0.05, t0 + 0.02), (b, 0.0, t1), leaf, WOOD)[2]
        build.paint(front, (0.08, 0.1, b - a - 0.08, t1 - t0 - 0.12), leaf * 0.8, WOOD)


def _entrance(build: Builder, wall: Frame, rng: np.random.Generator, place: Opening, trim: Colour) -> None:
    s0, t0, s1, t1 = place
    build.recess(wall, place, 0.0, 0.25, trim, texture=STONE)
    leaf = build.upright(wall, place, 0.25, wood(rng, 45.0, 110.0), WOOD)
    for low, high in ((0.15, 1.0), (1.15, 1.75)):
        build.paint(leaf, (0.18, low, s1 - s0 - 0.18, high), wood(rng, 100.0, 160.0), WOOD)
    build.paint(leaf, (0.05, 1.9, s1 - s0 - 0.05, 2.25), colour(70.0, SKY_HUE_DEG, 15.0), PLAIN)
    build.ring(wall, (s0 - 0.15, t0, s1 + 0.15, t1 + 0.2), [place], -0.06, 0.0, tone=trim, texture=STONE)
    build.box(wall, (s0 - 0.3, -0.55, t1 + 0.2), (s1 + 0.3, 0.0, t1 + 0.3), trim * 0.9, STONE)


def _roof(build: Builder, wall: Frame, rng: np.random.Generator, left: float, width: float, height: float, paint: Colour) -> None:
    """A slope behind the cornice and the gable walls at both ends, which show over lower neighbours."""
    rise, depth = rng.uniform(1.8, 3.0), 5.0
    s0, s1 = left, left + width
    tiles = colour(rng.uniform(80.0, 120.0), rng.uniform(0.0, 360.0), 25.0)
    build.face(
        wall.world(np.array([[s0, 0, height], [s1, 0, height], [s1, depth, height + rise], [s0, depth, height + rise]])),
        tiles,
        WOOD,
    )
    for s, turn in ((s0, 1), (s1, -1)):
        lower = np.array([[s, 2 * depth, 0.0], [s, 0, 0.0], [s, 0, height], [s, 2 * depth, height]])[::turn]
        gable = np.array([[s, 2 * depth, height], [s, 0, height], [s, depth, height + rise]])[::turn]
        build.face(wall.world(lower), paint * 0.92, PLASTER)
        build.face(wall.world(gable), paint * 0.92, PLASTER)


def _daylight(rng: np.random.Generator) -> Lamps:
    """A sun far away over the street, and the sky."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    sun = 1e4 * np.array([np.cos(azimuth), np.sin(azimuth), 1.2])
    return Lamps(sun[None], np.array([0.35]), np.array([1e6]), 0.66, 0.1, np.array([0.09, 0.05]))
