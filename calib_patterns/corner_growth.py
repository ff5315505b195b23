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
from calib_patterns.corner_kind import MIN_CLEARNESS, CornerKind, accepted
from calib_patterns.local_map import LEAST_SIGMA_PX, KnownCorners, LocalMap, disagreement, local_map
from calib_patterns.saddle import SETTLED_GRID_PX, SETTLED_PX, SaddleFit

MAX_PREDICTION_SIGMA = 0.25
"""Corners are looked for where the map is this certain, in squares."""
MAX_GUESS_SIGMA, MAX_GUESS_STEP, ALIKE = 1.0, 0.25, 1.4
"""Where nothing certain is left, less certain predictions are tried too, in squares; corners found there have to be nearer to
them and as contrasted and clear as the others, within this factor."""
MIN_NARROW_PX = 8.0
"""Squares that are at least this wide are also tried with half the window."""
MORE, MUCH_MORE = 1.2, 1.5
"""Fits that leave these many times what others do have something in their window that is not of the corner: of the same corner
without the insides of its squares (0.95 to 1.05 where these are of one colour), and of other corners or half the window."""
AS_CLEAR = 0.25
"""Contrast over what its fit leaves, as a share of what that is among the corners around it: beyond the end of a board a blurred
edge fits like a poor corner."""
AROUND = 9
"""Corners nearest to one on the board, itself included."""
MOST_SIGMA = 10.0
"""A corner whose standard deviation is so many times the usual one is covered in part."""
SETTLED_SHARE = 0.04
"""A fit has settled when a step is shorter than this share of the usual standard deviation of corners."""
MIN_CORNERS = 4
_MAX_ROUNDS, _MAX_FINISHES = 30, 3
_FIELDS = ("pixels", "sigma_px", "contrast", "residual", "blur_px", "converged")


def _inside(pixels: Float[np.ndarray, "n 2"], shape: tuple[int, ...]) -> Bool[np.ndarray, " n"]:
    """Corners in the photo, with a few pixels on either side."""
    return np.all((pixels >= 1.0) & (pixels <= np.array(shape[1::-1]) - 2.0), axis=1)


