"""Photos whose segments are not of the lines that their tracks say: named, with what to do."""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import bdtr

from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.scene import AdjustedScene
from omnilines.pipelines.options import JudgeOptions
from omnilines.records import Advice
from omnilines.triangulation.by_chance import photo_standing_out
from omnilines.triangulation.observations import PlaneObservations

MOST_NAMED = 3
LOOKED_AT = 20
"""Photos with the farthest segments that are looked into, and others that they are compared with."""


def far_photos(scene: AdjustedScene, given: Pose, options: JudgeOptions, *, refined: bool, seed: int = 0) -> tuple[Advice, ...]:
    """What to do about photos whose segments lie far from their lines, where those of others do not, and about those whose
    segments hardly fit the other photos under the poses as they were `given`: least squares spread their errors over all
    photos. `refined`: whether poses were adjusted."""
    photos, far_px = _middles(scene)
    if far_px.max(initial=0.0) <= options.rough_px:
        return ()
    order = np.argsort(-far_px, kind="stable")
    rest = order[LOOKED_AT:]
    looked_at = photos[np.concatenate([order[:LOOKED_AT], rest[:: 1 + len(rest) // LOOKED_AT]])]
    strange, others = _strangers(scene.table.arcs, given, looked_at, options, seed)
    usual = float(np.median(far_px))
    far = [k for k in order if far_px[k] > max(options.rough_px, options.far_photo * usual) and photos[k] not in strange]
    found, images = [], scene.poses.images
    if strange:
        their = "its" if len(strange) == 1 else "their"
        few = _named([f"{images[k]} ({100 * share:.0f} %)" for k, share in strange.items()])
        said = (
            f"Few segments of {few} fit the lines of the other photos better than any segment there, of half of the photos at "
            f"least {100 * others:.0f} %: {their} pose or name is likely that of another photo."
        )
        found.append(Advice(said, f"Correct {their} pose or name, or leave {'it' if len(strange) == 1 else 'them'} out."))
    if far:
        named = _named([f"{images[photos[k]]} ({rounded(far_px[k])} px)" for k in far])
        said = f"Half of the segments of {named} lie so far from their lines, of other photos {rounded(usual)} px."
        found.append(Advice(said, f"Check the poses of these photos, and their names{'' if refined else ', or refine poses'}."))
    return tuple(found)


def _middles(scene: AdjustedScene) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """The photos, and how far half of the segments of each lie from their lines (px)."""
    far_px, images = np.abs(scene.residual_px).max(-1), scene.table.arcs.image.numpy()
    known = np.flatnonzero(np.isfinite(far_px))
    known = known[np.argsort(images[known], kind="stable")]
    photos, starts = np.unique(images[known], return_index=True)
    ends = np.append(starts, len(known))[1:]
    return photos, np.array([np.median(far_px[known[start:end]]) for start, end in zip(starts, ends, strict=True)])


def _strangers(
    arcs: MatchedArcs, given: Pose, photos: Int[np.ndarray, " k"], options: JudgeOptions, seed: int
) -> tuple[dict[int, float], float]:
    """Those of some photos of which far fewer tracks stand out than of the median one, and not by chance; with that share of
    their tracks, and of its."""
    planes = PlaneObservations.from_arcs(arcs.bearings, given[arcs.image], arcs.track, arcs.tracks, arcs.by_pixel)
    found = [(int(photo), photo_standing_out(planes, arcs.image, int(photo), seed)) for photo in photos]
    told = [(photo, one.standing_out, one.tracks) for photo, one in found if one.tracks]
    usual = float(np.median([count / tracks for _, count, tracks in told])) if told else 0.0
    few = {
        photo: count / tracks
        for photo, count, tracks in sorted(told)
        if options.gain * count < usual * tracks and bdtr(count, tracks, usual) <= options.sure
    }
    return few, usual


def _named(names: list[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(names[:MOST_NAMED])}{more}"
