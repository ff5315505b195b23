"""How much each chain pulls at the camera, and what follows: covariances that hold where points of a chain, or chains of a photo,
err together.

With the normals eliminated chain c has the score g_c, the derivative of its half sum of squares by the kept blocks (camera,
directions), and all chains the information S: the curvature of the robust cost, which is less than that of the weighted squares,
as weights fall where residuals grow (P. J. Huber, 1981). At the minimum the scores add up to 0. Whatever the errors along a
chain have in common, the covariance of the kept blocks is

    S^-1 (sum_c g_c g_c' + P) S^-1

with the information P of what is known of the camera, and of right angles, before
(the sandwich of P. J. Huber, 1967, by clusters: K.-Y. Liang and S. L. Zeger, 1986), each square raised by what the fit hides of
its error (`leverage.py`). Chains of a photo may err together too: blur,
a building that is not quite at right angles. Few photos do not tell a matrix; but they tell by how much, over all camera
parameters, the scores of photos are larger than independent chains explain, and that factor raises the covariance; and along
which directions they scatter by more still (`photo_scatter.py`).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.calibration.lines.leverage import correction as leverage_correction
from omnilines.calibration.lines.photo_scatter import raised_along
from omnilines.calibration.lines.problem import CameraAndCircles, LineProblem
from omnilines.least_squares.schur import normal_equations, reduce

LEAST_SHARE = 1e-12
"""Eigenvalues of scaled information below it are 0: nothing is seen along them."""


@dataclass(frozen=True)
class LineScores:
    """The first q kept columns are those of the camera."""

    scores: Float[Tensor, "c k"]
    information: Float[Tensor, "k k"]
    camera: int
    """q."""
    photo: Int[Tensor, " c"]
    photos: int
    times: Float[Tensor, " c"]
    """Chains that are the same one as each, in other photos at the same place: each has its part of the weight."""
    prior: Float[Tensor, "k k"]
    """What of the information is of no chain: of what is known of the camera, and of right angles."""
    prior_score: Float[Tensor, " k"]
    correction: Float[Tensor, " c"]
    """Of the square of each chain's score by the camera, for what the fit hides of its errors (`leverage.py`)."""
    told: Float[Tensor, "c q q"]
    """Information of each chain on the camera, as its points state it."""

    @staticmethod
    def of(problem: LineProblem, state: CameraAndCircles) -> "LineScores":
        """Of a state in which camera and normals are fitted."""
        at, structure = problem.linearise(state), problem.structure
        equations = normal_equations(structure, at, torch.ones(len(at.residual), dtype=torch.float64))
        information = reduce(normal_equations(structure, at, problem.curvature), 0.0).matrix
        # A normal that moves takes its share of the residuals along: what a chain says of it is taken off.
        e = at.by_eliminated[:, 0]
        own = torch.zeros(structure.count, 2, dtype=e.dtype).index_add_(0, structure.index, e * at.residual)
        step = torch.linalg.lstsq(equations.eliminated, own[..., None]).solution[..., 0]
        residual = at.residual[:, 0] - (e * step[structure.index]).sum(-1)
        size = structure.kept_size
        scores = torch.zeros(structure.count, size, dtype=e.dtype)
        for group, offset, by in zip(structure.groups, structure.offsets, at.by_kept, strict=False):
            seen = torch.nonzero(group.index >= 0).flatten()
            columns = offset + group.index[seen, None] * group.dim + torch.arange(group.dim)
            values = by[seen, 0] * residual[seen, None]
            place = structure.index[seen, None] * size + columns
            scores.view(-1).index_add_(0, place.flatten(), values.flatten())
        readings, q = problem.chains.blocks, problem.basis.shape[1]
        if at.prior is None:
            prior, pull = torch.zeros(size, size, dtype=e.dtype), torch.zeros(size, dtype=e.dtype)
        else:
            prior, pull = at.prior.by_kept.mT @ at.prior.by_kept, at.prior.by_kept.mT @ at.prior.residual
        following = _following(information, q)
        correction, told = leverage_correction(
            structure,
            at,
            equations.eliminated,
            information=reduce(equations, 0.0).matrix,
            following=following,
            of_camera=pseudo_inverse(following.mT @ information @ following),
            directions=bool(problem.families.frames) + bool(problem.families.lone),
        )
        return LineScores(scores, information, q, readings.photo, readings.photos, readings.times, prior, pull, correction, told)

    @cached_property
    def _following(self) -> Float[Tensor, "k q"]:
        return _following(self.information, self.camera)

    @cached_property
    def of_camera(self) -> Float[Tensor, "c q"]:
        """Score of each chain by the camera, directions and circles following."""
        return self.scores @ self._following

    @property
    def total(self) -> Float[Tensor, " q"]:
        """Score of all that is known by the camera: 0 at the minimum."""
        return (self.scores.sum(0) + self.prior_score) @ self._following

    @property
    def camera_information(self) -> Float[Tensor, "q q"]:
        """What all that is known says of the camera."""
        return self._following.mT @ self.information @ self._following

    @property
    def known_before(self) -> Float[Tensor, "q q"]:
        """What of it is of no chain."""
        return self._following.mT @ self.prior @ self._following

    @property
    def pull_before(self) -> Float[Tensor, " q"]:
        """Score of that by the camera."""
        return self.prior_score @ self._following

    @property
    def angles_before(self) -> Float[Tensor, "q q"]:
        """What of that is of right angles: they are off by as much as is known before, and no more."""
        own = self.prior.clone()
        own[: self.camera, : self.camera] = 0.0
        return self._following.mT @ own @ self._following

    @property
    def information_of_lines(self) -> Float[Tensor, "q q"]:
        """Without what was known of the camera itself."""
        return self.camera_information - self.known_before + self.angles_before

    @property
    def covariance_of_lines(self) -> Float[Tensor, "q q"]:
        """Of the score, without what was known of the camera itself."""
        return self._of_lines + self.angles_before

    def freedom_of_lines(self, precision: Float[Tensor, "q q"]) -> float:
        """By which the scatter of chains tells the covariance of the score, whose inverse is `precision`. With the share A_c of
        each chain in it, as its points state it, entries of the sum scatter by sum tr(A_c)^2 + tr(A_c^2), and those of a Wishart
        matrix of n degrees of freedom by q (q + 1) / n (J. E. Pustejovsky and E. Tipton, 2018)."""
        share = precision @ self.told * self.times[:, None, None]
        trace = share.diagonal(dim1=-2, dim2=-1).sum(-1)
        scatter = (self.times * (trace.square() + (share * share.mT).sum((-2, -1)))).sum()
        # Points state their noise too small or too large; by how much, chains tell.
        scatter *= ((precision * self._of_lines).sum() / trace.sum().clamp_min(1e-300)).square()
        return self.camera * (self.camera + 1) / max(float(scatter), 1e-12)

    @cached_property
    def by_photo(self) -> Float[Tensor, "v q"]:
        """Score of each photo by the camera."""
        return self.of_camera.new_zeros(self.photos, self.camera).index_add_(0, self.photo, self.of_camera)

    def photo_information(self, problem: LineProblem, state: CameraAndCircles) -> Float[Tensor, "v q q"]:
        """What each photo says of the camera, directions following; their sum, with what is known before, is that of all."""
        at, structure = problem.linearise(state), problem.structure
        photos = []
        for photo in range(self.photos):
            # The weights of other photos are 0, so that their blocks say nothing.
            weight = torch.where(self.photo[structure.index] == photo, problem.curvature, 0.0)
            matrix = reduce(normal_equations(structure, replace(at, prior=None), weight), 0.0).matrix
            photos.append(self._following.mT @ matrix @ self._following)
        return torch.stack(photos)

    @cached_property
    def _of_chains(self) -> Float[Tensor, "q q"]:
        """Covariance of the total by chains that err as they like; those that are the same one err together."""
        return self.of_camera.mT @ (self.of_camera * (self.times * self.correction)[:, None])

    @cached_property
    def _of_lines(self) -> Float[Tensor, "q q"]:
        """The same, raised by what chains of one photo have in common."""
        precision = pseudo_inverse(self._of_chains)
        of_chain = ((self.of_camera @ precision) * self.of_camera).sum(-1) * self.times * self.correction
        shares = of_chain.new_zeros(self.photos).index_add_(0, self.photo, of_chain)
        return raised_along(self._of_chains, self.by_photo, shares, LEAST_SHARE)

    @cached_property
    def score_covariance(self) -> Float[Tensor, "q q"]:
        """Of the total: that of chains as photos scatter, and that of what is known before."""
        return self._of_lines + self.known_before

    @cached_property
    def covariance(self) -> Float[Tensor, "q q"]:
        """Of the camera along the basis."""
        inverse = pseudo_inverse(self.camera_information)
        return inverse @ self.score_covariance @ inverse


def _following(information: Float[Tensor, "k k"], camera: int) -> Float[Tensor, "k q"]:
    """How all kept blocks move with the camera where the others are fitted to it."""
    gain = pseudo_inverse(information[camera:, camera:]) @ information[camera:, :camera]
    return torch.cat([torch.eye(camera, dtype=gain.dtype), -gain])


def pseudo_inverse(matrix: Float[Tensor, "k k"]) -> Float[Tensor, "k k"]:
    """Inverse of a symmetric matrix, in units in which its diagonal is one; 0 along what is not seen."""
    unit = torch.where(matrix.diagonal() > 0, matrix.diagonal().clamp_min(1e-300).rsqrt(), 0.0)
    return unit[:, None] * torch.linalg.pinv(matrix * unit[:, None] * unit, rtol=LEAST_SHARE, hermitian=True) * unit
