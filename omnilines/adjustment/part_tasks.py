"""What is done with one part of a scene, here or by a worker that reads the part from its file.

Each is a function of a task that can be sent, and changes nothing but the part's own sums beside its file: done twice it does the
same.
"""

import os
import pickle
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from camera_models.pose import Pose
from omnilines.adjustment.engine import empty_chart
from omnilines.adjustment.engine_passes import LinePasses, pose_rows
from omnilines.adjustment.engine_sandwich import frame_gains
from omnilines.adjustment.kernels import covariance as covariance_kernel
from omnilines.adjustment.kernels.line import FrameSums, LineBlocks
from omnilines.adjustment.state import moved_poses
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares.pattern import PairPattern, pair_pattern
from omnilines.least_squares.reduced_system import ReducedSystem
from omnilines.least_squares.separators import Reduced, SharedStep
from omnilines.progress import in_shares

AT_ONCE = 1 << 12
"""Pairs of photos whose covariances are formed at once."""


@dataclass(frozen=True)
class PartPasses:
    """The lines of a part, laid out so that its inner frames come first, then the shared ones, then those that are held."""

    passes: LinePasses
    inner: int
    """Number of inner frames."""

    @cached_property
    def pattern(self) -> PairPattern:
        """Of the inner frames."""
        whole = self.passes.layout.pattern
        own = np.stack([whole.row[self._within], whole.column[self._within]], 1)
        return pair_pattern(2 * np.arange(len(own) + 1), own.ravel(), self.inner)

    @cached_property
    def _within(self) -> Int[np.ndarray, " b"]:
        return np.flatnonzero(self.passes.layout.pattern.column < self.inner)

    def split(self, total: FrameSums, damping: float) -> "Split | None":
        """The damped equations of the inner frames and of the shared ones; None where those of the inner ones are singular."""
        whole, n = self.passes.layout.pattern, self.inner
        system = ReducedSystem.of(self.pattern, total.blocks[self._within], np.zeros((6 * n, 0)), damping)
        if system is None:
            return None
        between, shared = np.zeros((n, 6, whole.kept - n, 6)), np.zeros((whole.kept - n, 6, whole.kept - n, 6))
        across = np.flatnonzero((whole.row < n) & (whole.column >= n))
        between[whole.row[across], :, whole.column[across] - n] = total.blocks[across]
        beyond = np.flatnonzero(whole.row >= n)
        i, j = whole.row[beyond] - n, whole.column[beyond] - n
        shared[j, :, i] = total.blocks[beyond].transpose(0, 2, 1)
        shared[i, :, j] = total.blocks[beyond]
        return Split(system, between.reshape(6 * n, -1), shared.reshape(6 * (whole.kept - n), -1))


@dataclass(frozen=True)
class Split:
    """S_ii, S_is and S_ss of a part."""

    system: ReducedSystem
    between: Float[np.ndarray, "i s"]
    shared: Float[np.ndarray, "s s"]


@dataclass(frozen=True)
class PartAt:
    """A part at a state of the scene; frames in the order of its layout, lines by their numbers in it."""

    file: Path
    poses: Pose
    chart: LineChart
    damping: float
    gauge: Float[np.ndarray, "k g"]
    """B of its free frames."""
    datum: Float[np.ndarray, "k g"]
    """C of them."""


@dataclass(frozen=True)
class PartStep:
    """The step of the shared frames, for a part."""

    at: PartAt
    shared: SharedStep


@dataclass(frozen=True)
class Followed:
    """Where a part is after a step."""

    inner: Float[np.ndarray, "i 6"]
    """Step of its inner frames."""
    chart: LineChart
    cost: float
    promised: float


@dataclass(frozen=True)
class PartCovariance:
    """What a part has to be told for its covariances: C = Q - V W' - W V'."""

    at: PartAt
    shared: Float[np.ndarray, "s s"]
    """Q of the shared frames."""
    solved_datum: Float[np.ndarray, "s g"]
    """Q C of them."""
    products: Float[np.ndarray, "g g"]
    """C' Q C of all frames."""
    lines: Int[np.ndarray, " b"] | None = None
    """Of which the joint covariance is asked for, by their numbers in the part."""


