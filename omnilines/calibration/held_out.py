"""How well a camera predicts views that its fit has not seen, from one linearisation of the fit of all views.

With the pose of view v eliminated, its residuals are e_v + A_v d for a change d of the camera. Without view v the camera moves by

    d_v = -(S - S_v)^-1 (g - g_v),    S_v = A_v' A_v,  g_v = A_v' e_v,  S and g their sums (g = 0 at the optimum)

and what then remains of the view, its pose fitted anew, is |e_v + A_v d_v|^2 (PRESS, D. Allen 1974, with views left out in the
place of single observations). It is exact where the problem is linear, which it nearly is so near to the optimum.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.least_squares.dense import LEAST_EIGENVALUE

EXACT_PX = 1e-6
"""Errors below are those of rounding."""


@dataclass(frozen=True)
class HeldOut:
    """Held-out error of one camera over views."""

    parameters: int
    squares_px2: Float[Tensor, " v"]
    """Sum of the squared distances of each view by the camera of all others; infinite where those leave the camera open."""
    counts: Float[Tensor, " v"]
    """Corners of each view."""

    @property
    def rms_px(self) -> float:
        """Per point."""
        return math.sqrt(float(self.squares_px2.sum() / self.counts.sum()))

    def as_good_as(self, best: "HeldOut", no_worse_factor: float) -> bool:
        """Whether what is lost against the best is within its standard error (paired over the views; L. Breiman et al. 1984),
        and hardly anything: its RMS is not greater by this factor."""
        difference = (self.squares_px2 - best.squares_px2) / self.counts.mean()
        within = bool(difference.mean() <= difference.std() / math.sqrt(len(difference)))
        return self.rms_px <= max(best.rms_px, EXACT_PX) or (within and self.rms_px <= no_worse_factor * best.rms_px)

    def beaten_by(self, other: "HeldOut", significance: float) -> bool:
        """Whether the other predicts views better by more than chance makes oftener than `significance`: Student's t of what
        it saves of each view. Few views tell their scatter too badly for one standard error."""
        saved = self.squares_px2 - other.squares_px2
        if len(saved) < 2:
            return False
        t = float(saved.mean() / (saved.std() / math.sqrt(len(saved))))
        return bool(stats.t.sf(t, len(saved) - 1) < significance)


@dataclass(frozen=True)
class ViewTerms:
    """What each view says of the kept parameters near an optimum, its pose eliminated: |e_v + A_v d|^2 as a quadratic in d."""

    matrix: Float[Tensor, "v k k"]
    """S_v = A_v' A_v."""
    gradient: Float[Tensor, "v k"]
    """g_v = A_v' e_v."""
    squares_px2: Float[Tensor, " v"]
    counts: Float[Tensor, " v"]
    known: tuple[Float[Tensor, "k k"], Float[Tensor, " k"]] | None = None
    """What is known without any view, as matrix and gradient: it stays when a view is left out."""

    @staticmethod
    def of(problem: BoardProblem, optimum: CameraAndBoards) -> "ViewTerms":
        """Of (weighted) residuals by plain least squares."""
        at = problem.linearise(optimum)
        gram = problem.points.cells.gram(torch.cat([at.by_eliminated, *at.by_kept, at.residual[..., None]], -1))
        own, coupling = gram[:, :6, :6], gram[:, :6, 6:]
        eliminated, info = torch.linalg.solve_ex(own, coupling)
        if info.any():  # what a view leaves open of its pose moves nothing
            eliminated = torch.linalg.pinv(own, hermitian=True) @ coupling
        reduced = gram[:, 6:, 6:] - coupling.mT @ eliminated
        counts = problem.points.counts.to(reduced.dtype)
        return ViewTerms(reduced[:, :-1, :-1], reduced[:, :-1, -1], reduced[:, -1, -1], counts)

    def moved(self, step: Float[Tensor, " k"], kept: list[int]) -> "ViewTerms":
        """Seen from a neighbour, of some of the parameters; the others are held there."""
        turned = self.matrix @ step
        squares = self.squares_px2 + 2 * self.gradient @ step + turned @ step
        return ViewTerms(self.matrix[:, kept][:, :, kept], (self.gradient + turned)[:, kept], squares, self.counts)

    def held_out(self) -> HeldOut:
        """What remains of every view by the camera of all others."""
        # In coordinates in which S is the identity; what S leaves open moves nothing.
        total, pull = self.matrix.sum(0), self.gradient.sum(0)
        if self.known is not None:
            total, pull = total + self.known[0], pull + self.known[1]
        unit = total.diagonal().clamp_min(1e-300).rsqrt()
        values, vectors = torch.linalg.eigh(total * unit[:, None] * unit)
        sound = values > LEAST_EIGENVALUE
        basis = unit[:, None] * vectors[:, sound] * values[sound].rsqrt()
        matrix, gradient = basis.mT @ self.matrix @ basis, self.gradient @ basis
        factor, info = torch.linalg.cholesky_ex(basis.mT @ total @ basis - matrix)
        step = -torch.cholesky_solve((pull @ basis - gradient)[..., None], factor)[..., 0]
        change = 2 * (gradient * step).sum(-1) + (step[:, None] @ matrix @ step[..., None])[:, 0, 0]
        # The square of an error that is 0 may round to below it.
        remaining = (self.squares_px2 + change).clamp_min(0.0)
        told = (info == 0) & (len(self.counts) > 1)
        return HeldOut(len(total), torch.where(told, remaining, torch.inf), self.counts)


def held_out(problem: BoardProblem, optimum: CameraAndBoards) -> HeldOut:
    """Of the camera and boards that minimise a problem by plain least squares; squares of weighted residuals."""
    return ViewTerms.of(problem, optimum).held_out()
