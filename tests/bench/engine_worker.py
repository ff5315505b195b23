"""The line engine in a process of its own, as `peer_engine.py` runs its peers: the same figures as JSON on standard output.

Arguments: a saved street; `poses`, `lines`, `whole` (lines and poses with all covariances), or `whitened` (the same, with arcs
weighed by their noise) with a partition after a colon, as `whitened:500`; number of threads; most iterations.
`warm` is what loading the compiled kernels takes. `iteration` is the least of all; of lines alone, which leave the adjustment one
by one as they settle, the mean.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from engine_scene import Street, street

from omnilines.adjustment.engine import LineEngine
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Progress


def timed(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Wall-clock and processor seconds of a call, and what it returned."""
    start, own = time.perf_counter(), time.process_time()
    result = work()
    return time.perf_counter() - start, time.process_time() - own, result


def memory_mb() -> float:
    """Peak of the process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def engine_of(scene: Street, arcs: Any, lines_only: bool) -> tuple[LineEngine, LinesAndPoses]:
    """What `adjust_lines` builds before its first iteration."""
    poses, lines = scene.poses, scene.lines
    state = LinesAndPoses(poses, LineChart.about_cameras(lines, poses.centre[arcs.image], arcs.track))
    freedom = Freedom(torch.full((len(poses),), lines_only))
    return LineEngine(LineProblem(arcs, "sector", freedom, state), Loss()), state


def main() -> None:
    """See the head of the file."""
    with np.load(sys.argv[1]) as arrays:
        stored = dict(arrays)
    fields = ("rotation", "translation", "ends_m", "image", "track", "ends_px")
    scene, what = Street(*(stored[name] for name in fields)), sys.argv[2]
    torch.set_num_threads(int(sys.argv[3]))
    most = int(sys.argv[4])
    small = street(30, 500, 8)
    warm = timed(lambda: adjust_lines(small.arcs(), small.lines, small.poses, refine_poses=what != "lines"))[:2]
    arcs = scene.arcs()
    before = memory_mb()
    cost, _, partition = what.partition(":")
    if cost in ("whole", "whitened"):
        cost, parts = "sector" if cost == "whole" else cost, int(partition or 0)
        steps: list[tuple[float, float]] = []

        def stamp(progress: Progress) -> None:
            steps.append((time.perf_counter(), time.process_time()))

        wall, own, done = timed(
            lambda: adjust_lines(arcs, scene.lines, scene.poses, cost=cost, partition=parts, max_iterations=most, callback=stamp)
        )
        found = {"warm": warm, "all": (wall, own), "iterations": done.iterations, "cost": done.cost, "memory_mb": memory_mb()}
        print(json.dumps({**found, "iteration": np.diff(np.array(steps), axis=0).min(0).tolist(), "before_mb": before}))
        return
    wall, own, (engine, state) = timed(lambda: engine_of(scene, arcs, what == "lines"))
    ticks: list[tuple[float, float]] = [(time.perf_counter(), time.process_time())]

    def tell(progress: Progress) -> None:
        if progress.accepted:
            ticks.append((time.perf_counter(), time.process_time()))

    all_wall, all_own, found = timed(lambda: engine.minimise(state, most, tell))
    taken = np.diff(np.array(ticks), axis=0)[1:]
    result = {
        "warm": warm,
        "build": (wall, own),
        "iteration": (taken.mean(0) if what == "lines" else taken.min(0)).tolist(),
        "all": (all_wall, all_own),
        "iterations": found.iterations,
        "start": found.initial_cost,
        "end": found.cost,
        "outcome": found.outcome.name,
        "memory_mb": memory_mb(),
        "before_mb": before,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
