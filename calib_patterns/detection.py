"""Finding a checkerboard in a wide-angle photo, whole or in part: an ordered ensemble of searches.

First OpenCV's classic detector, the quickest where a board is seen whole; then the visible part grown from saddle points
(partial.py), at several scales and contrasts. What the classic detector returns is only a start: every corner is fitted
(saddle.py), and a grid counts when its corners are saddles of alternating sign, its squares are unfolded and it bends smoothly.
"""

import math
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calib_patterns._pattern import Detection
from calib_patterns.grid_checks import checks, flaw_of, good_corners, turns_of, typical_blur_px, typical_sigma_px
from calib_patterns.local_map import KnownCorners, local_map
from calib_patterns.options import DetectionOptions, SearchOptions
from calib_patterns.partial import visible_part
from calib_patterns.saddle import SaddleFit, fit_corners, fit_saddles, median, misfit

LEAST_SIDE_PX = 20
"""No target is seen in a photo that is smaller where it is searched, and OpenCV's detectors fail on some of them."""
_THINNED = 32
_BEND_OF_NOISE = 0.6745 * 6.0**0.5
"""Median absolute second difference of white noise of unit standard deviation."""
_MAX_FITS, _SETTLED_SIGMAS = 4, 5.0
"""Of the grid of a whole board: fits after the hasty one, and by how many standard deviations the last one moves corners at most,
so that another would move them by half of one."""
_ALIKE_BLUR = 2.0
"""By what factor the blur that a corner is fitted with again may differ from the usual one."""
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE

Grey = np.ndarray


def _classic(image: Grey, nx: int, ny: int, noisy_grey: float) -> np.ndarray | None:
    """Quadrilaterals of an adaptive threshold, linked into a grid; smoothed where noise would make thousands of them, since the
    detector stretches contrast by itself."""
    lines = stretched(image[::_THINNED]).astype(np.int16)
    bends = np.abs(lines[:, 2:] - 2 * lines[:, 1:-1] + lines[:, :-2])
    if 2 * np.count_nonzero(bends > noisy_grey * _BEND_OF_NOISE) > bends.size:
        image = cv2.GaussianBlur(image, (0, 0), 1.0)
    found, corners = cv2.findChessboardCorners(image, (nx, ny), None, _CLASSIC)
    return corners if found else None


@dataclass(frozen=True)
class _Growth:
    """One search for the visible part of a board."""

    scale: float
    """Relative to the base scale of the photo."""
    equalise: bool


_GROWTHS = (_Growth(1.0, False), _Growth(1.0, True), _Growth(2.0, False), _Growth(0.5, False))
"""Uneven light hides corners in the second, small squares need the third, strongly blurred ones the last."""


