"""The line engine at size beside pylimap's line adjustment and pycolmap's points on the same street: time and memory.

Everybody works in a process of their own, one after another, with as many threads. Seconds depend on the machine; asserted
are ratios within the run, of processor seconds, which other work on the machine disturbs least.
"""

import json
import math
import os
import pathlib
import subprocess
import sys
import time
from typing import Any

import pytest
import torch
from engine_scene import Street, street
from timing import NO_PEERS, PEERS, SMALL, print_table

from omnilines.adjustment.engine_layout import layout
from omnilines.adjustment.memory import ARC, BASE, engine_bytes
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares.band import band_width
from omnilines.triangulation import triangulate
from omnilines.triangulation.observations import PlaneObservations

HERE = pathlib.Path(__file__).resolve().parent
THREADS = min(2, os.cpu_count() or 1)
REPEATS = 1 if SMALL else 3
MOST = 100
SCALE = 25 if SMALL else 1
"""Scenes have so many times fewer cameras and lines; ratios then say nothing."""
Figures = dict[str, Any]


@pytest.fixture
def peers() -> None:
    """Skips where there is none to compare with."""
    if not PEERS.is_file():
        pytest.skip(NO_PEERS)


def run(python: str | pathlib.Path, script: str, saved: pathlib.Path, what: str, most: int = MOST) -> Figures:
    """The figures of a worker, the least of REPEATS runs for those that are times of one iteration."""
    found: list[Figures] = []
    for _ in range(REPEATS):
        command = [str(python), str(HERE / script), str(saved), what, str(THREADS), str(most)]
        environment = {**os.environ, "OMP_NUM_THREADS": str(THREADS), "PYTHONPATH": str(HERE)}
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        found.append(json.loads(done.stdout.splitlines()[-1]))
    least = dict(found[0])
    for name in ("iteration", "build", "all", "warm"):
        if name in least:
            least[name] = [min(each[name][k] for each in found) for k in range(2)]
    return least


def some_street(cameras: int, lines: int, views: int) -> Street:
    """Of that size, or SCALE times smaller."""
    return street(max(cameras // SCALE, views), max(lines // SCALE, 100), views)


def size_of(scene: Street) -> str:
    """Of a row or a table."""
    return f"{len(scene.poses):,} cameras x {len(scene.ends_m):,} x {len(scene.image) // len(scene.ends_m)}"


def row(who: str, what: str, figures: Figures, observations: int) -> list[str]:
    """Of the tables."""
    wall, own = figures["iteration"]
    return [
        who,
        what,
        f"{1e3 * wall:.1f}",
        f"{1e3 * own:.1f}",
        f"{1e6 * own / observations:.2f}",
        f"{figures['build'][0]:.2f}",
        str(figures["iterations"]),
        f"{figures['all'][0]:.2f}",
        f"{figures['memory_mb']:.0f}",
    ]


HEADER = ["who", "what", "ms an iteration", "CPU ms", "CPU us an observation", "s to build", "iterations", "s in all", "MB"]


def bench_hundred_cameras_vs_pylimap(tmp_path: pathlib.Path, peers: None) -> None:
    scene, saved = some_street(100, 5_000, 8), tmp_path / "street.npz"
    scene.save(str(saved))
    rows, ratios = [], []
    for what, name in (("poses", "lines and poses"), ("lines", "lines only")):
        ours, peer = run(sys.executable, "engine_worker.py", saved, what), run(PEERS, "peer_engine.py", saved, what)
        rows += [row("pylimap", name, peer, len(scene.image)), row("ours", name, ours, len(scene.image))]
        ratios.append([ours[key][1] / peer[key][1] for key in ("iteration", "all")] + [ours["memory_mb"] / peer["memory_mb"]])
    print_table(f"{size_of(scene)}, {THREADS} threads", HEADER, rows)
    for name, (iteration, everything, memory) in zip(("lines and poses", "lines only"), ratios, strict=True):
        print(
            f"  {name}: {iteration:.2f} of its CPU time an iteration, {everything:.2f} to the optimum, {memory:.2f} of its memory"
        )
    print(f"  loading the compiled kernels: {ours['warm'][0]:.2f} s ({ours['warm'][1]:.2f} s CPU)")
    assert SMALL or max(max(iteration, everything) for iteration, everything, _ in ratios) <= 0.7


def bench_thousand_cameras_vs_pycolmap(tmp_path: pathlib.Path, peers: None) -> None:
    scene, saved = some_street(1_000, 100_000, 8), tmp_path / "street.npz"
    points, points_saved = some_street(1_000, 100_000, 6), tmp_path / "points.npz"
    scene.save(str(saved))
    points.save(str(points_saved))
    ours = run(sys.executable, "engine_worker.py", saved, "poses")
    peer = run(PEERS, "peer_engine.py", points_saved, "points", 5)
    rows = [row("pycolmap", "points x 6 views", peer, len(points.image)), row("ours", "lines x 8 views", ours, len(scene.image))]
    print_table(f"{size_of(scene)}, {THREADS} threads (the peer stops after 5 iterations)", HEADER, rows)
    share = ours["iteration"][1] / peer["iteration"][1] * len(points.image) / len(scene.image)
    memory, build = ours["memory_mb"] / peer["memory_mb"], ours["build"][1] / peer["build"][1]
    print(f"  {share:.2f} of its CPU time an observation, {memory:.2f} of its memory, {build:.2f} of its CPU time to build")
    assert SMALL or (share <= 1.0 and memory <= 2.0 and build <= 1.0)


def bench_memory_is_what_the_formula_says(tmp_path: pathlib.Path) -> None:
    rows = []
    for cameras, lines in ((100, 5_000), (300, 20_000), (1_000, 100_000))[: 1 if SMALL else None]:
        scene, saved = some_street(cameras, lines, 8), tmp_path / f"{cameras}.npz"
        scene.save(str(saved))
        command = [sys.executable, str(HERE / "engine_worker.py"), str(saved), "whole", "1", "3"]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(HERE)})
        found = json.loads(done.stdout.splitlines()[-1])["memory_mb"]
        arcs, poses = scene.arcs(), scene.poses
        state = LinesAndPoses(poses, LineChart.about_cameras(scene.lines, poses.centre[arcs.image], arcs.track))
        laid_out = layout(LineProblem(arcs, "sector", Freedom(torch.zeros(len(poses), dtype=torch.bool)), state))
        pattern = laid_out.pattern
        own = engine_bytes(
            observations=len(arcs),
            lines=arcs.tracks,
            free=len(poses),
            pairs=len(pattern.row),
            width=band_width(pattern, 6),
            summed=sum(last - first for first, last in laid_out.blocks_of_shares),
        )
        expected = (BASE + ARC * len(arcs) + own) / 1024**2
        rows.append([size_of(scene), f"{found:.0f}", f"{expected:.0f}", f"{expected / found:.2f}"])
        assert SMALL or abs(expected / found - 1) < 0.3
    print_table("Peak memory of an adjustment with all covariances", ["scene", "MB", "by the formula", "ratio"], rows)


