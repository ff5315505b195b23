"""Tracks that poses and cameras hardly explain: refused, with what is wrong with them where the tracks themselves tell it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.pixel_readings import other_pixels
from omnilines.geometry.sphere import arc_normal
from omnilines.pipelines.options import JudgeOptions
from omnilines.posing.readings import Reading, other_readings, rarer_readings
from omnilines.triangulation.by_chance import StandOut, misfit, standing_out
from omnilines.triangulation.observations import PlaneObservations

SAMPLED = 60
"""Tracks that are looked at, drawn with the seed."""
LEAST_TRACKS = 3
"""Of three segments or more: fewer do not tell."""
LEAST_TO_REFUSE = 5
"""Tracks that stand out by chance as often as not where poses are rough: fewer do not tell that nothing fits."""
MOST_SEGMENTS = 8
"""Of a track, that are looked at."""
OTHERS = 10_000
"""Segments of other tracks, that random tracks are made of beside these."""
ANGLES = tuple(1.1**k for k in range(-20, 21) if k)
"""Times the angle off the axis under which another camera would see a pixel."""


@dataclass(frozen=True)
class _Sampled:
    """The tracks that are looked at."""

    arcs: MatchedArcs
    """Of these tracks, and others of the same photos."""
    rows: Int[Tensor, " m"]
    """Of `arcs`: those of the tracks."""
    track: Int[Tensor, " m"]
    """Which of the tracks each is of."""
    tracks: int
    options: JudgeOptions
    seed: int

    def misfit(self, poses: Pose) -> Float[Tensor, " k"]:
        """Of the tracks (px^2)."""
        return misfit(self.planes(poses).take(self.rows, self.track, self.tracks), self.seed)

    def stand_out(self, poses: Pose) -> StandOut:
        """Of the tracks."""
        return standing_out(self.planes(poses), self.arcs.image, self.rows, self.seed)

    def planes(self, poses: Pose) -> PlaneObservations:
        """Of all arcs."""
        own = self.arcs
        return PlaneObservations.from_arcs(own.bearings, poses[own.image], own.track, own.tracks, own.by_pixel)

    def explained(self, square: Float[Tensor, " k"], best: Float[Tensor, " k"]) -> int:
        """How many tracks fit as well as the better half does in the best case, but for their noise."""
        return int((square <= self.options.fitting * best.median()).sum())


@dataclass(frozen=True)
class Misfit:
    """How far half of the tracks lie from any line, as they were judged."""

    px: float
    rough_px: float
    """From which on it is spoken of."""

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence where tracks fit worse than segments are found."""
        if self.px <= self.rough_px:
            return ()
        return (
            f"Half of the tracks lie {rounded(self.px)} px or more from any line, far more than segments are off by: poses, "
            "calibration or tracks are rough or wrong; refine poses, or check that all are of the same photos.",
        )


def judge_tracks(
    arcs: MatchedArcs,
    given: Pose,
    cameras: Sequence[CameraModel],
    *,
    refined: tuple[MatchedArcs, Pose] | None = None,
    options: JudgeOptions = JudgeOptions(),
    seed: int = 0,
) -> Misfit | None:
    """Refuse tracks that fit no better than random ones do, and those that another reading of the tables explains far better.

    `given` are the poses as they were given, `cameras` those that `arcs.observed` numbers, `refined` the arcs and poses after an
    adjustment. Tracks of two segments, and fewer than three of them, tell nothing: None.

    Raises InputError that says which reading of poses or segments, or which camera, explains the tracks, or that nothing does.
    """
    chosen = _sample(arcs, options, seed)
    if chosen(arcs).tracks < LEAST_TRACKS:
        return None
    sampled, poses = chosen(arcs), given
    square = sampled.misfit(poses)
    enough = options.fitting_px**2
    if float(square.median()) <= enough:
        return _misfit(sampled, square, cameras) if refined is None else _misfit_of(chosen(refined[0]), refined[1], cameras)
    # An adjustment may mend poses that were read wrongly, and bend them to another camera, but in a world of its own.
    _refuse_reading(sampled, given, square, cameras)
    _refuse_camera(sampled, given, square)
    if refined is not None:
        final, end = chosen(refined[0]), refined[1]
        better = final.misfit(end)
        # One that went astray says nothing of what was given, but it is what comes out.
        if float(better.median()) < float(square.median()):
            sampled, poses, square = final, end, better
    if float(square.median()) <= enough:
        return _misfit(sampled, square, cameras)
    held = sampled.stand_out(poses)
    _refuse_camera(sampled, poses, square)
    if held.tracks >= LEAST_TO_REFUSE and held.chance > options.max_chance:
        raise InputError(
            f"The tracks fit the poses and the calibration no better than segments put together at random: {held.standing_out} "
            f"of {held.tracks} stand out, {rounded(held.tracks * held.share_by_chance)} would by chance. Segments, tracks, "
            "poses and "
            "calibration of the same photos were expected; correct what is of others."
        )
    return _misfit(sampled, square, cameras) if refined is None else _misfit_of(chosen(refined[0]), refined[1], cameras)


