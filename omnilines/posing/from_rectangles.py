"""Poses of photos from a sheet of known size that each of them shows and that does not move: the sheet is the world.

A blank sheet looks the same after half a turn. Of two photos, features that both show tell: with the poses right up to that turn,
b_from_a is one of two, and matched features lie in the epipolar planes of the true one only. Each pair votes; photos that strong
votes link take their turns from each other, the others are left out.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraEstimate, CameraModel, InputError
from camera_models.pose import Pose
from omnilines.posing.feature_matches import matched, pairs_to_compare
from omnilines.posing.features import Features, feature_finder
from omnilines.posing.find_rectangle import BearingArcs, FoundRectangle, find_rectangle
from omnilines.posing.options import PosingOptions, RectangleOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.rectangle import Rectangle
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Advice, ImagePoses


def poses_from_rectangles(
    photos: Sequence[str],
    read: Callable[[str], np.ndarray],
    arcs_of: Callable[[str], BearingArcs],
    cameras: Mapping[str, CameraModel],
    camera_of: Mapping[str, str],
    *,
    estimates: Mapping[str, CameraEstimate],
    rectangle: Rectangle,
    seed: int = 0,
    progress: ProgressCallback = silent,
    options: PosingOptions = PosingOptions(),
) -> PhotoPoses:
    """`cam_from_world` of the photos that show the sheet, in metres; x points to the right in the first of them.

    `read` gives the photo of a name, `arcs_of` its arcs. The covariances are those of the noise that the arcs state, times the
    variance that all sheets together show where it is more. Photos without a sheet, and those whose half turn their features do
    not tell, are left out. Raises InputError where no photo shows the sheet.
    """
    found, lost = _sheets(photos, arcs_of, rectangle, options.rectangle, progress)
    names = list(found)
    turned = np.zeros(len(names), dtype=bool)
    if len(names) > 1:
        find, features = feature_finder(options.features), []
        for done, name in enumerate(names):
            progress("telling its ends apart", done, len(names))
            camera = camera_of[name]
            features.append(find(read(name), cameras[camera], estimates.get(camera), None))
        poses = Pose.stack([found[name].pose for name in names])
        turned, known = half_turns(features, poses, rectangle, seed, options)
        for k in np.flatnonzero(~known).tolist():
            lost[names[k]] = (
                f"{names[k]} has no pose: the sheet looks the same after half a turn, and too few features that other photos "
                "show tell which way it lies; leave things lying around the sheet."
            )
        names, turned = [names[k] for k in np.flatnonzero(known)], turned[known]
    own = [found[name].pose for name in names]
    chosen = [pose @ rectangle.half_turn if turn else pose for pose, turn in zip(own, turned.tolist(), strict=True)]
    shown = float(np.mean([found[name].chi_square for name in names])) / 2.0
    table = ImagePoses(
        tuple(names),
        Pose.stack(chosen),
        tuple(camera_of[name] for name in names),
        max(1.0, shown) * np.stack([found[name].covariance for name in names]),
    )
    world = (
        "The world is the sheet: its origin is a corner, x runs along its first side, to the right in "
        f"{names[0]}, z into it. Half a turn more would fit as well."
    )
    return PhotoPoses(table, lost, (world,), advice=_doubts([found[name] for name in names], rectangle))


def _sheets(
    photos: Sequence[str],
    arcs_of: Callable[[str], BearingArcs],
    rectangle: Rectangle,
    options: RectangleOptions,
    progress: ProgressCallback,
) -> tuple[dict[str, FoundRectangle], dict[str, str]]:
    """The sheet of each photo that shows it, and why the others have none. Raises InputError where none shows it."""
    found: dict[str, FoundRectangle] = {}
    lost: dict[str, str] = {}
    for done, photo in enumerate(photos):
        progress("finding the sheet", done, len(photos))
        outcome = find_rectangle(arcs_of(photo), rectangle, options)
        if isinstance(outcome, str):
            lost[photo] = f"{photo} has no pose: {outcome}"
        else:
            found[photo] = outcome
    if not found:
        raise InputError(
            f"A sheet of {1e3 * rectangle.width_m:g} x {1e3 * rectangle.height_m:g} mm, brighter than what it lies on, was "
            f"expected in some photo, found none; {next(iter(lost.values()), 'give photos.')}"
        )
    return found, lost


def _doubts(found: Sequence[FoundRectangle], rectangle: Rectangle) -> tuple[Advice, ...]:
    """Whether something else than these may be the sheet, of another size."""
    outshone = sum(one.outshone for one in found)
    if not outshone:
        return ()
    limit = (
        f"In {outshone} of {len(found)} photos something brighter and larger than the sheet that was taken has four corners but "
        "another shape. That may be the sheet: then poses and lengths are wrong."
    )
    asked = f"{1e3 * rectangle.width_m:g} x {1e3 * rectangle.height_m:g} mm"
    return (Advice(limit, f"Measure the sheet: {asked} was given, letter paper has 279.4 x 215.9, A4 297 x 210."),)


def half_turns(
    features: Sequence[Features],
    cam_from_sheet: Pose,
    rectangle: Rectangle,
    seed: int = 0,
    options: PosingOptions = PosingOptions(),
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Which photos have to be turned by half a turn to agree with the first that is known, and which are known.

    Known are the photos of the largest group that clear votes link.
    """
    count, its = len(features), options.rectangle
    votes, doubt = np.zeros((count, count)), np.zeros((count, count))
    for i, j in pairs_to_compare(features, seed, options.matches):
        pairs, _ = matched(features[i], features[j], options.matches)
        a, b = features[i].bearings[pairs[:, 0]], features[j].bearings[pairs[:, 1]]
        j_from_i = cam_from_sheet[j] @ cam_from_sheet[i].inverse()
        other = cam_from_sheet[j] @ rectangle.half_turn @ cam_from_sheet[i].inverse()
        far = float(cam_from_sheet[i].translation.norm())
        same, turned = (_agree(a, b, pose, far, its) for pose in (j_from_i, other))
        votes[i, j] = votes[j, i] = float((same & ~turned).sum()) - float((turned & ~same).sum())
        doubt[i, j] = doubt[j, i] = math.sqrt(float((same ^ turned).sum()))
    clear = np.abs(votes) >= its.clear_sigmas * np.maximum(doubt, 1.0)
    best: tuple[list[int], np.ndarray] = ([], np.zeros(count, dtype=bool))
    left = set(range(count))
    while left:
        group, turned_of = _linked(min(left), votes, clear)
        left -= set(group)
        if len(group) > len(best[0]):
            best = group, turned_of
    known = np.zeros(count, dtype=bool)
    known[best[0]] = True
    turned_of = best[1]
    first = int(np.flatnonzero(known)[0])
    return np.where(known, turned_of ^ turned_of[first], False), known


