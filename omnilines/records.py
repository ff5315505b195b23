"""The frozen tables and results that the stages hand to each other. Arrays are NumPy; nothing here computes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models.errors import InputError
from camera_models.pose import Pose
from camera_models.typed import Typed

LARGEST_M = 1e9
"""Of a coordinate in a file; those of the Earth and its orbits are within it."""


def _require(holds: bool | np.bool_, what: str, expected: str, found: object) -> None:
    """Raises InputError where a table is none."""
    if not holds:
        raise InputError(f"{what} was expected to be {expected}, found {found}; correct it.")


def _require_index(index: Int[np.ndarray, " n"], low: int, count: int, what: str) -> None:
    """Raises InputError where a row names something beyond a list of so many."""
    wrong = index[(index < low) | (index >= count)]
    _require(not len(wrong), what, f"from {low} to {count - 1}, as many as are named", wrong[:1])


def _require_finite(values: Float[np.ndarray, "n *more"], what: str) -> None:
    bad = ~np.isfinite(values)
    _require(not bad.any(), what, "finite numbers", f"{values[bad][:1]} in row {np.argwhere(bad)[:1, 0]}")


def _require_sigmas(sigma_px: Float[np.ndarray, " n"] | None, what: str) -> None:
    if sigma_px is not None:
        _require((np.isfinite(sigma_px) & (sigma_px > 0)).all(), what, "standard deviations above 0", sigma_px.min(initial=0.0))


@dataclass(frozen=True)
class Corners(Typed):
    """Observed target corners, one row each; a view is one board pose at one instant in one photo. Raises InputError where
    columns are of different length, of other kinds than stated, or hold numbers that are not finite."""

    view: Int[np.ndarray, " n"]
    """Index of each row's view into `images` and `view_names`."""
    view_names: tuple[str, ...]
    images: tuple[str, ...]
    """POSIX path of each view's photo relative to the photo folder."""
    board_m: Float[np.ndarray, "n 3"]
    pixels: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, " n"] | None = None
    """Standard deviation of each corner where the detector states one."""
    ids: Int[np.ndarray, " n"] | None = None
    """Position of each corner in its pattern where known."""
    cameras: tuple[str, ...] | None = None
    """Camera of each view; None where there is one camera."""
    frames: tuple[str, ...] | None = None
    """Instant of each view of a rig."""
    boards: tuple[str, ...] | None = None
    """Board of each view; None where there is one board."""
    times_s: Float[np.ndarray, " v"] | None = None
    """When each view was taken, by the clock of its camera."""

    def __post_init__(self) -> None:
        """Refuse what is no table."""
        super().__post_init__()
        views = len(self.view_names)
        _require_index(self.view, 0, views, "`view` of Corners")
        for name in ("images", "cameras", "frames", "boards", "times_s"):
            values = getattr(self, name)
            count = views if values is None else len(values)
            _require(count == views, f"`{name}` of Corners", f"of {views} views", count)
        for name in ("board_m", "pixels") + (("times_s",) if self.times_s is not None else ()):
            _require_finite(getattr(self, name), f"`{name}` of Corners")
        _require_sigmas(self.sigma_px, "`sigma_px` of Corners")

    def __repr__(self) -> str:
        return f"Corners(corners={len(self)}, views={len(self.view_names)})"

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True)
class ViewResult:
    """What became of one view in a calibration."""

    name: str
    image: str
    used: bool
    reason: str | None
    """Why it was not used, one sentence; None when it was."""
    corners_used: int = 0
    corners_rejected: int = 0
    rms_px_per_point: float | None = None
    cam_from_board: Pose | None = None
    camera: str = "cam0"
    leverage: float | None = None
    """Share of the camera's parameters that this view decides: the shares of all views add up to 1."""
    remarks: tuple[str, ...] = ()
    """What a person should know of a view that is used all the same, one sentence each."""
    frame: str | None = None
    """Instant of a view of a rig."""


@dataclass(frozen=True)
class Detail:
    """What a person should know of one photo; the command line tells of many of a kind together."""

    photo: str
    text: str
    """The whole sentence, which begins with the name."""

    @staticmethod
    def of(photo: str, reason: str) -> "Detail":
        """From what is to be said behind the name of a photo."""
        return Detail(photo, f"{photo}: {reason}")