def _misfit_of(sampled: _Sampled, poses: Pose, cameras: Sequence[CameraModel]) -> Misfit:
    return _misfit(sampled, sampled.misfit(poses), cameras)


def _misfit(sampled: _Sampled, square: Float[Tensor, " k"], cameras: Sequence[CameraModel]) -> Misfit:
    """Beside what segments are off by, which they may state, and the size of the images."""
    return Misfit(math.sqrt(float(square.median())), limits_px(sampled.arcs, cameras, sampled.options)[0])


def limits_px(arcs: MatchedArcs, cameras: Sequence[CameraModel], options: JudgeOptions) -> tuple[float, float]:
    """Distances of half of the tracks, or segments, from which on they are spoken of, and from which on lines do not hold."""
    stated = float(arcs.covariance_px2.diagonal(dim1=-2, dim2=-1).median().sqrt()) if arcs.sigma_known else 1.0
    rough = options.rough_px * max(stated, 1.0)
    return rough, max(rough, options.rough_share * max(max(camera.image_size) for camera in cameras))


def _sample(arcs: MatchedArcs, options: JudgeOptions, seed: int) -> Callable[[MatchedArcs], _Sampled]:
    """Tracks of three segments or more, drawn with the seed, among others of the same photos; of the same arcs, or of what they
    have become."""
    generator = torch.Generator().manual_seed(seed)
    enough = torch.nonzero(torch.bincount(arcs.track, minlength=arcs.tracks) >= 3).flatten()
    some = enough[torch.randperm(len(enough), generator=generator)[:SAMPLED]]
    shuffled = torch.randperm(len(arcs), generator=generator)
    looked_at = torch.isin(arcs.track[shuffled], some)
    rows = shuffled[looked_at]
    rows = rows[_rank_of_equals(arcs.track[rows]) < MOST_SEGMENTS]
    kept = torch.cat([rows, shuffled[~looked_at][:OTHERS]])
    numbers, track = arcs.track[rows].unique(return_inverse=True)

    def chosen(own: MatchedArcs) -> _Sampled:
        return _Sampled(own.rows(kept), torch.arange(len(rows)), track, len(numbers), options, seed)

    return chosen


