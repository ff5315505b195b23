"""One solver for every adjustment: Levenberg-Marquardt with a Schur complement; it knows no camera and no line."""

from omnilines.least_squares.dense import Problem, Solution, solve
from omnilines.least_squares.levenberg_marquardt import Engine, Minimum, Outcome, Progress, Step, minimise
from omnilines.least_squares.losses import LOSSES, Loss
from omnilines.least_squares.schur import CellLinearisation, CellPart, KeptPrior, Linearisation
from omnilines.least_squares.structure import Cells, KeptGroup, Structure

__all__ = [
    "LOSSES",
    "CellLinearisation",
    "CellPart",
    "Cells",
    "Engine",
    "KeptGroup",
    "KeptPrior",
    "Linearisation",
    "Loss",
    "Minimum",
    "Outcome",
    "Problem",
    "Progress",
    "Solution",
    "Step",
    "Structure",
    "minimise",
    "solve",
]
