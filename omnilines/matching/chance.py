"""Lines that more photos show than would by chance.

Among windows, steps and slats arcs of several edges meet in lines that are not there, of four photos and more. What tells them
from true ones is that as many photos would show a line anywhere else: in each photo the line is moved across itself, and the
share of the places where an arc would show it is the chance that the photo shows a line that is not there. Short arcs beside a
long line, of which every photo shows most by one arc, are no such chance. Photos that look where the line is and do not show it
count against it, the more the fewer arcs they have there.

The same photos tell how much of a line a photo shows that looks where it is: what it is worth in a photo that had no part in it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models import CameraModel
from omnilines.geometry.line import PlueckerLines
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.asked import AskedLines
from omnilines.matching.kernels.chance import at_least, shown_and_beside
from omnilines.matching.known_lines import mean_colours
from omnilines.matching.options import MatchingOptions
from omnilines.progress import on_all_cores, silent

SAMPLES = 33
"""Places along a line that are looked for in a photo."""
PHOTOS_AT_ONCE = 10
"""That a core compares lines with."""
T = TypeVar("T")


class LineEvidence(NamedTuple):
    """What photos say of each of l lines."""

    chance: Float[np.ndarray, " l"]
    """Probability that as many photos would show it if it were not there, between 0 and 1."""
    shown_share: Float[np.ndarray, " l"]
    """Share of its length that its own arcs cover, the mean over all photos that look where it is, between 0 and 1."""


def line_evidence(
    arcs: ViewedArcs,
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    own: Int[np.ndarray, " n"],
    cameras: Sequence[CameraModel],
    *,
    neighbours: Bool[np.ndarray, "m m"] | None = None,
    options: MatchingOptions = MatchingOptions(),
) -> LineEvidence:
    """What photos say of each of l lines.

    `positions_m` are the ends of each line along it, `own` is the line of every arc, -1 for none, and `cameras` has one for each
    photo. A photo shows a line where one of its own arcs lies there, or another that fits and looks like it. Asked are the photos
    that show a line by its own arcs and their `neighbours`, all without these. They look where a line is that have
    `options.chance.min_length_px` of it in their field, hidden or not, and are not `options.chance.farther` from it.
    """
    if not len(lines):
        return LineEvidence(np.zeros(0), np.zeros(0))
    rows = np.flatnonzero(own >= 0)
    asked = AskedLines.every(arcs.images, len(lines))
    if neighbours is not None:
        asked = AskedLines.near(neighbours, arcs.image, own, len(lines))
    width_px, beside_px = _compared(arcs, lines, positions_m, own, asked, options)
    # Line by line from here on, those of each line photo by photo.
    by_line = np.argsort(asked.lines, kind="stable")
    line, photo = asked.lines[by_line], asked.photos[by_line]
    width_px, beside_px = width_px[by_line], beside_px[by_line]
    shown = ~np.isnan(width_px)
    times = np.bincount(line, shown, minlength=len(lines)).astype(np.int64)
    # One arc more than there are, as wide as those that show the line: no chance is 0.
    one_px = (np.bincount(line, np.nan_to_num(width_px), minlength=len(lines)) / np.maximum(times, 1))[line]
    chance = np.minimum((beside_px + one_px) / (2.0 * options.chance.reach_px + one_px), 1.0)
    seen_px = _lengths_px(lines, positions_m, arcs, cameras, asked)[by_line]
    near = _near(arcs, lines, positions_m, line, photo, shown, options.chance.farther)
    looks = shown | (near & (seen_px >= options.chance.min_length_px))
    covered = _covered_share(arcs, lines, positions_m, rows, own[rows])
    photos = np.bincount(line, looks, minlength=len(lines))
    return LineEvidence(at_least(chance[looks], line[looks], times), np.minimum(covered / np.maximum(photos, 1.0), 1.0))


def _compared(
    arcs: ViewedArcs,
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    own: Int[np.ndarray, " n"],
    asked: AskedLines,
    options: MatchingOptions,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """As `shown_and_beside`, of all photos."""
    direction, moment = lines.direction.numpy(), lines.moment.numpy()
    rows = np.flatnonzero(own >= 0)
    against = ((arcs.packed[rows, 3:6] - arcs.packed[rows, :3]) * direction[own[rows]]).sum(-1) < 0
    colours = mean_colours(arcs, rows, own[rows], against, len(lines))
    least_share = options.chance.as_much * _least_share(arcs, lines, positions_m, rows, own[rows])

    def compare(low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
        """The lines that the photos from `low` up to `high` are asked for."""
        starts = asked.starts[low : high + 1]
        return shown_and_beside(
            direction,
            moment,
            positions_m,
            colours,
            own,
            least_share,
            arcs.packed,
            arcs.px_rad,
            arcs.colours,
            arcs.starts[low : high + 1],
            starts - starts[0],
            asked.lines[starts[0] : starts[-1]],
            options.chance.reach_px,
            options.explained.max_chi_square,
            options.hypotheses.min_overlap_share,
            options.likeness,
        )

    compared = _by_photos(compare, arcs.images)
    width_px, beside_px = (np.concatenate(column) for column in zip(*compared, strict=True))
    return width_px, beside_px


def _near(
    arcs: ViewedArcs,
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    line: Int[np.ndarray, " k"],
    photo: Int[np.ndarray, " k"],
    shown: Bool[np.ndarray, " k"],
    farther: float,
) -> Bool[np.ndarray, " k"]:
    """Of pairs of a line and a photo, those of photos that are not so many times as far from it as the farthest that shows it."""
    middle = lines.point_at(torch.as_tensor(positions_m.mean(1))).numpy()
    distance_m = np.linalg.norm(middle[line] - arcs.poses.centre.numpy()[photo], axis=-1)
    farthest_m = np.zeros(len(lines))
    np.maximum.at(farthest_m, line[shown], distance_m[shown])
    near: Bool[np.ndarray, " k"] = distance_m <= farther * farthest_m[line]
    return near


def _covered_share(
    arcs: ViewedArcs,
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    rows: Int[np.ndarray, " m"],
    line: Int[np.ndarray, " m"],
) -> Float[np.ndarray, " l"]:
    """Share of each line that arcs of its own cover, the sum over all photos; arcs of one photo that overlap count once."""
    places, usable = arcs.positions(lines, rows, line)
    low, high = positions_m[line].T
    begin, end = np.clip((places - low[:, None]) / (high - low)[:, None], 0.0, 1.0)[usable].T
    pair = (line * arcs.images + arcs.image[rows])[usable]
    order = np.lexsort((begin, pair))
    # The lines of all photos one after another, so that what is behind an arc is behind all that begin before it.
    number = np.unique(pair[order], return_inverse=True)[1]
    first, last = 2.0 * number + begin[order], 2.0 * number + end[order]
    before = np.append(-1.0, np.maximum.accumulate(last)[:-1]) if len(last) else last
    own = np.maximum(last - np.maximum(first, before), 0.0)
    # np.bincount gives integers where there is nothing to add.
    return np.bincount(line[usable][order], own, minlength=len(lines)).astype(np.float64)


def _least_share(
    arcs: ViewedArcs,
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    rows: Int[np.ndarray, " m"],
    line: Int[np.ndarray, " m"],
) -> Float[np.ndarray, " l"]:
    """Share of each line that an arc of its own covers, in the photo of those that show it where that is least; 0 for none."""
    places, usable = arcs.positions(lines, rows, line)
    low, high = positions_m[line].T
    share = np.clip((np.minimum(places[:, 1], high) - np.maximum(places[:, 0], low)) / (high - low), 0.0, 1.0)
    pair, number = np.unique(line[usable] * arcs.images + arcs.image[rows[usable]], return_inverse=True)
    most = np.zeros(len(pair))
    np.maximum.at(most, number, share[usable])
    least = np.full(len(lines), np.inf)
    np.minimum.at(least, pair // arcs.images, most)
    return np.where(np.isfinite(least), least, 0.0)


def _lengths_px(
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    arcs: ViewedArcs,
    cameras: Sequence[CameraModel],
    asked: AskedLines,
) -> Float[np.ndarray, " k"]:
    """Length of the part of each line in the field of each photo that is asked for it, whether something hides it or not."""
    share = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)
    low, high = torch.as_tensor(positions_m).T[..., None]
    points = lines[:, None].point_at(low + share * (high - low))

    def lengths(first: int, last: int) -> Float[np.ndarray, " k"]:
        """Those of the photos from `first` up to `last`."""
        return np.concatenate([length(photo) for photo in range(first, last)])

    def length(photo: int) -> Float[np.ndarray, " k"]:
        """Those of one photo."""
        model, own = cameras[photo], torch.as_tensor(asked.lines[asked.starts[photo] : asked.starts[photo + 1]])
        with torch.no_grad():
            pixels, valid = (one.numpy() for one in model.project(arcs.poses[photo].transform(points[own])))
        step = np.diff(pixels, axis=1)
        if model.PERIODIC:
            step[..., 0] -= model.image_size[0] * np.round(step[..., 0] / model.image_size[0])
        inside: Bool[np.ndarray, "l k"] = valid & ((pixels >= -0.5) & (pixels <= np.array(model.image_size) - 0.5)).all(-1)
        found: Float[np.ndarray, " l"] = np.where(inside[:, 1:] & inside[:, :-1], np.linalg.norm(step, axis=-1), 0.0).sum(1)
        return found

    return np.concatenate(_by_photos(lengths, arcs.images))


def _by_photos(work: Callable[[int, int], T], photos: int) -> list[T]:
    """work(low, high) of PHOTOS_AT_ONCE photos after another, on all cores."""
    lows = range(0, max(photos, 1), PHOTOS_AT_ONCE)
    return on_all_cores(lambda low: work(low, min(low + PHOTOS_AT_ONCE, photos)), lows, "", silent)