def _rank_of_equals(labels: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Of each element, how many of the same label stand before it."""
    order = labels.argsort(stable=True)
    count = torch.bincount(labels)
    rank = torch.empty_like(labels)
    rank[order] = torch.arange(len(labels)) - (count.cumsum(0) - count)[labels[order]]
    return rank


@dataclass(frozen=True)
class _Read:
    """The tables, read in another way."""

    says: str
    """What they seem to be."""
    remedy: str
    """What was expected, and what to do."""
    sampled: _Sampled
    poses: Pose
    sure: float
    """Probability up to which that is no chance: the more readings are tried, the smaller."""


def _refuse_reading(sampled: _Sampled, given: Pose, square: Float[Tensor, " k"], cameras: Sequence[CameraModel]) -> None:
    """Raises InputError where another reading of poses or segments explains far more than these misfits do."""
    sure, rarer = sampled.options.sure, list(rarer_readings(given))
    read = [_of_poses(sampled, one, sure) for one in other_readings(given)]
    read += _of_pixels(sampled, given, cameras)
    read += [_of_poses(sampled, one, sure / len(rarer)) for one in rarer]
    found = [one.sampled.misfit(one.poses) for one in read]
    median = [float(one.median()) for one in found]
    # Where all cameras look alike, two readings may be one: the usual mistakes come first.
    best = next(k for k, value in enumerate(median) if value <= sampled.options.gain * min(median))
    if _far_better(read[best].sampled, read[best].poses, found[best], square, read[best].sure):
        explained, as_given = (sampled.explained(own, found[best]) for own in (found[best], square))
        raise InputError(
            f"{read[best].says}: as given they explain {as_given} of {sampled.tracks} tracks, read so {explained}. "
            f"{read[best].remedy}."
        )


def _of_poses(sampled: _Sampled, reading: Reading, sure: float) -> _Read:
    remedy = f"X_cam = R X_world + t and qw,qx,qy,qz were expected; {reading.remedy}"
    return _Read(f"The poses look {reading.looks}", remedy, sampled, reading.poses, sure)


def _of_pixels(sampled: _Sampled, given: Pose, cameras: Sequence[CameraModel]) -> list[_Read]:
    """Those of the other readings of the segments in which all of them lie in their images and have a length."""
    observed, options = sampled.arcs.observed, sampled.options
    if observed is None:
        return []
    size = torch.tensor([camera.image_size for camera in cameras], dtype=torch.float64)[observed.camera]
    margin, read = options.beyond_share * size.amax(-1)[:, None, None], []
    for one in other_pixels(observed.pixels, size):
        if bool(((one.pixels >= -margin) & (one.pixels <= size[:, None] + margin)).all()):
            arcs = replace(sampled.arcs, observed=replace(observed, pixels=one.pixels)).seen_by(cameras)
            if bool((arc_normal(*arcs.bearings.unbind(1)).norm(dim=-1) > 0.5).all()):
                remedy = f"u_px to the right and v_px down from the first pixel were expected; {one.remedy}"
                read.append(_Read(f"The segments look {one.looks}", remedy, replace(sampled, arcs=arcs), given, options.sure))
    return read


def _far_better(sampled: _Sampled, poses: Pose, other: Float[Tensor, " k"], square: Float[Tensor, " k"], sure: float) -> bool:
    """Whether the misfits `other` under these poses are far better than others, and not by chance."""
    options = sampled.options
    if not bool(torch.isfinite(other.median())):
        return False
    if sampled.explained(other, other) < options.gain * sampled.explained(square, other):
        return False
    found = sampled.stand_out(poses)
    return 2 * found.standing_out >= found.tracks and found.chance <= sure


def _refuse_camera(sampled: _Sampled, poses: Pose, square: Float[Tensor, " k"]) -> None:
    """Raises InputError where a camera of other angles explains far more."""
    arcs = sampled.arcs
    widest = float(_off_axis(arcs.bearings).max())
    best = 1.0, sampled, square
    for scale in (one for one in ANGLES if one * widest < torch.pi):
        other = replace(sampled, arcs=replace(arcs, bearings=_scaled(arcs.bearings, scale), by_pixel=scale * arcs.by_pixel))
        found = other.misfit(poses)
        if float(found.median()) < float(best[2].median()):
            best = scale, other, found
    scale, other, found = best
    if _far_better(other, poses, found, square, sampled.options.sure):
        explained, as_given = (sampled.explained(own, found) for own in (found, square))
        raise InputError(
            f"The calibration looks like that of another camera: it explains {as_given} of {sampled.tracks} tracks, one that "
            f"sees under {rounded(scale)} times its angles would explain {explained}; give that of these photos."
        )


def _scaled(bearings: Float[Tensor, "n 2 3"], scale: float) -> Float[Tensor, "n 2 3"]:
    """The bearings with their angles off the axis so many times as large."""
    angle = scale * _off_axis(bearings)
    around = bearings[..., :2] / bearings[..., :2].norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.cat([around * angle.sin(), angle.cos()], -1)


def _off_axis(bearings: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 1"]:
    """The angle from the axis z."""
    return torch.atan2(bearings[..., :2].norm(dim=-1, keepdim=True), bearings[..., 2:])
