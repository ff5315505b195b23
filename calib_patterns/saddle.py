"""Checkerboard corners to sub-pixel accuracy: least-squares fit of a blurred saddle, all corners at once.

Around a corner p two edges cross. With h_k the signed distance of a pixel from edge k, w_k its blur, g the gain (px) and l the
change of light, the image is

    I = (1 + l_u du + l_v dv) (a + b s),   (du, dv) = pixel - p
    s = 1 - 2 [F((h_1 - g) / w_1) F((-h_2 - g) / w_2) + F((-h_1 - g) / w_1) F((h_2 - g) / w_2)]
    h_k = n_k . (du, dv) - curvature_k / 2 (t_k . (du, dv))^2

with F the normal distribution function and t_k, n_k the unit tangent and normal of the edge at p. The light scales black and
white alike, and steeply where a lens darkens towards its rim: a slope that is added instead pulls corners there towards the
light by some tenths of a pixel. For g = 0, s is the product of
two blurred steps. Overexposed white or spread ink moves all edges into the other colour, which leaves a gap or a bridge at the
corner: that is the gain; by symmetry it does not move p. The curvatures are taken from the neighbouring corners: a wide lens
bends edges enough to move a straight-edge fit by several hundredths of a pixel, and fitting them too would cost half as much
again in standard deviation. For white noise the fit is the maximum-likelihood estimate, and its normal matrix states its
precision.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float

from calib_patterns.kernels.saddle_fit import fit_all
from calib_patterns.kernels.saddle_window import LEAST_SQUARE_PX, MAX_HALF_WINDOW_PX, PARAMETERS, starts
from calib_patterns.options import DetectionOptions, FitOptions, GridOptions

MIN_HALF_WINDOW_PX = 3
MAX_STEPS = 20
SETTLED_PX, SETTLED_GRID_PX = 1e-3, 5e-3
"""A fit ends with the step that is shorter than this: each is about a tenth of the one before. What is no saddle seldom settles
so far; the corners of a whole grid are told from what is none by each other."""
SETTLED_SIGMA = 0.1
"""Where noise lets blur and gain wander along their valley, a corner has settled with a last step that is shorter than this share
of its standard deviation."""
HASTY_PX, MIN_THINNED_PX = 0.05, 7
"""The same for a hasty fit, and the half window from which on it uses every other pixel each way."""


@dataclass(frozen=True)
class SaddleFit:
    """The corners after the fit, in the shape they were given: the rows and columns of a grid, or a list."""

    pixels: Float[np.ndarray, "*grid 2"]
    sigma_px: Float[np.ndarray, "*grid"]
    contrast: Float[np.ndarray, "*grid"]
    """b: half the grey-level step, positive where the square between increasing x and increasing y is the brighter."""
    residual: Float[np.ndarray, "*grid"]
    """Root mean square of what the fit leaves, in grey levels."""
    blur_px: Float[np.ndarray, "*grid 2"]
    """w of both edges, the standard deviation of the profile across it: of the edge along +x, then of that along +y."""
    converged: Bool[np.ndarray, "*grid"]

    def reshaped(self, *shape: int) -> "SaddleFit":
        """The same corners in another shape."""
        scalars = (values.reshape(shape) for values in (self.sigma_px, self.contrast, self.residual))
        pairs = (values.reshape(*shape, 2) for values in (self.pixels, self.blur_px))
        (sigma_px, contrast, residual), (pixels, blur_px) = scalars, pairs
        return SaddleFit(pixels, sigma_px, contrast, residual, blur_px, self.converged.reshape(shape))


def median(values: Float[np.ndarray, "*any"]) -> float:
    """Of all values: NumPy's costs several times as much where they are few."""
    ordered = np.sort(values, axis=None)
    return float(0.5 * (ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]))


@lru_cache(maxsize=256)
def _stencils(
    count: int, octaves: int, options: GridOptions, *, leave_out: bool = False
) -> tuple[Float[np.ndarray, "orders n n"], Float[np.ndarray, " n"]]:
    """Matrices that take values at 0 .. n-1, known to 2^octaves squares, to the coefficients of each order of the polynomial
    around each place that is the most probable, and the standard deviation (squares) of its value; with `leave_out` without the
    value known at that place."""
    orders = np.arange(min(len(options.row_priors), count))
    offset = np.arange(count) - np.arange(count, dtype=np.float64)[:, None]
    basis = offset[..., None] ** orders
    weight = 1.0 / (4.0**octaves + (options.row_remainder * np.abs(offset) ** len(options.row_priors)) ** 2)
    weighted = basis * (weight * (offset != 0) if leave_out else weight)[..., None]
    prior = np.diag(1.0 / np.square(options.row_priors[: len(orders)]))
    covariance = np.linalg.inv(weighted.transpose(0, 2, 1) @ basis + prior)
    return np.ascontiguousarray((covariance @ weighted.transpose(0, 2, 1)).transpose(1, 0, 2)), np.sqrt(covariance[:, 0, 0])


def _sizes_px(grid: Float[np.ndarray, "ny nx 2"], sigma_px: float) -> tuple[tuple[float, int], tuple[float, int]]:
    """Mean width and height of the squares, and to how many octaves of each the grid is known, rounded to few different ones."""
    steps = (grid[:, 1:] - grid[:, :-1], grid[1:] - grid[:-1])
    width, height = (float(np.hypot(step[..., 0], step[..., 1]).mean()) + 1e-6 for step in steps)
    columns, rows = (min(max(round(math.log2(sigma_px / size)), -20), 5) for size in (width, height))
    return (width, columns), (height, rows)


