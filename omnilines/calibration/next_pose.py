"""What limits a calibration, and which pose of the board, in the next photo, would lower the uncertainty of its projection most.

With C = F F' the covariance of the parameters and S_v / s^2 what a view v with corners of standard deviation s tells of them, its
pose eliminated (`calibration.held_out`), the covariance with that view is F (I + F' S_v F / s^2)^-1 F'. Of many poses that a
person could hold the one is taken whose largest standard deviation of the projection, anywhere in the image, is least; then the
next one, with that view counted in.
"""

import itertools
import math
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models.pose import Pose
from omnilines.calibration.image_field import SEARCH_STEPS, ImageField, KnownProjection
from omnilines.calibration.pose_candidates import Candidates, SeenBoards, candidates, view_information
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.shooting_words import fall_words, limits_of, place_words, pose_words, px_words, sigma_words
from omnilines.calibration.thresholds import ShootingThresholds
from omnilines.calibration.uncertainty import as_stated_px, most_stated_px
from omnilines.records import Corners

TEN = 10
"""Photos more of any kind, with which the best pose is compared in words."""


@dataclass(frozen=True)
class NextPose:
    """A pose of the board for the next photo."""

    words: str
    """Where and how to hold the board."""
    cam_from_board: Pose
    tilt_deg: float
    """Between the board's normal and the ray to its middle."""
    distance_m: float
    """From the camera to the middle of the board."""
    place_px: tuple[float, float]
    """Of the middle of the board in the image."""
    worst_px: float
    """Largest standard deviation of the projection expected once this photo, and those proposed before it, have been shot."""
    median_px: float


