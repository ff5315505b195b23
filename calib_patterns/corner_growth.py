"""Corners of a board grown from a few known places, corner by corner, each verified as a saddle of the printed kind.

What is known gives a local map of the board (local_map.py). Corners it predicts well are fitted (saddle.py); those that fit join
what is known, and the next ones are predicted from them, until nothing is gained. So none is returned that the photo does not
show.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from calib_patterns._pattern import Detection
from calib_patterns.corner_kind import CornerKind, accepted
from calib_patterns.local_map import KnownCorners, LocalMap, disagreement, local_map
from calib_patterns.options import DetectionOptions
from calib_patterns.saddle import SETTLED_GRID_PX, SETTLED_PX, SaddleFit

AROUND = 9
"""Corners nearest to one on the board, itself included."""
SETTLED_SHARE = 0.04
"""A fit has settled when a step is shorter than this share of the usual standard deviation of corners."""
MIN_CORNERS = 4
_MAX_ROUNDS, _MAX_FINISHES = 30, 3
_FIELDS = ("pixels", "sigma_px", "contrast", "residual", "blur_px", "converged")


def inside_photo(pixels: Float[np.ndarray, "*n 2"], shape: tuple[int, ...]) -> Bool[np.ndarray, "*n"]:
    """Corners in a photo of (h, w, ...), with a few pixels on either side."""
    return np.all((pixels >= 1.0) & (pixels <= np.array(shape[1::-1]) - 2.0), axis=-1)


@dataclass
class _Growth:
    """Corners accepted so far."""

    grey: np.ndarray
    kind: CornerKind
    options: DetectionOptions
    seeds: KnownCorners
    strict: bool
    """See `grow_corners`."""
    good: Bool[np.ndarray, " n"]
    fit: SaddleFit

    @property
    def corners(self) -> KnownCorners:
        """The accepted ones."""
        sigma_px = np.maximum(self.fit.sigma_px[self.good], self.options.map.min_sigma_px)
        return KnownCorners(self.kind.corners_m[self.good], self.fit.pixels[self.good], sigma_px)

    @property
    def contrast(self) -> float:
        """Their usual contrast, 0 where there is none yet."""
        return float(np.median(np.abs(self.fit.contrast[self.good]))) if self.good.any() else 0.0

    @property
    def blur_px(self) -> float:
        """Their usual blur, of the more blurred edge."""
        return float(np.clip(np.median(self.fit.blur_px[self.good].max(-1)), 0.5, 4.0)) if self.good.any() else 1.0

    @property
    def settled_px(self) -> float:
        """How far the fits have to settle: a small share of what noise moves the corners by."""
        if not self.good.any():
            return SETTLED_PX
        return float(np.clip(SETTLED_SHARE * np.median(self.fit.sigma_px[self.good]), SETTLED_PX, SETTLED_GRID_PX))

    def places(self, chosen: Int[np.ndarray, " k"], known: KnownCorners | None = None) -> LocalMap:
        """The map at some corners, from all that is known or from some of it."""
        return local_map(known or self.known(), self.kind.corners_m[chosen], self.kind.spacing_m, self.options.map)

    def places_of_good(self, chosen: Int[np.ndarray, " k"]) -> LocalMap:
        """The map at accepted corners, from such alone where they are enough. Seeds may lie in the margin of the board, where a
        wrong place bends the edges of the windows next to it."""
        return self.places(chosen, self.corners if int(self.good.sum()) >= AROUND else None)

    def inside(self, pixels: Float[np.ndarray, "k 2"]) -> Bool[np.ndarray, " k"]:
        """Corners in the photo."""
        return inside_photo(pixels, self.grey.shape)

    def fitted(self, kind: CornerKind, places: LocalMap) -> SaddleFit:
        """Corners of a kind near their places."""
        return kind.fit(self.grey, places, self.blur_px, self.options.fit, self.settled_px)

    def known(self) -> KnownCorners:
        """Corners and tags."""
        return self.corners.joined(self.seeds)

    def look(self, chosen: Int[np.ndarray, " k"], places: LocalMap, *, narrow: bool = False) -> None:
        """Fit corners at their predictions; keep those that are accepted, forget the others."""
        kind = self.kind.at(chosen).narrowed() if narrow else self.kind.at(chosen)
        fit = self.fitted(kind, places)
        _put(self.fit, chosen, fit)
        contrast = max(self.contrast, float(np.median(np.abs(fit.contrast[fit.converged]))) if fit.converged.any() else 0.0)
        usual_px = self.blur_px if self.good.any() else np.inf
        good = accepted(kind, fit, places, contrast, usual_px, self.options)
        self.good[chosen] = good & self.inside(fit.pixels)

    def grow(self) -> None:
        """Until nothing is gained. A tag that was read wrongly misleads where corners alone do not."""
        for _ in range(_MAX_ROUNDS):
            if self.good.all():
                break
            gained = self.gain(self.known()) or (int(self.good.sum()) >= MIN_CORNERS and self.gain(self.corners))
            if not gained:
                break

    def gain(self, known: KnownCorners) -> bool:
        """Look for what is missing where `known` says; whether something was found."""
        limits, before = self.options.growth, int(self.good.sum())
        missing = np.flatnonzero(~self.good)
        places = self.places(missing, known)
        square_px, inside = self.kind.square_px(places), self.inside(places.pixels)
        certain = inside & (places.sigma_px < limits.max_sigma_squares * square_px + 0.7)
        if certain.any():
            self.look(missing[certain], places_at(places, certain))
        if int(self.good.sum()) == before:
            guessed = inside & ~certain & (places.sigma_px < limits.guess_sigma_squares * square_px + 0.7)
            if guessed.any():
                self.guess(missing[guessed], places_at(places, guessed))
        return int(self.good.sum()) > before

    def guess(self, chosen: Int[np.ndarray, " k"], places: LocalMap) -> None:
        """Fit corners at uncertain predictions; keep those that are near them all the same and look just like the others."""
        kind, limits = self.kind.at(chosen), self.options.growth
        fit = self.fitted(kind, places)
        strength, contrast, factor = kind.sign * fit.contrast, self.contrast, limits.guess_alike_factor
        alike = (strength > contrast / factor) & (strength < contrast * factor)
        alike &= strength > factor * self.options.corners.min_clearness * fit.residual
        near = np.linalg.norm(fit.pixels - places.pixels, axis=1) < limits.guess_step_squares * kind.square_px(places)
        good = accepted(kind, fit, places, contrast, self.blur_px, self.options) & alike & near & self.inside(fit.pixels)
        _put(self.fit, chosen[good], _rows(fit, good))
        self.good[chosen[good]] = True

    def look_closely(self) -> None:
        """Try what is missing with half the window, until nothing is gained: something may lie next to a corner. The neighbours
        must agree."""
        before = -1
        while before < int(self.good.sum()) < len(self.good) and self.good.any():
            before, missing = int(self.good.sum()), np.flatnonzero(~self.good)
            places = self.places(missing)
            square_px, inside = self.kind.square_px(places), self.inside(places.pixels)
            ahead = inside & (square_px >= self.options.growth.min_narrow_px) & (places.sigma_px < 0.1 * square_px + 0.5)
            if ahead.any():
                self.look(missing[ahead], places_at(places, ahead), narrow=True)
                self.drop_what_disagrees()

    def finish(self) -> None:
        """What needs the others for comparison, until nothing changes: once wrong corners are gone, right ones may be found."""
        for _ in range(_MAX_FINISHES):
            before = self.good.copy()
            self.grow()
            if self.strict:
                self.settle()
            self.look_closely()
            self.look_again()
            self.drop_what_is_unclear()
            self.drop_what_disagrees()
            if (self.good == before).all():
                break

    def look_again(self) -> None:
        """Fit the corners without the insides of the squares, which may hold a tag. Those that then still leave more than others
        are fitted with half the window: the next edge may be nearer than a square away. What leaves clearly less is taken."""
        chosen, limits = np.flatnonzero(self.good), self.options.growth
        if not chosen.size:
            return
        places = self.places_of_good(chosen)
        self.take_if_clearer(self.kind.at(chosen).along_edges(self.options.fit), chosen, places, limits.clearer_factor)
        much = self.fit.residual[chosen] > limits.much_clearer_factor * np.median(self.fit.residual[chosen])
        much &= self.kind.square_px(places) >= limits.min_narrow_px
        if much.any():
            narrowed = self.kind.at(chosen[much]).narrowed()
            self.take_if_clearer(narrowed, chosen[much], places_at(places, much), limits.much_clearer_factor)

    def take_if_clearer(self, kind: CornerKind, chosen: Int[np.ndarray, " k"], places: LocalMap, more: float) -> None:
        """Fit the chosen corners with the windows of another kind, and keep what leaves less than before by the factor `more`."""
        fit = self.fitted(kind, places)
        better = accepted(kind, fit, places, self.contrast, self.blur_px, self.options)
        better &= self.fit.residual[chosen] > more * fit.residual
        _put(self.fit, chosen[better], _rows(fit, better))

    def drop_what_disagrees(self) -> None:
        """Forget the corners that the others contradict, the worst first: those that it drags along agree once it is gone."""
        while self.good.sum() >= MIN_CORNERS:
            over = disagreement(self.corners, self.kind.spacing_m, self.options.map)
            if over.max() <= 1.0:
                break
            self.good[np.flatnonzero(self.good)[over > max(0.5 * over.max(), 1.0)]] = False

    def drop_what_is_unclear(self) -> None:
        """Forget the corners that stand out far less than those around them."""
        chosen = np.flatnonzero(self.good)
        if chosen.size < AROUND:
            return
        clearness = np.abs(self.fit.contrast[chosen]) / self.fit.residual[chosen]
        corners_m = self.kind.corners_m[chosen]
        around = np.asarray(cKDTree(corners_m).query(corners_m, k=AROUND)[1])
        usual = np.median(clearness[around], axis=1)
        self.good[chosen[clearness < self.options.growth.min_clearness_share * usual]] = False

    def settle(self) -> None:
        """Fit all again with windows and curvatures from each other, and drop those that the others contradict."""
        chosen = np.flatnonzero(self.good)
        if chosen.size < MIN_CORNERS:
            return
        self.drop_what_is_unclear()
        self.drop_what_disagrees()
        chosen = np.flatnonzero(self.good)
        if chosen.size:
            self.look(chosen, self.places_of_good(chosen))


def places_at(places: LocalMap, chosen: Bool[np.ndarray, " n"]) -> LocalMap:
    return LocalMap(places.pixels[chosen], places.first[chosen], places.second[chosen], places.sigma_px[chosen])


def _rows(fit: SaddleFit, chosen: Bool[np.ndarray, " n"]) -> SaddleFit:
    return SaddleFit(*(getattr(fit, name)[chosen] for name in _FIELDS))


def _put(fit: SaddleFit, rows: Int[np.ndarray, " k"], new: SaddleFit) -> None:
    """Replace some rows."""
    for name in _FIELDS:
        getattr(fit, name)[rows] = getattr(new, name)


def grow_corners(
    grey: np.ndarray, kind: CornerKind, seeds: KnownCorners, options: DetectionOptions, *, strict: bool = False
) -> Detection:
    """Every corner of a board that a photo shows, grown from known places of the board; ids are rows of `kind`.

    `grey`: (h, w) of any depth, the board seen from its front. `seeds`: at least three places, known to about a pixel.
    `strict`: each round of growth is settled before the next, which loses some blurred corners. That is for a `kind` that goes on
    beyond the end of the board, where edges of squares and margin look like poor corners.
    """
    count = len(kind.corners_m)
    none = SaddleFit(
        np.zeros((count, 2)),
        np.full(count, np.inf),
        np.zeros(count),
        np.zeros(count),
        np.ones((count, 2)),
        np.zeros(count, dtype=bool),
    )
    growth = _Growth(grey, kind, options, seeds, strict, np.zeros(count, dtype=bool), none)
    for _ in range(1 if strict else 2):
        growth.grow()
        growth.settle()
    growth.finish()
    ids = np.flatnonzero(growth.good)
    # What lies half under something else fits, but far worse than the rest.
    sigma_px = growth.fit.sigma_px[ids]
    ids = ids[sigma_px < options.growth.max_sigma_factor * np.median(sigma_px)] if len(ids) else ids
    if len(ids) < MIN_CORNERS:
        return Detection.empty()
    return Detection(ids, growth.fit.pixels[ids], growth.fit.sigma_px[ids], growth.fit.blur_px[ids])
