"""By how much right angles of the world are off: estimated from the lines themselves.

With the camera, all directions and circles eliminated, lines say of the deviations a of the right angles of all frames that they
have the information L and the score s at 0. If a is normal with the covariance A(t) the likelihood of t is (restricted, since the
camera is eliminated: H. D. Patterson and R. Thompson, 1971)

    log p(s | t) = -log det(I + L A) / 2 + s' (I + A L)^-1 A s / 2.

A has a part that all photos share, and one of each; both have the standard deviation t: photos of one building, all taken the
same way, show only what they do not share, and there is no reason why the rest should be less. Beside, photos show the same
lines, whose strays from their directions more photos do not average out: what they make of the angles of a single photo is shared
too. Before lines are seen, t is half-Cauchy with the stray of lines as its scale (A. Gelman, 2006); its median after that counts.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.calibration.lines.problem import AngleSigmas, CameraAndCircles, LineProblem
from omnilines.calibration.lines.scores import LineScores, pseudo_inverse
from omnilines.least_squares.schur import normal_equations

LEAST_RAD = 1e-5
LARGEST_RAD = 0.1
STEPS = 60
"""Of the grid of standard deviations, even in their logarithms."""


def angle_sigmas(problem: LineProblem, state: CameraAndCircles, scores: LineScores) -> AngleSigmas:
    """By the lines of a state in which they are fitted; the strays of lines where there is no frame."""
    frames, stray = problem.families.frames, problem.families.frame_stray_rad
    if not frames:
        return AngleSigmas.of_strays(problem.families)
    q, own = scores.camera, slice(scores.information.shape[0] - 3 * frames, None)
    # Of what is known before, that of the camera stays.
    information = scores.information - scores.prior
    information[:q, :q] += scores.prior[:q, :q]
    gradient = scores.scores.sum(0)
    gradient[:q] += scores.prior_score[:q]
    rest = slice(0, problem.angle_columns.start)
    gain = pseudo_inverse(information[rest, rest]) @ information[rest, own]
    left = information[own, own] - information[own, rest] @ gain
    off = (state.off_rad[:1] + state.off_rad[1:]).flatten()
    score = left @ off - (gradient[own] - gain.mT @ gradient[rest])
    of_strays = _strays_of_photos(problem, state, scores, information)
    grid = torch.as_tensor(np.geomspace(LEAST_RAD, LARGEST_RAD, STEPS))
    found = torch.stack([_log_likelihood(left, score, float(t), of_strays) for t in grid])
    density = torch.exp(found - found.max()) * grid / (1.0 + (grid / stray).square())
    below = torch.cumsum(density, 0) / density.sum()
    sigma = float(grid[int((below < 0.5).sum())])
    shared = (sigma**2 + of_strays).sqrt().tolist()
    return AngleSigmas((shared[0], shared[1], shared[2]), sigma)


def _log_likelihood(
    information: Float[Tensor, "n n"], score: Float[Tensor, " n"], sigma: float, of_strays: Float[Tensor, "3"]
) -> Float[Tensor, ""]:
    """Of a standard deviation of what photos share, beside strays, and of what they do not."""
    frames = len(score) // 3
    one = torch.eye(len(score), dtype=score.dtype)
    a = torch.diag(sigma**2 + of_strays).repeat(frames, frames) + sigma**2 * one
    inner = one + a @ information
    return 0.5 * (score @ torch.linalg.solve(inner, a @ score) - torch.linalg.slogdet(inner)[1])


def _strays_of_photos(
    problem: LineProblem, state: CameraAndCircles, scores: LineScores, information: Float[Tensor, "k k"]
) -> Float[Tensor, "3"]:
    """Variance, by strays alone, of the angles yz, xz and xy as single photos show them with the camera held: the harmonic mean
    over photos.

    With the normal of a circle eliminated the share of the stray in the variance of a member is 1 - e' E^-1 e, e its derivative
    by the normal and E the information on it.
    """
    at, members = problem.linearise(state), problem.members
    equations = normal_equations(problem.structure, at, torch.ones(len(at.residual), dtype=torch.float64))
    e = at.by_eliminated[len(at.residual) - len(members) :, 0]
    inside = torch.linalg.lstsq(equations.eliminated[members], e[..., None]).solution[..., 0]
    share = (1.0 - (e * inside).sum(-1)).clamp(0.0, 1.0)
    q, frames = scores.camera, problem.families.frames
    first, precision = information.shape[0] - 3 * frames, torch.zeros(3, dtype=torch.float64)
    of_frame = torch.where(problem.families.in_frame, problem.families.of_chain // 3, -1)[members]
    for k in range(frames):
        columns = torch.cat([torch.arange(3) + q + 3 * k, torch.arange(3) + first + 3 * k])
        own = scores.scores[members[of_frame == k]][:, columns] * scores.times[members[of_frame == k], None].sqrt()
        inverse = pseudo_inverse(information[columns][:, columns])
        spread = (inverse @ (own.mT @ (own * share[of_frame == k, None])) @ inverse).diagonal()[3:]
        precision += torch.where(spread > 0, 1.0 / spread.clamp_min(LEAST_RAD**2), 0.0)
    return torch.where(precision > 0, frames / precision.clamp_min(1e-300), LARGEST_RAD**2).clamp(max=LARGEST_RAD**2)