def bench_time_grows_linearly(tmp_path: pathlib.Path) -> None:
    sizes = ((50, 1_250), (1_000, 12_500)) if SMALL else ((50, 1_250), (150, 12_500), (1_000, 125_000))
    seconds, rows = [], []
    for cameras, lines in sizes:
        scene, saved = some_street(cameras, lines, 8), tmp_path / f"{cameras}.npz"
        scene.save(str(saved))
        found = run(sys.executable, "engine_worker.py", saved, "poses", 6)
        seconds.append(found["iteration"][1])
        rows.append(row("ours", size_of(scene), found, len(scene.image)))
    exponent = math.log(seconds[-1] / seconds[0]) / math.log(sizes[-1][1] / sizes[0][1])
    print_table("Growth of one iteration, lines and poses", HEADER, rows)
    print(f"  time grows with the power {exponent:.2f} of the observations")
    assert SMALL or exponent < 1.1


def bench_triangulation_of_many_tracks() -> None:
    scene = some_street(200, 100_000, 8)
    arcs, poses = scene.arcs(), scene.poses
    threads = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    ticks = []
    try:
        for _ in range(1 + REPEATS):
            start, own = time.perf_counter(), time.process_time()
            planes = PlaneObservations.from_arcs(
                arcs.bearings, poses[arcs.image], arcs.track, arcs.tracks, arcs.by_pixel, covariance_px2=arcs.covariance_px2
            )
            found = triangulate("dual", planes)
            known = torch.isfinite(found.covariance).all(-1).all(-1)
            ticks.append((time.perf_counter() - start, time.process_time() - own))
    finally:
        torch.set_num_threads(threads)
    wall, own = (min(tick[k] for tick in ticks[1:]) for k in range(2))
    print(
        f"\n\n  triangulation with covariance of {arcs.tracks:,} tracks of 8 views: {wall:.2f} s, {own:.2f} s CPU, "
        f"{THREADS} threads"
    )
    assert int(known.sum()) > 0.99 * arcs.tracks
    if os.cpu_count() == THREADS and os.getloadavg()[0] > 1.5 * THREADS:
        pytest.skip("the machine is busy with other work; the time is printed, not asserted")
    assert wall < 1.0
