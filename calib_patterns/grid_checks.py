"""Whether a grid of fitted corners is the board that was asked for: its corners are saddles of alternating sign, its squares are
unfolded and bend smoothly, and it does not go on beyond its sides."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from calib_patterns.options import DetectionOptions
from calib_patterns.saddle import SaddleFit, fit_corners, grid_derivatives, median

GOES_ON = "its squares go on beyond it; give the number of inner corners that the board has"


def turns_of(grid: Float[np.ndarray, "ny nx 2"]) -> Float[np.ndarray, "4 my mx"]:
    """Cross products of the sides that meet in each corner of the quadrilaterals of neighbouring corners."""
    across, down = grid[:, 1:] - grid[:, :-1], grid[1:] - grid[:-1]
    pairs = ((x, y) for x in (across[:-1], across[1:]) for y in (down[:, :-1], down[:, 1:]))
    return np.stack([x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0] for x, y in pairs])


def unfolded(grid: Float[np.ndarray, "ny nx 2"]) -> bool:
    """Whether all quadrilaterals of neighbouring corners are convex and turn the same way."""
    turns = turns_of(grid)
    return bool(turns.min() > 0 or turns.max() < 0)


def _smooth(grid: Float[np.ndarray, "ny nx 2"]) -> bool:
    """Whether neighbouring squares differ by less than their own size, as they do in any lens (a skipped row does not)."""
    return max(_unevenness(grid), _unevenness(grid.transpose(1, 0, 2))) < 0.9


def _unevenness(rows: Float[np.ndarray, "k n 2"]) -> float:
    """By how much steps along a row differ from the next at most, over the mean step of their row."""
    steps = rows[:, 1:] - rows[:, :-1]
    change = steps[:, 1:] - steps[:, :-1]
    usual = np.hypot(steps[..., 0], steps[..., 1]).mean(1, keepdims=True)
    return float((np.hypot(change[..., 0], change[..., 1]) / usual).max())


def typical_blur_px(fit: SaddleFit) -> float:
    """Of the more blurred edge of a corner, within what a fit should start from."""
    return min(max(median(np.maximum(fit.blur_px[..., 0], fit.blur_px[..., 1])), 0.5), 4.0)


def typical_sigma_px(fit: SaddleFit, finder_sigma_px: float) -> float:
    """Of the corners that were fitted at all, that of the finder where none was."""
    return median(fit.sigma_px[fit.converged]) if fit.converged.any() else finder_sigma_px


@lru_cache(maxsize=64)
def checks(ny: int, nx: int) -> Float[np.ndarray, "ny nx"]:
    """1 and -1 like the squares of a board, from 1 on."""
    return np.where((np.arange(ny)[:, None] + np.arange(nx)) % 2 == 0, 1.0, -1.0)


def _strengths(contrast: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "ny nx"]:
    """Contrasts of a grid, positive where they alternate as most do."""
    alternating = checks(*contrast.shape) * contrast
    return np.asarray(alternating * np.sign(median(alternating)))


def good_corners(fit: SaddleFit, max_sigma_px: float) -> Bool[np.ndarray, "ny nx"]:
    """Corners where a saddle of the board's own contrast and sign stands clear of what the fit leaves."""
    strength = _strengths(fit.contrast)
    clear = (strength > 2.5 * fit.residual) & (strength > 0.15 * median(strength))
    return fit.converged & clear & (fit.sigma_px < max_sigma_px)


def _extended(grid: Float[np.ndarray, "ny nx 2"]) -> Float[np.ndarray, "my mx 2"]:
    """The grid with one more row and column on every side, extrapolated to second order."""
    ny, nx, _ = grid.shape
    wider = np.empty((ny + 2, nx + 2, 2))
    wider[1:-1, 1:-1] = grid
    inner, columns = wider[:, 1:-1], wider.transpose(1, 0, 2)
    for rows in (inner, columns):
        rows[0] = 3 * rows[1] - 3 * rows[2] + rows[3]
        rows[-1] = 3 * rows[-2] - 3 * rows[-3] + rows[-4]
    return wider


