"""Poses under which the arcs of photos hardly agree: refused, where poses or photos read in another way explain the arcs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from camera_models import Calibration, GeometryError, InputError
from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.slack import Evidence, evidence_of_poses
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs, viewed_arcs
from omnilines.pipelines.photo_readings import (
    PhotoReading,
    finer_angles,
    other_cameras,
    slipped_calibrations,
    steps_of_angles,
    turned_photos,
)
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.readings import Reading, other_readings, rarer_readings
from omnilines.progress import ProgressCallback
from omnilines.records import Advice, ImagePoses

READ = ("table", "colmap", "tool")
"""Sources of poses whose numbers may be of another convention."""
EXPECTED = "X_cam = R X_world + t and qw,qx,qy,qz were expected"
SLIPPED_PHOTOS = 6
"""Three in each half: poses of two agree with any arcs."""
AXES_KINDS = 2
"""Ways to write poses that are tried with any axes: as they are, and inverted."""


def refuse_reading(
    found: Sequence[FoundArcs], posed: PhotoPoses, cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> None:
    """Raises InputError where lines stand out clearly under another reading of the poses or of the photos, and hardly as given.

    Few photos with few arcs may agree under poses that are none of theirs: the reading has to stand out from all others.
    """
    if not _may_be_read(posed):
        return
    try:
        _refuse_usual(found, posed, cameras, options, progress)
        asked = _Asked(found, posed, cameras, options, progress)
        told = asked.photos() or asked.cameras_of_photos() or asked.axes()
    except GeometryError:
        return
    if told is not None:
        raise InputError(f"{told.limit} {told.do}")


def doubted_photos(
    found: Sequence[FoundArcs],
    posed: PhotoPoses,
    cameras: Calibration,
    share: float,
    options: SceneOptions,
    progress: ProgressCallback,
) -> tuple[Advice, ...]:
    """What tells that the photos are of another camera, where lines explain no more than this share of their arcs."""
    if share >= options.advice.few_explained or not _may_be_read(posed) or "intrinsics" in options.refine:
        return ()
    try:
        told = _Asked(found, posed, cameras, options, progress).cameras_of_photos()
    except GeometryError:
        return ()
    return () if told is None else (told,)


def _may_be_read(posed: PhotoPoses) -> bool:
    return posed.source in READ and posed.poses.frames is None


def _refuse_usual(
    found: Sequence[FoundArcs], posed: PhotoPoses, cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> None:
    """Raises InputError where one of the usual readings of poses, or of photos, explains what agrees by chance only as given."""

    def evidence(some: Sequence[FoundArcs], cam_from_world: Pose, seed: int) -> Evidence:
        poses = replace(posed.poses, cam_from_world=cam_from_world, covariance=None)
        return evidence_of_poses(viewed_arcs(some, poses, cameras), seed, options.matching)

    given = posed.poses.cam_from_world
    as_given = evidence(found, given, options.seed)
    if as_given.beyond_chance:
        return
    readings = [(found, one.poses, f"poses look {one.looks}", f"{EXPECTED}; {one.remedy}") for one in other_readings(given)]
    # What is right of photos that are flipped may agree by chance with poses that are read wrongly.
    readings += [(one.found, given, f"photos look {one.looks}", one.remedy.capitalize()) for one in turned_photos(found, cameras)]
    sigmas = []
    for done, (some, cam_from_world, _, _) in enumerate(readings):
        progress("reading the poses in other ways", done, len(readings))
        sigmas.append(evidence(some, cam_from_world, options.seed).sigmas)
    best = max(range(len(readings)), key=lambda k: sigmas[k])
    rival = max([as_given.sigmas, *(other for k, other in enumerate(sigmas) if k != best)])
    least = max(options.matching.tolerance.chance_sigmas, options.judge.stands_out * rival)
    some, cam_from_world, looks, remedy = readings[best]
    # Other arcs, and another chance, have to say the same.
    if sigmas[best] > least and evidence(some, cam_from_world, options.seed + 1).sigmas > least:
        raise InputError(f"The {looks}: as given the lines of the photos agree by chance only, read so they stand out. {remedy}.")
    _refuse_slipped(found, posed.poses, cameras, options)


def _refuse_slipped(found: Sequence[FoundArcs], given: ImagePoses, cameras: Calibration, options: SceneOptions) -> None:
    """Raises InputError where the poses of neighbours in the table explain what agrees by chance only as given.

    Of poses in any other order some are those of neighbours by chance: both halves of the photos have to say so.
    """
    count = len(given)
    for step in (1, -1):
        order = np.roll(np.arange(count), -step)
        slipped = replace(given, cam_from_world=given.cam_from_world[order], covariance=None)
        parts = (slipped, slipped.rows(range(count // 2)), slipped.rows(range(count // 2, count)))
        told = (evidence_of_poses(viewed_arcs(found, part, cameras), options.seed, options.matching) for part in parts)
        if count >= SLIPPED_PHOTOS and all(one.beyond_chance for one in told):
            raise InputError(
                f"The poses look slipped by one row: {given.images[1]} has that of {given.images[1 - step]}, and so on: "
                "as given the lines of the photos agree by chance only, read so they stand out. Write each beside its own photo."
            )


@dataclass(frozen=True)
class _Asked:
    """Photos with the poses given, asked what else they may be.

    All is asked under the largest slack alone, since other readings are near the truth at best: a camera of 5 percent of another
    focal length. How far lines stand out there falls to a tenth within ten percent of it.
    """

    found: Sequence[FoundArcs]
    posed: PhotoPoses
    cameras: Calibration
    options: SceneOptions
    progress: ProgressCallback

    def photos(self) -> Advice | None:
        """Flipped or turned photos, and slips of their calibration."""
        return self._read([*turned_photos(self.found, self.cameras), *slipped_calibrations(self.found, self.cameras)])

    def cameras_of_photos(self) -> Advice | None:
        """Those of another camera: about which, and then nearer to it."""
        if not any(model.calibration_basis().shape[1] for model in self.cameras.values()):
            return None
        angles, gain = steps_of_angles(), []
        for done, angle in enumerate(angles):
            self.progress("trying other cameras", done, len(angles))
            readings = other_cameras(self.found, self.cameras, [angle])
            gain.append(max(self._asked(self._arcs(one.found, one.cameras), self.options.seed).gain for one in readings))
        best = angles[max(range(len(angles)), key=lambda k: gain[k])]
        return self._read(list(other_cameras(self.found, self.cameras, finer_angles(best))), alike=True)

    def axes(self) -> Advice | None:
        """Poses of cameras with other axes."""
        given = self.posed.poses.cam_from_world
        arcs, readings = self._arcs(self.found, self.cameras), list(rarer_readings(given, AXES_KINDS))

        def asked(one: Reading) -> Callable[[int], Evidence]:
            return lambda seed: self._asked(arcs.with_poses(one.poses), seed)

        best = self._best(map(asked, readings))
        if best is None:
            return None
        return Advice(f"The poses look {readings[best[0]].looks}: {best[1]} {EXPECTED};", f"{readings[best[0]].remedy}.")

    def _read(self, readings: Sequence[PhotoReading], *, alike: bool = False) -> Advice | None:
        def asked(one: PhotoReading) -> Callable[[int], Evidence]:
            arcs = self._arcs(one.found, one.cameras)
            return lambda seed: self._asked(arcs, seed)

        best = self._best(map(asked, readings), alike=alike)
        if best is None:
            return None
        remedy = readings[best[0]].remedy
        return Advice(f"The photos look {readings[best[0]].looks}: {best[1]}", f"{remedy.capitalize()}.")

    def _best(self, asked: Iterable[Callable[[int], Evidence]], *, alike: bool = False) -> tuple[int, str] | None:
        """Which of several readings stands out from what is given and, where they are not alike, from all others, and a sentence
        of how far; None where none does."""
        judge, sure, seed = self.options.judge, self.options.matching.tolerance.chance_sigmas, self.options.seed
        asked, given = list(asked), self._arcs(self.found, self.cameras)
        every = []
        for done, one in enumerate(asked):
            self.progress("reading poses and photos in other ways", done, len(asked))
            every.append(one(seed))
        best = max(range(len(every)), key=lambda k: every[k].gain)
        others = [] if alike else [one.gain for k, one in enumerate(every) if k != best]
        # Other arcs, and another chance, have to say the same.
        for found, as_given in ((every[best], self._asked(given, seed)), (asked[best](seed + 1), self._asked(given, seed + 1))):
            if found.sigmas <= sure or found.gain <= judge.stands_out * max([as_given.gain, *others]):
                return None
        if not as_given.beyond_chance:
            return best, "as given the lines of the photos agree by chance only, read so they stand out."
        times = rounded(found.gain / as_given.gain)
        return best, f"read so the lines of the photos stand out {times} times as far as they do as given."

    def _arcs(self, found: Sequence[FoundArcs], cameras: Calibration) -> ViewedArcs:
        return viewed_arcs(found, self.posed.poses, cameras)

    def _asked(self, arcs: ViewedArcs, seed: int) -> Evidence:
        matching = self.options.matching
        slack = matching.tolerance._replace(tried_px=matching.tolerance.tried_px[-1:])
        return evidence_of_poses(arcs, seed, replace(matching, tolerance=slack))
