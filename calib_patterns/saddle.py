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

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from calib_patterns.saddle_kernel import PARAMETERS, fit_all

MAX_HALF_WINDOW_PX = 10
WINDOW_SQUARES = 0.42
"""The window reaches this far into the adjoining squares, short of the next edges and their blur."""
MODEL_SIGMA_PX = 0.01
"""What the saddle leaves unmodelled (pixel integration, third-order distortion), added in quadrature to the noise's share."""
MAX_STEPS = 20

STENCIL = 5
"""Corners that a derivative along the board is taken from. Three leave the curvature of edges at the border of the board wrong,
which moves corners by some 0.005 px, all alike: seven standard deviations of the focal length of a well calibrated camera."""


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


@dataclass(frozen=True)
class _Patches:
    """The pixels around each corner: position, grey level and whether they belong to the window."""

    pixels: Float[np.ndarray, "n k 2"]
    grey: Float[np.ndarray, "n k"]
    mask: Bool[np.ndarray, "n k"]


def _stencils(count: int) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """Matrices that take values at 0 .. n-1 to first and second derivatives there: those of the polynomial through the nearest
    STENCIL values (Fornberg 1988)."""
    width = min(STENCIL, count)
    first, second = np.zeros((count, count)), np.zeros((count, count))
    for at in range(count):
        low = min(max(at - width // 2, 0), count - width)
        coefficients = np.linalg.inv(np.vander(np.arange(low, low + width) - float(at), width, increasing=True))
        first[at, low : low + width], second[at, low : low + width] = coefficients[1], 2 * coefficients[2]
    return first, second


def grid_derivatives(grid: Float[np.ndarray, "ny nx 2"]) -> tuple[Float[np.ndarray, "ny nx 2 2"], Float[np.ndarray, "ny nx 2 2"]]:
    """First (.., (u, v), (x, y)) and second ([..., k] along x, then y) derivatives of pixels by board squares at each corner."""
    (down, bend_down), (across, bend_across) = _stencils(grid.shape[0]), _stencils(grid.shape[1])
    first = np.stack([np.einsum("ij,kjc->kic", across, grid), np.einsum("ij,jkc->ikc", down, grid)], -1)
    second = np.stack([np.einsum("ij,kjc->kic", bend_across, grid), np.einsum("ij,jkc->ikc", bend_down, grid)], -1)
    return first, second


def _curvatures(first: Float[np.ndarray, "n 2 2"], second: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "n 2"]:
    """Signed curvature (1/px) of both edges, positive towards the normal (-t_v, t_u) of their tangents +x and -y."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.array([1.0, -1.0]) * cross / np.sum(first**2, 1) ** 1.5


def _patches(
    image: np.ndarray,
    corners: Float[np.ndarray, "n 2"],
    squares: Float[np.ndarray, "n 2 2"],
    plain: Float[np.ndarray, "n 2 2"] | None,
) -> _Patches:
    """Windows of the image that reach WINDOW_SQUARES into each adjoining square, at most MAX_HALF_WINDOW_PX.

    `plain` as in `fit_corners`.
    """
    reach = WINDOW_SQUARES * np.abs(squares).sum(2).max()
    half = int(np.clip(np.ceil(reach), 3, MAX_HALF_WINDOW_PX))
    offsets = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)), -1).reshape(-1, 2)
    pixels = np.rint(corners).astype(np.int64)[:, None] + offsets
    height, width = image.shape
    inside = (pixels >= 0).all(2) & (pixels[..., 0] < width) & (pixels[..., 1] < height)
    grey = image[np.clip(pixels[..., 1], 0, height - 1), np.clip(pixels[..., 0], 0, width - 1)].astype(np.float64)
    offset = pixels - corners[:, None]
    in_squares = np.einsum("nij,nkj->nki", np.linalg.inv(squares), offset)
    near = (np.abs(in_squares) < WINDOW_SQUARES).all(2) & (np.sum(offset**2, 2) < (half + 0.5) ** 2)
    # A window of fewer pixels than a fit needs is widened to the 5 x 5 around the corner.
    few = near.sum(1, keepdims=True) < 2 * PARAMETERS
    near |= few & (np.abs(offset) < 2.51).all(2)
    if plain is not None:
        row, column = (in_squares[..., 1] > 0).astype(np.int64), (in_squares[..., 0] > 0).astype(np.int64)
        near &= np.abs(in_squares).min(2) < plain[np.arange(len(corners))[:, None], row, column]
    near &= inside
    # Only the pixels of the windows, as many as the largest holds: the fit's time goes with their number.
    kept = np.argsort(~near, axis=1, kind="stable")[:, : max(int(near.sum(1).max(initial=0)), 1)]
    columns = np.take_along_axis(pixels, kept[..., None], 1)
    return _Patches(columns.astype(np.float64), np.take_along_axis(grey, kept, 1), np.take_along_axis(near, kept, 1))


def _start(
    corners: Float[np.ndarray, "n 2"], squares: Float[np.ndarray, "n 2 2"], blur_px: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n p"]:
    """Parameters from the grid's directions (tangents +x and -y, normals +y and +x)."""
    parameters = np.zeros((len(corners), PARAMETERS))
    parameters[:, :2] = corners
    parameters[:, 2] = np.arctan2(squares[:, 1, 0], squares[:, 0, 0])
    parameters[:, 3] = np.arctan2(-squares[:, 1, 1], -squares[:, 0, 1])
    parameters[:, 4:6] = np.log(blur_px)[:, None]
    return parameters


def fit_saddles(
    image: np.ndarray, grid: Float[np.ndarray, "ny nx 2"], start_blur_px: float = 1.0, max_steps: int = MAX_STEPS
) -> SaddleFit:
    """Refine a grid of checkerboard corners known to within about twice `start_blur_px` + 1 px.

    `image`: (h, w) grey, any depth. Corners whose window holds too few pixels or whose fit ran away come back unmoved with
    `converged` false and infinite `sigma_px`.
    """
    first, second = grid_derivatives(grid)
    fit = fit_corners(
        image,
        grid.reshape(-1, 2),
        first.reshape(-1, 2, 2),
        second.reshape(-1, 2, 2),
        start_blur_px=start_blur_px,
        max_steps=max_steps,
    )
    return fit.reshaped(*grid.shape[:2])


def fit_corners(
    image: np.ndarray,
    corners: Float[np.ndarray, "n 2"],
    first: Float[np.ndarray, "n 2 2"],
    second: Float[np.ndarray, "n 2 2"],
    *,
    plain: Float[np.ndarray, "n 2 2"] | None = None,
    start_blur_px: float = 1.0,
    max_steps: int = MAX_STEPS,
) -> SaddleFit:
    """Refine scattered corners: `fit_saddles` for corners that need not form a grid.

    `first`, `second`: derivatives of the pixels by board squares as `grid_derivatives` gives them. `plain` limits what of each
    quadrant is one colour, [.., y > 0, x > 0]: the width, in squares, of the strips along both edges that hold no tag.
    """
    squares = first
    singular = np.linalg.svd(squares, compute_uv=False)[:, -1]
    squares = np.where((singular > 0.5)[:, None, None], squares, np.eye(2))
    patches = _patches(image, corners, squares, plain)
    max_blur_px = max(0.25 * float(np.median(singular)), 1.5)
    blur = np.clip(0.2 * singular, 0.5, start_blur_px)
    parameters = _start(corners, squares, blur)
    counts = patches.mask.sum(1)
    cost, normal, settled = fit_all(
        parameters, _curvatures(squares, second), patches.pixels, patches.grey, counts, max_blur_px, max_steps
    )

    freedom = counts - PARAMETERS
    variance = cost / np.maximum(freedom, 1)
    scale = 1e-6 + np.sqrt(np.einsum("nii->ni", normal))
    inverse = np.linalg.inv(normal / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(PARAMETERS))
    position = inverse[:, [0, 1], [0, 1]] / scale[:, :2] ** 2
    sigma = np.sqrt(variance * position.mean(1) + MODEL_SIGMA_PX**2)
    moved = np.linalg.norm(parameters[:, :2] - corners, axis=1)
    converged = settled & (freedom > 0) & (singular > 0.5) & (moved < 0.5 * singular)
    return SaddleFit(
        np.where(converged[:, None], parameters[:, :2], corners),
        np.where(converged, sigma, np.inf),
        parameters[:, 10],
        np.sqrt(variance),
        np.exp(parameters[:, 4:6]),
        converged,
    )
