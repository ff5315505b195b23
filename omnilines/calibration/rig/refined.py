"""The joint fit of a rig with the calibrations that are held refined, of the same corners with the same weights."""

from collections.abc import Collection
from dataclasses import replace

from omnilines.calibration.rig.joint import RigData, RigFit
from omnilines.calibration.rig.problem import RigState
from omnilines.least_squares import Outcome, Solution, solve

ITERATIONS = 50


def refined_rig(data: RigData, fit: RigFit, state: RigState, held: Collection[int]) -> tuple[RigData, Solution[RigState]] | None:
    """With the parameters of these members free; None where none is held, or the corners leave one open."""
    if not held:
        return None
    own = [state.models[k].calibration_basis() if k in held else basis for k, basis in enumerate(data.bases)]
    free = replace(data, bases=tuple(own))
    found = solve(free.problem(fit.points.chosen(fit.kept)), state, max_iterations=ITERATIONS, damping=1e-8)
    return None if found.outcome is Outcome.DEGENERATE else (free, found)
