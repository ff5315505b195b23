"""How much each chain pulls at the camera, and what follows: covariances that hold where points of a chain, or chains of a photo,
err together.

With the normals eliminated chain c has the score g_c, the derivative of its half sum of squares by the kept blocks (camera,
directions), and all chains the information S. At the minimum the scores add up to 0. Whatever the errors along a chain have in
common, the covariance of the kept blocks is

    S^-1 (sum_c g_c g_c') S^-1

(the sandwich of P. J. Huber, 1967, by clusters: K.-Y. Liang and S. L. Zeger, 1986). Chains of a photo may err together too: blur,
a building that is not quite at right angles. Few photos do not tell a matrix; but they tell by how much, over all camera
parameters, the scores of photos are larger than independent chains explain, and that factor raises the covariance.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

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
    prior: Float[Tensor, "q q"]
    """What of the information of the camera is of no chain."""

    @staticmethod
    def of(problem: LineProblem, state: CameraAndCircles) -> "LineScores":
        """Of a state in which the normals are fitted."""
        at, structure = problem.linearise(state), problem.structure
        equations = normal_equations(structure, at, torch.ones(len(at.residual), dtype=torch.float64))
        reduced = reduce(equations, 0.0)
        # A normal that moves takes its share of the residuals along: what a chain says of it is taken off.
        e = at.by_eliminated[:, 0]
        own = torch.zeros(structure.count, 2, dtype=e.dtype).index_add_(0, structure.index, e * at.residual)
        step = torch.linalg.lstsq(equations.eliminated, own[..., None]).solution[..., 0]
        residual = at.residual[:, 0] - (e * step[structure.index]).sum(-1)
        scores = torch.zeros(structure.count, structure.kept_size, dtype=e.dtype)
        for group, offset, by in zip(structure.groups, structure.offsets, at.by_kept, strict=False):
            seen = torch.nonzero(group.index >= 0).flatten()
            columns = offset + group.index[seen, None] * group.dim + torch.arange(group.dim)
            values = by[seen, 0] * residual[seen, None]
            place = structure.index[seen, None] * structure.kept_size + columns
            scores.view(-1).index_add_(0, place.flatten(), values.flatten())
        readings, q = problem.readings, problem.basis.shape[1]
        prior = torch.zeros(q, q, dtype=e.dtype) if problem.prior is None else problem.prior.information
        return LineScores(scores, reduced.matrix, q, readings.photo, readings.photos, prior)

    @cached_property
    def _directions_out(self) -> tuple[Float[Tensor, "c q"], Float[Tensor, "q q"]]:
        """Scores and information of the camera with the directions eliminated."""
        q = self.camera
        whole, own = self.information, self.information[q:, q:]
        gain = pseudo_inverse(own) @ whole[q:, :q]
        return self.scores[:, :q] - self.scores[:, q:] @ gain, whole[:q, :q] - whole[:q, q:] @ gain

    @property
    def of_camera(self) -> Float[Tensor, "c q"]:
        """Score of each chain by the camera, directions and circles following."""
        return self._directions_out[0]

    @property
    def camera_information(self) -> Float[Tensor, "q q"]:
        """What all chains say of the camera."""
        return self._directions_out[1]

    @cached_property
    def by_photo(self) -> Float[Tensor, "v q"]:
        """Score of each photo by the camera."""
        return self.of_camera.new_zeros(self.photos, self.camera).index_add_(0, self.photo, self.of_camera)

    def photo_information(self, problem: LineProblem, state: CameraAndCircles) -> Float[Tensor, "v q q"]:
        """What each photo says of the camera, its directions following; their sum, with the prior, is that of all."""
        at, structure, q = problem.linearise(state), problem.structure, self.camera
        photos = []
        for photo in range(self.photos):
            # The weights of other photos are 0, so that their blocks say nothing.
            weight = (self.photo[structure.index] == photo).double()
            equations = normal_equations(structure, replace(at, prior=None), weight)
            matrix = reduce(equations, 0.0).matrix
            gain = pseudo_inverse(matrix[q:, q:]) @ matrix[q:, :q]
            photos.append(matrix[:q, :q] - matrix[:q, q:] @ gain)
        return torch.stack(photos)

    @cached_property
    def score_covariance(self) -> Float[Tensor, "q q"]:
        """Of the sum of all scores: that of chains, times the factor of photos."""
        return self.of_camera.mT @ self.of_camera * max(1.0, self.photo_factor)

    @cached_property
    def photo_factor(self) -> float:
        """Variance of the scores of photos about their mean, over that of independent chains, over all directions of the
        camera."""
        seen = self.by_photo[self.by_photo.any(-1)]
        if len(seen) < 2:
            return 1.0
        off = seen - seen.mean(0)
        inverse = pseudo_inverse(self.of_camera.mT @ self.of_camera)
        return float((off @ inverse * off).sum()) / self.camera * len(seen) / (len(seen) - 1)

    @cached_property
    def covariance(self) -> Float[Tensor, "q q"]:
        """Of the camera along the basis."""
        inverse = pseudo_inverse(self.camera_information)
        return inverse @ (self.score_covariance + self.prior) @ inverse


def pseudo_inverse(matrix: Float[Tensor, "k k"]) -> Float[Tensor, "k k"]:
    """Inverse of a symmetric matrix, in units in which its diagonal is one; 0 along what is not seen."""
    unit = torch.where(matrix.diagonal() > 0, matrix.diagonal().clamp_min(1e-300).rsqrt(), 0.0)
    return unit[:, None] * torch.linalg.pinv(matrix * unit[:, None] * unit, rtol=LEAST_SHARE, hermitian=True) * unit
