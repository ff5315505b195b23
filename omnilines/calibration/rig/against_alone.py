"""Does a rig contradict what each of its cameras alone says? By the views that it leaves out, and by the cameras' parameters."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.stats import chi2
from torch import Tensor

from omnilines.calibration.board_shape import AS_DRAWN
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.rig.followed import NOT_FOLLOWED
from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.least_squares import Outcome

BREAKDOWN = 0.5
"""Share of the views from which on a robust fit may be that of the wrong ones (P. Rousseeuw and A. Leroy 1987)."""


@dataclass(frozen=True)
class AgainstAlone:
    """What of the cameras alone contradicts their rig."""

    fitted: int
    """Views that fit their camera alone and by which the rig could tie it to others: these see the board at once, or in the same
    run of frames."""
    rejected: int
    """Those of them that do not: they do not fit the rig, or no other camera's view does then."""
    sigmas: dict[str, float]
    """By how many standard deviations the parameters of a camera differ from those that all its views alone give, as a normal
    variable of the same probability; of cameras where that is more than chance."""
    many_share: float
    """Of views, from which on the rejected ones are named."""

    @cached_property
    def unknown(self) -> bool:
        """Whether so many views are rejected that the rig may be that of the wrong ones."""
        return self.rejected >= BREAKDOWN * self.fitted > 0

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence each; none where nothing contradicts."""
        found = []
        if self.rejected > self.many_share * self.fitted:
            found.append(
                f"{self.rejected} of {self.fitted} views that fit their camera alone do not tie it to the others, as they do not "
                "fit the rig: frames are of other instants, boards are numbered wrongly, or the cameras do not stand as it says; "
                "look at these views before you use it."
            )
        for name, sigmas in self.sigmas.items():
            found.append(
                f"Camera {name}: its parameters in the rig differ by {sigmas:.2g} standard deviations from those that its views "
                "alone give (chi-square test): the rig is wrong, or the model does not suit the lens; compare it with its "
                "calibration alone."
            )
        return tuple(found)


def against_alone(outcome: RigOutcome, covariance: Float[Tensor, "k k"]) -> AgainstAlone:
    """The comparison; `covariance` is that of the parameters of all members, one after the other, and what follows them."""
    data = outcome.data
    used = np.unique(outcome.fit.points.view[outcome.fit.kept].numpy())
    posed = np.concatenate([outcome.alone[c].views for c in data.cameras])
    followed = np.array([outcome.reasons.get(int(v)) != NOT_FOLLOWED for v in posed])
    sharing = _sharing(data, posed[followed])
    tied = np.intersect1d(sharing, _sharing(data, outcome.fit.views[used]))
    sigmas, low = {}, 0
    for k, c in enumerate(data.cameras):
        high = low + len(outcome.solution.state.models[k].parameters)
        found = _sigmas(outcome, k, covariance[low:high, low:high])
        if found is not None:
            sigmas[data.views.cameras[c]] = found
        low = high
    share = outcome.thresholds.views.many_rejected_share
    return AgainstAlone(len(sharing), len(sharing) - len(tied), sigmas, share)


def _sharing(data: RigData, views: Int[np.ndarray, " v"]) -> Int[np.ndarray, " w"]:
    """Those of some views whose instant, or run of frames, another camera sees in one of them."""
    seen = np.unique(np.stack([data.block[views], data.views.camera[views]]), axis=1)[0]
    blocks, cameras = np.unique(seen, return_counts=True)
    return views[np.isin(data.block[views], blocks[(cameras > 1) & (blocks >= 0)])]


def _sigmas(outcome: RigOutcome, member: int, covariance: Float[Tensor, "p p"]) -> float | None:
    """`AgainstAlone.sigmas` of a member; None where the difference may be chance, or rows of images have times of their own,
    which they have not alone."""
    data, basis, c = outcome.data, outcome.data.bases[member], outcome.data.cameras[member]
    if data.readout is not None or not basis.shape[1] or len(data.cameras) < 2:
        return None
    corners, model, own = data.views.corners, outcome.solution.state.models[member], outcome.alone[c]
    rows = np.flatnonzero(data.views.of_camera(c)[2])[own.kept]
    views, place = np.unique(corners.view[rows], return_inverse=True)
    board_m = outcome.solution.state.shape.place(torch.as_tensor(data.board_m[rows]))
    points = BoardPoints(torch.as_tensor(place), len(views), board_m, torch.as_tensor(corners.pixels[rows]))
    begin = CameraAndBoards(model, resect_boards(points, model.unproject(points.pixels)[0]))
    weight = torch.as_tensor(1 / (own.noise.sigma_px * data.relative[rows]))
    found = BoardProblem(points, basis, weight, AS_DRAWN).solve(begin)
    if found.outcome is Outcome.DEGENERATE:
        return None
    freedom = max(1, 2 * len(rows) - 6 * len(views) - basis.shape[1])
    columns = torch.linalg.pinv(basis)
    # The rig has these views too, so that the variance of the difference is less than the sum.
    spread = found.kept_covariance() * max(1.0, found.cost / freedom) + columns @ covariance @ columns.mT
    off = columns @ (found.state.model.parameters - model.parameters)
    chance = float(chi2.sf(float(off @ torch.linalg.solve(spread, off)), len(off)))
    if chance > outcome.thresholds.noise.significance / len(data.cameras):
        return None
    return math.sqrt(float(chi2.isf(max(chance, 1e-300), 1)))