def misfit(grid: Float[np.ndarray, "ny nx 2"], sigma_px: float, options: GridOptions) -> Float[np.ndarray, "ny nx"]:
    """How far each corner of a grid known to `sigma_px` is from where the others of its row and of its column say, whichever is
    the nearer, over what that may be: `misfit_px`, `misfit_squares` and three standard deviations."""
    over = []
    for rows, (size, octaves) in zip((grid, grid.transpose(1, 0, 2)), _sizes_px(grid, sigma_px), strict=True):
        (value, *_), sigma = _stencils(rows.shape[1], octaves, options, leave_out=True)
        off = value @ rows - rows
        over.append(np.hypot(off[..., 0], off[..., 1]) / (options.misfit_px + (options.misfit_squares + 3.0 * sigma) * size))
    return np.minimum(over[0], over[1].T)


def grid_derivatives(
    grid: Float[np.ndarray, "ny nx 2"], sigma_px: float, options: GridOptions
) -> tuple[Float[np.ndarray, "ny nx 2 2"], Float[np.ndarray, "ny nx 2 2"]]:
    """First (.., (u, v), (x, y)) and second ([..., k] along x, then y) derivatives of pixels by board squares at each corner, of
    a grid of at least 3 x 3 corners known to `sigma_px`."""
    (_, columns), (_, rows) = _sizes_px(grid, sigma_px)
    across, _ = _stencils(grid.shape[1], columns, options)
    down, _ = _stencils(grid.shape[0], rows, options)
    # Orders 1 and 2, along the rows and along the columns.
    along_x = across[1:3, None] @ grid
    along_y = (down[1:3] @ grid.reshape(len(grid), -1)).reshape(2, *grid.shape)
    first, second = np.stack([along_x, along_y], -1)
    return first, 2.0 * second


def fit_saddles(
    image: np.ndarray,
    grid: Float[np.ndarray, "ny nx 2"],
    sigma_px: float,
    options: DetectionOptions,
    *,
    start_blur_px: float | Float[np.ndarray, "ny nx 2"] = 1.0,
    hasty: bool = False,
) -> SaddleFit:
    """Refine a grid of checkerboard corners known to `sigma_px`, at worst to within about twice `start_blur_px` + 1 px.

    `image`: (h, w) grey, any depth. `start_blur_px` is that of all edges, or of both edges of each corner. Corners whose window
    holds too few pixels or whose fit ran away come back unmoved with `converged` false and infinite `sigma_px`.
    """
    first, second = grid_derivatives(grid, sigma_px, options.grid)
    fit = fit_corners(
        image,
        grid.reshape(-1, 2),
        first.reshape(-1, 2, 2),
        second.reshape(-1, 2, 2),
        options.fit,
        start_blur_px=start_blur_px if isinstance(start_blur_px, float) else start_blur_px.reshape(-1, 2),
        settled_px=SETTLED_GRID_PX,
        hasty=hasty,
    )
    return fit.reshaped(*grid.shape[:2])


def fit_corners(
    image: np.ndarray,
    corners: Float[np.ndarray, "n 2"],
    first: Float[np.ndarray, "n 2 2"],
    second: Float[np.ndarray, "n 2 2"],
    options: FitOptions,
    *,
    plain: Float[np.ndarray, "n 2 2"] | None = None,
    start_blur_px: float | Float[np.ndarray, "n 2"] = 1.0,
    max_steps: int = MAX_STEPS,
    settled_px: float = SETTLED_PX,
    hasty: bool = False,
) -> SaddleFit:
    """Refine scattered corners: `fit_saddles` for corners that need not form a grid.

    `first`, `second`: derivatives of the pixels by board squares as `grid_derivatives` gives them. `plain` limits what of each
    quadrant is one colour, [.., y > 0, x > 0]: the width, in squares, of the strips along both edges that hold no tag. `hasty`:
    only for another fit to start from.
    """
    # A copy, as numba compiles once more for what may not be written.
    blur_px = np.broadcast_to(start_blur_px, corners.shape).copy()
    parameters, curvature, into_squares, narrowest, widest = starts(corners, first, second, blur_px)
    enough_px = HASTY_PX if hasty else settled_px
    widest_blur_px = max(options.max_blur_squares * median(narrowest), 1.5)
    # In this order what is no number is the least.
    half = math.ceil(min(MAX_HALF_WINDOW_PX, max(MIN_HALF_WINDOW_PX, options.window_squares * widest)))
    counts, cost, spread, last_px = fit_all(
        np.ascontiguousarray(image),
        parameters,
        curvature,
        into_squares,
        np.full((len(corners), 2, 2), np.inf) if plain is None else plain,
        half,
        2 if hasty and half >= MIN_THINNED_PX else 1,
        options.window_squares,
        widest_blur_px,
        max_steps,
        enough_px,
    )

    freedom = counts - PARAMETERS
    variance = cost / np.maximum(freedom, 1)
    sigma = np.sqrt(variance * spread + options.model_sigma_px**2)
    moved = np.hypot(*(parameters[:, :2] - corners).T)
    settled = last_px < np.maximum(enough_px, SETTLED_SIGMA * sigma)
    blur_px = np.exp(parameters[:, 4:6])
    # At its limit the blur is not fitted.
    resolved = blur_px.max(1, initial=0.0) < 0.999 * widest_blur_px
    converged = settled & resolved & (freedom > 0) & (narrowest > LEAST_SQUARE_PX) & (moved < 0.5 * narrowest)
    return SaddleFit(
        np.where(converged[:, None], parameters[:, :2], corners),
        np.where(converged, sigma, np.inf),
        parameters[:, 10],
        np.sqrt(variance),
        blur_px,
        converged,
    )
