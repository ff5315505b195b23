"""A sheet of letter paper on a table among books, bookends, a ruler and a box: the dissertation's book sequence, from a seed.

The sheet lies with a corner at the origin of its own frame, x along its longer side, y along its shorter one, z down; the table's
top is z = 0 of the world, and the sheet's middle its origin. Photos look at the sheet from one half of the space above it, so
that nothing stands between.
"""

from dataclasses import replace

import numpy as np

from camera_models.pose import Pose
from omnilines.scenes.building import Builder, Colour, Frame, colour
from omnilines.scenes.furniture import FABRIC, PLAIN, STONE, WOOD, tone, wood
from omnilines.scenes.polygon_scene import Dome, Lamps, PolygonScene
from omnilines.scenes.room import room_textures
from omnilines.synthetic.targets import generator

SHEET_M = (0.279, 0.216)
PAPER_GREY = 225.0
BRIGHTEST_COVER = 165.0
"""Nothing else is nearly as bright as the paper."""
NEAREST_M, FARTHEST_M = 0.75, 1.05
"""Of a camera from the middle of the sheet."""
LOWEST_DEG, HIGHEST_DEG, ASIDE_DEG = 38.0, 65.0, 70.0
"""Heights of the cameras above the table, and how far round they go to either side of -y."""


def books(seed: int) -> PolygonScene:
    """Rows of books behind and beside the sheet, a stack, a ruler and a box before it."""
    rng = generator(seed, "books")
    build = Builder(room_textures(rng))
    ground = wood(rng, 60.0, 110.0)
    floor = tone(rng, 60.0, 100.0, 12.0)
    build.face(np.array([[-4, -4, -0.74], [4, -4, -0.74], [4, 4, -0.74], [-4, 4, -0.74]], dtype=np.float64), floor, STONE)
    top = build.box(Frame.at(0.0, 0.1), (-0.8, -0.55, -0.035), (0.8, 0.55, 0.0), ground, WOOD)[1]
    half = np.array(SHEET_M) / 2
    outline = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0]
    build.paint_shape(top, outline, colour(PAPER_GREY, 60.0, 3.0), PLAIN)
    _row(build, Frame.at(rng.uniform(-0.05, 0.05), 0.33, 0.0, rng.uniform(-8.0, 8.0)), rng)
    for side in (-1.0, 1.0):
        _stack(build, Frame.at(side * rng.uniform(0.36, 0.42), rng.uniform(-0.05, 0.1), 0.0, rng.uniform(-20.0, 20.0)), rng)
    _ruler(build, Frame.at(rng.uniform(-0.05, 0.05), -0.22, 0.0, rng.uniform(-6.0, 6.0)), rng)
    low = Frame.at(rng.uniform(-0.5, -0.4), -0.27, 0.0, rng.uniform(0.0, 60.0))
    build.box(low, (-0.06, -0.04, 0.0), (0.06, 0.04, rng.uniform(0.03, 0.05)), tone(rng, 30.0, BRIGHTEST_COVER, 50.0))
    sky = np.stack([colour(90.0), colour(120.0)])
    reach = FARTHEST_M + 0.1
    lamps = Lamps(
        position_m=np.array([[-0.8, -0.6, 1.5], [1.2, 0.4, 1.3]]),
        strength=np.array([0.7, 0.4]),
        reach_m=np.array([2.5, 2.5]),
        ambient=0.7,
        up=0.06,
        side=np.array([0.06, 0.04]),
    )
    scene = build.scene(lamps, sky, np.array([-reach, -reach, 0.3]), np.array([reach, reach, reach]))
    return replace(scene, dome=Dome((NEAREST_M, FARTHEST_M), (LOWEST_DEG, HIGHEST_DEG), ASIDE_DEG))


def sheet_from_world() -> Pose:
    """Where the sheet lies."""
    half = np.array(SHEET_M) / 2
    return Pose.of(np.diag([1.0, -1.0, -1.0]), np.array([half[0], half[1], 0.0]))


def _cover(rng: np.random.Generator) -> Colour:
    """Of a book."""
    return tone(rng, 25.0, BRIGHTEST_COVER, 55.0)


def _titled(build: Builder, face: int, rng: np.random.Generator, cover: Colour, size: tuple[float, float]) -> None:
    """A label on a cover or a spine."""
    (w, h), last = size, None
    for low, high in ((0.55, 0.85), (0.15, 0.3)):
        shade = cover * 0.55 if cover.mean() > 80.0 else np.minimum(cover * 1.7 + 25.0, BRIGHTEST_COVER)
        place = (rng.uniform(0.12, 0.2) * w, low * h, rng.uniform(0.7, 0.88) * w, high * h)
        last = build.paint(face, place, shade, PLAIN, over=last)


def _row(build: Builder, at: Frame, rng: np.random.Generator) -> None:
    """Standing books between two bookends."""
    plain = wood(rng, 50.0, 150.0)
    left = -0.24
    build.box(at, (left - 0.02, -0.06, 0.0), (left - 0.001, 0.08, 0.15), plain, WOOD)
    while left < 0.2:
        thick, tall, deep = rng.uniform(0.022, 0.05), rng.uniform(0.15, 0.21), rng.uniform(0.1, 0.15)
        cover, front = _cover(rng), rng.uniform(-0.06, -0.04)
        spine = build.box(at, (left, front, 0.0), (left + thick - 0.001, front + deep, tall), cover, FABRIC)[2]
        _titled(build, spine, rng, cover, (thick - 0.001, tall))
        left += thick
    build.box(at, (left, -0.06, 0.0), (left + 0.019, 0.08, 0.15), plain, WOOD)


def _stack(build: Builder, at: Frame, rng: np.random.Generator) -> None:
    """Lying books, each turned a little."""
    height, shrink = 0.0, 1.0
    for _ in range(int(rng.integers(2, 4))):
        thick, cover = rng.uniform(0.02, 0.04), _cover(rng)
        w, d = shrink * rng.uniform(0.1, 0.12), shrink * rng.uniform(0.075, 0.09)
        own = at.tilted((0.0, 0.0, height), 2, rng.uniform(-12.0, 12.0))
        top = build.box(own, (-w, -d, 0.0), (w, d, thick), cover, FABRIC)[1]
        _titled(build, top, rng, cover, (2 * w, 2 * d))
        height, shrink = height + thick + 2e-4, 0.8 * shrink


def _ruler(build: Builder, at: Frame, rng: np.random.Generator) -> None:
    """With marks a centimetre apart."""
    shade = tone(rng, 90.0, 150.0, 40.0)
    top = build.box(at, (-0.155, -0.016, 0.0), (0.155, 0.016, 0.003), shade, PLAIN)[1]
    for k in range(1, 31):
        length = 0.014 if k % 5 == 0 else 0.007
        build.paint(top, (0.01 * k - 0.0005, 0.032 - length, 0.01 * k + 0.0005, 0.032), shade * 0.35, PLAIN)