def _linked(
    start: int, votes: Float[np.ndarray, "n n"], clear: Bool[np.ndarray, "n n"]
) -> tuple[list[int], Bool[np.ndarray, " n"]]:
    """The photos that clear votes link to one, and which of them are turned to it, along the strongest links."""
    turned, group = np.zeros(len(votes), dtype=bool), [start]
    while True:
        strength = np.where(clear[group], np.abs(votes[group]), 0.0)
        strength[:, group] = 0.0
        row, column = np.unravel_index(int(strength.argmax()), strength.shape)
        if strength[row, column] == 0.0:
            return group, turned
        turned[column] = turned[group[row]] ^ (votes[group[row], column] < 0)
        group.append(int(column))


def _agree(
    a: Float[Tensor, "m 3"], b: Float[Tensor, "m 3"], b_from_a: Pose, sheet_m: float, options: RectangleOptions
) -> Bool[Tensor, " m"]:
    """Which matched bearings lie in one epipolar plane, on one side of the baseline; the sheet is `sheet_m` away."""
    sine = math.sin(options.epipolar_rad)
    far = a @ b_from_a.rotation.mT
    baseline = b_from_a.translation
    length = float(baseline.norm())
    if length < options.min_baseline_share * sheet_m:
        return torch.linalg.cross(far, b).norm(dim=-1) < sine
    towards = (baseline / length).expand_as(far)
    normal = torch.linalg.cross(far, towards)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    side = (torch.linalg.cross(towards, normal) * b).sum(-1) * (torch.linalg.cross(towards, normal) * far).sum(-1) > 0
    return ((normal * b).sum(-1).abs() < sine) & side
