"""What the benchmarks share: wall-clock time, tables, a line scene of any size, and what makes a run small."""

import itertools
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import cv2
import torch

from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import solve

IMAGES = 20
SMALL = bool(os.environ.get("OMNILINES_BENCH_SMALL"))
"""Whether functions `bench_*` are to run with little data: only to see that they run. Times mean nothing then, and no ratio of
times is asserted. Scripts have the option --small (tests/test_benches.py)."""
SKIPPED = 77
"""Exit status of a script that lacks something, as in Automake."""
PEERS = Path(__file__).resolve().parents[2] / ".venv-peers" / "bin" / "python"
NO_PEERS = f"other implementations run in an environment of their own, which is absent: {PEERS}; `make bench` installs it"

# One thread for every implementation: ratios then do not depend on how many cores are idle.
torch.set_num_threads(1)
cv2.setNumThreads(1)


def skip(reason: str) -> NoReturn:
    """End a script that lacks something; of a function use pytest.skip."""
    print(f"skipped: {reason}")
    sys.exit(SKIPPED)


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Least wall-clock seconds of one call, after one that does not count."""
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A plain table on standard output."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    print(f"\n\n{title}")
    for row in [header, *rows]:
        print("  " + "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())


def line_scene(observations: int, seed: int = 0) -> tuple[MatchedArcs, PlueckerLines, Pose]:
    """Noisy arcs of random lines in a cube of 2 m, all seen by IMAGES cameras around it, with disturbed lines and poses."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    tracks = observations // IMAGES
    ends = 2 * torch.rand(tracks, 2, 3, generator=generator, dtype=torch.float64) - 1
    turns = normal(IMAGES, 3)
    rotation = Pose.exp(torch.cat([turns, torch.zeros_like(turns)], -1)).rotation
    # Every camera looks at the cube from 5 m: the centre lies at +5 along z.
    poses = Pose(rotation, torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64).expand(IMAGES, 3).clone())
    image, track = torch.arange(IMAGES).repeat(tracks), torch.arange(tracks).repeat_interleave(IMAGES)
    seen = ends[track] @ poses.rotation[image].mT + poses.translation[image, None]
    bearings = seen / seen.norm(dim=-1, keepdim=True) + 1e-3 * normal(len(track), 2, 3)
    bearings = bearings / bearings.norm(dim=-1, keepdim=True)
    # A camera of 500 px per radian; the derivative spans the plane across the bearing.
    eye = torch.eye(3, dtype=torch.float64)
    by_pixel = (eye - bearings[..., :, None] * bearings[..., None, :])[..., :2] / 500
    covariance = torch.eye(2, dtype=torch.float64).expand(len(track), 2, 2, 2)
    arcs = MatchedArcs(image, track, IMAGES, tracks, bearings, by_pixel, covariance, False)
    start = ends + 0.02 * normal(tracks, 2, 3)
    disturbed = Pose.exp(0.01 * normal(IMAGES, 6)) @ poses
    return arcs, PlueckerLines.from_points(start[:, 0], start[:, 1]), disturbed


def iteration_seconds(observations: int, iterations: int = 5) -> float:
    """Least seconds of one Levenberg-Marquardt iteration of the sector cost, lines and poses free."""
    arcs, lines, poses = line_scene(observations)
    chart = LineChart.about_cameras(lines, poses.centre[arcs.image], arcs.track)
    state = LinesAndPoses(poses, chart)
    problem = LineProblem(arcs, "sector", Freedom(torch.zeros(IMAGES, dtype=torch.bool)), state)
    ticks: list[float] = []
    solve(problem, state, max_iterations=iterations, tolerance=0.0, callback=lambda _: ticks.append(time.perf_counter()))
    return min(later - earlier for earlier, later in itertools.pairwise(ticks))
