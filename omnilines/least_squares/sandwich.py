"""The covariance H^-1 K H^-1 of parameters that solve equations with the derivative H, whose right side has the covariance K.

Both have the arrow form of `schur.py`. With the gains G = E^-1 W' of H, R = K_w' - K_e G and X = S^-1 K_S S^-1,

    K_S = K_k - sum (K_w G + G' K_w' - G' K_e G),      Cov_e = E^-1 K_e E^-1 + G X G' - (E^-1 R S^-1 G' + its transpose).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.repeatable import total
from omnilines.least_squares.schur import NormalEquations, Reduced, chunk_of
from omnilines.least_squares.structure import SizeClass


@dataclass(frozen=True)
class Sandwich:
    """H by its reduced equations and S^-1 in some gauge, and K."""

    reduced: Reduced
    inverse: Float[Tensor, "k k"]
    scores: NormalEquations
    """K: its gradients are not used."""

    def _parts(self) -> Iterator[tuple[SizeClass, Tensor, Tensor, Tensor]]:
        """Blocks with equally many kept columns, a bounded number at once: with their G, R and K_e."""
        equations, scores = self.reduced.equations, self.scores
        for part in equations.structure.size_classes:
            size = part.columns.shape[1]
            step = max(1, chunk_of(equations.coupling.device) // max(1, size) ** 2)
            for low in range(0, len(part.blocks), step):
                some = SizeClass(*(table[low : low + step] for table in (part.blocks, part.columns, part.rows)))
                gain = torch.cholesky_solve(equations.coupling[some.rows].mT, self.reduced.factor[some.blocks])
                own = scores.eliminated[some.blocks]
                yield some, gain, scores.coupling[some.rows].mT - own @ gain, own

    @cached_property
    def reduced_scores(self) -> Float[Tensor, "k k"]:
        """K_S."""
        matrix = self.scores.kept.clone()
        flat, k = matrix.view(-1), len(matrix)
        for part, gain, rest, own in self._parts():
            # K_w G = (R + K_e G)' G.
            shared = rest.mT @ gain
            place = part.columns[:, :, None] * k + part.columns[:, None, :]
            flat.index_add_(0, place.flatten(), -(shared + shared.mT + gain.mT @ own @ gain).flatten())
        return matrix

    def trace(self) -> float:
        """tr(H^-1 K)."""
        seen = self._seen
        own = torch.cholesky_solve(self.scores.eliminated[seen], self.reduced.factor[seen])
        return total(own.diagonal(dim1=1, dim2=2)) + total(self.inverse * self.reduced_scores)

    @cached_property
    def _seen(self) -> Tensor:
        return (torch.diagonal(self.reduced.equations.eliminated, dim1=-2, dim2=-1) > 0).any(-1)

    @cached_property
    def kept(self) -> Float[Tensor, "k k"]:
        """X."""
        return self.inverse @ self.reduced_scores @ self.inverse

    def _own(self) -> Float[Tensor, "count e e"]:
        """E^-1 K_e E^-1; NaN where a block is not observed."""
        half = torch.cholesky_solve(self.scores.eliminated, self.reduced.factor)
        return torch.where(self._seen[:, None, None], torch.cholesky_solve(half.mT, self.reduced.factor), float("nan"))

    def eliminated(self) -> Float[Tensor, "count e e"]:
        """Of every eliminated block; NaN where one is not observed."""
        result = self._own()
        for part, gain, rest, _ in self._parts():
            at = part.columns[:, :, None], part.columns[:, None, :]
            shared = torch.cholesky_solve(rest, self.reduced.factor[part.blocks]) @ self.inverse[at] @ gain.mT
            result.index_add_(0, part.blocks, gain @ self.kept[at] @ gain.mT - shared - shared.mT)
        return result

    def joint(self, blocks: Int[Tensor, " b"]) -> Float[Tensor, "be be"]:
        """Of some eliminated blocks together, dense, in the order given; NaN where not observed."""
        count, dim = self.reduced.equations.eliminated.shape[:2]
        gains, rests = (self.inverse.new_zeros(count, dim, len(self.inverse)) for _ in range(2))
        for part, gain, rest, _ in self._parts():
            columns = part.columns[:, None, :].expand(-1, dim, -1)
            gains[part.blocks] = torch.zeros_like(gains[part.blocks]).scatter_(-1, columns, gain)
            solved = torch.cholesky_solve(rest, self.reduced.factor[part.blocks])
            rests[part.blocks] = torch.zeros_like(gains[part.blocks]).scatter_(-1, columns, solved)
        g, r = gains[blocks].flatten(0, 1), rests[blocks].flatten(0, 1)
        shared = r @ self.inverse @ g.mT
        return torch.block_diag(*self._own()[blocks]) + g @ self.kept @ g.mT - shared - shared.mT