@dataclass(frozen=True)
class JointLines:
    """Covariance of some lines of a part, as `own` for fixed shared frames and by how they follow these and the gauge's V, W."""

    own: Float[np.ndarray, "b4 b4"]
    by_shared: Float[np.ndarray, "b4 s"]
    by_gauge: Float[np.ndarray, "b4 g"]
    by_solved: Float[np.ndarray, "b4 g"]


def cost_of_part(at: PartAt) -> float:
    """Loss of all observations."""
    passes = _stored(at.file).passes
    return float(passes.costs(pose_rows(at.poses), passes.lines(at.chart)).sum())


def reduce_part(at: PartAt) -> Reduced | None:
    """The part reduced to its shared frames; None where its own equations are singular. Its sums are kept beside its file."""
    part: PartPasses = _stored(at.file)
    found = part.passes.reduce(pose_rows(at.poses), part.passes.lines(at.chart), at.damping)
    if found is None:
        return None
    solved, total = found
    part.passes.damped(total, at.damping)
    split = part.split(total, at.damping)
    if split is None:
        return None
    _store(_sums_file(at.file), (solved, total))
    size = 6 * part.inner
    right = np.concatenate([total.gradient[:, :6].reshape(-1, 1), at.datum], 1)
    beyond = right[size:].copy()
    beyond[:, 1:] = 0.0
    follow = split.system.solve(np.concatenate([right[:size], split.between], 1))
    right_solved, gains = np.split(follow, [right.shape[1]], 1)
    information = split.shared - split.between.T @ gains
    return Reduced(
        0.5 * (information + information.T),
        beyond - split.between.T @ right_solved,
        right[:size].T @ right_solved,
        split.system.weakest()[0] if at.damping == 0.0 else np.inf,
    )


