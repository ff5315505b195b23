"""What the print looks like around the corners of a board, and which fits are corners of that kind."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from calib_patterns.local_map import LocalMap
from calib_patterns.options import DetectionOptions, FitOptions
from calib_patterns.saddle import SETTLED_PX, SaddleFit, fit_corners


@dataclass(frozen=True)
class CornerKind:
    """What the print looks like around its corners, for `fit_corners` and for telling a corner from what is none."""

    corners_m: Float[np.ndarray, "n 2"]
    sign: Float[np.ndarray, " n"]
    """+1 where the quadrant towards +x and +y is white, -1 where it is black."""
    plain: Float[np.ndarray, "n 2 2"]
    """See `fit_corners`."""
    square_m: float
    """Side of the squares around the corners, which the windows are sized by."""
    spacing_m: float
    """Typical distance of neighbouring corners, the unit of the local map."""
    margin: Float[np.ndarray, "n 2 2"] | None = None
    """How far, in squares, a tag is from the edges in each quadrant, infinite where there is none; None without tags."""

    def at(self, chosen: Int[np.ndarray, " k"]) -> "CornerKind":
        """Some of the corners."""
        margin = None if self.margin is None else self.margin[chosen]
        return CornerKind(self.corners_m[chosen], self.sign[chosen], self.plain[chosen], self.square_m, self.spacing_m, margin)

    def fit(
        self, grey: np.ndarray, places: LocalMap, start_blur_px: float, options: FitOptions, settled_px: float = SETTLED_PX
    ) -> SaddleFit:
        """The saddles near the predicted places."""
        share = self.square_m / self.spacing_m
        first, second = places.first * share, places.second * share**2
        plain = self._clear_of_tags(first, start_blur_px, options)
        return fit_corners(
            grey, places.pixels, first, second, options, plain=plain, start_blur_px=start_blur_px, settled_px=settled_px
        )

    def _clear_of_tags(
        self, first: Float[np.ndarray, "n 2 2"], blur_px: float, options: FitOptions
    ) -> Float[np.ndarray, "n 2 2"]:
        """`plain`, narrowed by the blur of tags; `first` are derivatives of the pixels by squares."""
        if self.margin is None:
            return self.plain
        # Between opposite sides of a square, where it is the narrower.
        width_px = np.abs(np.linalg.det(first)) / np.maximum(np.linalg.norm(first, axis=1).max(-1), 1e-9)
        blurred = options.tag_clear_blurs * blur_px / np.maximum(width_px, 1e-9)
        tagged = np.isfinite(self.margin)
        margin = np.where(tagged, self.margin, 0.0)
        clear = np.maximum(margin - blurred[:, None, None], options.least_margin_share * margin)
        return np.where(tagged, np.minimum(self.plain, clear), self.plain)

    def narrowed(self) -> "CornerKind":
        """With windows of half the width."""
        margin = None if self.margin is None else 2.0 * self.margin
        return replace(self, square_m=0.5 * self.square_m, plain=2.0 * self.plain, margin=margin)

    def along_edges(self, options: FitOptions) -> "CornerKind":
        """With the pixels within half a window of either edge only, without the insides of the squares."""
        return replace(self, plain=np.minimum(self.plain, 0.5 * options.window_squares))

    def square_px(self, places: LocalMap) -> Float[np.ndarray, " n"]:
        """Width of the squares in the photo, where they are the most foreshortened."""
        return places.spacing_px * self.square_m / self.spacing_m


def squares_kind(
    corners_m: Float[np.ndarray, "n 2"], sign: Float[np.ndarray, " n"], square_m: float, margin: float, options: FitOptions
) -> CornerKind:
    """The corners of a checkerboard whose black squares are plain, the white ones as far as `margin` squares from their sides;
    infinite where there are no tags."""
    if not math.isfinite(margin):
        return CornerKind(corners_m, sign, np.full((len(sign), 2, 2), np.inf), square_m, square_m)
    white = np.eye(2, dtype=bool) == (sign > 0)[:, None, None]
    plain = np.where(white, options.tag_margin_share * margin, np.inf)
    return CornerKind(corners_m, sign, plain, square_m, square_m, np.where(white, margin, np.inf))


def accepted(
    kind: CornerKind, fit: SaddleFit, places: LocalMap, contrast: float, blur_px: float, options: DetectionOptions
) -> Bool[np.ndarray, " n"]:
    """Which fits are corners: of the printed sign and about the usual `contrast`, clear of what the fit leaves, near their
    prediction, and no more blurred than their squares are wide or, where the usual `blur_px` (infinite while nothing is known) is
    about that, than the others.
    """
    limits = options.corners
    strength = kind.sign * fit.contrast
    square_px = kind.square_px(places)
    clear = (strength > limits.min_clearness * fit.residual) & (strength > limits.min_contrast_share * contrast)
    near = np.linalg.norm(fit.pixels - places.pixels, axis=1) < np.maximum(limits.max_step_squares * square_px, 2.0)
    alike = np.minimum(limits.usual_blur_factor * blur_px, limits.max_usual_blur_squares * square_px)
    widest = np.minimum(np.maximum(limits.max_blur_squares * square_px, 1.4), max(limits.max_blur_factor * blur_px, 1.4))
    sharp = fit.blur_px.max(1) < np.maximum(widest, alike)
    good: Bool[np.ndarray, " n"] = fit.converged & clear & near & sharp & (fit.sigma_px < options.fit.max_sigma_px)
    return good
