"""How far the board moves between the shutters of the cameras: the spread of its poses in one frame, and how certain that is.

In the frame of the board, about its middle, camera v of frame f sees the board moved by

    y_v = x_f + d_v + e_v,    Cov e_v = C_v (the corners of the view),    Cov d_v = u_f diag(s_turn^2, s_shift^2)

where x_f is the pose of the frame. u_f has mean precision 1 (a gamma distribution of 1 / u_f, so that d is Student's): hands are
still at times and quick at others. With x_f integrated out (restricted likelihood, H. Patterson and R. Thompson 1971) the two
standard deviations and the degrees of freedom of the tails are those of the largest likelihood; each u_f is then the one that
its frame is expected to have.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.optimize
import scipy.stats
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

SCALES = 12
"""Values of u_f by which its distribution is summed: equally likely ones."""
TAILS = (2.0, 4.0, 10.0, math.inf)
"""Degrees of freedom that are tried."""
LEAST_TURN_RAD, LEAST_SHIFT_M = 1e-7, 1e-7


@dataclass(frozen=True, eq=False)
class SeenPoses:
    """The poses of the board as each view alone sees it, of frames that several cameras see."""

    frame: Int[Tensor, " v"]
    """0, 1, 2, ... without a gap."""
    twist: Float[Tensor, "v 6"]
    covariance: Float[Tensor, "v 6 6"]

    @cached_property
    def frames(self) -> int:
        """How many there are."""
        return int(self.frame.max()) + 1 if len(self.frame) else 0

    def of_several(self, some: Bool[Tensor, " v"]) -> "SeenPoses":
        """Of some views, those of frames that several of them see."""
        several = some & (torch.bincount(self.frame[some], minlength=self.frames)[self.frame] > 1)
        _, frame = torch.unique(self.frame[several], return_inverse=True)
        return SeenPoses(frame, self.twist[several], self.covariance[several])

    def log_likelihood(self, variance: Float[Tensor, " 6"], scale: Float[Tensor, " s"]) -> Float[Tensor, "s f"]:
        """Restricted, of every frame for each scale u of the variance, up to a constant."""
        spread = self.covariance + scale[:, None, None, None] * torch.diag(variance)
        factor = torch.linalg.cholesky(spread)
        weight = torch.cholesky_inverse(factor)
        seen = (weight @ self.twist[..., None])[..., 0]

        def by_frame(values: Tensor) -> Tensor:
            return values.new_zeros(len(scale), self.frames, *values.shape[2:]).index_add_(1, self.frame, values)

        total, right = by_frame(weight), by_frame(seen)
        lower = torch.linalg.cholesky(total)
        mean = torch.cholesky_solve(right[..., None], lower)[..., 0]
        squares = by_frame((seen * self.twist).sum(-1)) - (mean * right).sum(-1)
        sizes = by_frame(2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)) + 2 * lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return -0.5 * (sizes + squares)


@dataclass(frozen=True, eq=False)
class Shutters:
    """How far the board moves between shutters."""

    turn_rad: float
    """Standard deviation about each axis, of one camera from the mean pose."""
    shift_m: float
    """The same along each axis."""
    tails: float
    """Degrees of freedom of the spread; infinite where all frames are alike."""
    frame_scale: Float[Tensor, " f"]
    """u_f."""
    gain: float
    """Twice the gain of the logarithmic likelihood over a board that stands still."""

    @property
    def sigmas(self) -> tuple[float, float]:
        """Both standard deviations (rad, m)."""
        return self.turn_rad, self.shift_m

    def change(self, before: "Shutters") -> float:
        """Largest relative change of a standard deviation."""
        return max(abs(self.shift_m / before.shift_m - 1), abs(self.turn_rad / before.turn_rad - 1))

    def clear(self, significance: float) -> bool:
        """Whether that gain is beyond chance: on the edge of what is possible, chi-square of two is an upper bound."""
        return self.gain > float(scipy.stats.chi2.isf(significance, 2))


def elsewhere(
    seen: SeenPoses, doubted: Bool[Tensor, " v"], start: tuple[float, float], significance: float
) -> Float[Tensor, " v"]:
    """Of views that are doubted, how many standard deviations of the board's motion they are from where the other views of their
    frame see it, where chance would not take one of them that far (F test of six, and of the tails); 0 of all others.

    The motion is that of the views that are not doubted, then with those of the doubted that chance takes there, until none is
    added: what moves a little more than the others goes on with them, what is of another instant stays apart.
    """
    admitted, far = ~doubted, torch.zeros(len(doubted), dtype=torch.float64)
    while True:
        some = seen.of_several(admitted)
        if not some.frames:
            return torch.zeros_like(far)
        moved = estimated(some, start)
        spread = seen.covariance + torch.diag(_variance((moved.turn_rad, moved.shift_m)))
        weight = torch.linalg.inv(spread) * admitted[:, None, None]
        total = torch.zeros(seen.frames, 6, 6, dtype=torch.float64).index_add_(0, seen.frame, weight)
        right = torch.zeros(seen.frames, 6, dtype=torch.float64).index_add_(
            0, seen.frame, (weight @ seen.twist[..., None])[..., 0]
        )
        others = torch.bincount(seen.frame[admitted], minlength=seen.frames) > 0
        certain = torch.linalg.inv(torch.where(others[:, None, None], total, torch.eye(6, dtype=torch.float64)))
        off = seen.twist - (certain @ right[..., None])[seen.frame, :, 0]
        squares = (off * torch.linalg.solve(spread + certain[seen.frame], off)).sum(-1)
        beyond = squares > _by_chance(significance / max(int(doubted.sum()), 1), moved.tails)
        far = torch.where(~admitted & others[seen.frame] & beyond, (squares / 6).sqrt(), 0.0)
        near = ~admitted & (far == 0)
        if not bool(near.any()):
            return far
        # Of frames that no admitted view sees, one view at a time.
        admitted = admitted | (near & others[seen.frame]) | _first_of_frames(seen.frame, near & ~others[seen.frame])


def _by_chance(probability: float, tails: float) -> float:
    """The square of six standardised numbers with these tails that is exceeded with this probability."""
    if math.isinf(tails):
        return float(scipy.stats.chi2.isf(probability, 6))
    return 6 * float(scipy.stats.f.isf(probability, 6, tails))


def _first_of_frames(frame: Int[Tensor, " v"], some: Bool[Tensor, " v"]) -> Bool[Tensor, " v"]:
    """The first of some views in each of their frames."""
    rows = torch.nonzero(some).flatten()
    _, place = np.unique(frame[rows].numpy(), return_index=True)
    found = torch.zeros_like(some)
    found[rows[torch.as_tensor(place)]] = True
    return found


def estimated(seen: SeenPoses, start: tuple[float, float], lost: float = 0.0) -> Shutters:
    """The spread of largest likelihood; `lost` are the degrees of freedom that the extrinsics have taken of the poses.

    `start` are standard deviations (rad, m) to begin from.
    """
    still = float(seen.log_likelihood(torch.zeros(6, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)).sum())
    best, found, tails = -math.inf, start, math.inf
    for each in TAILS:
        own, value = _of_tails(seen, _scales(each), found)
        # Heavier tails are one parameter more or less of the same kind: the largest likelihood decides.
        if value > best:
            best, found, tails = value, own, each
    scales = _scales(tails)
    by_frame = seen.log_likelihood(_variance(found), scales)
    share = torch.softmax(by_frame, 0)
    frame_scale = 1 / (share / scales[:, None]).sum(0)
    whole = 6.0 * (len(seen.frame) - seen.frames)
    wider = math.sqrt(whole / max(whole - lost, 1.0))
    return Shutters(found[0] * wider, found[1] * wider, tails, frame_scale, 2 * (best - still))


def _scales(tails: float) -> Float[Tensor, " s"]:
    """Equally likely values of u."""
    if math.isinf(tails):
        return torch.ones(1, dtype=torch.float64)
    middle = (torch.arange(SCALES, dtype=torch.float64) + 0.5) / SCALES
    return torch.as_tensor(tails / scipy.stats.chi2.ppf(middle.numpy(), tails))


def _variance(sigma: tuple[float, float]) -> Float[Tensor, " 6"]:
    return torch.tensor([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3, dtype=torch.float64)


def _of_tails(seen: SeenPoses, scales: Tensor, start: tuple[float, float]) -> tuple[tuple[float, float], float]:
    """The standard deviations of largest likelihood for one set of scales, and that likelihood."""

    def cost(logs: Float[np.ndarray, "2"]) -> float:
        sigma = max(math.exp(logs[0]), LEAST_TURN_RAD), max(math.exp(logs[1]), LEAST_SHIFT_M)
        values = seen.log_likelihood(_variance(sigma), scales)
        return -float((torch.logsumexp(values, 0) - math.log(len(scales))).sum())

    found = scipy.optimize.minimize(
        cost, [math.log(start[0]), math.log(start[1])], method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01}
    )
    return (max(math.exp(found.x[0]), LEAST_TURN_RAD), max(math.exp(found.x[1]), LEAST_SHIFT_M)), -float(found.fun)
