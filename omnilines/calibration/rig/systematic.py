"""What the errors that all corners of a camera have in common do to a rig.

Residuals show what differs from corner to corner. A detector also leaves something that is alike in all of them: rendered photos
of wide lenses show corners shifted towards the centre of the image by 0.001 to 0.002 px, whatever their noise (a blurred edge
that a lens bends moves to its hollow side). Thousands of corners average their noise to less than that, so it is carried as an
error of its own: a radial shift of each camera, unknown, of a given standard deviation. With b its effect on the
residuals, the estimate moves by (J' J)^-1 J' b.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigProblem, RigState
from omnilines.least_squares import Solution
from omnilines.least_squares.schur import back_substitute, normal_equations, reduce


def moved_by_radial_shifts(
    problem: RigProblem, solution: Solution[RigState], radial_shift_px: float
) -> tuple[Float[Tensor, "c k"], Float[Tensor, "c f e"]]:
    """How the kept parameters and the poses of all frames move if the corners of each camera in turn are shifted away from the
    centre of its image by so much."""
    points, state = problem.points, solution.state
    at = problem.linearise(state)
    weight, covariance = torch.ones(len(at.residual), dtype=torch.float64), solution.kept_covariance()
    kept, frames = [], []
    for camera, model in enumerate(state.models):
        shift = _outwards(points, camera, model.centre_px) * points.weight[:, None] * radial_shift_px
        # An observed pixel that moves outwards is a residual that shrinks by as much.
        equations = normal_equations(problem.structure, replace(at, residual=-problem.of_corners(shift)), weight)
        reduced = reduce(equations, 0.0)
        step = covariance @ reduced.right_side
        kept.append(step)
        frames.append(back_substitute(reduced, step))
    return torch.stack(kept), torch.stack(frames)


def _outwards(points: RigPoints, camera: int, centre_px: Float[Tensor, "2"]) -> Float[Tensor, "n 2"]:
    """Unit vectors from the centre of the image for the corners of one camera, zero for the others."""
    away = points.pixels - centre_px
    unit = away / away.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return torch.where((points.camera[points.view] == camera)[:, None], unit, 0.0)
