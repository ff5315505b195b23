"""What the compiled engine says at the end of an adjustment: which directions are weak, and all covariances."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.adjustment.engine import LineEngine, Reduction
from omnilines.adjustment.engine_sandwich import LineSandwich, frame_gains
from omnilines.adjustment.kernels import covariance as covariance_kernel
from omnilines.adjustment.state import LinesAndPoses
from omnilines.least_squares import Minimum, Outcome
from omnilines.least_squares.dense import LEAST_EIGENVALUE
from omnilines.progress import in_shares


@dataclass(frozen=True)
class LineSolution:
    """As `least_squares.Solution`, block-sparse."""

    end: Minimum[LinesAndPoses]
    smallest_eigenvalue: float
    weakest_direction: Float[Tensor, " k"]
    engine: LineEngine
    reduction: Reduction | None
    scatter: Float[Tensor, "n 2 2"] | None = None
    unit: float = 1.0

    @property
    def state(self) -> LinesAndPoses:
        """With the least cost found."""
        return self.end.state

    @property
    def cost(self) -> float:
        """Sum of the loss, and of the prior."""
        return self.end.cost

    @property
    def determined(self) -> bool:
        """Whether the equations have a solution."""
        return self.reduction is not None and (self.reduction.system is not None or not len(self.engine.problem.free))

    @cached_property
    def _inverse(self) -> Float[np.ndarray, "blocks 6 6"]:
        """S^-1 of the frames."""
        assert self.reduction is not None
        return np.zeros((0, 6, 6)) if self.reduction.system is None else self.reduction.system.covariance_blocks()

    @cached_property
    def _sandwich(self) -> LineSandwich | None:
        """For residuals of unequal variance."""
        if self.scatter is None or self.reduction is None:
            return None
        engine, prior = self.engine, self.engine.prior_blocks(self.state)
        return LineSandwich(
            layout=engine.layout,
            views=engine.views,
            scatter=self.scatter[engine.layout.observations].numpy(),
            of_prior=None if prior is None else self.unit * prior,
            pose=engine.poses(self.state),
            lines=engine.lines(self.state.chart),
            solved=self.reduction.solved,
            system=self.reduction.system,
            inverse=self._inverse,
        )

    def absorbed(self, parameters: int) -> float:
        """Sum of the squared residuals of the noise of the arcs that so many free parameters take up; NaN where undetermined."""
        if not self.determined:
            return math.nan
        if self._sandwich is not None:
            return self._sandwich.trace()
        return self.unit * (parameters - self.prior_share())

    def prior_share(self) -> float:
        """Parameters that the prior determines, tr(H^-1 P'P)."""
        own = self.engine.prior_blocks(self.state)
        if own is None or not self.determined:
            return 0.0
        return float((self._inverse[self.engine.layout.pattern.diagonal] * own).sum())

    def covariances(self) -> tuple[Float[Tensor, "frames 6 6"], Float[Tensor, "t 4 4"]]:
        """Of every free frame, in the order of the problem, and of every line; NaN where not determined, and for held lines."""
        engine, layout_ = self.engine, self.engine.layout
        tracks, free = engine.problem.arcs.tracks, len(engine.problem.free)
        lines, frames = np.full((tracks, 4, 4), np.nan), np.full((free, 6, 6), np.nan)
        if self.reduction is None or not self.determined:
            return torch.from_numpy(frames), torch.from_numpy(lines)
        if self._sandwich is not None:
            frames, lines = self._sandwich.covariances()
            return torch.from_numpy(layout_.back(frames)), torch.from_numpy(lines)
        blocks = self._inverse
        if free:
            frames = layout_.back(blocks[layout_.pattern.diagonal])
        pose, chart, solved = engine.poses(self.state), engine.lines(self.state.chart), self.reduction.solved
        in_shares(
            lambda _, low, high: covariance_kernel.line_covariances(
                low, high, engine.views, pose, chart, layout_.pairs, blocks, solved, lines
            ),
            layout_.shares,
        )
        return self.unit * torch.from_numpy(frames), self.unit * torch.from_numpy(lines)

    def eliminated_covariance(self) -> Float[Tensor, "t 4 4"]:
        """Of every line."""
        return self.covariances()[1]

    def joint_eliminated_covariance(self, blocks: Int[Tensor, " b"]) -> Float[Tensor, "b4 b4"]:
        """Of some lines together, dense: only for as many as such a matrix can hold. NaN where not determined."""
        engine, size, chosen = self.engine, 4 * len(blocks), blocks.numpy()
        if self.reduction is None or not self.determined:
            return torch.full((size, size), torch.nan, dtype=torch.float64)
        solved = self.reduction.solved
        observed = (solved.diagonal[chosen] > 0).any(1)
        own = np.zeros((len(blocks), 4, 4))
        own[:, *np.tril_indices(4)] = solved.factors[chosen]
        roots = np.linalg.inv(own).transpose(0, 2, 1)
        gains = frame_gains(
            engine.layout, engine.views, engine.poses(self.state), engine.lines(self.state.chart), solved, blocks=chosen
        )
        if self._sandwich is not None:
            joint = self._sandwich.joint(chosen, roots, gains)
        else:
            joint = self.unit * scipy.linalg.block_diag(*(roots @ roots.transpose(0, 2, 1)))
            if self.reduction.system is not None:
                flat = gains.reshape(size, -1)
                joint += self.unit * flat @ self.reduction.system.solve(np.ascontiguousarray(flat.T))
        unknown = np.repeat(~observed, 4)
        joint[unknown], joint[:, unknown] = np.nan, np.nan
        return torch.from_numpy(joint)


def line_solution(
    engine: LineEngine,
    found: Minimum[LinesAndPoses],
    scatter: Float[Tensor, "n 2 2"] | None = None,
    unit: float = 1.0,
    known: Float[Tensor, "free 6 6"] | None = None,
) -> LineSolution:
    """What the undamped equations say at the end, for residuals with the covariance `scatter`, or of the variance `unit`,
    which is that of the prior in either case. The frame that covariances are in weighs every free frame by what is `known` of it,
    and all alike without."""
    reduction = engine.reduce(found.state, 0.0)
    smallest, direction = 0.0, np.zeros(6 * len(engine.problem.free))
    if reduction is not None and not len(direction):
        smallest = 1.0
    elif reduction is not None and reduction.system is not None:
        smallest, direction = reduction.system.weakest()
        if known is not None:
            reduction = replace(reduction, system=reduction.system.in_datum(known.numpy()[engine.layout.rank]))
    outcome = Outcome.DEGENERATE if smallest < LEAST_EIGENVALUE else found.outcome
    weakest = torch.from_numpy(engine.layout.back(direction.reshape(-1, 6)).flatten())
    end = replace(found, outcome=outcome)
    return LineSolution(
        end=end,
        smallest_eigenvalue=smallest,
        weakest_direction=weakest,
        engine=engine,
        reduction=reduction,
        scatter=scatter,
        unit=unit,
    )
