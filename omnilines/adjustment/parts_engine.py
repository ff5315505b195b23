"""The adjustment of a scene in parts: the same steps and covariances as in one piece, by parts and the photos that they share.

In each iteration every part eliminates its lines and then its inner photos, and says what that leaves of the shared ones
(`least_squares/separators.py`). One system of all shared photos gives their step, and the parts follow, by themselves again. Of a
part only its observations and its blocks are in memory, in the process that works on it: they lie in a file.
"""

import contextlib
import shutil
import tempfile
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.adjustment import part_tasks as tasks
from omnilines.adjustment.engine import passes_of
from omnilines.adjustment.engine_layout import layout
from omnilines.adjustment.part_tasks import PartAt, PartCovariance, PartPasses, PartStep
from omnilines.adjustment.parts import Division, problem_of
from omnilines.adjustment.problem import LineProblem
from omnilines.adjustment.state import LinesAndPoses, moved_poses
from omnilines.least_squares import Loss, Minimum, Outcome, Progress, Step, minimise
from omnilines.least_squares.datum import weighed
from omnilines.least_squares.dense import LEAST_EIGENVALUE
from omnilines.least_squares.reduced_system import scaled_gauge
from omnilines.least_squares.separators import SharedStep, SharedSystem, blocks_of
from omnilines.progress import Each, one_torch_thread

PARTS = "parts-"
"""How the names of folders of parts begin."""
T = TypeVar("T")
R = TypeVar("R")


def here(work: Callable[[T], R], items: Sequence[T], /) -> list[R]:
    """In this process, one after another, so that one part is in memory at a time."""
    return [work(item) for item in items]


@dataclass(frozen=True)
class Workers:
    """Who works on parts, and where these lie."""

    each: Each = here
    folder: Path | None = None
    """That all of them see; temporary files of this machine where there is none."""


@dataclass(frozen=True)
class _Places:
    """Where a part's frames and lines are in the scene."""

    file: Path
    frames: Int[Tensor, " f"]
    """Of the scene, in the order of the part's layout."""
    inner: int
    shared: Int[np.ndarray, " s"]
    """Place of its shared frames among all that are."""
    tracks: Int[Tensor, " t"]

    @property
    def free(self) -> Int[Tensor, " k"]:
        """Frames that move."""
        return self.frames[: self.inner + len(self.shared)]


