"""Photos whose arcs hardly any line explains, and what to do: their poses are wrong, or they see what no other photo does."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.known_lines import KnownLines
from omnilines.matching.options import MatchingOptions
from omnilines.matching.placing import lines_of_others, lines_of_tracks
from omnilines.matching.resection import PlacedByLines, explained_by_lines, refined_by_lines
from omnilines.matching.tracks import FIRST_VIEWS
from omnilines.pipelines.frame import SFM
from omnilines.pipelines.kept_lines import KeptLines, least_joined
from omnilines.pipelines.options import AdviceOptions, SceneOptions
from omnilines.posing.still_rig import StillRig, rig_that_stood_still
from omnilines.progress import ProgressCallback
from omnilines.records import Advice, ImagePoses, PhotoCount

MOST_LOOKED_AT = 8
"""Photos whose poses are looked into."""
NAMED = 5
"""Photos that one sentence names."""
TO_REFINE = "`refine` lines,poses"


@dataclass(frozen=True)
class BetterPose:
    """How far from the pose that a photo has another one is that explains more of its arcs."""

    turn_rad: float
    distance: float
    explained: float
    of: str | None = None
    """The photo whose pose it is, where it is that of another."""


def weak_photos(photos: Sequence[PhotoCount], hardly_explained: float) -> list[PhotoCount]:
    """Those with far fewer of their arcs in lines than others: a wrong pose explains arcs by chance only."""
    limit = hardly_explained * float(np.median([photo.share for photo in photos]))
    return [photo for photo in photos if photo.arcs and photo.share < limit]


def advice(
    scene: KeptLines, still: float, source: str, moved: Collection[str], options: SceneOptions, progress: ProgressCallback
) -> tuple[Advice, ...]:
    """The photos, and the stage, at which most arcs are lost, each with what to do; `still` is the share of arcs that stay
    where they are, `source` that of the poses, `moved` the photos of which it is said that their poses were far off.

    Where poses are held, each weak photo is tried with the poses of the other weak ones, as their names may be exchanged, and
    another pose near its own is looked for: one that explains far more says that the pose is at fault. With poses refined that
    was done before.
    """
    weak, refined = weak_photos(scene.photos, options.advice.hardly_explained), "poses" in options.refine
    names = [photo.image for photo in weak[:MOST_LOOKED_AT]]
    stays = still > options.advice.still
    if stays and source != SFM:
        return (*_still(still), *_by_chance(scene, options.advice))
    if rig := still_rig(scene.scene.poses, source, options):
        # Other photos of it would be of the same places.
        return (*_rig_stood_still(rig, scene.scene.lines.unit.sign), *_by_chance(scene, options.advice))
    carried = _carried_along(still) if stays else ()
    if not scene.matched.beyond_chance:
        # What agrees by chance tells nothing of single photos.
        return carried
    better = {} if refined else _better_poses(scene, names, options, progress)
    return (
        *carried,
        *_exchanged(weak, better),
        *_wrong_poses(scene, weak, better),
        *_apart(scene, weak, {*better, *moved}, refined),
        *_whole(scene, refined, options.min_views, options.advice),
        *_by_chance(scene, options.advice),
    )


def still_rig(poses: ImagePoses, source: str, options: SceneOptions) -> StillRig | None:
    """The rig that stood still while the photos were taken that its poses come from."""
    return rig_that_stood_still(poses, options.posing.carried.rig_still) if source == SFM else None


def _still(share: float) -> tuple[Advice, ...]:
    """A camera that stood still, while a board was moved."""
    told = (
        f"{100 * share:.0f} % of the arcs in no line stay where they are from photo to photo, while the lines move: the camera "
        "stood still."
    )
    return (Advice(told, "Only what was moved is rebuilt. Leave the board where it is, and move the camera."),)


def _rig_stood_still(rig: StillRig, sign: str) -> tuple[Advice, ...]:
    """A rig of which all instants show the same from the same places."""
    told = (
        f"The rig stood still: half of its instants are at one place, to {rounded(100 * rig.off / rig.apart)} percent of the "
        f"{rounded(rig.apart)} {sign} between its cameras. What moved is not rebuilt, and the rest is seen from the places of "
        "its cameras alone."
    )
    do = "Move the rig between instants, by more than its cameras are apart; for a board that was moved, give `poses` boards"
    do += "; of what stood still one instant tells as much: give its photos alone, with `poses` rig." if rig.cameras > 2 else "."
    found = [Advice(told, do)]
    if rig.elsewhere:
        one = len(rig.elsewhere) == 1
        where = f"The instant{'' if one else 's'} {_named(rig.elsewhere)} {'is' if one else 'are'} put elsewhere"
        why = f"what moved before the cameras, such as a board, has taken {'its pose' if one else 'their poses'} along"
        do = f"Leave {'its' if one else 'their'} photos out, unless the rig was moved."
        found.append(Advice(f"{where}: where the rig was not moved, {why}, and the lines that only these show are wrong.", do))
    return tuple(found)


def _carried_along(share: float) -> tuple[Advice, ...]:
    """Poses from all that photos show would be one where the camera stood still."""
    told = (
        f"{100 * share:.0f} % of the arcs in no line stay where they are from photo to photo, while the lines move: they go "
        "along with the camera, as a vehicle or a mount does that it sees."
    )
    return (Advice(told, "Leave out what goes along with the camera, with `mask`."),)


def _better_poses(
    scene: KeptLines, names: Sequence[str], options: SceneOptions, progress: ProgressCallback
) -> dict[str, BetterPose]:
    if not names:
        return {}
    poses, matched = scene.scene.poses, scene.matched
    arcs = matched.arcs.with_poses(poses.cam_from_world)
    known = lines_of_tracks(arcs, matched.tracks.track, len(matched.tracks))
    found = {}
    for done, name in enumerate(names):
        progress("looking into weak photos", done, len(names))
        row = poses.images.index(name)
        others = lines_of_others(known, arcs, matched.tracks, np.array([row]))
        of_others = {other: poses.cam_from_world[[poses.images.index(other)]] for other in names if other != name}
        better = _pose_of_another(arcs.of_photo(row), others, of_others, options.matching)
        if better is None:
            better = _better_pose(arcs.of_photo(row), others, options.advice.start_rad, options.matching)
        if better is not None:
            found[name] = better
    return found


def _pose_of_another(
    arcs: ViewedArcs, known: KnownLines, poses: Mapping[str, Pose], matching: MatchingOptions
) -> BetterPose | None:
    """Which of the poses of other photos explains far more of the one photo of `arcs` than its own; None where none does."""
    its, own = matching.placing, explained_by_lines(arcs, known, matching).score
    score = {name: explained_by_lines(arcs.with_poses(pose), known, matching).score for name, pose in poses.items()}
    best = max(score, key=lambda name: score[name], default=None)
    if best is None or score[best] < max(its.min_score, its.above_chance * own):
        return None
    return BetterPose(*_apart_from(poses[best], arcs.poses), score[best], best)


def _apart_from(pose: Pose, given: Pose) -> tuple[float, float]:
    """Angle (rad) and distance between two."""
    turn = (pose @ given.inverse()).log()[0, :3].norm()
    return float(turn), float((pose.centre - given.centre).norm())


def _better_pose(arcs: ViewedArcs, known: KnownLines, start_rad: float, matching: MatchingOptions) -> BetterPose | None:
    """Another pose within some degrees of that of the one photo of `arcs` that explains far more; None where there is none."""
    turns = start_rad * torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(torch.float64)
    starts = Pose.exp(torch.cat([turns, torch.zeros_like(turns)], -1)) @ Pose.stack([arcs.poses[0]] * len(turns))
    placed = [refined_by_lines(arcs.with_poses(starts[k : k + 1]), known, matching) for k in range(len(starts))]
    best: PlacedByLines | None = max((one for one in placed if one is not None), key=lambda one: one.score, default=None)
    its = matching.placing
    if best is None or best.score < max(its.min_score, its.above_chance * explained_by_lines(arcs, known, matching).score):
        return None
    return BetterPose(*_apart_from(best.pose, arcs.poses), best.score)


def _exchanged(weak: Sequence[PhotoCount], better: dict[str, BetterPose]) -> tuple[Advice, ...]:
    """The photos that have poses of each other."""
    taken = [(photo.image, better[photo.image].of) for photo in weak if photo.image in better and better[photo.image].of]
    if not taken:
        return ()
    where = _named([f"{image} where {other} is said to be" for image, other in taken])
    return (
        Advice(
            f"The lines of the other photos put {where}.", "Names are exchanged: correct those of the photos or of their poses."
        ),
    )


def _wrong_poses(scene: KeptLines, weak: Sequence[PhotoCount], better: dict[str, BetterPose]) -> tuple[Advice, ...]:
    """The photos whose poses are at fault."""
    wrong = [photo for photo in weak if photo.image in better and better[photo.image].of is None]
    if not wrong:
        return ()
    sign = scene.scene.lines.unit.sign

    def off(photo: PhotoCount) -> str:
        one = better[photo.image]
        return f"{photo.image} ({rounded(math.degrees(one.turn_rad))} degrees and {rounded(one.distance)} {sign} from its pose)"

    them = "its pose" if len(wrong) == 1 else "their poses"
    where = f"The lines of the other photos put {_named([off(p) for p in wrong])} elsewhere."
    others = "with `pose_sigma_deg` and `pose_sigma_m` the others stay as near their own as these are known"
    return (Advice(where, f"{TO_REFINE} mends {them}; {others}."),)


def _apart(scene: KeptLines, weak: Sequence[PhotoCount], told: Collection[str], refined: bool) -> tuple[Advice, ...]:
    """The photos that share hardly any line with others, and the photos that stand nearest to them."""
    apart = [photo for photo in weak if photo.image not in told]
    if not apart:
        return ()
    names = _named([f"{photo.image} ({photo.in_lines} of {photo.arcs})" for photo in apart])
    median = 100 * float(np.median([photo.share for photo in scene.photos]))
    beside = _nearest(scene, apart[0].image, {photo.image for photo in weak})
    between = f"Take photos between {apart[0].image} and {beside}" if beside else "Take more photos"
    between = more_views(scene.scene.poses, between)
    poses = "" if refined else f", or try {TO_REFINE}"
    few = (
        f"Lines explain few of the arcs of {names}; half of the photos have {median:.0f} % explained or more. They show what no "
        "others do, or their poses are far off."
    )
    return (Advice(few, f"{between}{poses}."),)


def _nearest(scene: KeptLines, image: str, weak: set[str]) -> str | None:
    """The photo nearest to one, of those that lines explain."""
    poses = scene.scene.poses
    row = poses.images.index(image)
    away = (poses.cam_from_world.centre - poses.cam_from_world.centre[row]).norm(dim=-1).tolist()
    others = [
        (distance, name)
        for distance, name, instant in zip(away, poses.images, poses.instants, strict=True)
        if name not in weak and instant != poses.instants[row]
    ]
    return min(others)[1] if others else None


def _whole(scene: KeptLines, refined: bool, min_views: int, options: AdviceOptions) -> tuple[Advice, ...]:
    """Where most arcs are lost, if lines explain few of them in most photos."""
    share = float(np.median([photo.share for photo in scene.photos]))
    if share >= options.few_explained:
        return ()
    total, matched, confirmed, enough, tracks, kept = (
        sum(getattr(photo, stage) for photo in scene.photos)
        for stage in ("arcs", "matched", "confirmed", "in_enough", "in_tracks", "in_lines")
    )
    losses = (
        (total - matched, "look like no arc of another photo that could show their line"),
        (matched - confirmed, "agree with one other photo only"),
        (confirmed - enough, f"agree with fewer than {min_views} photos"),
        (enough - tracks, "do not fit the others of their line"),
        (tracks - kept, "are of lines that were dropped (see the stages)"),
    )
    lost, why = max(losses, key=lambda loss: loss[0])
    told = f"Lines explain {100 * kept / total:.0f} % of all arcs; {100 * lost / total:.0f} % {why}."
    if scene.tolerance_px >= options.poor_tolerance_px:
        do = "Calibrate the camera again." if refined else f"{TO_REFINE} mends poses."
        return (Advice(f"{told} Poses or calibration are off by {scene.tolerance_px:g} px.", do),)
    bolted = of_one_instant(scene.scene.poses)
    # Photos that a rig takes at once cannot be joined by others between them.
    few = lost == confirmed - enough or bolted
    fewer = f", or `min_views` {min_views - 1}, with more lines by chance" if few and min_views > FIRST_VIEWS else ""
    between = "" if bolted else f"Photos between {_least_joined(scene)}, help most"
    return (Advice(told, f"{more_views(scene.scene.poses, between)}{fewer}."),)


def of_one_instant(poses: ImagePoses) -> bool:
    """Whether a rig took all photos at once: nobody can take another beside one of them."""
    return poses.frames is not None and len(set(poses.frames)) == 1


def more_views(poses: ImagePoses, otherwise: str) -> str:
    """What to do for more views of the lines: where a rig took all photos at once, photos of more instants, else as is said."""
    return "Take photos of more instants, with poses from the photos (`poses` sfm)" if of_one_instant(poses) else otherwise


def _least_joined(scene: KeptLines) -> str:
    """The two photos, or instants of a rig, that all others hang together by, or the nearest that no lines join."""
    poses = scene.scene.poses
    a, b, shared = least_joined(scene)
    which = "the instants " if poses.frames is not None and len(set(poses.instants)) > 1 else ""
    return f"{which}{a} and {b}, {f'which share {shared} lines' if shared else 'the nearest two that no lines join'}"


def _by_chance(scene: KeptLines, options: AdviceOptions) -> tuple[Advice, ...]:
    """How many lines are there by chance, if many are."""
    share = scene.scene.lines.chance_share
    if share is None or np.nansum(share) <= options.many_by_chance * len(share):
        return ()
    count = float(np.nansum(share))
    told = f"About {count:.0f} of {len(share)} lines ({100 * count / len(share):.0f} %) are there by chance."
    return (Advice(told, "Where lines have to be surely there, drop those with the largest chance_share in lines.csv."),)


def _named(items: Sequence[str]) -> str:
    more = f" and {len(items) - NAMED} more" if len(items) > NAMED else ""
    return ", ".join(items[:NAMED]) + more
