"""Which of the lines are there by chance: told by the same photos, moved a little.

Arcs of several edges meet in lines that are not there. How many do, the photos tell: where each of them is moved a little, its
arcs fit those of others by chance alone. They are moved, not turned, as the edges of buildings are parallel and stay so: arcs of
parallel edges meet far more easily than others. What is then found went through all that the lines went through. But arcs that
show a line are not free: those of lines that more photos show than have to are left out, and what is found counts by the chance
that no other line has its arcs.

Lines of moved photos are shown by shorter arcs, and by fewer of the photos that look there. Their density over that of the
lines, at the same share shown and the same length of arcs, is the share of such lines that are there by chance: the local false
discovery rate (Efron, Large-Scale Inference, 2010), with decoys (Elias and Gygi, Nature Methods 4, 2007). The logarithm of its
odds is taken for linear in both figures.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage, optimize, special

from camera_models import CameraModel, GeometryError
from camera_models.pose import Pose
from omnilines.adjustment.scene import AdjustedScene
from omnilines.matching.match import Matched
from omnilines.pipelines.kept_lines import KeptLines, counted, photo_counts
from omnilines.pipelines.options import KeptLineOptions, SceneOptions
from omnilines.pipelines.passing_lines import passing_lines
from omnilines.pipelines.photo_arcs import FoundArcs, in_order
from omnilines.progress import ProgressCallback
from omnilines.records import ImagePoses, Lines, StageCount

MORE_BY_CHANCE = 0.25
"""Lines that are added to those found by chance, as well shown as all lines are: where none was found there may still be some."""
TURNS, SETTLED = 50, 1e-4
"""Most times that shares are found anew, and the change that ends it."""
MovedLines = Callable[[ImagePoses, Int[np.ndarray, " k"]], tuple[Matched, AdjustedScene] | None]
"""The tracks of some of the arcs in photos that stand elsewhere, and their lines; None where there are none."""


@dataclass(frozen=True)
class FoundByChance:
    """Which arcs lines have that were found by chance."""

    count: int
    """Of the lines."""
    chance_line: Int[np.ndarray, " k"]
    """Of each arc which of them it shows, -1 for none."""
    image: Int[np.ndarray, " k"]
    line: Int[np.ndarray, " k"]
    """The line that the arc shows in the photos as they stand, -1 for none."""

    @classmethod
    def of_none(cls) -> "FoundByChance":
        """Where no line was found by chance."""
        nothing = np.zeros(0, dtype=np.int64)
        return cls(0, nothing, nothing, nothing)

    def free(self, share: Float[np.ndarray, " n"]) -> Float[np.ndarray, " c"]:
        """Of each line found by chance the probability that in each of its photos an arc of it shows no other line, where such
        a share of lines like the others is there by chance."""
        member = np.flatnonzero(self.chance_line >= 0)
        photos = int(self.image.max(initial=0)) + 1
        pair, place = np.unique(self.chance_line[member] * photos + self.image[member], return_inverse=True)
        of_photo = np.zeros(len(pair))
        np.maximum.at(of_photo, place, np.append(share, 1.0)[self.line[member]])
        free = np.ones(self.count)
        np.multiply.at(free, pair // photos, of_photo)
        return free


def with_chance(
    kept: KeptLines,
    found: Sequence[FoundArcs],
    cameras: Mapping[str, CameraModel],
    moved_lines: MovedLines,
    *,
    options: SceneOptions,
    progress: ProgressCallback,
) -> KeptLines:
    """The lines with their `chance_share`, without those of which it is above `options.kept_lines.max_chance_share`.

    Raises GeometryError where all are.
    """
    progress("comparing lines with those of moved photos", 0, 0)
    lines, limits = kept.scene.lines, options.kept_lines
    length_px = np.concatenate([photo.length_px for photo in in_order(found, kept.scene.poses)])
    shown, by_chance, arcs = how_shown(lines, kept.segments.track, length_px), np.zeros((0, 2)), FoundByChance.of_none()
    left = _arcs_left(kept, options.min_views)
    of_moved = moved_lines(moved_photos(kept, limits, np.random.default_rng(options.seed)), left)
    if of_moved is not None:
        own = passing_lines(found, *of_moved, cameras, options=options, progress=progress)
        by_chance = how_shown(own.table, own.row, length_px[left])
        arcs = FoundByChance(len(own.table), own.row, kept.segments.image[left], kept.segments.track[left])
    share = settled_share(shown, by_chance, arcs.free)
    rows = np.flatnonzero(share <= limits.max_chance_share)
    if not len(rows):
        rough = "" if "poses" in options.refine else " (`refine` lines,poses mends rough ones)"
        raise GeometryError(
            f"No line was left: of {len(lines)} lines, all are likely there by chance, as photos that are moved a little show "
            f"{len(by_chance)} (`max_chance_share` {limits.max_chance_share:g}); check the poses{rough}, or give more photos."
        )
    return _some(kept, replace(lines, chance_share=share), rows, options.min_views)


def moved_photos(kept: KeptLines, limits: KeptLineOptions, rng: np.random.Generator) -> ImagePoses:
    """The photos, each moved by `min_moved_rad` to `max_moved_rad` times the median distance of the lines that it shows."""
    poses, segments = kept.scene.poses, kept.segments
    centre, member = poses.cam_from_world.centre.numpy(), np.flatnonzero(segments.track >= 0)
    middle, image = kept.scene.lines.ends_m[segments.track[member]].mean(1), segments.image[member]
    distance_m = np.linalg.norm(middle - centre[image], axis=-1)
    typical_m = np.full(len(centre), np.median(distance_m))
    showing = np.unique(image)
    typical_m[showing] = ndimage.median(distance_m, image, showing)
    way = rng.standard_normal(centre.shape)
    moved_m = typical_m * rng.uniform(limits.min_moved_rad, limits.max_moved_rad, len(centre))
    way *= (moved_m / np.linalg.norm(way, axis=-1))[:, None]
    rotation = poses.cam_from_world.rotation
    moved = Pose(rotation, -(rotation @ torch.as_tensor(centre + way)[..., None])[..., 0])
    return replace(poses, cam_from_world=moved, covariance=None, frames=None)


def how_shown(lines: Lines, line: Int[np.ndarray, " n"], length_px: Float[np.ndarray, " n"]) -> Float[np.ndarray, "l 2"]:
    """Of each line the share that photos show, and the logarithm of the median length (px) of its arcs; `line` is that of every
    arc, -1 for none."""
    assert lines.shown_share is not None
    count = np.bincount(line[line >= 0], minlength=len(lines))
    typical_px = np.full(len(lines), np.median(length_px))
    showing = np.flatnonzero(count)
    typical_px[showing] = ndimage.median(length_px, line, showing) if len(showing) else 0.0
    return np.stack([lines.shown_share, np.log(typical_px)], -1)


def settled_share(
    shown: Float[np.ndarray, "n 2"],
    by_chance: Float[np.ndarray, "c 2"],
    free: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " c"]],
) -> Float[np.ndarray, " n"]:
    """`chance_share` where each of the c lines counts by the chance that no other line has its arcs: `free` tells it, given the
    share of each of the n lines. Both are found in turn, as each decides the other."""
    share = np.ones(len(shown))
    for _ in range(TURNS):
        before, share = share, chance_share(shown, by_chance, free(share))
        if np.abs(share - before).max() < SETTLED:
            break
    return share


def chance_share(
    shown: Float[np.ndarray, "n 2"], by_chance: Float[np.ndarray, "c 2"], count: Float[np.ndarray, " c"]
) -> Float[np.ndarray, " n"]:
    """Of n lines, shown as `how_shown` tells, the share of lines like each that are there by chance.

    c lines were found by chance alone, each counts as many. The prior of both slopes, per standard deviation of the lines, is a
    standard normal.
    """
    middle, spread = shown.mean(0), shown.std(0)
    spread = np.where(spread > 0.0, spread, 1.0)

    def terms(some: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 3"]:
        """1 and both figures, in standard deviations of the lines."""
        return np.concatenate([np.ones((len(some), 1)), (some - middle) / spread], axis=1)

    x = np.concatenate([terms(shown), terms(shown), terms(by_chance)])
    chance = np.repeat([0.0, 1.0, 1.0], [len(shown), len(shown), len(by_chance)])
    weight = np.concatenate([np.ones(len(shown)), np.full(len(shown), MORE_BY_CHANCE / len(shown)), count])

    def loss(slopes: Float[np.ndarray, " 3"]) -> tuple[float, Float[np.ndarray, " 3"]]:
        """Negative logarithm of the posterior, and its gradient: one of a line and a line by chance is the latter with
        share / (1 + share)."""
        odds, prior = x @ slopes, np.append(0.0, slopes[1:])
        share = special.expit(odds)
        value = weight @ (np.log1p(share) - chance * special.log_expit(odds)) + 0.5 * prior @ prior
        return float(value), x.T @ (weight * (1.0 - share) * (share / (1.0 + share) - chance)) + prior

    slopes = optimize.minimize(loss, np.zeros(3), jac=True, method="BFGS").x
    found: Float[np.ndarray, " n"] = special.expit(terms(shown) @ slopes)
    return found


def _arcs_left(kept: KeptLines, min_views: int) -> Int[np.ndarray, " k"]:
    """The arcs that are in no line, or in one that no more photos show than have to."""
    views = np.append(kept.scene.lines.views, 0)
    return np.flatnonzero(views[kept.segments.track] <= min_views)


def _some(kept: KeptLines, lines: Lines, rows: Int[np.ndarray, " k"], min_views: int) -> KeptLines:
    """Some of the lines, and the others counted."""
    number = np.full(len(lines) + 1, -1)
    number[rows] = np.arange(len(rows))
    table = lines.rows(rows)
    segments = replace(kept.segments, track=number[kept.segments.track], tracks=table.tracks)
    *before, last = kept.stages
    dropped = counted([("nearly as many like them are found where photos are moved", len(lines) - len(rows))])
    return replace(
        kept,
        scene=replace(kept.scene, lines=table),
        segments=segments,
        stages=(*before, StageCount(last.stage, len(rows), (*last.dropped, *dropped))),
        photos=photo_counts(segments, kept.matched, min_views),
        track=kept.track[rows],
    )