@dataclass(frozen=True)
class NextViews:
    """What limits a calibration, and what to shoot next."""

    worst_px: float
    """Largest standard deviation of the projection over all that the image shows, in its worst direction."""
    median_px: float
    worst_at_px: tuple[float, float]
    worst_where: str
    image: str
    """What these are of, in words: the image, or the part of it that is taken for it where no photo shows where it ends."""
    corner_sigma_px: float
    view_sigma_px: float
    """With which corners of one more view count: more than that of a corner where photos contradict each other."""
    limits: tuple[str, ...]
    """What limits the calibration, the gravest first, one sentence each."""
    noisy: bool
    """Whether the last of them is the noise of the corners, which poses of the board do not lower."""
    poses: tuple[NextPose, ...]
    """Each for when those before it have been shot; none where no pose helps."""
    conclusion: str
    """Whether it is good enough, or what more photos of any kind would do: one sentence."""
    board_m: Float[np.ndarray, "n 3"]
    """Corners of the board that the poses are of."""
    known: KnownProjection = dataclass_field(repr=False)
    """The projection all over the image, for views that come in between."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """What to do, one sentence for each pose."""
        expected = [self.worst_px, *(pose.worst_px for pose in self.poses)]
        falls = [fall_words(now, then, self.most_px) for now, then in itertools.pairwise(expected)]
        return tuple(f"hold the board {pose.words}: {falls_by}" for pose, falls_by in zip(self.poses, falls, strict=True))

    @property
    def most_px(self) -> float:
        """Above it a standard deviation of the projection is stated as not known."""
        return most_stated_px(self.known.field.model)

    @property
    def stated_worst_px(self) -> float:
        """`worst_px` for people: infinite where it is stated as not known."""
        return as_stated_px(self.worst_px, self.most_px)

    @property
    def worst_words(self) -> str:
        """The largest standard deviation of the projection."""
        return sigma_words(self.worst_px, self.most_px)

    @property
    def median_words(self) -> str:
        """The median one."""
        return sigma_words(self.median_px, self.most_px)


def next_views(
    fit: CameraCalibration,
    corners: Corners,
    *,
    rim_px: float | None = None,
    rim_seen: bool = True,
    board_m: Float[np.ndarray, "n 3"] | None = None,
    thresholds: ShootingThresholds = ShootingThresholds(),
) -> NextViews | None:
    """Of a calibration and the corners that it was fitted to; None where nothing of the camera was estimated.

    `rim_px` is the distance from the centre pixel to the rim of the lens or mirror as photos show it, None where they show the
    world up to the image's border; without `rim_seen` it is assumed, and the words say so. `board_m` are the
    corners of the whole board, by default those that the table has.
    """
    if not fit.covariance.any():
        return None
    low, high = math.radians(fit.min_angle_deg), math.radians(fit.max_angle_deg)
    pixels = torch.as_tensor(corners.pixels[fit.kept])
    field = ImageField(fit.model, rim_px, low)
    known = KnownProjection.of(field, torch.as_tensor(fit.covariance), low, high)
    board = _board_of(corners, fit.kept) if board_m is None else board_m
    used = [v for v, view in enumerate(fit.views) if view.cam_from_board is not None]
    poses = Pose.stack([pose for view in fit.views if (pose := view.cam_from_board) is not None])
    place = np.full(len(fit.views), -1)
    place[used] = np.arange(len(used))
    seen = SeenBoards.of(torch.as_tensor(board), poses, torch.as_tensor(place[corners.view[fit.kept]]), pixels)
    view_sigma_px = fit.corner_sigma_px * fit.beyond_noise
    coarse = KnownProjection.of(field, torch.as_tensor(fit.covariance), low, high, SEARCH_STEPS)
    proposed = _best_in_turn(coarse, known, seen, view_sigma_px, thresholds)
    sigma = known.sigma_px
    worst = known.pixels[int(sigma.argmax())]
    where = place_words(field, worst)
    assumed = not rim_seen and rim_px is not None and rim_px < fit.model.image_radius_px
    image = f"the image within {rim_px:.0f} px of its centre (no photo shows where it ends)" if assumed else "the image"
    return NextViews(
        worst_px=float(sigma.max()),
        median_px=float(sigma.median()),
        worst_at_px=(float(worst[0]), float(worst[1])),
        worst_where=where,
        image=image,
        corner_sigma_px=fit.corner_sigma_px,
        view_sigma_px=view_sigma_px,
        limits=limits_of(field, pixels, poses, seen, fit.corner_sigma_px, thresholds),
        noisy=fit.corner_sigma_px > thresholds.noisy_px,
        poses=proposed,
        conclusion=_known_words(known, image, where, fit.corner_sigma_px) + _more_words(len(used), bool(proposed), thresholds),
        board_m=board,
        known=known,
    )


def _board_of(corners: Corners, kept: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "m 3"]:
    """The corners of the table, of several boards those of the board that was seen most."""
    rows = kept
    if corners.boards is not None:
        names, board = np.unique(corners.boards, return_inverse=True)
        seen = board[corners.view]
        rows = kept & (seen == np.bincount(seen[kept], minlength=len(names)).argmax())
    return np.unique(corners.board_m[rows], axis=0)


def _best_in_turn(
    known: KnownProjection, stated: KnownProjection, seen: SeenBoards, view_sigma_px: float, thresholds: ShootingThresholds
) -> tuple[NextPose, ...]:
    """The pose that helps most, then the one that helps most with it, and so on, as long as they help. Many are compared at few
    places of the image (`known`); what is `stated` of those that are taken is of as many as all figures of the camera are."""
    tried = candidates(known.field, seen, thresholds)
    found: list[NextPose] = []
    if not len(tried):
        return ()
    of_parameters = view_information(known.field, tried.poses, seen.board_m) / view_sigma_px**2
    information = known.factor.mT @ of_parameters @ known.factor
    before = float(stated.sigma_px.max())
    left = torch.ones(len(tried), dtype=torch.bool)
    while len(found) < thresholds.poses and bool(left.any()):
        after = known.sigma_after_px(information)
        best = int(torch.where(left, after.amax(-1), torch.inf).argmin())
        stated, _ = stated.with_view(information[best])
        worst = float(stated.sigma_px.max())
        if worst > (1 - thresholds.least_gain) * before:
            break
        found.append(_described(known.field, seen, tried, best, (worst, float(stated.sigma_px.median()))))
        apart = (tried.places_px - tried.places_px[best]).norm(dim=-1)
        left &= apart >= thresholds.apart_share * max(known.field.model.image_size)
        known, change = known.with_view(information[best])
        information = change @ information @ change.mT
        before = worst
    return tuple(found)


def _described(field: ImageField, seen: SeenBoards, tried: Candidates, best: int, sigmas_px: tuple[float, float]) -> NextPose:
    pose = tried.poses[best]
    u, v = tried.places_px[best].tolist()
    return NextPose(
        words=pose_words(field, seen.board_m, tried, best),
        cam_from_board=pose,
        tilt_deg=float(tried.tilt_deg[best]),
        distance_m=float(pose.transform(seen.board_m.mean(0, keepdim=True)).norm()),
        place_px=(u, v),
        worst_px=sigmas_px[0],
        median_px=sigmas_px[1],
    )


def _known_words(known: KnownProjection, image: str, worst_where: str, corner_sigma_px: float) -> str:
    """How well the projection is known."""
    worst_px, median_px = float(known.sigma_px.max()), float(known.sigma_px.median())
    worst, median, corner = (px_words(value) for value in (worst_px, median_px, corner_sigma_px))
    most_px = most_stated_px(known.field.model)
    if worst_px <= corner_sigma_px:
        said = f"It is good enough for most uses: the projection is known to {worst} px or better all over {image}"
    elif worst_px <= most_px:
        said = f"The projection is known to {median} px in the median of {image} and to {worst} px at worst"
    elif median_px <= most_px:
        said = f"The projection is known to {median} px in the median of {image}, but not {worst_where}"
    else:
        said = f"The projection is not known in most of {image}"
    return f"{said}, a single corner to {corner} px"


def _more_words(views: int, helps: bool, thresholds: ShootingThresholds) -> str:
    """What more photos of any kind would do."""
    more = f"{100 * (1 - math.sqrt(views / (views + TEN))):.0f} percent"
    if helps:
        return f"; {TEN} more photos like these would lower the uncertainty by about {more}."
    least = f"{100 * thresholds.least_gain:.0f} percent"
    return f"; no pose lowers the uncertainty by more than {least}, {TEN} more photos of any kind by about {more}."
