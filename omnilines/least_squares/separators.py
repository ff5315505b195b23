"""The system of the blocks that parts of a problem share, each part reduced to them (substructuring).

With the inner blocks i and the shared ones s of a part, whose equations have the matrix S and right sides R,

    T = S_ss - S_si S_ii^-1 S_is,   h = R_s - S_si S_ii^-1 R_i,   p = R_i' S_ii^-1 R_i

are all that the others need of it: summed over the parts, T x_s = h are the equations of the shared blocks with all inner ones
eliminated, T^-1 their joint covariance, and R' S^-1 R = p + h' T^-1 h. Within a part x_i = S_ii^-1 (R_i - S_is x_s).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from omnilines.least_squares.pattern import PairPattern
from omnilines.least_squares.reduced_system import ReducedSystem


@dataclass(frozen=True)
class Reduced:
    """What a part says of its shared blocks; of its right sides the first is that of the equations, the others are the C of the
    constraint C' x = 0 on the gauge B, C'B = I."""

    information: Float[np.ndarray, "k k"]
    """T."""
    right: Float[np.ndarray, "k r"]
    """h; of C without that of the shared blocks themselves, which is no part's."""
    products: Float[np.ndarray, "r r"]
    """p."""
    weakest: float
    """The least eigenvalue of S_ii scaled to a unit diagonal, where it was asked for."""


@dataclass(frozen=True)
class SharedStep:
    """The step of the shared blocks, and what inner ones need to follow: x = S^-1 (R_0 - C a) - B b."""

    solved: Float[np.ndarray, " k"]
    """S^-1 (R_0 - C a) of the shared blocks."""
    along: Float[np.ndarray, " g"]
    """a."""
    left: Float[np.ndarray, " g"]
    """b."""


@dataclass(frozen=True)
class SharedSystem:
    """T of all parts with the gauge B, a basis over all blocks, inner and shared."""

    system: ReducedSystem
    gauge: Float[np.ndarray, "k g"]
    """B of the shared blocks."""
    solutions: Float[np.ndarray, "k r"]
    """T^-1 h."""
    products: Float[np.ndarray, "r r"]
    """R' S^-1 R of all blocks."""
    weakest_inner: float

    @staticmethod
    def of(
        pattern: PairPattern,
        touched: Sequence[Int[np.ndarray, " _"]],
        reduced: Sequence[Reduced],
        gauge: Float[np.ndarray, "k g"],
        datum: Float[np.ndarray, "k g"],
        damping: float,
        sizes: Float[np.ndarray, " k"] | None = None,
    ) -> "SharedSystem | None":
        """The system of what parts say of the shared blocks that each of them touches, ascending, with B and C of these; `sizes`
        as in `ReducedSystem.of`. None where it does not determine them."""
        dim = len(gauge) // pattern.kept
        blocks = np.zeros((len(pattern.row), dim, dim))
        right = np.zeros((pattern.kept, dim, 1 + gauge.shape[1]))
        right[:, :, 1:] = datum.reshape(pattern.kept, dim, datum.shape[1])
        for own, part in zip(touched, reduced, strict=True):
            i, j = np.triu_indices(len(own))
            information = part.information.reshape(len(own), dim, len(own), dim)
            blocks[blocks_of(pattern, own, i, j)] += information[i, :, j]
            right[own] += part.right.reshape(len(own), dim, -1)
        system = ReducedSystem.of(pattern, blocks, gauge, damping, sizes)
        if system is None:
            return None
        flat = right.reshape(len(gauge), -1)
        solutions = system.factor.solve(flat)
        products = sum((part.products for part in reduced), start=flat.T @ solutions)
        return SharedSystem(system, gauge, solutions, products, min(part.weakest for part in reduced))

    @property
    def pinned(self) -> bool:
        """Whether S is held along the gauge by its diagonal, as it is singular there."""
        return self.system.along is None

    def step(self) -> SharedStep:
        """The step on the constraint C' x = 0."""
        none = np.zeros(self.gauge.shape[1])
        by_datum = self.products[1:, 0]
        if self.pinned:
            return SharedStep(self.solutions[:, 0], none, by_datum)
        along = np.linalg.solve(self.products[1:, 1:], by_datum) if len(none) else none
        return SharedStep(self.solutions[:, 0] - self.solutions[:, 1:] @ along, along, none)

    def weakest(self) -> float:
        """The least eigenvalue of the inner blocks of any part, and of the shared ones on the gauge's complement, each scaled to
        a unit diagonal: zero where that of the whole is."""
        return min(self.weakest_inner, self.system.weakest()[0])


def blocks_of(
    pattern: PairPattern, own: Int[np.ndarray, " s"], i: Int[np.ndarray, " b"], j: Int[np.ndarray, " b"]
) -> Int[np.ndarray, " b"]:
    """Numbers of the blocks of pairs i <= j of some kept blocks."""
    return pattern.block_of[pattern.window[own[i]] + own[j] - own[i]]