def follow_part(task: PartStep) -> Followed | None:
    """Inner frames and lines after the step of the shared frames; None where it is not finite."""
    at, shared = task.at, task.shared
    part: PartPasses = _stored(at.file)
    solved, total = _stored(_sums_file(at.file))
    split = part.split(total, at.damping)
    assert split is not None, "the sums were kept, so that they could be solved"
    passes, size = part.passes, 6 * part.inner
    right = total.gradient[:, :6].ravel()[:size] - at.datum[:size] @ shared.along - split.between @ shared.solved
    inner = split.system.solve(right[:, None])[:, 0]
    kept = np.concatenate([inner, shared.solved]) - at.gauge @ shared.left
    if not np.isfinite(kept).all():
        return None
    promised = float(kept @ total.gradient[:, 6:].ravel() + at.damping * (kept**2 @ total.diagonal.ravel()))
    delta = np.zeros((len(at.poses), 6))
    delta[: len(kept) // 6] = kept.reshape(-1, 6)
    free = torch.arange(len(kept) // 6)
    moved, chart = moved_poses(at.poses, free, torch.from_numpy(delta[: len(free)])), empty_chart(at.chart)
    lines, into = passes.lines(at.chart), passes.lines(chart)
    of_lines, cost = passes.follow(pose_rows(at.poses), pose_rows(moved), delta, lines, at.damping, solved=solved, into=into)
    return Followed(delta[: part.inner], chart, cost, promised + of_lines)


def covariances_of_part(task: PartCovariance) -> tuple[Float[np.ndarray, "free 6 6"], Float[np.ndarray, "t 4 4"]]:
    """Of its free frames and of its lines, for residuals of unit variance, at the state that it was reduced at last."""
    part, solved, split, gains = _reduced(task.at)
    pattern, n = part.passes.layout.pattern, part.inner
    blocks = np.empty((len(pattern.row), 6, 6))
    blocks[part._within] = split.system.covariance_blocks()
    # How all frames follow the shared ones: x_i = -S_ii^-1 S_is x_s.
    follow = np.concatenate([-gains, np.eye(len(task.shared))]).reshape(pattern.kept, 6, -1)
    spread = (follow.reshape(-1, len(task.shared)) @ task.shared).reshape(follow.shape)
    left, right = (v.reshape(pattern.kept, 6, v.shape[1]) for v in _of_gauge(task, split, gains))
    blocks[pattern.column >= n] = 0.0
    for low in range(0, len(blocks), AT_ONCE):
        i, j = pattern.row[low : low + AT_ONCE], pattern.column[low : low + AT_ONCE]
        blocks[low : low + AT_ONCE] += spread[i] @ follow[j].transpose(0, 2, 1)
        blocks[low : low + AT_ONCE] -= left[i] @ right[j].transpose(0, 2, 1) + right[i] @ left[j].transpose(0, 2, 1)
    passes, at = part.passes, task.at
    lines = np.full((len(at.chart), 4, 4), np.nan)
    given = (passes.views, pose_rows(at.poses), passes.lines(at.chart), passes.layout.pairs, blocks, solved, lines)
    in_shares(lambda _, low, high: covariance_kernel.line_covariances(low, high, *given), passes.layout.shares)
    return blocks[pattern.diagonal], lines


def joint_of_part(task: PartCovariance) -> JointLines:
    """Of some of its lines together."""
    assert task.lines is not None, "lines were expected"
    part, solved, split, gains = _reduced(task.at)
    passes, at, size = part.passes, task.at, 6 * part.inner
    roots = line_roots(solved, task.lines)
    chart = passes.lines(at.chart)
    ways = frame_gains(passes.layout, passes.views, pose_rows(at.poses), chart, solved, blocks=task.lines)
    flat = -ways.reshape(4 * len(task.lines), -1)
    own = np.zeros((len(task.lines), 4, len(task.lines), 4))
    each = np.arange(len(task.lines))
    own[each, :, each] = roots @ roots.transpose(0, 2, 1)
    inner = np.ascontiguousarray(flat[:, :size].T)
    left, right = _of_gauge(task, split, gains)
    return JointLines(
        own.reshape(len(flat), -1) + inner.T @ split.system.solve(inner),
        flat[:, size:] - flat[:, :size] @ gains,
        flat @ left,
        flat @ right,
    )


def line_roots(solved: LineBlocks, lines: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 4 4"]:
    """L'^-1 of some lines."""
    own = np.zeros((len(lines), 4, 4))
    own[:, *np.tril_indices(4)] = solved.factors[lines]
    return np.linalg.inv(own).transpose(0, 2, 1)


def _of_gauge(
    task: PartCovariance, split: Split, gains: Float[np.ndarray, "i s"]
) -> tuple[Float[np.ndarray, "k g"], Float[np.ndarray, "k g"]]:
    """V = B and W = Q C - B (C' Q C) / 2 of its free frames."""
    gauge, size = task.at.gauge, len(gains)
    inner = split.system.solve(np.ascontiguousarray(task.at.datum[:size])) - gains @ task.solved_datum
    return gauge, np.concatenate([inner, task.solved_datum]) - 0.5 * gauge @ task.products


def _reduced(at: PartAt) -> tuple[PartPasses, LineBlocks, Split, Float[np.ndarray, "i s"]]:
    """A part with what was kept of its last reduction, and S_ii^-1 S_is."""
    part: PartPasses = _stored(at.file)
    solved, total = _stored(_sums_file(at.file))
    split = part.split(total, at.damping)
    assert split is not None, "the sums were kept, so that they could be solved"
    return part, solved, split, split.system.solve(split.between)


def store_part(file: Path, part: PartPasses) -> None:
    """Where the tasks find it."""
    _store(file, part)


def _sums_file(file: Path) -> Path:
    return file.with_suffix(".sums")


def _store(file: Path, value: Any) -> None:
    """Whole or not at all: a task may be done by two workers at once."""
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=file.name)
    with os.fdopen(handle, "wb") as stream:
        pickle.dump(value, stream, protocol=5)
    os.replace(name, file)


def _stored(file: Path) -> Any:
    with file.open("rb") as stream:
        return pickle.load(stream)
