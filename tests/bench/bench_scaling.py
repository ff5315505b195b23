"""Time of one iteration of the line adjustment (sector cost) against the number of observations.

    python tests/bench/bench_scaling.py

An iteration is the linearisation, the normal equations, the reduction to 20 cameras, the solution and the back-substitution. The
exit status is 1 when the slope of time against observations, both in logarithms, is above 1.15; no limit is set on seconds.
"""

import os
import sys
import time

import numpy as np
import torch

from camera_models.pose import Pose, rotation_from_vector
from omnilines.adjustment.arcs import Arcs
from omnilines.adjustment.lines import LineProblem, LinesAndPoses, factor_of
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares.levenberg_marquardt import constrained_solve
from omnilines.least_squares.schur import back_substitute, normal_equations, reduce

CAMERAS, VIEWS = 20, 8
OBSERVATIONS = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000)
STEEPEST_SLOPE = 1.15
REPEATS = 5


def scene(observations: int, seed: int = 0) -> tuple[LineProblem, LinesAndPoses]:
    """Cameras on a sphere round a unit cube of lines, each line seen by 8 of the 20, bearings disturbed by 1 mrad."""
    rng = np.random.default_rng(seed)
    count = observations // VIEWS
    directions = rng.standard_normal((CAMERAS, 3))
    centres = torch.as_tensor(3 * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    rotation = rotation_from_vector(torch.as_tensor(rng.uniform(-1, 1, (CAMERAS, 3))))
    poses = Pose(rotation, -(rotation @ centres[..., None])[..., 0])
    ends = torch.as_tensor(rng.uniform(-0.5, 0.5, (count, 2, 3)))
    track = torch.arange(count).repeat_interleave(VIEWS)
    image = torch.as_tensor(rng.permuted(np.tile(np.arange(CAMERAS), (count, 1)), axis=1)[:, :VIEWS].flatten())
    seen = poses[image].transform(ends[track]) + 3e-3 * torch.as_tensor(rng.standard_normal((len(track), 2, 3)))
    bearings = seen / seen.norm(dim=-1, keepdim=True)
    unused = torch.zeros(len(track), 2, 3, 2, dtype=torch.float64)
    arcs = Arcs(image, track, CAMERAS, count, bearings, unused, unused[:, :, :2], False)
    chart = LineChart.about_cameras(PlueckerLines.from_points(ends[:, 0], ends[:, 1]), centres[image], track)
    state = LinesAndPoses(poses, chart)
    held = torch.zeros(CAMERAS, dtype=torch.bool)
    return LineProblem(arcs, factor_of("sector", arcs, state.normals(arcs)), held), state


def iteration_seconds(problem: LineProblem, state: LinesAndPoses) -> float:
    """The least time of some repetitions of one iteration."""
    weight = torch.ones(len(problem.arcs), dtype=torch.float64)
    seconds = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        equations = normal_equations(problem.structure, problem.linearise(state), weight)
        reduced = reduce(equations, 1e-4)
        step = constrained_solve(reduced.matrix, problem.gauge(state), reduced.right_side)
        assert step is not None
        back_substitute(reduced, step)
        seconds.append(time.perf_counter() - start)
    # The first also finds the structure, once for all iterations.
    return min(seconds[1:])


def main() -> int:
    """Print the table and the slope; 0 when it is close to linear."""
    print(f"load of the machine: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores, {torch.get_num_threads()} threads")
    print(f"{'observations':>12} {'lines':>8} {'ms':>10} {'us/observation':>15}")
    times = []
    for observations in OBSERVATIONS:
        times.append(iteration_seconds(*scene(observations)))
        per = 1e6 * times[-1] / observations
        print(f"{observations:>12,} {observations // VIEWS:>8,} {1e3 * times[-1]:>10.2f} {per:>15.2f}", flush=True)
    slope = float(np.polyfit(np.log(OBSERVATIONS), np.log(times), 1)[0])
    holds = slope <= STEEPEST_SLOPE
    print(f"log-log slope {slope:.3f}, limit {STEEPEST_SLOPE}: {'holds' if holds else 'does not hold'}")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
