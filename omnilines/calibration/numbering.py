"""In which ways the corners of a plain board may have been numbered: turned, and shifted where only a part was seen.

The corners of a plain checkerboard carry no names. A detector that sees the whole board may begin at another end of it (half a
turn, on square boards also a quarter), one that sees a part cannot know which part. Each of these numberings is a rigid motion
of the board that maps its lattice onto itself.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from camera_models.pose import Pose

ON_LATTICE = 1e-3
"""Coordinates of a lattice are whole multiples of its pitch to within this share of it."""
TURNS = tuple(np.array(m) for m in ([[1, 0], [0, 1]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]], [[0, 1], [-1, 0]]))
MIRRORED = np.array([[-1, 0], [0, 1]])


@dataclass(frozen=True)
class Lattice:
    """The lattice of a board's corners: index k stands for the coordinate first_m + k pitch_m, k from 0 to last."""

    first_m: Float[np.ndarray, "2"]
    pitch_m: Float[np.ndarray, "2"]
    last: Int[np.ndarray, "2"]

    @staticmethod
    def of(board_m: Float[np.ndarray, "n 3"]) -> "Lattice | None":
        """The lattice of all corners of a board that any photo shows; None where they form none (tags with gaps)."""
        first, pitch, last = [], [], []
        for axis in (0, 1):
            values = np.unique(np.round(board_m[:, axis], 9))
            steps = np.diff(values)
            steps = steps[steps > 1e-7]
            if not len(steps):
                return None
            index = (values - values[0]) / steps.min()
            if np.abs(index - np.rint(index)).max() > ON_LATTICE:
                return None
            first.append(values[0])
            # The longest distance tells the pitch best.
            pitch.append((values[-1] - values[0]) / np.rint(index[-1]))
            last.append(int(np.rint(index[-1])))
        return Lattice(np.array(first), np.array(pitch), np.array(last))

    @property
    def square(self) -> bool:
        """Whether a quarter of a turn maps the lattice onto itself."""
        return bool(abs(self.pitch_m[0] - self.pitch_m[1]) <= ON_LATTICE * self.pitch_m[0])

    def indices(self, board_m: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 2"]:
        """Whole numbers of corners on the lattice."""
        return np.rint((board_m[:, :2] - self.first_m) / self.pitch_m).astype(np.int64)


@dataclass(frozen=True)
class Numbering:
    """What is known of how a board's corners are numbered."""

    lattice: Lattice | None = None
    """None where every corner has a name of its own (tags): the numbering is then beyond doubt."""
    coloured: bool = False
    """The detector tells black squares from white: numberings that exchange them are left out."""
    trusted: bool = True
    """Where several numberings fit equally well, the one in the table is taken; otherwise none is."""

    def placements(
        self, low: Int[np.ndarray, "2"], high: Int[np.ndarray, "2"], slack: Int[np.ndarray, "2"], mirrored: bool
    ) -> Pose:
        """The motions `board_from_numbered` (k,) of a patch of corners with indices `low` to `high`, the identity first.

        The patch may come to lie anywhere on the board and up to `slack` beyond its ends. With `mirrored` the patch may also have
        been numbered as it looks in a mirror.
        """
        if self.lattice is None:
            return Pose.identity(1)
        turns = TURNS if self.lattice.square else TURNS[:2]
        if mirrored:
            turns = (*turns, *(turn @ MIRRORED for turn in turns))
        found = {(0, 0, 0): (TURNS[0], np.zeros(2, dtype=np.int64))}
        for number, turn in enumerate(turns):
            ends = turn @ np.stack([low, high], -1)
            first, last = -slack - ends.min(1), self.lattice.last + slack - ends.max(1)
            for x, y in itertools.product(range(first[0], last[0] + 1), range(first[1], last[1] + 1)):
                # Along the diagonal a turn either keeps the colours of the squares round a corner or exchanges them.
                exchanged = abs(int(turn.sum())) != 2
                if not self.coloured or ((x + y) % 2 == 1) == exchanged:
                    found[number, x, y] = (turn, np.array([x, y]))
        return self._motions([turn for turn, _ in found.values()], [shift for _, shift in found.values()])

    def _motions(self, turns: Sequence[Int[np.ndarray, "2 2"]], shifts: Sequence[Int[np.ndarray, "2"]]) -> Pose:
        assert self.lattice is not None
        rotation, translation = np.zeros((len(turns), 3, 3)), np.zeros((len(turns), 3))
        rotation[:, :2, :2] = turns
        # A mirrored numbering of points in a plane is that plane seen from behind: a proper turn all the same.
        rotation[:, 2, 2] = np.linalg.det(rotation[:, :2, :2]).round()
        translation[:, :2] = self.lattice.first_m + self.lattice.pitch_m * np.stack(shifts)
        translation[:, :2] -= np.stack(turns) @ self.lattice.first_m
        return Pose(torch.as_tensor(rotation), torch.as_tensor(translation))