@dataclass
class _Growth:
    """Corners accepted so far."""

    grey: np.ndarray
    kind: CornerKind
    seeds: KnownCorners
    strict: bool
    """See `grow_corners`."""
    good: Bool[np.ndarray, " n"]
    fit: SaddleFit

    @property
    def corners(self) -> KnownCorners:
        """The accepted ones."""
        return KnownCorners(
            self.kind.corners_m[self.good], self.fit.pixels[self.good], np.maximum(self.fit.sigma_px[self.good], LEAST_SIGMA_PX)
        )

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

    def known(self) -> KnownCorners:
        """Corners and tags."""
        return self.corners.joined(self.seeds)

    def look(self, chosen: Int[np.ndarray, " k"], places: LocalMap, *, narrow: bool = False) -> None:
        """Fit corners at their predictions; keep those that are accepted, forget the others."""
        kind = self.kind.at(chosen).narrowed() if narrow else self.kind.at(chosen)
        fit = kind.fit(self.grey, places, self.blur_px, self.settled_px)
        _put(self.fit, chosen, fit)
        contrast = max(self.contrast, float(np.median(np.abs(fit.contrast[fit.converged]))) if fit.converged.any() else 0.0)
        usual_px = self.blur_px if self.good.any() else np.inf
        self.good[chosen] = accepted(kind, fit, places, contrast, usual_px) & _inside(fit.pixels, self.grey.shape)

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
        before = int(self.good.sum())
        missing = np.flatnonzero(~self.good)
        places = local_map(known, self.kind.corners_m[missing], self.kind.spacing_m)
        square_px, inside = self.kind.square_px(places), _inside(places.pixels, self.grey.shape)
        certain = inside & (places.sigma_px < MAX_PREDICTION_SIGMA * square_px + 0.7)
        if certain.any():
            self.look(missing[certain], _at(places, certain))
        if int(self.good.sum()) == before:
            guessed = inside & ~certain & (places.sigma_px < MAX_GUESS_SIGMA * square_px + 0.7)
            if guessed.any():
                self.guess(missing[guessed], _at(places, guessed))
        return int(self.good.sum()) > before

    def guess(self, chosen: Int[np.ndarray, " k"], places: LocalMap) -> None:
        """Fit corners at uncertain predictions; keep those that are near them all the same and look just like the others."""
        kind = self.kind.at(chosen)
        fit = kind.fit(self.grey, places, self.blur_px, self.settled_px)
        strength, contrast = kind.sign * fit.contrast, self.contrast
        alike = (strength > contrast / ALIKE) & (strength < contrast * ALIKE) & (strength > ALIKE * MIN_CLEARNESS * fit.residual)
        near = np.linalg.norm(fit.pixels - places.pixels, axis=1) < MAX_GUESS_STEP * kind.square_px(places)
        good = accepted(kind, fit, places, contrast, self.blur_px) & alike & near & _inside(fit.pixels, self.grey.shape)
        _put(self.fit, chosen[good], _rows(fit, good))
        self.good[chosen[good]] = True

    def look_closely(self) -> None:
        """Try what is missing with half the window, until nothing is gained: something may lie next to a corner. The neighbours
        must agree."""
        before = -1
        while before < int(self.good.sum()) < len(self.good) and self.good.any():
            before, missing = int(self.good.sum()), np.flatnonzero(~self.good)
            places = local_map(self.known(), self.kind.corners_m[missing], self.kind.spacing_m)
            square_px, inside = self.kind.square_px(places), _inside(places.pixels, self.grey.shape)
            ahead = inside & (square_px >= MIN_NARROW_PX) & (places.sigma_px < 0.1 * square_px + 0.5)
            if ahead.any():
                self.look(missing[ahead], _at(places, ahead), narrow=True)
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
        chosen = np.flatnonzero(self.good)
        if not chosen.size:
            return
        places = local_map(self.known(), self.kind.corners_m[chosen], self.kind.spacing_m)
        self.take_if_clearer(self.kind.at(chosen).along_edges(), chosen, places, MORE)
        much = self.fit.residual[chosen] > MUCH_MORE * np.median(self.fit.residual[chosen])
        much &= self.kind.square_px(places) >= MIN_NARROW_PX
        if much.any():
            self.take_if_clearer(self.kind.at(chosen[much]).narrowed(), chosen[much], _at(places, much), MUCH_MORE)

    def take_if_clearer(self, kind: CornerKind, chosen: Int[np.ndarray, " k"], places: LocalMap, more: float) -> None:
        """Fit the chosen corners with the windows of another kind, and keep what leaves less than before by the factor `more`."""
        fit = kind.fit(self.grey, places, self.blur_px, self.settled_px)
        better = accepted(kind, fit, places, self.contrast, self.blur_px) & (self.fit.residual[chosen] > more * fit.residual)
        _put(self.fit, chosen[better], _rows(fit, better))

    def drop_what_disagrees(self) -> None:
        """Forget the corners that the others contradict, the worst first: those that it drags along agree once it is gone."""
        while self.good.sum() >= MIN_CORNERS:
            over = disagreement(self.corners, self.kind.spacing_m)
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
        self.good[chosen[clearness < AS_CLEAR * np.median(clearness[around], axis=1)]] = False

    def settle(self) -> None:
        """Fit all again with windows and curvatures from each other, and drop those that the others contradict."""
        chosen = np.flatnonzero(self.good)
        if chosen.size < MIN_CORNERS:
            return
        self.drop_what_is_unclear()
        self.drop_what_disagrees()
        chosen = np.flatnonzero(self.good)
        if chosen.size:
            self.look(chosen, local_map(self.known(), self.kind.corners_m[chosen], self.kind.spacing_m))


def _at(places: LocalMap, chosen: Bool[np.ndarray, " n"]) -> LocalMap:
    return LocalMap(places.pixels[chosen], places.first[chosen], places.second[chosen], places.sigma_px[chosen])


def _rows(fit: SaddleFit, chosen: Bool[np.ndarray, " n"]) -> SaddleFit:
    return SaddleFit(*(getattr(fit, name)[chosen] for name in _FIELDS))


def _put(fit: SaddleFit, rows: Int[np.ndarray, " k"], new: SaddleFit) -> None:
    """Replace some rows."""
    for name in _FIELDS:
        getattr(fit, name)[rows] = getattr(new, name)


def grow_corners(grey: np.ndarray, kind: CornerKind, seeds: KnownCorners, *, strict: bool = False) -> Detection:
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
    growth = _Growth(grey, kind, seeds, strict, np.zeros(count, dtype=bool), none)
    for _ in range(1 if strict else 2):
        growth.grow()
        growth.settle()
    growth.finish()
    ids = np.flatnonzero(growth.good)
    # What lies half under something else fits, but far worse than the rest.
    ids = ids[growth.fit.sigma_px[ids] < MOST_SIGMA * np.median(growth.fit.sigma_px[ids])] if len(ids) else ids
    if len(ids) < MIN_CORNERS:
        return Detection.empty()
    return Detection(ids, growth.fit.pixels[ids], growth.fit.sigma_px[ids], growth.fit.blur_px[ids])