def grey_of(image: np.ndarray) -> Grey:
    """(h, w) of the photo's own depth."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def stretched(grey: Grey) -> Grey:
    """8 bits that span the photo's own range, but for 0.1 percent at either end."""
    thinned = grey[:: max(1, grey.shape[0] // 500), :: max(1, grey.shape[1] // 500)]
    levels = int(np.iinfo(grey.dtype).max) + 1
    below = np.cumsum(cv2.calcHist([np.ascontiguousarray(thinned)], [0], None, [levels], [0, levels]))
    low, high = np.searchsorted(below, below[-1] * np.array([0.001, 0.999]))
    table = np.clip((np.arange(levels) - low) * (255.0 / max(high - low, 1)), 0, 255).round().astype(np.uint8)
    return np.asarray(cv2.LUT(grey, table) if grey.dtype == np.uint8 else table[grey])


def _rescaled(image: Grey, scale: float) -> Grey:
    if scale == 1.0:
        return image
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)


def searched(
    grey: Grey, options: SearchOptions, scale: float = 1.0, *, equalise: bool = False, as_it_is: bool = False
) -> tuple[Grey, Float[np.ndarray, "2"]]:
    """The photo in 8 bits at `scale` times that of the search, and the factors (u, v) that take its pixels back to full scale.

    Its range is stretched to that of 8 bits, unless it has 8 bits and is to stay `as_it_is`. Pixels have their centres at whole
    numbers: scaling is about (-0.5, -0.5), by factors that rounding sets off from `scale`.
    """
    levels = grey if as_it_is and grey.dtype == np.uint8 else stretched(grey)
    image = _rescaled(levels, scale * min(1.0, options.side_px / max(grey.shape)))
    if equalise:
        image = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(image)
    return image, np.array(grey.shape[::-1]) / np.array(image.shape[::-1])


def _refined(grey: Grey, grid: Float[np.ndarray, "ny nx 2"], scale: float, options: DetectionOptions) -> SaddleFit:
    """Fits that take windows and curvatures from the grid that the one before, first a hasty one, refines. Each moves corners by
    about a tenth of what the one before moved them by; the last are fitted where that is well below their noise."""
    finder_px = options.grid.finder_sigma_px
    fit = fit_saddles(grey, grid, finder_px / scale, options, start_blur_px=max(1.0, 1.0 / scale), hasty=True)
    start: float | Float[np.ndarray, "ny nx 2"] = typical_blur_px(fit)
    for _ in range(_MAX_FITS):
        before = fit.pixels
        fit = fit_saddles(grey, before, typical_sigma_px(fit, finder_px), options, start_blur_px=start)
        good = good_corners(fit, options.fit.max_sigma_px)
        if good.mean() < options.grid.min_good_share:
            break
        if not good.all():
            fit = _fitted_from_others(grey, fit, good, options)
        if np.abs(fit.pixels - before).max() < _SETTLED_SIGMAS * typical_sigma_px(fit, finder_px):
            break
        # A fit ends where its corner comes to rest: one that begins at rest would leave the blur where it begins.
        usual_px = typical_blur_px(fit)
        start = np.clip(np.nan_to_num(fit.blur_px, nan=usual_px), usual_px / _ALIKE_BLUR, usual_px * _ALIKE_BLUR)
    return fit


def _fitted_from_others(grey: Grey, fit: SaddleFit, good: Bool[np.ndarray, "ny nx"], options: DetectionOptions) -> SaddleFit:
    """The corners that are not good fitted once more, from where the good ones say: the finder was too far off there."""
    row, column = np.nonzero(good)
    sigma_px = np.maximum(fit.sigma_px[good], options.map.min_sigma_px)
    known = KnownCorners(np.stack([column, row], -1).astype(np.float64), fit.pixels[good], sigma_px)
    row, column = np.nonzero(~good)
    places = local_map(known, np.stack([column, row], -1).astype(np.float64), 1.0, options.map)
    blur_px = typical_blur_px(fit)
    again = fit_corners(grey, places.pixels, places.first, places.second, options.fit, start_blur_px=blur_px)
    for field in fields(SaddleFit):
        getattr(fit, field.name)[~good] = getattr(again, field.name)
    return fit


def _numberings(nx: int, ny: int, flip: bool) -> list[tuple[np.ndarray, bool]]:
    """Orders (ny, nx) of the found corners with the wanted handedness, and whether each exchanges the diagonals of a corner."""
    index = np.arange(nx * ny).reshape(ny, nx)
    index = index[:, ::-1] if flip else index
    turns = (0, 1, 2, 3) if nx == ny else (0, 2)
    return [(np.rot90(index, turn), flip != (turn % 2 == 1)) for turn in turns]


def _board_order(fit: SaddleFit, mirrored: bool) -> np.ndarray:
    """Found corners (flat indices, (ny, nx)) in the board's own order, chosen as `Checkerboard.detect` states."""
    ny, nx = fit.contrast.shape
    flat = fit.pixels.reshape(-1, 2)
    signs = checks(ny, nx)
    # Positive contrast: bright towards (-x, -y) and (+x, +y). Robust signs, so that a corner that is covered does not decide.
    contrast = (np.sign(median(fit.contrast * signs)) * signs).reshape(-1)

    def preference(numbering: tuple[np.ndarray, bool]) -> tuple[bool, float]:
        order, exchanged = numbering
        black_first = bool((contrast[order[0, 0]] < 0) != exchanged)
        x_axis = (flat[order[:, -1]] - flat[order[:, 0]]).mean(0)
        return black_first, float(x_axis[0] / np.hypot(*x_axis))

    # The grid is unfolded: one of its quadrilaterals tells.
    left_handed = bool(turns_of(fit.pixels[:2, :2]).max() < 0)
    return max(_numberings(nx, ny, left_handed != mirrored), key=preference)[0]


VISIBLE_PART = "at least 3 x 3 corners with their squares have to be seen, some 8 px apart"


def why_not(grey: Grey, name: str, options: SearchOptions, needs: str = VISIBLE_PART) -> str:
    """One sentence: the likeliest reason why a target was not found; `needs` ends it where the photo itself is good."""
    return photo_flaw(grey, name, options) or f"No {name} was found: {needs}."


def is_too_small(image: np.ndarray, options: SearchOptions) -> bool:
    """Whether a photo, (h, w) or (h, w, 3), shows no target as it is searched: a narrow one is reduced by its longer side."""
    short, long = sorted(image.shape[:2])
    return short * min(1.0, options.side_px / long) < LEAST_SIDE_PX


def photo_flaw(grey: Grey, name: str, options: SearchOptions) -> str | None:
    """One sentence: why a photo cannot show a target; None where it is good."""
    if is_too_small(grey, options):
        size = f"{grey.shape[1]}x{grey.shape[0]} px"
        least_px = math.ceil(LEAST_SIDE_PX * max(1.0, max(grey.shape) / options.side_px))
        return f"The photo of {size} is too small to show a {name}: give one whose shorter side is {least_px} px or more."
    full = 65535 if grey.dtype == np.uint16 else 255
    low, high = np.percentile(grey[::4, ::4], [1, 99]) / full
    if high < 0.12:
        most = max(1, math.ceil(100 * high))
        why = f"99 percent of it is below {most} percent of full scale" if grey.any() else "it is black"
        return f"The photo is too dark to show a {name}: {why}."
    if low > 0.9:
        least = min(99, math.floor(100 * low))
        why = f"99 percent of it is above {least} percent of full scale" if (grey < full).any() else "it is white"
        return f"The photo is overexposed: {why}."
    if high - low < 0.08:
        return f"The photo has too little contrast to show a {name}: it spans {100 * (high - low):.0f} percent of full scale."
    reduced = _rescaled(stretched(grey), min(1.0, options.side_px / max(grey.shape))).astype(np.float32)
    steepest = float(np.percentile(np.abs(np.diff(reduced, axis=1)), 99.9))
    if steepest < 12:
        return (
            f"The photo is too blurred to show a {name}: its steepest edges rise by {steepest:.0f} of 255 grey levels per pixel."
        )
    return None


def _detection(fit: SaddleFit, good: Bool[np.ndarray, "ny nx"], order: np.ndarray) -> Detection:
    """The good corners of a grid in the board's order."""
    ids = np.flatnonzero(good.reshape(-1)[order.reshape(-1)])
    picked = order.reshape(-1)[ids]
    # On a board as high as wide, the found rows may be the board's columns.
    edges = [0, 1] if abs(int(order[0, 1] - order[0, 0])) == 1 else [1, 0]
    blur_px = fit.blur_px.reshape(-1, 2)[picked][:, edges]
    return Detection(ids, fit.pixels.reshape(-1, 2)[picked], fit.sigma_px.reshape(-1)[picked], blur_px)


def detect_checkerboard(
    image: np.ndarray, nx: int, ny: int, options: DetectionOptions, *, mirrored: bool
) -> tuple[Detection, str | None]:
    """The visible corners of an nx x ny board as `Checkerboard.detect` states, or none and why."""
    grey = grey_of(image)
    name = f"checkerboard of {nx}x{ny} inner corners"
    if is_too_small(grey, options.search):
        return Detection.empty(), why_not(grey, name, options.search)
    found, misfit = _whole_board(grey, nx, ny, options, mirrored=mirrored)
    flaw = None
    for growth in _GROWTHS:
        # A board that is not the one asked for is not searched on: something of it will always fit.
        pixels = growth.scale**2 * min(grey.size, options.search.side_px**2)
        if found is None and flaw is None and pixels <= options.search.max_pixels:
            search, factors = searched(grey, options.search, growth.scale, equalise=growth.equalise)
            found, flaw = visible_part(grey, search, factors, nx, ny, options, mirrored=mirrored)
    flaw = flaw or misfit
    if found is not None:
        return found, None
    if flaw is None:
        return Detection.empty(), why_not(grey, name, options.search)
    return Detection.empty(), f"A grid like a {name} was found, but {flaw}."


def _whole_board(
    grey: Grey, nx: int, ny: int, options: DetectionOptions, *, mirrored: bool
) -> tuple[Detection | None, str | None]:
    """The board that the classic detector finds, or what keeps its grid from being one; neither where a corner is wrong."""
    # The detector stretches contrast by itself.
    search, factors = searched(grey, options.search, as_it_is=True)
    corners = _classic(search, nx, ny, options.search.noisy_grey)
    if corners is None:
        return None, None
    grid = (corners.reshape(ny, nx, 2).astype(np.float64) + 0.5) * factors - 0.5
    fit = _refined(grey, grid, 1.0 / float(factors.max()), options)
    if misfit(fit.pixels, typical_sigma_px(fit, options.grid.finder_sigma_px), options.grid).max() > 1.0:
        # One corner is none: the others do better without it, and it may be found where they say.
        return None, None
    good = good_corners(fit, options.fit.max_sigma_px)
    flaw = flaw_of(grey, fit, good, options)
    return (_detection(fit, good, _board_order(fit, mirrored)), None) if flaw is None else (None, flaw)