@dataclass(frozen=True)
class _Ring:
    """The corners around a grid of ny x nx, but for the four at its own corners."""

    rows: Int[np.ndarray, " k"]
    """Of the grid with one more row and column on every side, as are the columns."""
    columns: Int[np.ndarray, " k"]
    side: Int[np.ndarray, " k"]
    lengths: Int[np.ndarray, "4"]
    """Corners of each side."""
    few: Bool[np.ndarray, " k"]
    """As few of each side, evenly spaced, as rule out that it goes on when none of them is a corner."""


@lru_cache(maxsize=64)
def _ring(ny: int, nx: int, goes_on_share: float) -> _Ring:
    x, y = np.arange(1, nx + 1), np.arange(1, ny + 1)
    rows = np.concatenate([np.zeros_like(x), np.full_like(x, ny + 1), y, y])
    columns = np.concatenate([x, x, np.zeros_like(y), np.full_like(y, nx + 1)])
    lengths = np.array([nx, nx, ny, ny])
    count = np.repeat(lengths - np.floor(goes_on_share * lengths + 1e-9).astype(int), lengths)
    few = np.concatenate([x, x, y, y]) * count % np.repeat(lengths, lengths) < count
    return _Ring(rows, columns, np.repeat(np.arange(4), lengths), lengths, few)


def _goes_on(grey: np.ndarray, fit: SaddleFit, options: DetectionOptions) -> bool:
    """Whether the board has another row or column of inner corners beyond one of the sides of the grid.

    Of each side few corners are looked at first, the others only where one of them is a corner.
    """
    ny, nx = fit.contrast.shape
    ring, start = _ring(ny, nx, options.grid.goes_on_share), _extended(fit.pixels)
    if not ring.few.any():
        return False
    first, second = grid_derivatives(start, typical_sigma_px(fit, options.grid.finder_sigma_px), options.grid)
    usual, blur_px = median(checks(ny, nx) * fit.contrast), typical_blur_px(fit)

    def corners(looked_at: Bool[np.ndarray, " k"]) -> Bool[np.ndarray, " m"]:
        """Which of some places of the ring are inner corners of the board."""
        at = ring.rows[looked_at], ring.columns[looked_at]
        # What is no saddle never settles; what is one does so within a few steps from here.
        outer = fit_corners(grey, start[at], first[at], second[at], options.fit, start_blur_px=blur_px, max_steps=8, hasty=True)
        square_px = np.sqrt((first[at] ** 2).sum(-2).min(-1))
        near = np.hypot(*(outer.pixels - start[at]).T) < 0.3 * square_px
        strength = checks(ny + 2, nx + 2)[at] * outer.contrast * np.sign(usual)
        clear = (strength > 2.5 * outer.residual) & (strength > 0.15 * abs(usual))
        return outer.converged & clear & (outer.sigma_px < options.fit.max_sigma_px) & near

    good = np.zeros(len(ring.side), dtype=bool)
    good[ring.few] = corners(ring.few)
    others = ~ring.few & np.isin(ring.side, ring.side[good])
    if others.any():
        good[others] = corners(others)
    return bool((np.bincount(ring.side[good], minlength=4) > options.grid.goes_on_share * ring.lengths).any())


def flaw_of(grey: np.ndarray, fit: SaddleFit, good: Bool[np.ndarray, "ny nx"], options: DetectionOptions) -> str | None:
    """What keeps the fitted grid from being the board, None when nothing does."""
    if good.mean() < options.grid.min_good_share:
        return "its corners do not alternate like a checkerboard's"
    if not (unfolded(fit.pixels) and _smooth(fit.pixels)):
        return "its rows and columns are folded or uneven"
    if _goes_on(grey, fit, options):
        return GOES_ON
    return None
