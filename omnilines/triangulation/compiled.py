"""The compiled passes over tracks (`track_kernel.py`, `sums_kernel.py`), for tensors on the processor; torch does others."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import PHI_MAX_RAD, PHI_MIN_RAD, LineChart
from omnilines.progress import in_shares, threads_for
from omnilines.triangulation.kernels import consensus as consensus_kernel
from omnilines.triangulation.kernels import likelihood as likelihood_kernel
from omnilines.triangulation.kernels import sums as sums_kernel
from omnilines.triangulation.kernels import track as track_kernel
from omnilines.triangulation.kernels.consensus import ConsensusRules
from omnilines.triangulation.kernels.track import TrackResults, TrackRows

NO_ARCS = np.empty((0, 2, 3))
NO_NOISE = np.empty((0, 2, 3, 2))


def on_processor(values: Tensor) -> bool:
    """Whether the compiled passes take a tensor."""
    return values.device.type == "cpu" and values.dtype == torch.float64 and not values.requires_grad


def array(values: Tensor) -> np.ndarray:
    """The same memory in order, for a kernel."""
    return np.ascontiguousarray(values.numpy())


def track_rows(
    track: Int[Tensor, " n"],
    tracks: int,
    normal: Float[Tensor, "n 3"],
    centre: Float[Tensor, "n 3"],
    arcs: Float[Tensor, "n 2 3"] | None,
) -> TrackRows:
    """Observations by track."""
    own = track.numpy()
    sorted_already = bool((own[1:] >= own[:-1]).all())
    rows = np.arange(len(own)) if sorted_already else np.argsort(own, kind="stable")
    start = np.zeros(tracks + 1, dtype=np.int64)
    np.cumsum(np.bincount(own, minlength=tracks), out=start[1:])
    return TrackRows(start, rows, array(normal), array(centre), NO_ARCS if arcs is None else array(arcs))


def shares(rows: TrackRows) -> list[int]:
    """Bounds of tracks with equally many observations, one share a thread."""
    tracks = len(rows.start) - 1
    threads = threads_for(tracks)
    bounds = np.searchsorted(rows.start, rows.start[-1] * np.arange(1, threads) / threads)
    return [0, *bounds.tolist(), tracks]


def solved(rows: TrackRows, smallest_angle: float, shortest: float, null_space: float) -> TrackResults:
    """Frames and dual-space lines of all tracks; NaN where a track is not solvable."""
    tracks = len(rows.start) - 1

    def blank(*shape: int) -> np.ndarray:
        return np.full((tracks, *shape), np.nan)

    out = TrackResults(
        blank(3), blank(3), blank(), blank(3), blank(), blank(3), blank(3), blank(3), blank(3), np.zeros(tracks, dtype=np.bool_)
    )
    in_shares(
        lambda _, low, high: track_kernel.solve_tracks(low, high, rows, smallest_angle, shortest, null_space, out), shares(rows)
    )
    return out


def status_sums(
    rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, lines: PlueckerLines, mean_normal: Float[Tensor, "t 3"]
) -> Float[Tensor, "t 12"]:
    """The columns of `kernels/sums.py` but CLEAR and TOUCHED."""
    sums = np.zeros((len(rows.start) - 1, 12))
    spread = NO_NOISE if noise is None else array(noise)
    given = array(lines.direction), array(lines.moment), array(mean_normal)
    in_shares(lambda _, low, high: sums_kernel.sum_tracks(low, high, rows, spread, *given, sums), shares(rows))
    return torch.from_numpy(sums)


def camera_sums(
    rows: TrackRows, lines: PlueckerLines, limit: Float[Tensor, " t"], touching: float, sums: Float[Tensor, "t 12"]
) -> None:
    """Fill CLEAR and TOUCHED."""
    given = array(lines.direction), array(lines.moment), array(limit)
    in_shares(lambda _, low, high: sums_kernel.sum_cameras(low, high, rows, *given, touching, sums.numpy()), shares(rows))


def chart_about_cameras(rows: TrackRows, lines: PlueckerLines) -> LineChart:
    """As `LineChart.about_cameras`."""
    scale, camera = np.full(len(lines), np.nan), np.full((len(lines), 3), np.nan)
    given = array(lines.direction), array(lines.moment)
    in_shares(lambda _, low, high: sums_kernel.middle_cameras(low, high, rows, *given, scale, camera), shares(rows))
    rho, centre = torch.from_numpy(scale), torch.from_numpy(camera)
    foot = lines.closest_point(centre)
    away = centre - foot
    return LineChart.from_lines(lines, foot + away * (rho / away.norm(dim=-1))[:, None], rho)


def information(
    rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, chart: LineChart
) -> tuple[Float[Tensor, "t 5 5"], Float[Tensor, " t"]]:
    """[J h]' [J h] of every track at its chart, and what double precision leaves of the sum of h^2."""
    tracks = len(rows.start) - 1
    total, rounding = np.zeros((tracks, 5, 5)), np.zeros(tracks)
    local = LineChart(torch.zeros_like(chart.centre), chart.scale, chart.S, chart.phi)
    lines, jacobian = local.lines(), local.jacobian()
    given = array(chart.centre), array(lines.direction), array(lines.moment), array(jacobian[:, :3]), array(jacobian[:, 3:])
    spread = NO_NOISE if noise is None else array(noise)
    in_shares(lambda _, low, high: sums_kernel.sum_information(low, high, rows, spread, *given, total, rounding), shares(rows))
    return torch.from_numpy(total), torch.from_numpy(rounding)


