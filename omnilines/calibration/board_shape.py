"""How a real board differs from its drawing: squares that are not square, and a sheet that is not flat.

    X = (x, (1 + aspect) y, bend_xx p^2 + bend_xy p q + bend_yy q^2 + ...),   p = (x - x0) / h,  q = (y - y0) / h

with (x0, y0) the middle of the corners and h half their larger extent; the bends are in metres. A sheet on a warped board is
wavy: "surface" adds the terms of the third and fourth degree. Shift, scale and tilt of the
sheet are left to its pose and to the size of the squares.
"""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.calibration.options import REFINABLE, require_refinable

TERM_NAMES = ("aspect", "bend_xx_m", "bend_xy_m", "bend_yy_m")
POWERS = tuple((degree - k, k) for degree in (2, 3, 4) for k in range(degree + 1))
"""Of p and q in each bend, those of the second degree first."""
WAVE_NAMES = tuple(f"bend_{'x' * i}{'y' * j}_m" for i, j in POWERS[3:])
"""Terms of the third and fourth degree, which follow those of TERM_NAMES where they are estimated."""
TERMS_OF = dict(zip(REFINABLE, (tuple(range(1, 1 + len(POWERS))), (0,), (1, 2, 3)), strict=True))
"""The terms that each of what can be asked for frees."""


def _no_terms() -> Tensor:
    return torch.zeros(len(TERM_NAMES), dtype=torch.float64)


def _nothing_free() -> Tensor:
    return torch.zeros(len(TERM_NAMES), 0, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class BoardShape:
    """The terms of the module's header, and which of them are estimated (columns of `free`)."""

    terms: Float[Tensor, " t"] = field(default_factory=_no_terms)
    free: Float[Tensor, "t f"] = field(default_factory=_nothing_free)
    middle_m: tuple[float, float] = (0.0, 0.0)
    half_m: float = 1.0

    @staticmethod
    def to_refine(names: tuple[str, ...], board_m: Float[Tensor, "n 3"]) -> "BoardShape":
        """A plane board of square squares with the terms of `names` (of REFINABLE) free. Raises InputError on another name."""
        require_refinable(names)
        columns = sorted({column for name in names for column in TERMS_OF[name]})
        low, high = board_m[:, :2].amin(0), board_m[:, :2].amax(0)
        middle = (0.5 * (low + high)).tolist()
        count = max(len(TERM_NAMES), *(column + 1 for column in columns)) if columns else len(TERM_NAMES)
        free = torch.eye(count, dtype=torch.float64)[:, columns]
        return BoardShape(torch.zeros(count, dtype=torch.float64), free, (middle[0], middle[1]), 0.5 * float((high - low).max()))

    @property
    def plain(self) -> bool:
        """Whether the board is as drawn."""
        return self.free.shape[1] == 0

    @property
    def names(self) -> tuple[str, ...]:
        """Of the terms."""
        return (TERM_NAMES + WAVE_NAMES)[: len(self.terms)]

    @property
    def free_names(self) -> tuple[str, ...]:
        """Of the terms that are estimated."""
        return tuple(self.names[int(column.argmax())] for column in self.free.mT)

    def _bends(self, board: Float[Tensor, "n 3"]) -> Float[Tensor, "n b"]:
        """d z / d bends."""
        p, q = (board[:, 0] - self.middle_m[0]) / self.half_m, (board[:, 1] - self.middle_m[1]) / self.half_m
        return torch.stack([p**i * q**j for i, j in POWERS[: len(self.terms) - 1]], -1)

    def place(self, board: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Where the corners of the drawing really are, in the frame of the board (metres)."""
        if self.plain:
            return board
        x, y, z = board.unbind(-1)
        return torch.stack([x, (1 + self.terms[0]) * y, z + self._bends(board) @ self.terms[1:]], -1)

    def by_terms(self, board: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 t"]:
        """d place / d terms."""
        jacobian = board.new_zeros(len(board), 3, len(self.terms))
        jacobian[:, 1, 0] = board[:, 1]
        jacobian[:, 2, 1:] = self._bends(board)
        return jacobian

    def off_plane_m(self, board: Float[Tensor, "n 3"]) -> float:
        """Largest distance of a corner from the plane nearest to all of them."""
        places = self.place(torch.unique(board, dim=0))
        design = torch.cat([places[:, :2], torch.ones_like(places[:, :1])], 1)
        left = places[:, 2:] - design @ torch.linalg.lstsq(design, places[:, 2:]).solution
        return float(left.abs().max())

    def moved(self, step: Float[Tensor, " t"]) -> "BoardShape":
        """The shape with other terms."""
        return self if self.plain else replace(self, terms=self.terms + step)


AS_DRAWN = BoardShape()
"""A flat board of square squares, nothing of it estimated."""
