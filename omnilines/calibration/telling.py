"""Which instants of many tell most of the cameras: D-optimal design with the pose of every board eliminated.

Each view v adds S_v = A_v' A_v / s_v^2 to the information on its camera (`held_out`), s_v being the noise of its own corners, so
that blurred and sheared views count less. Of all sets of so many instants the one wanted has the largest determinant of the
summed information of every camera (V. Fedorov, Theory of optimal experiments, 1972): taken one by one, then exchanged while that
gains. Cameras of a rig are tied by the instants that two of them share; each tells about as much, of six numbers.

A calibration weighs all views alike. Then one with r times the variance of n others makes a mean less certain where r > 2 + 1/n:
views that are noisier than that are taken only where there are not enough others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.held_out import ViewTerms
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.views import board_points, corner_weights
from omnilines.records import Corners

LOUD = 2.0
"""Times the typical variance of corners from which on one more view harms a mean of many."""
ROUNDS = 3
"""Of exchanges; later ones gain next to nothing."""
_OPEN = 1e-6
"""Share of the mean information that the first instants are compared with, since few of them determine no camera."""


@dataclass(frozen=True)
class ViewInformation:
    """What the views of one camera say of it."""

    names: tuple[str, ...]
    matrix: Float[Tensor, "v k k"]
    """Of the camera's parameters along independent directions in which all views together say one each."""
    noise: Float[Tensor, " v"]
    """Variance of the corners of each view over the typical one."""


def view_information(corners: Corners, fit: CameraCalibration) -> ViewInformation:
    """Of the views that a calibration used."""
    used = [(place, view) for place, view in enumerate(fit.views) if view.used and view.cam_from_board is not None]
    numbers = {name: number for number, name in enumerate(corners.view_names)}
    views = [numbers[view.name] for _, view in used]
    rows = fit.kept & np.isin(corners.view, views)
    points = board_points(corners, rows, views)
    poses = Pose.stack([view.cam_from_board for _, view in used if view.cam_from_board is not None])
    problem = BoardProblem(points, fit.model.calibration_basis(), corner_weights(corners, rows))
    terms = ViewTerms.of(problem, CameraAndBoards(fit.model, poses, fit.board))
    own_px2 = terms.squares_px2 / terms.counts
    typical_px2 = float(own_px2.median())
    matrix = terms.matrix / _noise_px2(terms, typical_px2)[:, None, None]
    total = matrix.sum(0)
    unit = total.diagonal().clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(total * unit[:, None] * unit)
    basis = unit[:, None] * vectors * values.clamp_min(1e-12 * float(values[-1])).rsqrt()
    return ViewInformation(tuple(view.name for _, view in used), basis.mT @ matrix @ basis, own_px2 / typical_px2)


def _noise_px2(terms: ViewTerms, typical_px2: float) -> Float[Tensor, " v"]:
    """Of each view by its own residuals and, as of one more view, those of a typical one; never below that."""
    own = (terms.squares_px2 + typical_px2 * terms.counts.mean()) / (terms.counts + terms.counts.mean())
    return own.clamp_min(typical_px2)


def telling_instants(cameras: Sequence[ViewInformation], instants: Mapping[str, int], count: int, most: int) -> list[int]:
    """At most `most` of the instants 0 ... count - 1, those that tell most first; `instants`: that of every view by its name."""
    design = _Design.of(cameras, instants, count)
    useful = [place for place in range(count) if bool(design.seen[:, place].any())]
    quiet = [place for place in useful if float(design.noise[:, place].max()) <= LOUD]
    useful = quiet if len(quiet) >= most else useful
    if len(useful) <= most:
        return useful
    chosen: list[int] = []
    while len(chosen) < most:
        left = [place for place in useful if place not in chosen]
        chosen.append(left[int(design.gains(chosen, left).argmax())])
    for _ in range(ROUNDS):
        before = list(chosen)
        for slot in range(most):
            others = chosen[:slot] + chosen[slot + 1 :]
            left = [place for place in useful if place not in others]
            chosen[slot] = left[int(design.gains(others, left).argmax())]
        if chosen == before:
            break
    return chosen


@dataclass(frozen=True)
class _Design:
    """The information of every instant on every camera."""

    matrices: tuple[Float[Tensor, "t _ _"], ...]
    seen: Float[Tensor, "c t"]
    """1 where a camera sees the board."""
    noise: Float[Tensor, "c t"]
    """Of its view, over that of a typical one; 0 where it sees none."""

    @staticmethod
    def of(cameras: Sequence[ViewInformation], instants: Mapping[str, int], count: int) -> "_Design":
        """Views that no camera used add nothing."""
        matrices = []
        seen, noise = torch.zeros(2, len(cameras), count, dtype=torch.float64)
        for number, camera in enumerate(cameras):
            size = camera.matrix.shape[-1]
            matrix = torch.zeros(count, size, size, dtype=torch.float64)
            for name, own, variance in zip(camera.names, camera.matrix, camera.noise, strict=True):
                place = instants[name]
                matrix[place] += own
                seen[number, place] = 1.0
                noise[number, place] = max(noise[number, place], variance)
            matrices.append(matrix)
        return _Design(tuple(matrices), seen, noise)

    def gains(self, chosen: list[int], candidates: list[int]) -> Float[Tensor, " n"]:
        """The logarithm of the determinants with each of the candidates added to those chosen."""
        total = torch.zeros(len(candidates), dtype=torch.float64)
        for matrix in self.matrices:
            size = matrix.shape[-1]
            start = matrix[chosen].sum(0) + _OPEN * torch.eye(size, dtype=torch.float64)
            total += torch.linalg.slogdet(start + matrix[candidates])[1]
        if len(self.matrices) > 1:
            shared = (self.seen * (self.seen.sum(0) > 1)).to(torch.float64)
            total += 6.0 * (_OPEN + shared[:, chosen].sum(1, keepdim=True) + shared[:, candidates]).log().sum(0)
        return total