def refined(rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, start: LineChart, iterations: int) -> PlueckerLines:
    """The most likely line of every track from the line of `start`, world frame; NaN where a chart is not finite."""
    tracks = len(start)
    # Coordinates from the centre of each chart, so that nothing is lost far from the world origin.
    charts = torch.cat([torch.zeros_like(start.centre), start.S.flatten(1), start.phi[:, None]], 1).numpy()
    origin, scale = array(start.centre), array(start.scale)
    charts[~np.isfinite(origin).all(-1)] = np.nan
    spread = NO_NOISE if noise is None else array(noise)
    in_shares(
        lambda _, low, high: likelihood_kernel.refine_tracks(
            low, high, rows, spread, origin, scale, charts, PHI_MIN_RAD, PHI_MAX_RAD, iterations
        ),
        shares(rows) if tracks else [0, 0],
    )
    found = torch.from_numpy(charts)
    chart = LineChart(
        start.centre + found[:, :3], start.scale, found[:, 3:12].reshape(tracks, 3, 3), found[:, likelihood_kernel.PHI]
    )
    return chart.lines()


PairTable = tuple[Int[np.ndarray, "p 2"], Int[np.ndarray, " s"]]
"""Pairs of rows to try, and the first of those of a track of so many rows: those of k rows are pairs[start[k]:start[k + 1]]."""


def least_majority(
    rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, pairs: PairTable, parallel: float
) -> Float[Tensor, " t"]:
    """As `consensus.least_majority_square`."""
    out = np.empty(len(rows.start) - 1)
    spread = NO_NOISE if noise is None else array(noise)
    in_shares(lambda _, low, high: consensus_kernel.majority_tracks(low, high, rows, spread, *pairs, parallel, out), shares(rows))
    return torch.from_numpy(out)


def nearest_pairs(
    rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, pairs: PairTable, parallel: float, limit: float
) -> PlueckerLines:
    """The line of the two planes of each track from which all of its rows have the least sum of squares, each at most `limit`."""
    out = np.empty((len(rows.start) - 1, 6))
    spread = NO_NOISE if noise is None else array(noise)
    in_shares(
        lambda _, low, high: consensus_kernel.nearest_pair_tracks(low, high, rows, spread, *pairs, parallel, limit, out),
        shares(rows),
    )
    found = torch.from_numpy(out)
    return PlueckerLines(found[:, :3], found[:, 3:])


def consensus(
    rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, pairs: PairTable, rules: ConsensusRules
) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " t"], Float[Tensor, " n"]]:
    """The fields of `consensus.Consensus`."""
    inlier, solved = np.zeros(len(rows.rows), dtype=np.bool_), np.zeros(len(rows.start) - 1, dtype=np.bool_)
    square = np.full(len(rows.rows), np.inf)
    spread = NO_NOISE if noise is None else array(noise)
    in_shares(
        lambda _, low, high: consensus_kernel.consensus_tracks(low, high, rows, spread, *pairs, rules, inlier, square, solved),
        shares(rows),
    )
    return torch.from_numpy(inlier), torch.from_numpy(solved), torch.from_numpy(square)


def judged(rows: TrackRows, noise: Float[Tensor, "n 2 3 2"] | None, lines: PlueckerLines, variance: float) -> Float[Tensor, " n"]:
    """As `consensus.judge` with all rows being inliers."""
    square, spread = np.full(len(rows.rows), np.inf), NO_NOISE if noise is None else array(noise)
    given = np.concatenate([array(lines.direction), array(lines.moment)], 1)
    in_shares(lambda _, low, high: consensus_kernel.judge_tracks(low, high, rows, spread, given, variance, square), shares(rows))
    return torch.from_numpy(square)


def planes(
    bearings: Float[Tensor, "n 2 3"],
    poses: Pose,
    by_pixel: Float[Tensor, "n 2 3 2"] | None,
    covariance_px2: Float[Tensor, "n 2 2 2"] | None,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 2 3"], Float[Tensor, "n 2 3 2"] | None, int]:
    """Normals, world bearings and noise of arcs, and how many covariances of end points are not positive definite."""
    count = len(bearings)
    world, normal = np.empty((count, 2, 3)), np.empty((count, 3))
    noise = NO_NOISE if by_pixel is None else np.empty((count, 2, 3, 2))
    given = array(bearings), array(poses.rotation), NO_NOISE if by_pixel is None else array(by_pixel)
    covariance = np.empty((0, 2, 2, 2)) if covariance_px2 is None else array(covariance_px2)
    threads = threads_for(count)
    wrong = in_shares(
        lambda _, low, high: sums_kernel.planes(low, high, *given, covariance, world, normal, noise),
        [count * k // threads for k in range(threads + 1)],
    )
    return torch.from_numpy(normal), torch.from_numpy(world), None if by_pixel is None else torch.from_numpy(noise), sum(wrong)