@dataclass(frozen=True)
class Segments(Typed):
    """Observed image segments (chords of arcs), one row each. Raises InputError where columns are of different length, of other
    kinds than stated, or hold numbers that are not finite, or covariances that are none."""

    image: Int[np.ndarray, " n"]
    """Index of each row's photo into `images`."""
    images: tuple[str, ...]
    track: Int[np.ndarray, " n"]
    """Index of each row's track into `tracks`; -1 where not matched."""
    tracks: tuple[str, ...]
    endpoints_px: Float[np.ndarray, "n 2 2"]
    """(row, end, (u, v))."""
    sigma_px: Float[np.ndarray, " n"] | None = None
    covariance_px2: Float[np.ndarray, "n 2 2 2"] | None = None
    """2x2 covariance of each end point where given."""
    cameras: tuple[str, ...] | None = None
    """Camera of each photo where the file names it."""

    def __post_init__(self) -> None:
        """Refuse what is no table."""
        super().__post_init__()
        _require_index(self.image, 0, len(self.images), "`image` of Segments")
        _require_index(self.track, -1, len(self.tracks), "`track` of Segments")
        count, named = len(self.images), len(self.images if self.cameras is None else self.cameras)
        _require(named == count, "`cameras` of Segments", f"of {count} photos", named)
        _require_finite(self.endpoints_px, "`endpoints_px` of Segments")
        _require_sigmas(self.sigma_px, "`sigma_px` of Segments")
        if self.covariance_px2 is not None:
            suu, suv, svu, svv = np.moveaxis(self.covariance_px2.reshape(-1, 4), 1, 0)
            one = (suu > 0) & (svv > 0) & (np.abs(suv) <= np.sqrt(suu * svv) * (1 + 1e-9)) & np.isclose(suv, svu)
            wrong = self.covariance_px2[~one.reshape(-1, 2).all(1)][:1]
            _require(one.all(), "`covariance_px2` of Segments", "symmetric, with variances above 0", wrong.tolist())

    def __repr__(self) -> str:
        return f"Segments(segments={len(self)}, images={len(self.images)}, tracks={len(self.tracks)})"

    def __len__(self) -> int:
        return len(self.image)

    def rows(self, chosen: Int[np.ndarray, " k"]) -> "Segments":
        """Some of them, in any order."""
        sigma = None if self.sigma_px is None else self.sigma_px[chosen]
        covariance = None if self.covariance_px2 is None else self.covariance_px2[chosen]
        table = (self.image[chosen], self.images, self.track[chosen], self.tracks, self.endpoints_px[chosen])
        return Segments(*table, sigma, covariance, self.cameras)


@dataclass(frozen=True)
class ImagePoses(Typed):
    """`cam_from_world` of photos. Raises InputError where there is not a pose of each, or one is none."""

    images: tuple[str, ...]
    cam_from_world: Pose
    cameras: tuple[str, ...] | None = None
    covariance: Float[np.ndarray, "n 6 6"] | None = None
    """Of the left perturbation (rotation_rad, translation_m) of each pose, in the frame that they were adjusted in
    (`adjustment/datum.py`); NaN where nothing tells how well a pose is known."""
    frames: tuple[str, ...] | None = None
    """Instant of each photo of a rig."""

    def __post_init__(self) -> None:
        """Refuse what is no table."""
        super().__post_init__()
        self.cam_from_world.require_rigid()
        shape = tuple(self.cam_from_world.translation.shape)
        _require(shape == (len(self), 3), "`cam_from_world` of ImagePoses", f"poses of {len(self)} photos", shape)
        for name in ("cameras", "frames"):
            values = getattr(self, name)
            count = len(self if values is None else values)
            _require(count == len(self), f"`{name}` of ImagePoses", f"of {len(self)} photos", count)

    @property
    def instants(self) -> tuple[str, ...]:
        """Of each photo that which moves as one with it: the instant of a rig, else the photo itself."""
        return self.images if self.frames is None else self.frames

    def rows(self, rows: Sequence[int]) -> "ImagePoses":
        """Some of the photos."""
        index = list(rows)
        cameras, frames = (None if one is None else tuple(one[k] for k in index) for one in (self.cameras, self.frames))
        covariance = None if self.covariance is None else self.covariance[index]
        return ImagePoses(tuple(self.images[k] for k in index), self.cam_from_world[index], cameras, covariance, frames)

    def __repr__(self) -> str:
        return f"ImagePoses(images={len(self)})"

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class PosePoints(Typed):
    """Points of known place that the pose of a photo was found from. Raises InputError where there is not a pixel of each."""

    points_m: Float[np.ndarray, "k 3"]
    pixels: Float[np.ndarray, "k 2"]

    def __post_init__(self) -> None:
        """Refuse what is no table."""
        super().__post_init__()
        _require(len(self.pixels) == len(self.points_m), "`pixels` of PosePoints", f"of {len(self.points_m)}", len(self.pixels))


LINE_STATUSES = (
    "ok",
    "weak",
    "two_views",
    "parallel_planes",
    "epipolar",
    "through_centre",
    "behind",
    "at_infinity",
    "too_few_views",
    "inconsistent",
    "unsupported",
)
"""Every status a line can have; the end points are known for `ok` and `weak` only. `two_views` is read but not written: a line of
two views is `weak` and keeps its end points (`triangulation.result.Triangulation.two_views` names it)."""