class PartsEngine:
    """An `Engine` for one problem from one start, without a prior."""

    def __init__(
        self, problem: LineProblem, state: LinesAndPoses, loss: Loss, division: Division, workers: Workers = Workers()
    ) -> None:
        """The parts lie in files for as long as the engine does."""
        assert problem.prior is None, "a prior is left to the adjustment in one piece"
        self.problem, self.division, self.each = problem, division, workers.each
        folder = Path(tempfile.mkdtemp(prefix=PARTS, dir=workers.folder))
        self._remove = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.residuals = 2 * len(problem.arcs)
        self._places: list[_Places] = []
        shared = torch.from_numpy(division.shared)
        for number, part in enumerate(division.parts):
            own = problem_of(part, problem, state)
            last = torch.searchsorted(part.frames, shared[part.shared])
            # Workers have a core each; here a part has all of them.
            with contextlib.nullcontext() if self.each is here else one_torch_thread():
                laid_out = layout(own, last.numpy())
            file, inner = folder / f"part{number}.pickle", laid_out.pattern.kept - len(part.shared)
            tasks.store_part(file, PartPasses(passes_of(own, loss, laid_out), inner))
            self._places.append(_Places(file, part.frames[laid_out.frames], inner, part.shared, part.tracks))

    def close(self) -> None:
        """Remove the files of the parts, which go with the engine otherwise."""
        self._remove()

    def cost(self, state: LinesAndPoses) -> float:
        """Sum of the loss."""
        none = self._of_frames(np.zeros((6 * len(self.problem.free), 0)))
        return sum(self.each(tasks.cost_of_part, self._at(state, 0.0, none, none)))

    def minimise(
        self, state: LinesAndPoses, max_iterations: int, callback: Callable[[Progress], None] | None = None
    ) -> Minimum[LinesAndPoses]:
        """Levenberg-Marquardt."""
        return minimise(self, state, max_iterations, callback=callback)

    def step(self, state: LinesAndPoses, damping: float) -> Step[LinesAndPoses] | None:
        """The step of shared frames, inner ones and lines; None where the equations are singular."""
        found = self.reduce(state, damping)
        if found is None:
            return None
        at, system = found
        shared = system.step()
        if not np.isfinite(shared.solved).all():
            return None
        followed = self.each(tasks.follow_part, [self._step_of(*pair, shared) for pair in zip(at, self._places, strict=True)])
        delta = torch.zeros(len(state.rig_from_world), 6, dtype=torch.float64)
        moved_shared = shared.solved - system.gauge @ shared.left
        delta[torch.from_numpy(self.division.shared)] = torch.from_numpy(moved_shared).reshape(-1, 6)
        centre, turn, phi = state.chart.centre.clone(), state.chart.S.clone(), state.chart.phi.clone()
        cost = promised = 0.0
        for part, end in zip(self._places, followed, strict=True):
            if end is None:
                return None
            delta[part.frames[: part.inner]] = torch.from_numpy(end.inner)
            centre[part.tracks], turn[part.tracks], phi[part.tracks] = end.chart.centre, end.chart.S, end.chart.phi
            cost, promised = cost + end.cost, promised + end.promised
        moved = moved_poses(state.rig_from_world, self.problem.free, delta[self.problem.free])
        chart = replace(state.chart, centre=centre, S=turn, phi=phi)
        return Step(replace(state, rig_from_world=moved, chart=chart), cost, promised)

    def reduce(
        self, state: LinesAndPoses, damping: float, known: Float[Tensor, "free 6 6"] | None = None
    ) -> tuple[list[PartAt], SharedSystem] | None:
        """Every part at a state, and the system of what they share; None where anything is not determined. The
        frame weighs every free photo by what is `known` of it, and all alike without (`least_squares/datum.py`)."""
        sizes = self.problem.step_sizes(state).numpy()
        found = scaled_gauge(self.problem.motions(state).numpy(), sizes)
        if found is None:
            return None
        datum = found.datum if known is None else weighed(found.gauge, known.numpy())
        gauge, datum = self._of_frames(found.gauge), self._of_frames(datum)
        at = self._at(state, damping, gauge, datum)
        reduced = [found for found in self.each(tasks.reduce_part, at) if found is not None]
        if len(reduced) < len(at):
            return None
        shared = torch.from_numpy(self.division.shared)
        touched = [part.shared for part in self._places]
        of_shared = self._rows(gauge, shared), self._rows(datum, shared)
        # The same six for every frame.
        system = SharedSystem.of(self.division.pattern, touched, reduced, *of_shared, damping, sizes[: 6 * len(shared)])
        return None if system is None else (at, system)

    def _of_frames(self, columns: Float[np.ndarray, "k g"]) -> Float[np.ndarray, "f6 g"]:
        """Columns of the free frames, with rows for all frames of the scene."""
        whole = np.zeros((len(self.problem.freedom.held_frames), 6, columns.shape[1]))
        whole[self.problem.free.numpy()] = columns.reshape(len(self.problem.free), 6, columns.shape[1])
        return whole.reshape(len(whole) * 6, columns.shape[1])

    @staticmethod
    def _rows(columns: Float[np.ndarray, "f6 g"], frames: Int[Tensor, " k"]) -> Float[np.ndarray, "k6 g"]:
        """Of some frames."""
        size = columns.shape[1]
        return columns.reshape(len(columns) // 6, 6, size)[frames.numpy()].reshape(6 * len(frames), size)

    def _at(
        self, state: LinesAndPoses, damping: float, gauge: Float[np.ndarray, "f6 g"], datum: Float[np.ndarray, "f6 g"]
    ) -> list[PartAt]:
        return [
            PartAt(
                part.file,
                state.rig_from_world[part.frames],
                state.chart[part.tracks],
                damping,
                self._rows(gauge, part.free),
                self._rows(datum, part.free),
            )
            for part in self._places
        ]

    def _step_of(self, at: PartAt, part: _Places, shared: SharedStep) -> PartStep:
        return PartStep(at, replace(shared, solved=shared.solved.reshape(-1, 6)[part.shared].ravel()))


@dataclass(frozen=True)
class PartsSolution:
    """As `engine_solution.LineSolution`, by parts. No covariance is conditional: each holds what all parts say."""

    end: Minimum[LinesAndPoses]
    engine: PartsEngine
    at: Sequence[PartAt]
    system: SharedSystem | None
    smallest_eigenvalue: float
    """That of `SharedSystem.weakest`."""
    unit: float = 1.0

    @property
    def cost(self) -> float:
        """Sum of the loss."""
        return self.end.cost

    @property
    def state(self) -> LinesAndPoses:
        """With the least cost found."""
        return self.end.state

    def absorbed(self, parameters: int) -> float:
        """Sum of the squared residuals of the noise of the arcs that so many free parameters take up; NaN where undetermined."""
        return float("nan") if self.system is None else self.unit * parameters

    def prior_share(self) -> float:
        """There is no prior."""
        return 0.0

    def shared_covariance(self) -> Float[Tensor, "s6 s6"]:
        """Joint covariance of all frames that parts share, in the order of the division: dense, for as many as that can hold."""
        size = 6 * len(self.engine.division.shared)
        if self.system is None:
            return torch.full((size, size), torch.nan, dtype=torch.float64)
        gauge, solved = self.system.gauge, self.system.solutions[:, 1:]
        spread = self.system.system.factor.solve(np.eye(size))
        right = solved - 0.5 * gauge @ self.system.products[1:, 1:]
        return self.unit * torch.from_numpy(spread - gauge @ right.T - right @ gauge.T)

    def covariances(self) -> tuple[Float[Tensor, "free 6 6"], Float[Tensor, "t 4 4"]]:
        """Of every free frame, in the order of the problem, and of every line; NaN where not determined, and for held lines."""
        problem = self.engine.problem
        lines = torch.full((problem.arcs.tracks, 4, 4), torch.nan, dtype=torch.float64)
        frames = torch.full((len(problem.freedom.held_frames), 6, 6), torch.nan, dtype=torch.float64)
        if self.system is not None:
            found = self.engine.each(tasks.covariances_of_part, self._told({}))
            for part, (of_frames, of_lines) in zip(self.engine._places, found, strict=True):
                frames[part.free], lines[part.tracks] = torch.from_numpy(of_frames), torch.from_numpy(of_lines)
        return self.unit * frames[problem.free], self.unit * lines

    def eliminated_covariance(self) -> Float[Tensor, "t 4 4"]:
        """Of every line."""
        return self.covariances()[1]

    def joint_eliminated_covariance(self, blocks: Int[Tensor, " b"]) -> Float[Tensor, "b4 b4"]:
        """Of some lines together, dense: only for as many as such a matrix can hold. NaN where not determined."""
        size = 4 * len(blocks)
        joint = np.full((size, size), np.nan)
        if self.system is None:
            return torch.from_numpy(joint)
        places = self.engine._places
        rows = [torch.nonzero(torch.isin(blocks, part.tracks)).flatten() for part in places]
        asked = {k: torch.searchsorted(places[k].tracks, blocks[own]).numpy() for k, own in enumerate(rows) if len(own)}
        # Here: it may be asked for when the workers have gone.
        found = dict(zip(asked, here(tasks.joint_of_part, self._told(asked)), strict=True))
        by_shared = np.zeros((size, len(self.system.gauge)))
        left, right = np.zeros((size, self.system.gauge.shape[1])), np.zeros((size, self.system.gauge.shape[1]))
        own = np.zeros((size, size))
        for k, lines in found.items():
            at = (4 * rows[k].numpy()[:, None] + np.arange(4)).ravel()
            columns = (6 * places[k].shared[:, None] + np.arange(6)).ravel()
            own[np.ix_(at, at)] = lines.own
            by_shared[np.ix_(at, columns)] = lines.by_shared
            left[at], right[at] = lines.by_gauge, lines.by_solved
        spread = self.system.system.factor.solve(np.ascontiguousarray(by_shared.T))
        joint = own + by_shared @ spread - left @ right.T - right @ left.T
        return torch.from_numpy(self.unit * joint)

    def _told(self, asked: dict[int, Int[np.ndarray, " b"]]) -> list[PartCovariance]:
        """For those parts of which lines are asked for together, or for all."""
        assert self.system is not None
        system, pattern = self.system, self.engine.division.pattern
        blocks = system.system.factor.inverse_blocks(pattern, 6)
        solved = system.solutions[:, 1:].reshape(pattern.kept, 6, system.gauge.shape[1])
        found = []
        for k in asked or range(len(self.at)):
            own = self.engine._places[k].shared
            i, j = np.triu_indices(len(own))
            spread = np.empty((len(own), 6, len(own), 6))
            spread[j, :, i] = blocks[blocks_of(pattern, own, i, j)].transpose(0, 2, 1)
            spread[i, :, j] = blocks[blocks_of(pattern, own, i, j)]
            by_datum = solved[own].reshape(6 * len(own), solved.shape[2])
            dense = spread.reshape(6 * len(own), -1)
            found.append(PartCovariance(self.at[k], dense, by_datum, system.products[1:, 1:], asked.get(k)))
        return found


def parts_solution(
    engine: PartsEngine, found: Minimum[LinesAndPoses], unit: float = 1.0, known: Float[Tensor, "free 6 6"] | None = None
) -> PartsSolution:
    """What the undamped equations say at the end, for residuals of the variance `unit`; `known` as in `PartsEngine.reduce`."""
    reduction = engine.reduce(found.state, 0.0, known)
    if reduction is None:
        return PartsSolution(replace(found, outcome=Outcome.DEGENERATE), engine, (), None, 0.0, unit)
    at, system = reduction
    smallest = system.weakest()
    end = replace(found, outcome=Outcome.DEGENERATE) if smallest < LEAST_EIGENVALUE else found
    return PartsSolution(end, engine, at, system, smallest, unit)
