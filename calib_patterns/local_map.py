"""The map from the board to the photo around given places, learnt from the corners that are known near them.

No plane homography: through a fisheye the board is bent. Around each place b0 the map is a polynomial of fourth order in the
offset (b - b0) / spacing, whose coefficients of each order have a prior: smooth lenses bend a little over one spacing, and ever
less in higher orders. What one tag supports is then an affine map, what many corners support a map with its curvature, and
the prediction states its own standard deviation, which grows as it leaves the known corners:

    minimise  sum_i |p_i - sum_k c_k m_k(b_i)|^2 / s_i^2 + sum_k |c_k|^2 / q_k^2
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from calib_patterns.options import MapOptions

NEIGHBOURS = 24
"""Known corners that a prediction rests on."""


@dataclass(frozen=True)
class LocalMap:
    """The map at each place asked for."""

    pixels: Float[np.ndarray, "n 2"]
    first: Float[np.ndarray, "n 2 2"]
    """Derivatives of (u, v) by (x, y), pixels per spacing."""
    second: Float[np.ndarray, "n 2 2"]
    """Second derivatives of (u, v), [..., 0] along x twice, [..., 1] along y twice."""
    sigma_px: Float[np.ndarray, " n"]
    """Standard deviation of `pixels`, each coordinate."""

    @property
    def spacing_px(self) -> Float[np.ndarray, " n"]:
        """One spacing in the photo, where it is the most foreshortened."""
        return np.linalg.svd(self.first, compute_uv=False)[:, -1]


@dataclass(frozen=True)
class KnownCorners:
    """Places on the board whose pixels are known."""

    board_m: Float[np.ndarray, "m 2"]
    pixels: Float[np.ndarray, "m 2"]
    sigma_px: Float[np.ndarray, " m"]

    def joined(self, other: "KnownCorners") -> "KnownCorners":
        """Both sets."""
        return KnownCorners(
            np.concatenate([self.board_m, other.board_m]),
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.sigma_px, other.sigma_px]),
        )


@lru_cache(maxsize=8)
def _powers(orders: int) -> Int[np.ndarray, "k 2"]:
    """Powers of x and y of all terms below an order."""
    return np.array([(i - j, j) for i in range(orders) for j in range(i + 1)])


def local_map(
    known: KnownCorners,
    places_m: Float[np.ndarray, "n 2"],
    spacing_m: float,
    options: MapOptions,
    *,
    leave_out: bool = False,
) -> LocalMap:
    """The map at `places_m` (n x 2, board) from the nearest of at least three known corners.

    `leave_out` leaves out what is known of a place itself, so that the prediction tests it.
    """
    powers = _powers(len(options.priors))
    distance, index = _nearest(known, places_m)
    weight = (distance > 1e-9 if leave_out else np.ones(distance.shape, dtype=bool)).astype(np.float64)
    offset = (known.board_m[index] - places_m[:, None]) / spacing_m
    pixels = known.pixels[index]
    middle = np.sum(weight[..., None] * pixels, 1) / weight.sum(1)[:, None]
    scale = _spacing_in_photo(offset, pixels - middle[:, None], weight)
    beyond = options.remainder * scale[:, None] * (distance / spacing_m) ** len(options.priors)
    spread = known.sigma_px[index] ** 2 + beyond**2
    prior = np.array(options.priors)[powers.sum(1)] * scale[:, None]
    # Scaled by the prior, so that the normal matrix is well conditioned: identity plus what the corners tell.
    scaled = _monomials(offset, powers) * prior[..., None]
    weighted = scaled * (weight / spread)[:, None]
    right = np.zeros((len(prior), len(powers), 3))
    right[:, 0, 2] = 1.0
    right[..., :2] = weighted @ (pixels - middle[:, None])
    solution = np.linalg.solve(weighted @ scaled.transpose(0, 2, 1) + np.eye(len(powers)), right)
    coefficients, variance = prior[..., None] * solution[..., :2], solution[:, 0, 2]
    order = {(int(i), int(j)): k for k, (i, j) in enumerate(powers)}
    first = np.stack([coefficients[:, order[1, 0]], coefficients[:, order[0, 1]]], -1)
    second = 2.0 * np.stack([coefficients[:, order[2, 0]], coefficients[:, order[0, 2]]], -1)
    return LocalMap(middle + coefficients[:, 0], first, second, prior[:, 0] * np.sqrt(variance))


def _monomials(offset: Float[np.ndarray, "n k 2"], powers: Int[np.ndarray, "terms 2"]) -> Float[np.ndarray, "n terms k"]:
    """The products of powers that the map is made of: by multiplication, since raising to a power is ten times as slow."""
    x, y = offset[..., 0], offset[..., 1]
    power = [(np.ones_like(x), np.ones_like(y))]
    for _ in range(int(powers.max())):
        power.append((power[-1][0] * x, power[-1][1] * y))
    return np.stack([power[i][0] * power[j][1] for i, j in powers], 1)


def _nearest(known: KnownCorners, places_m: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
    count = min(NEIGHBOURS, len(known.board_m))
    distance, index = cKDTree(known.board_m).query(places_m, k=count)
    return np.asarray(distance).reshape(-1, count), np.asarray(index, dtype=np.int64).reshape(-1, count)


def _spacing_in_photo(
    offset: Float[np.ndarray, "n k 2"], pixels: Float[np.ndarray, "n k 2"], weight: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, " n"]:
    """Pixels per spacing: ratio of the scatter of the known corners in the photo to that on the board."""
    shares = (weight / weight.sum(1, keepdims=True))[..., None]
    on_board = offset - np.sum(shares * offset, 1)[:, None]
    return np.sqrt(np.sum(shares * pixels**2, (1, 2)) / np.maximum(np.sum(shares * on_board**2, (1, 2)), 1e-12)) + 1e-6


def disagreement(known: KnownCorners, spacing_m: float, options: MapOptions) -> Float[np.ndarray, " m"]:
    """How far each of at least four known corners is from where the others say, over what that may be: the misfit allowed and
    three of the prediction's standard deviations."""
    predicted = local_map(known, known.board_m, spacing_m, options, leave_out=True)
    off = np.linalg.norm(predicted.pixels - known.pixels, axis=1)
    return np.asarray(off / (options.misfit_px + options.misfit_spacings * predicted.spacing_px + 3.0 * predicted.sigma_px))
