"""Corners that a detection missed, found where a camera says that they are.

1. The pose of the board is fitted to the corners that are known, the camera held (camera_models/pose_fit.py).
2. The camera predicts every missing corner that it sees, with the directions and curvatures of its edges. What the camera leaves
   of the known corners near it is smooth, and its local map (local_map.py) corrects the prediction and says how certain it is:
   a first camera is a little off where no corner has been yet.
3. The corner is fitted in the photo (saddle.py). It counts when it is a saddle of the printed sign and of the board's own
   contrast, clear of what the fit leaves (corner_kind.py), within some standard deviations of its prediction, and when the
   corners around it, found before or with it, say so too.

This is repeated until nothing is gained. So a corner that is covered, or a background that resembles one, is not returned.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from calib_patterns._pattern import Detection, Pattern, check_image
from calib_patterns.camera_map import camera_map, projected
from calib_patterns.corner_growth import MIN_CORNERS, inside_photo, places_at
from calib_patterns.corner_kind import accepted
from calib_patterns.detection import grey_of
from calib_patterns.local_map import KnownCorners, LocalMap, local_map
from calib_patterns.options import DetectionOptions
from calib_patterns.partial import BLOCK_CORNERS
from calib_patterns.saddle import SaddleFit
from camera_models._model import CameraModel
from camera_models.pose import Pose
from camera_models.pose_fit import FREEDOM, refit_pose, robust_scale_px

NEWS_PX = 0.2
"""A corner is fitted again when its prediction has moved by more than this."""
_ROUNDS = 8


@dataclass(frozen=True)
class GuidedCorners:
    """What a photo shows of a board for a given camera."""

    detection: Detection
    """The corners known before, as they were, and those gained."""
    cam_from_board: Pose
    gained: int
    fits: bool
    """Whether camera and pose agree with the corners known before or, without any, with the photo; where not, none is gained."""


def seen_ids(pattern: Pattern, model: CameraModel, cam_from_board: Pose) -> Int[np.ndarray, " k"]:
    """Corners that the camera sees inside its image from a pose, unless something covers them."""
    with torch.no_grad():
        pixels, valid = model.project(cam_from_board.transform(torch.as_tensor(pattern.points_m)))
    return np.flatnonzero(valid.numpy() & inside_photo(pixels.numpy(), model.image_size[::-1]))


def guided_search(
    image: np.ndarray,
    pattern: Pattern,
    model: CameraModel,
    cam_from_board: Pose,
    found: Detection,
    options: DetectionOptions = DetectionOptions(),
) -> GuidedCorners:
    """The corners of a board in a photo: those found before and those that the camera leads to.

    `image` as in `Pattern.detect`, of `model.image_size`. `found`: corners known before, to half a pixel or so, a few of them may
    be wrong. With four or more the pose needs to be right to about a square; fewer are not used, and the pose has to be right to
    0.25 squares. Raises InputError for an image that is none.
    """
    check_image(image)
    search = _Search(grey_of(image), pattern, model, cam_from_board, found, options)
    if search.supported and not search.consistent():
        return GuidedCorners(found, cam_from_board, 0, False)
    for _ in range(_ROUNDS):
        before = int(search.good.sum())
        search.look(0)
        search.doubt()
        if int(search.good.sum()) <= before:
            break
    for halvings in (1, 2):
        search.look(halvings)
        search.doubt()
    if not (search.supported or search.holds_alone()):
        return GuidedCorners(found, cam_from_board, 0, False)
    return GuidedCorners(search.detection(), search.pose, int((search.good & ~search.given).sum()), True)


class _Search:
    """The corners known so far, rows by id."""

    def __init__(
        self,
        grey: np.ndarray,
        pattern: Pattern,
        model: CameraModel,
        pose: Pose,
        found: Detection,
        options: DetectionOptions,
    ) -> None:
        self.grey, self.pattern, self.model, self.pose = grey, pattern, model, pose
        self.options, self.limits = options, options.guided
        self.kind, self.points_m = pattern.corner_kind(options.fit), pattern.points_m
        count = len(self.points_m)
        self.pixels, self.sigma_px, self.blur_px = np.zeros((count, 2)), np.ones(count), np.ones((count, 2))
        self.contrast, self.residual_px, self.scale_px = np.zeros(count), np.zeros((count, 2)), self.limits.start_sigma_px
        self.tried_px = np.full((count, 2), -1e6)
        self.given = np.zeros(count, dtype=bool)
        self.supported = len(found) >= MIN_CORNERS
        if self.supported:
            self.given[found.ids] = True
            self.pixels[found.ids], self.sigma_px[found.ids] = found.pixels, found.sigma_px
        self.good, self.trusted = self.given.copy(), self.given.copy()
        if self.supported:
            self._refit()
            self._measure(found)
            self.doubt()

    def _measure(self, found: Detection) -> None:
        """Contrast and blur of the corners found; a plain board may begin with either colour."""
        places, _ = self._seen(found.ids)
        kind = self.kind.at(found.ids)
        fit = kind.fit(self.grey, replace(places, pixels=found.pixels), 1.0, self.options.fit)
        self.contrast[found.ids] = fit.contrast
        self.blur_px[found.ids] = fit.blur_px if found.blur_px is None else found.blur_px
        if self.pattern.plain_grid is not None and np.median(kind.sign * fit.contrast) < 0:
            self.kind = replace(self.kind, sign=-self.kind.sign)

    def _refit(self) -> None:
        """The pose, what it leaves of the good corners, and the scale of that."""
        ids = np.flatnonzero(self.good)
        if ids.size < MIN_CORNERS:
            return
        self.pose, self.residual_px[ids] = refit_pose(self.model, self.pose, self.points_m[ids], self.pixels[ids])
        freedom, scale_px = 2 * ids.size - FREEDOM, robust_scale_px(self.residual_px[ids])
        usual = self.limits.usual_freedom
        mean = (usual * self.limits.usual_scale_px**2 + freedom * scale_px**2) / (usual + freedom)
        self.scale_px = float(np.sqrt(mean))

    def consistent(self) -> bool:
        """Whether the camera agrees with the corners that are known."""
        places, seen = self._seen(np.flatnonzero(self.good))
        spacing_px = float(np.median(places.spacing_px[seen])) if seen.any() else 0.0
        return self.scale_px <= max(self.limits.max_misfit_px, self.limits.max_misfit_spacings * spacing_px)

    def holds_alone(self) -> bool:
        """Whether a pose that no corner supported has led to so many that it must be right, and the marks say so too."""
        enough = int(self.good.sum()) >= BLOCK_CORNERS and self.consistent()
        return enough and self.pattern.marks_agree(self.grey, partial(projected, self.model, self.pose), self.options)

    def _seen(self, ids: Int[np.ndarray, " k"]) -> tuple[LocalMap, Bool[np.ndarray, " k"]]:
        """The map at some corners as the camera alone has it, and which corners it sees with their surroundings."""
        return camera_map(self.model, self.pose, self.points_m[ids], self.kind.spacing_m, self.scale_px)

    def _predicted(self, ids: Int[np.ndarray, " k"], *, leave_out: bool = False) -> tuple[LocalMap, Bool[np.ndarray, " k"]]:
        """The same, corrected by what the camera leaves of the corners that are trusted, or of the others among them. Where no
        corner was given, nothing but the camera vouches for those gained."""
        places, seen = self._seen(ids)
        rows = np.flatnonzero(self.trusted)
        if not self.supported:
            return places, seen
        sigma_px = np.hypot(self.sigma_px[rows], self.scale_px)
        left = KnownCorners(self.kind.corners_m[rows], self.residual_px[rows], sigma_px)
        correction = local_map(left, self.kind.corners_m[ids], self.kind.spacing_m, self.options.map, leave_out=leave_out)
        return replace(places, pixels=places.pixels + correction.pixels, sigma_px=correction.sigma_px), seen

    def _too_far(
        self, ids: Int[np.ndarray, " k"], places: LocalMap, pixels: Float[np.ndarray, "k 2"], sigma_px: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, " k"]:
        """Distance of corners from their predictions over what it may be."""
        usual = float(np.median(self.sigma_px[self.good])) if self.good.any() else np.inf
        spread = np.sqrt(places.sigma_px**2 + np.minimum(sigma_px, self.limits.max_sigma_factor * usual) ** 2 + self.scale_px**2)
        farthest = np.maximum(self.limits.far_squares * self.kind.at(ids).square_px(places), 1.0)
        near = self.limits.near_px + self.limits.near_sigmas * spread
        return np.linalg.norm(pixels - places.pixels, axis=1) / np.minimum(near, farthest)

    def look(self, halvings: int) -> None:
        """Fit the corners that were not given at their predictions, again where these have moved, and keep those that are
        accepted. With the window halved once or twice, since something may lie next to a corner, only the missing ones."""
        missing = np.flatnonzero(~(self.good if halvings else self.given))
        if not missing.size:
            return
        places, seen = self._predicted(missing)
        square_px = self.kind.at(missing).square_px(places)
        if halvings:
            worth_it = square_px >= 0.5 * self.options.growth.min_narrow_px * 2**halvings
        else:
            worth_it = np.linalg.norm(places.pixels - self.tried_px[missing], axis=1) > NEWS_PX
        certain = places.sigma_px < self.limits.certain_squares * square_px + self.limits.certain_px
        ahead = seen & worth_it & certain & inside_photo(places.pixels, self.grey.shape)
        if ahead.any():
            self._fit(missing[ahead], places_at(places, ahead), halvings)

    def _fit(self, ids: Int[np.ndarray, " k"], places: LocalMap, halvings: int) -> None:
        """Fit corners at their predictions; keep those that are accepted, forget the others."""
        kind = self.kind.at(ids)
        for _ in range(halvings):
            kind = kind.narrowed()
        known = self.blur_px[self.good].max(-1)
        blur_px = float(np.clip(np.median(known), 0.5, 4.0)) if known.size else 1.0
        fit = kind.fit(self.grey, places, blur_px, self.options.fit)
        usual_px = blur_px if known.size else np.inf
        taken = accepted(kind, fit, places, self._usual_contrast(fit), usual_px, self.options)
        taken &= inside_photo(fit.pixels, self.grey.shape)
        taken &= self._too_far(ids, places, fit.pixels, fit.sigma_px) < 1.0
        self.tried_px[ids], self.good[ids], self.trusted[ids] = places.pixels, taken, taken
        rows = ids[taken]
        self.pixels[rows], self.sigma_px[rows] = fit.pixels[taken], fit.sigma_px[taken]
        self.blur_px[rows], self.contrast[rows] = fit.blur_px[taken], fit.contrast[taken]
        self._refit()

    def _usual_contrast(self, fit: SaddleFit) -> float:
        """Of the known corners or, where there is none, of those that were fitted."""
        known = self.contrast[self.good] if self.good.any() else fit.contrast[fit.converged]
        return float(np.median(np.abs(known))) if known.size else 0.0

    def doubt(self) -> None:
        """Drop what was gained where the other corners say something else, the worst first. What was found before is only no
        longer predicted from: the calibration judges it."""
        ids = np.flatnonzero(self.trusted)
        while ids.size > MIN_CORNERS:
            places, _ = self._predicted(ids, leave_out=True)
            excess = self._too_far(ids, places, self.pixels[ids], self.sigma_px[ids])
            worst = int(excess.argmax())
            if excess[worst] < 1.0:
                return
            self.trusted[ids[worst]] = False
            self.good[ids[worst]] = self.given[ids[worst]]
            self._refit()
            ids = np.delete(ids, worst)

    def detection(self) -> Detection:
        """What is known."""
        ids = np.flatnonzero(self.good)
        return Detection(ids, self.pixels[ids], self.sigma_px[ids], self.blur_px[ids])
