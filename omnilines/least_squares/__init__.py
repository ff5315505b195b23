"""One solver for every adjustment: Levenberg-Marquardt with a Schur complement; it knows no camera and no line."""

from omnilines.least_squares.levenberg_marquardt import Outcome, Problem, Progress, Solution, solve
from omnilines.least_squares.losses import LOSSES, Loss
from omnilines.least_squares.schur import CellLinearisation, CellPart, KeptPrior, Linearisation
from omnilines.least_squares.structure import Cells, KeptGroup, Structure

__all__ = [
    "LOSSES",
    "CellLinearisation",
    "CellPart",
    "Cells",
    "KeptGroup",
    "KeptPrior",
    "Linearisation",
    "Loss",
    "Outcome",
    "Problem",
    "Progress",
    "Solution",
    "Structure",
    "solve",
]
