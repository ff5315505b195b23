"""From the poses that structure from motion found to those of all photos, refined: guided matches, points, adjustment, resection.

Each round matches features again along the epipolar circles of the poses known so far, finds the points, and refines poses and
points together; the circles become narrower as the poses become better. In between, photos without a pose are resected from
points that their features match.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import GeometryError
from camera_models.pose import Pose
from omnilines.posing.bearing_residual import across, bearing_residual, placed
from omnilines.posing.feature_matches import matched_near
from omnilines.posing.features import Features
from omnilines.posing.options import PosingOptions
from omnilines.posing.point_adjustment import Frames, PosesAndPoints, adjust_points
from omnilines.posing.resection import resect
from omnilines.posing.tracks import Observations, compact, triangulated_tracks
from omnilines.progress import ProgressCallback, on_all_cores, silent

PairMatches = Mapping[tuple[int, int], Int[Tensor, "_ 2"]]


@dataclass(frozen=True)
class Matches:
    """Matches of descriptors alone, for each pair of photos that was compared."""

    clear: PairMatches
    faint: PairMatches
    """These, and others that are less clear."""


MIN_FRAMES, MAX_RESECTIONS = 2, 5


@dataclass(frozen=True)
class Grown:
    """What is known of the photos."""

    frames: Frames
    rig_from_world: Pose
    """Of every frame; the identity where it is not known."""
    known: Bool[np.ndarray, " frames"]
    seen: Observations
    points: Float[Tensor, "p 3"]
    """What the poses rest on."""
    every_seen: Observations
    every_point: Float[Tensor, "q 3"]
    """These, and points of two photos that nothing else vouches for: other photos may be resected from them."""
    covariance: Float[np.ndarray, "f 6 6"] | None = None
    scale: float = 1.0
    """Standard deviation of the residuals over what keypoints were taken to have."""

    @property
    def cam_from_world(self) -> Pose:
        """Of every photo, also of those whose frame is not known."""
        return self.frames.photos(self.rig_from_world)

    @property
    def photo_known(self) -> Bool[np.ndarray, " photos"]:
        """Whether a photo has a pose."""
        answer: Bool[np.ndarray, " photos"] = self.known[self.frames.of_photo.numpy()]
        return answer


def start_from(frames: Frames, poses: Mapping[int, Pose]) -> Grown:
    """The frames whose photos have a pose; of several photos of one frame the first counts."""
    count = int(frames.of_photo.max()) + 1
    placed, known = [Pose.identity() for _ in range(count)], np.zeros(count, dtype=bool)
    for photo, pose in poses.items():
        frame = int(frames.of_photo[photo])
        if not known[frame]:
            placed[frame], known[frame] = frames.cam_from_rig[photo].inverse() @ pose, True
    nothing = torch.zeros(0, dtype=torch.long)
    none = Observations(nothing, nothing, nothing, torch.zeros(0, 3).double(), torch.zeros(0, 2, 3).double())
    empty = torch.zeros(0, 3, dtype=torch.float64)
    return Grown(frames, Pose.stack(placed), known, none, empty, none, empty)


def grow(
    start: Grown,
    features: Sequence[Features],
    matches: Matches,
    *,
    seed: int,
    progress: ProgressCallback = silent,
    options: PosingOptions = PosingOptions(),
) -> Grown:
    """Poses refined over all rounds, photos without one resected where their features allow it.

    Raises GeometryError where no points are left.
    """
    grown, tolerances = start, options.growth.tolerances_sigmas
    for number, tolerance in enumerate(tolerances):
        words = f"matching again and refining poses, round {number + 1} of {len(tolerances)}"
        refine = partial(
            matched_again, features=features, matches=matches, limit=tolerance, stage=words, progress=progress, options=options
        )
        grown = refine(grown)
        if number < len(tolerances) - 1:
            grown = refine(_checked(_Points(grown, features, matches, options), seed, progress))
            for _ in range(MAX_RESECTIONS):
                more = _resected(_Points(grown, features, matches, options), seed, progress)
                if int(more.known.sum()) == int(grown.known.sum()):
                    break
                grown = refine(more)
    return grown


def matched_again(
    grown: Grown,
    features: Sequence[Features],
    matches: Matches,
    limit: float,
    stage: str,
    progress: ProgressCallback = silent,
    options: PosingOptions = PosingOptions(),
) -> Grown:
    """New guided matches, up to a limit in standard deviations of a keypoint, points from them, and two adjustments: with all,
    and without what does not fit.

    Raises GeometryError where no points are left.
    """
    tolerance_rad = limit * _typical_sigma(features)
    poses, known = grown.cam_from_world, grown.photo_known

    def near(pair: tuple[int, int]) -> Int[Tensor, "_ 2"]:
        i, j = pair
        return matched_near(features[i], features[j], poses[j] @ poses[i].inverse(), tolerance_rad, options.matches)

    pairs = [(i, j) for i, j in matches.clear if known[i] and known[j]]
    guided = dict(zip(pairs, on_all_cores(near, pairs, stage, progress), strict=True))
    parallax = options.growth.min_parallax_rad
    seen, points = triangulated_tracks(features, guided, poses, limit, parallax)
    plain = _keys(features, matches.faint)
    seen, points = _vouched(seen, points, features, plain)
    if not len(points):
        raise GeometryError("Points seen in several photos were expected, found none; give photos that overlap more.")
    first = adjust_points(seen, grown.frames, PosesAndPoints(grown.rig_from_world, points), options.resection)
    good = first.residual < options.resection.gross_sigmas * max(first.scale, 1.0)
    seen, points = compact(seen.chosen(torch.nonzero(good).flatten()), first.state.points)
    seen, points = _vouched(seen, points, features, plain)
    final = first
    if len(points):
        final = adjust_points(seen, grown.frames, replace(first.state, points=points), options.resection)
    moved = replace(grown, rig_from_world=final.state.rig_from_world)
    every_seen, every_point = triangulated_tracks(features, guided, moved.cam_from_world, limit, parallax)
    return replace(
        moved,
        points=final.state.points,
        seen=seen,
        every_point=every_point,
        every_seen=every_seen,
        covariance=final.covariance,
        scale=final.scale,
    )


def _typical_sigma(features: Sequence[Features]) -> float:
    every = torch.cat([f.sigma_rad for f in features])
    return float(every.median()) if len(every) else 1e-3


def _keys(features: Sequence[Features], matches: PairMatches) -> Int[Tensor, " k"]:
    """One number for each match, the same whichever photo comes first."""
    sizes = [len(f) for f in features]
    start, total = np.cumsum([0, *sizes]), sum(sizes)
    keys = [(pair[:, 0] + int(start[i])) * total + pair[:, 1] + int(start[j]) for (i, j), pair in matches.items()]
    return torch.cat([torch.zeros(0, dtype=torch.long), *keys])


def _vouched(
    seen: Observations, points: Float[Tensor, "p 3"], features: Sequence[Features], plain: Int[Tensor, " k"]
) -> tuple[Observations, Float[Tensor, "q 3"]]:
    """Points of three photos or more, and of two only those whose descriptors matched without guidance: a chance match on an
    epipolar circle always has a point, which would hold the poses where they are."""
    order = torch.argsort(seen.point * len(features) + seen.photo, stable=True)
    seen = seen.chosen(order)
    count = torch.bincount(seen.point, minlength=len(points))
    sizes = [len(f) for f in features]
    start = torch.cumsum(torch.tensor([0, *sizes[:-1]]), 0)
    at = start[seen.photo] + seen.feature
    first = torch.cumsum(count, 0) - count
    two = torch.nonzero(count == 2).flatten()
    sure = count >= 3
    sure[two] = torch.isin(at[first[two]] * sum(sizes) + at[first[two] + 1], plain)
    return compact(seen.chosen(torch.nonzero(sure[seen.point]).flatten()), points)


def _resected(points: "_Points", seed: int, tell: ProgressCallback) -> Grown:
    """Frames without a pose placed by the photo of theirs that most points agree on."""
    grown = points.grown
    poses, known = list(grown.rig_from_world[k] for k in range(len(grown.known))), grown.known.copy()
    lost = np.flatnonzero(~grown.known).tolist()
    for done, frame in enumerate(lost):
        tell("placing photos by points", done, len(lost))
        found = points.resected(frame, seed)
        if found is not None:
            poses[frame], known[frame] = found[1], True
    return replace(grown, rig_from_world=Pose.stack(poses), known=known)


def _checked(points: "_Points", seed: int, tell: ProgressCallback) -> Grown:
    """Every frame resected from points that the others know: placed anew where clearly more of them then agree, and left without
    a pose where too few agree with any. A photo that was joined by a few chance matches does not stay."""
    grown, its = points.grown, points.options.growth
    poses, known = list(grown.rig_from_world[k] for k in range(len(grown.known))), grown.known.copy()
    placed_frames = np.flatnonzero(grown.known).tolist()
    for done, frame in enumerate(placed_frames):
        tell("checking poses", done, len(placed_frames))
        agree = points.agreeing(frame)
        found = points.resected(frame, seed)
        if found is not None and found[0] > its.clearly_more * agree:
            poses[frame] = found[1]
        elif found is None and agree < its.min_resected:
            known[frame] = False
    if int(known.sum()) < MIN_FRAMES:
        return grown
    return replace(grown, rig_from_world=Pose.stack(poses), known=known)


class _Points:
    """Points for the resection of photos: which of them each feature's matches lead to."""

    def __init__(self, grown: Grown, features: Sequence[Features], matches: Matches, options: PosingOptions) -> None:
        self.grown, self.features, self.matches, self.options = grown, features, matches.clear, options
        self.sigmas = options.growth.resection_sigmas * max(grown.scale, 1.0)
        self.point_of = [torch.full((len(f),), -1) for f in features]
        for photo in torch.unique(grown.every_seen.photo).tolist():
            mine = grown.every_seen.photo == photo
            self.point_of[photo][grown.every_seen.feature[mine]] = grown.every_seen.point[mine]

    def _photos(self, frame: int) -> list[int]:
        return torch.nonzero(self.grown.frames.of_photo == frame).flatten().tolist()

    def _candidates(self, photo: int) -> Int[Tensor, "k 2"]:
        """(feature of the photo, point) that its matches with photos of other frames lead to; two other frames know the point."""
        frame = self.grown.frames.of_photo
        found = [torch.zeros(0, 2, dtype=torch.long)]
        for (i, j), pair in self.matches.items():
            if photo in (i, j) and frame[i] != frame[j]:
                own, other = (0, 1) if photo == i else (1, 0)
                point = self.point_of[j if photo == i else i][pair[:, other]]
                found.append(torch.stack([pair[point >= 0, own], point[point >= 0]], 1))
        pairs = torch.unique(torch.cat(found), dim=0)
        elsewhere = frame[self.grown.every_seen.photo] != frame[photo]
        known = torch.bincount(self.grown.every_seen.point[elsewhere], minlength=len(self.grown.every_point))
        return pairs[known[pairs[:, 1]] >= 2]

    def agreeing(self, frame: int) -> int:
        """Most points that agree with the pose a frame has, over its photos."""
        best, poses = 0, self.grown.cam_from_world
        for photo in self._photos(frame):
            pairs, own = self._candidates(photo), self.features[photo]
            bearings, sigma = own.bearings[pairs[:, 0]], self.sigmas * own.sigma_rad[pairs[:, 0]]
            seen = placed(poses[[photo] * len(pairs)], self.grown.every_point[pairs[:, 1]])
            residual, _ = bearing_residual(bearings, across(bearings) / sigma[:, None, None], seen)
            best = max(best, int((residual.norm(dim=-1) < self.options.resection.inlier_sigmas).sum()))
        return best

    def resected(self, frame: int, seed: int) -> tuple[int, Pose] | None:
        """Points that agree and rig_from_world, by the best of a frame's photos; None where they are too few."""
        best: tuple[int, Pose] | None = None
        its = self.options.growth
        for photo in self._photos(frame):
            pairs, own = self._candidates(photo), self.features[photo]
            if len(pairs) < its.min_resected:
                continue
            sigma = (self.sigmas * own.sigma_rad[pairs[:, 0]]).numpy()
            least = max(its.min_resected, int(its.min_resected_share * len(pairs)))
            seen, points = own.bearings[pairs[:, 0]].numpy(), self.grown.every_point[pairs[:, 1]].numpy()
            try:
                found = resect(seen, points, sigma, min_inliers=least, seed=seed, options=self.options.resection)
            except GeometryError:
                continue
            count = int(found.inliers.sum())
            if best is None or count > best[0]:
                best = (count, self.grown.frames.cam_from_rig[photo].inverse() @ found.pose)
        return best
