"""Photos that are blurred more than the others of their set, by the blur of the edges at their corners.

The profile across an edge has a variance: that of lens, pixel and defocus, plus that of the motion across the edge, which for a
steady motion by L px at the angle phi to the edge is (L sin phi)^2 / 12. A board has two directions of edges. Motion along one of
them blurs the other only; motion along a diagonal blurs both alike, as defocus does. So the more blurred direction tells that a
photo is blurred, and the ratio of both tells that the cause is motion, except along a diagonal, where the cause stays open.

How much is much is for the set to say: lenses differ, and in one lens the blur differs over the field by up to two times. The
location and the scale of the sharp photos, in logarithms, are those of the shortest half of the set (P. Rousseeuw and A. Leroy,
Robust Regression and Outlier Detection, 1987), which hold as long as more than half of the photos are sharp.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from calib_patterns.options import DetectionOptions, SharpnessOptions

TRIM, TRIMMED = 2.5, 1.048
"""Values beyond so many standard deviations of the first estimate are left out of the second; standard deviation of normal values
over that of those which this keeps."""


def blur_remarks(
    view: Int[np.ndarray, " n"],
    blur_px: Float[np.ndarray, "n 2"],
    views: int,
    options: DetectionOptions = DetectionOptions(),
) -> tuple[str | None, ...]:
    """For each of `views` photos of one camera one sentence (without its stop) if it is blurred, otherwise None.

    `view` is the photo of each corner, `blur_px` the standard deviation (> 0) of the profile across both its edges
    (`Detection.blur_px`). A photo is `motion-blurred` where one of the board's edge directions is blurred clearly more than in
    the other photos and than the other direction, `blurred` where both are alike. Sets of fewer than
    `SharpnessOptions.min_photos` photos, and photos of fewer than `min_corners` corners, get no remark.
    """
    median = _medians(view, blur_px, views, options.min_corners)
    judged = np.flatnonzero(np.isfinite(median[:, 0]))
    remarks: list[str | None] = [None] * views
    if len(judged) < options.sharpness.min_photos:
        return tuple(remarks)
    more, less = median[judged].max(1), median[judged].min(1)
    usual, blurred = _blurred(more, options.sharpness)
    moved = _moved(median[judged], options.sharpness)
    for k in np.flatnonzero(blurred):
        remarks[judged[k]] = (
            f"motion-blurred: its edges are blurred by {more[k]:.1f} px (standard deviation) in one direction and {less[k]:.1f} "
            f"px in the other, those of the other photos by {usual:.1f} px"
            if moved[k]
            else f"blurred, out of focus or by motion along a diagonal of the board: its edges are blurred by {more[k]:.1f} px "
            f"(standard deviation), those of the other photos by {usual:.1f} px"
        )
    return tuple(remarks)


def _medians(
    view: Int[np.ndarray, " n"], blur_px: Float[np.ndarray, "n 2"], views: int, min_corners: int
) -> Float[np.ndarray, "views 2"]:
    """Median blur of both edge directions of each photo, NaN for a photo of few corners."""
    order = np.argsort(view, kind="stable")
    groups = np.split(blur_px[order], np.searchsorted(view[order], np.arange(1, views)))
    return np.array([np.median(g, axis=0) if len(g) >= min_corners else np.full(2, np.nan) for g in groups])


def _blurred(more_px: Float[np.ndarray, " n"], options: SharpnessOptions) -> tuple[float, Bool[np.ndarray, " n"]]:
    """The usual blur (px) of the more blurred direction, and which photos are clearly above it."""
    log = np.log(more_px)
    centre, limit = _usual(log, options)
    usual = float(np.exp(centre))
    return usual, (log > centre + limit) & (more_px**2 > usual**2 + options.min_excess_px**2)


def _moved(blur_px: Float[np.ndarray, "n 2"], options: SharpnessOptions) -> Bool[np.ndarray, " n"]:
    """Photos whose two directions differ clearly more than they usually do."""
    log = np.log(blur_px[:, 0] / blur_px[:, 1])
    centre, limit = _usual(log, options)
    return np.abs(log - centre) > limit


def _usual(log: Float[np.ndarray, " n"], options: SharpnessOptions) -> tuple[float, float]:
    """Mean of the usual values, and how far from it a value is no longer usual.

    Start from the shortest interval that holds more than half of the values, with Rousseeuw and Leroy's correction for small
    samples; then mean and standard deviation of the values within TRIM of that start, which scatter far less.
    """
    ordered, count = np.sort(log), len(log) // 2 + 1
    length = ordered[count - 1 :] - ordered[: len(log) - count + 1]
    first = int(np.argmin(length))
    start = ordered[first] + 0.5 * length[first]
    scale = 1.4826 * (1 + 5 / (len(log) - 1)) * 0.5 * length[first]
    usual = log[np.abs(log - start) <= TRIM * scale]
    limit = options.cutoff_sigmas * TRIMMED * float(usual.std(ddof=1))
    return float(usual.mean()), max(float(np.log(options.min_ratio)), limit)
