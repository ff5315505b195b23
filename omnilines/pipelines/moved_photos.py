"""Photos that refined poses put far from those given: which they are, and whose given poses they have.

The refined poses are compared with those given in the world of these, which photos that stand out do not say. Where the rows of
a table slipped by one, the poses of most photos are those given for the next ones, or for those before.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from camera_models import GeometryError
from camera_models.wording import listed, rounded
from omnilines.pipelines.options import MovedOptions
from omnilines.posing.photo_poses import align_to
from omnilines.records import Advice, ImagePoses, LengthUnit, PhotoCount

ALIGNMENTS = 4
"""Rounds in which photos that stand out are left out of what tells the world."""


def photos_far_from_given(
    given: ImagePoses, final: ImagePoses, weak: Mapping[str, PhotoCount], unit: LengthUnit, options: MovedOptions
) -> tuple[tuple[Advice, ...], frozenset[str]]:
    """What is to be said of photos that are far from their given poses, and their names; `weak` are those that lines hardly
    explain where they are now. Of a rig one photo stands for those of its instant."""
    given, final = _shared(given, final)
    if len(final) < options.least_photos:
        return (), frozenset()
    slipped = _slipped(given, final, options)
    return _singled_out(given, final, weak, unit, options) if slipped is None else ((slipped,), frozenset())


def _shared(given: ImagePoses, final: ImagePoses) -> tuple[ImagePoses, ImagePoses]:
    """The poses of photos in both, one of each instant, in the order of those given."""
    row, seen = {image: k for k, image in enumerate(final.images)}, set[str]()
    kept = []
    for k, image in enumerate(given.images):
        if image in row and (instant := final.instants[row[image]]) not in seen:
            seen.add(instant)
            kept.append(k)
    return given.rows(kept), final.rows([row[given.images[k]] for k in kept])


def _slipped(given: ImagePoses, final: ImagePoses, options: MovedOptions) -> Advice | None:
    """Where the poses of most photos are those given one row below or above, much nearer than a step from row to row, and not
    those given for them."""
    names, count = given.images, len(given)
    steps = np.median(_between(given.rows(range(1, count)), given.rows(range(count - 1))), axis=0)
    unit = np.maximum(steps, [options.least_rad, 1e-300])
    as_given = np.linalg.norm(_off(final, given, options) / unit, axis=-1)
    for rows, which in ((1, "next photo"), (-1, "photo before")):
        # Of n photos that are one row apart, n - 1 are in both.
        own = range(count - 1) if rows == 1 else range(1, count)
        there = replace(given.rows([k + rows for k in own]), images=tuple(names[k] for k in own))
        off = np.linalg.norm(_off(final.rows(own), there, options) / unit, axis=-1)
        near = off < np.minimum(as_given[list(own)], 1.0) / options.slipped_times
        if near.mean() >= options.slipped_share:
            said = (
                f"The poses that were found for {int(near.sum())} of {count} photos are those given for the {which} of the "
                f"table, as that of {names[own[0]]} is the one given for {names[own[0] + rows]}: names slipped by one row."
            )
            return Advice(said, "Correct the names in the table of poses: the scene lies as far off in its world.")
    return None


def _off(final: ImagePoses, given: ImagePoses, options: MovedOptions) -> Float[np.ndarray, "n 2"]:
    """Angle (rad) and distance between the poses of each photo, in the world of those given as most photos tell it; infinite
    where they contradict each other altogether."""
    sound = list(range(len(given)))
    for _ in range(ALIGNMENTS):
        try:
            moved, _, _ = align_to(final, given.rows(sound))
        except GeometryError:
            return np.full((len(given), 2), math.inf)
        off = _between(moved, given)
        near = np.flatnonzero((off <= options.outlying * np.median(off, axis=0)).all(-1)).tolist()
        if near == sound or len(near) < options.least_photos:
            break
        sound = near
    return off


def _between(one: ImagePoses, other: ImagePoses) -> Float[np.ndarray, "n 2"]:
    turn = (one.cam_from_world @ other.cam_from_world.inverse()).log()[:, :3].norm(dim=-1)
    return torch.stack([turn, (one.cam_from_world.centre - other.cam_from_world.centre).norm(dim=-1)], -1).numpy()


def _singled_out(
    given: ImagePoses, final: ImagePoses, weak: Mapping[str, PhotoCount], unit: LengthUnit, options: MovedOptions
) -> tuple[tuple[Advice, ...], frozenset[str]]:
    """The few photos that moved much farther than the others, and than their refined poses are known."""
    off = _off(final, given, options)
    usual = np.median(off, axis=0)
    spread = float((given.cam_from_world.centre - given.cam_from_world.centre.mean(0)).square().sum(-1).mean().sqrt())
    least = np.maximum(options.times * usual, [options.least_rad, options.least_share * spread])
    far = np.flatnonzero((np.isfinite(off) & (off > least) & (off > options.sigmas * _sigma(final))).any(-1))
    if not len(far):
        return (), frozenset()

    def told(k: int) -> str:
        name, other = given.images[k], _taken_for(k, given, final, off, options)
        amount = f"{rounded(off[k, 1])} {unit.sign} and {rounded(math.degrees(off[k, 0]))} degrees"
        if name in weak:
            return f"{name} {amount} (even there lines explain {weak[name].in_lines} of its {weak[name].arcs} arcs)"
        return f"{name} {amount}" + ("" if other is None else f" (to where {other} is said to be)")

    far = far[np.argsort(-off[far, 1], kind="stable")]
    moved = listed(told(k) for k in far.tolist())
    photos = frozenset(given.images[k] for k in far.tolist())
    typical = f"{rounded(usual[1])} {unit.sign} and {rounded(math.degrees(usual[0]))} degrees"
    said = f"Refined poses lie far from those given: {moved}, where half of the photos move by {typical} or less."
    them = "that photo: its pose, and its name in the table" if len(far) == 1 else "those photos: their poses and names"
    return (Advice(said, f"Check what was given for {them}."),), photos


def _sigma(final: ImagePoses) -> Float[np.ndarray, "n 2"]:
    """The largest standard deviations of turn and place of each photo; 0 where none are known."""
    if final.covariance is None:
        return np.zeros((len(final), 2))
    parts = [final.covariance[:, :3, :3], final.covariance[:, 3:, 3:]]
    return np.stack([np.sqrt(np.linalg.eigvalsh(np.nan_to_num(one))[:, -1].clip(min=0)) for one in parts], -1)


def _taken_for(k: int, given: ImagePoses, final: ImagePoses, off: Float[np.ndarray, "n 2"], options: MovedOptions) -> str | None:
    """The photo whose given pose is the one that was found for the photo k; None where there is none."""
    others = [j for j in range(len(given)) if j != k]
    sound = given.rows([j for j in others if off[j, 1] <= off[k, 1] / options.slipped_times])
    if len(sound) < options.least_photos - 1:
        return None
    moved, _, _ = align_to(final, sound)
    its = ImagePoses((given.images[k],) * len(others), moved.cam_from_world[[k] * len(others)])
    away = _between(its, given.rows(others))
    near = np.flatnonzero((away < off[k] / options.slipped_times).all(-1))
    return None if not len(near) else given.images[others[int(near[away[near, 1].argmin()])]]