class LengthUnit(Enum):
    """What lengths are in: as a sign, a thousandth of it, and in words."""

    METRES = ("m", "mm", "metres")
    OPEN = ("units", "1e-3 units", "units whose length in metres is not known")

    @property
    def sign(self) -> str:
        """As it stands behind a number."""
        return self.value[0]

    @property
    def thousandth(self) -> str:
        """A thousandth of it, as it stands behind a number."""
        return self.value[1]

    @property
    def words(self) -> str:
        """As it stands in a sentence, or in the comment of a file."""
        return self.value[2]


@dataclass(frozen=True)
class Lines(Typed):
    """3D lines, one row per track. Raises InputError where columns are of different length or of other kinds than stated."""

    tracks: tuple[str, ...]
    ends_m: Float[np.ndarray, "n 2 3"]
    """(track, end, xyz); NaN where the status is neither `ok` nor `weak`."""
    views: Int[np.ndarray, " n"]
    rms_px: Float[np.ndarray, " n"]
    """Of the orthogonal distances of both observed end points over all views; NaN where there is no line."""
    sigma_m: Float[np.ndarray, " n"]
    """Largest standard deviation of either end in any one direction across the line; NaN where there is no line. It is that of
    one coordinate: `geometry.line.end_radius_sigmas` says how far the ends may be."""
    status: tuple[str, ...]
    covariance: Float[np.ndarray, "n 4 4"] | None = None
    """In the line chart (right perturbation of S, 3; phi, 1)."""
    chart_centre_m: Float[np.ndarray, "n 3"] | None = None
    chart_scale_m: Float[np.ndarray, " n"] | None = None
    unit: LengthUnit = LengthUnit.METRES
    """Of all lengths; where the scale is open, names in `_m` hold units too."""
    shown_share: Float[np.ndarray, " n"] | None = None
    """Share of each line that its arcs cover, the mean over all photos that look where it is, hidden or not; None where segments
    were matched by others."""
    chance_share: Float[np.ndarray, " n"] | None = None
    """Share of lines like each that are there by chance, as far as moved photos tell; NaN where a corner or a plane confirms a
    line, None where segments were matched by others."""
    calibration_sigma_m: Float[np.ndarray, " n"] | None = None
    """What of `sigma_m` is for errors of the calibration, as its file states them: lines have these in common. None where the
    file states none, or the cameras were refined."""

    def __repr__(self) -> str:
        return f"Lines(lines={int(self.known.sum())} of {len(self)}, unit={self.unit.sign!r})"

    def __len__(self) -> int:
        return len(self.tracks)

    def rows(self, chosen: Int[np.ndarray, " k"]) -> "Lines":
        """Some of them, in any order."""
        arrays = {column.name: getattr(self, column.name) for column in fields(self)}
        kept = {name: values[chosen] for name, values in arrays.items() if isinstance(values, np.ndarray)}
        tracks, status = (tuple(names[k] for k in chosen.tolist()) for names in (self.tracks, self.status))
        return replace(self, tracks=tracks, status=status, **kept)

    @property
    def known(self) -> Bool[np.ndarray, " n"]:
        """Rows that hold a line."""
        return np.array([s in ("ok", "weak") for s in self.status], dtype=bool)


@dataclass(frozen=True)
class Check:
    """One figure compared with its limit."""

    name: str
    value: float
    limit: float
    unit: str
    holds: bool


@dataclass(frozen=True)
class Polyline:
    """A curve of pixels to be drawn over a photo."""

    image: str
    pixels: Float[np.ndarray, "k 2"]
    label: str = ""
    kind: str = "model"
    """`model` for what the estimate predicts, `observed` for what was seen."""


@dataclass(frozen=True)
class Advice:
    """Something that limits a result, as it was measured, and what to do about it; a sentence each."""

    limit: str
    do: str


@dataclass(frozen=True)
class Summary:
    """Named figures for a report or a table on standard output: (name, text) rows under a title."""

    title: str
    rows: tuple[tuple[str, str], ...]
    notes: tuple[str, ...] = field(default=())
    of_photos: bool = False
    """Whether there is a row for each photo, which a terminal shows the first of."""
    verdict: str = ""
    """What it comes to, in one sentence: how good the result is."""
    advice: tuple[Advice, ...] = ()
    """What limits it, the gravest first."""


@dataclass(frozen=True)
class StageCount:
    """What a stage of a pipeline kept and dropped."""

    stage: str
    kept: int
    dropped: tuple[tuple[str, int], ...] = ()
    """(reason, number)."""


@dataclass(frozen=True)
class PhotoCount:
    """How many of the arcs of one photo came through each stage of matching."""

    image: str
    arcs: int
    matched: int
    """An arc of another photo could show its line, and looks like it."""
    confirmed: int
    """A third photo agrees."""
    in_enough: int
    """As many photos agree as have to see a line."""
    in_tracks: int
    in_lines: int

    @property
    def share(self) -> float:
        """Of the arcs, those that lines explain."""
        return self.in_lines / max(self.arcs, 1)
