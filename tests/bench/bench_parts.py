"""Adjustments of very many photos: 10,000 along a street, grids of streets, and the same in parts; time and memory.

Everything runs in a process of its own. Seconds are those of the processor; those of an iteration are the least of a run.
"""

import json
import os
import pathlib
import subprocess
import sys
import time

import numpy as np
from engine_scene import Street, grid, street
from timing import SMALL, print_table

from omnilines.least_squares.dissection import dissected
from omnilines.least_squares.pattern import pair_pattern
from omnilines.least_squares.separators import Reduced, SharedSystem

HERE = pathlib.Path(__file__).resolve().parent
HEADER = ("scene", "photos a part", "CPU s an iteration", "us an observation", "CPU s in all", "iterations", "MB before", "MB")
REACH = 6
"""Neighbours along a street that a camera is tied to, in `bench_systems_of_separators`."""


def run(saved: pathlib.Path, what: str, most: int) -> dict:
    """The figures of `engine_worker.py` on one thread."""
    command = [sys.executable, str(HERE / "engine_worker.py"), str(saved), what, "1", str(most)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def row(name: str, scene: Street, what: str, found: dict) -> list[str]:
    """Of the table."""
    own = found["iteration"][1]
    parts = what.partition(":")[2] or "one piece"
    each = (f"{own:.2f}", f"{1e6 * own / len(scene.image):.2f}", f"{found['all'][1]:.1f}", str(found["iterations"]))
    return [name, parts, *each, f"{found['before_mb']:.0f}", f"{found['memory_mb']:.0f}"]


def size_of(scene: Street) -> str:
    """Of a scene."""
    return f"{len(scene.poses):,} x {len(scene.ends_m):,} x 8"


def bench_parts_and_one_piece(tmp_path: pathlib.Path) -> None:
    """Lines and poses with all covariances, weighed by their noise."""
    scenes = {"street": (street(60, 1_800, 8), 20), "grid": (grid(3, 12, 2_000, 8), 30)}
    if not SMALL:
        scenes = {"street": (street(3_000, 150_000, 8), 500), "grid": (grid(9, 15, 100_000, 8), 500)}
    rows = []
    for name, (scene, most) in scenes.items():
        saved = tmp_path / f"{name}.npz"
        scene.save(str(saved))
        costs = []
        for what in ("whitened", f"whitened:{most}"):
            found = run(saved, what, 6)
            costs.append(found["cost"])
            rows.append(row(f"{name} {size_of(scene)}", scene, what, found))
        assert abs(costs[1] / costs[0] - 1) < 1e-9
    print_table("Lines and poses in one piece and in parts, with all covariances", HEADER, rows)


def bench_ten_thousand_cameras(tmp_path: pathlib.Path) -> None:
    """Iterations in one piece, without covariances."""
    sizes = ((100, 1_000),) if SMALL else ((1_000, 100_000), (3_000, 300_000), (10_000, 1_000_000))
    rows = []
    for cameras, lines in sizes:
        scene, saved = street(cameras, lines, 8), tmp_path / f"{cameras}.npz"
        scene.save(str(saved))
        rows.append(row("street " + size_of(scene), scene, "poses", run(saved, "poses", 4)))
    print_table("Iterations on lines and poses, in one piece", HEADER, rows)


def bench_systems_of_separators() -> None:
    """Time and memory of the system of the photos that parts of a grid of streets share."""
    rows = []
    for streets in (3, 4) if SMALL else (6, 10, 14):
        places, pairs = _tied(streets, 20)
        part = dissected(pairs[:, 0], pairs[:, 1], places, 100 if SMALL else 500)
        shared = np.flatnonzero(part < 0)
        number = np.full(places, -1)
        number[shared] = np.arange(len(shared))
        both = np.concatenate([pairs, pairs[:, ::-1]])
        touches = both[(part[both[:, 0]] >= 0) & (part[both[:, 1]] < 0)]
        touched = [np.unique(number[touches[part[touches[:, 0]] == k, 1]]) for k in range(part.max() + 1)]
        start = np.concatenate([[0], np.cumsum([len(own) for own in touched])])
        pattern = pair_pattern(start, np.concatenate(touched).astype(np.int64), len(shared))
        rng, reduced = np.random.default_rng(0), []
        for own in touched:
            root = rng.standard_normal((6 * len(own), 6 * len(own)))
            information = root @ root.T + 6 * len(own) * np.eye(6 * len(own))
            reduced.append(Reduced(information, np.zeros((6 * len(own), 1)), np.zeros((1, 1)), np.inf))
        nothing_open = np.zeros((6 * len(shared), 0))
        begin = time.process_time()
        system = SharedSystem.of(pattern, touched, reduced, nothing_open, nothing_open, 0.0)
        factor = time.process_time() - begin
        assert system is not None
        begin = time.process_time()
        system.system.factor.inverse_blocks(pattern, 6)
        covariances = time.process_time() - begin
        sent = sum(8 * (6 * len(own)) ** 2 for own in touched)
        each = (len(touched), len(shared), max(map(len, touched)))
        spent = (f"{factor:.2f}", f"{covariances:.2f}", f"{sent / 1e6:.0f}")
        rows.append([f"{streets} x {streets}", f"{places:,}", *map(str, each), *spent])
    header = ("streets", "photos", "parts", "shared", "most of a part", "CPU s, factor", "CPU s, covariances", "MB sent")
    print_table("The system of the separators", header, rows)


def _tied(streets: int, between: int) -> tuple[int, np.ndarray]:
    """How many photos a grid of streets has, and which are tied: those within REACH steps along a street."""
    long = (streets - 1) * between + 1
    places = {(x, between * s) for s in range(streets) for x in range(long)}
    places |= {(y, x) for x, y in places}
    number = {place: k for k, place in enumerate(sorted(places))}
    steps = [(step, 0) for step in range(1, REACH + 1)] + [(0, step) for step in range(1, REACH + 1)]
    pairs = [(k, number[x + dx, y + dy]) for (x, y), k in number.items() for dx, dy in steps if (x + dx, y + dy) in number]
    return len(number), np.array(pairs)
