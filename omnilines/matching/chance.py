"""Lines that more photos show than would by chance.

Among windows, steps and slats arcs of several edges meet in lines that are not there, of four photos and more. What tells them
from true ones is that as many photos would show a line anywhere else: in each photo the line is moved across itself, and the
share of the places where an arc would show it is the chance that the photo shows a line that is not there. Photos that look where
the line is and do not show it count against it, the more the fewer arcs they have there.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models import CameraModel
from omnilines.geometry.line import PlueckerLines
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.kernels.chance import at_least, shown_and_beside
from omnilines.matching.known_lines import mean_colours
from omnilines.matching.options import MatchingOptions

SAMPLES = 33
"""Places along a line that are looked for in a photo."""


def chance_of_lines(
    arcs: ViewedArcs,
    lines: PlueckerLines,
    positions_m: Float[np.ndarray, "l 2"],
    own: Int[np.ndarray, " n"],
    cameras: Sequence[CameraModel],
    *,
    options: MatchingOptions = MatchingOptions(),
) -> Float[np.ndarray, " l"]:
    """Probability that as many photos would show each of l lines if it were not there, between 0 and 1.

    `positions_m` are the ends of each line along it, `own` is the line of every arc, -1 for none, and `cameras` has one for each
    photo. A photo shows a line where one of its own arcs lies there, or another that fits and looks like it.
    """
    if not len(lines):
        return np.zeros(0)
    direction, moment = lines.direction.numpy(), lines.moment.numpy()
    rows = np.flatnonzero(own >= 0)
    against = ((arcs.packed[rows, 3:6] - arcs.packed[rows, :3]) * direction[own[rows]]).sum(-1) < 0
    colours = mean_colours(arcs, rows, own[rows], against, len(lines))
    width_px, beside_px = shown_and_beside(
        direction,
        moment,
        positions_m,
        colours,
        own,
        arcs.packed,
        arcs.px_rad,
        arcs.colours,
        arcs.starts,
        options.chance.reach_px,
        options.explained.max_chi_square,
        options.hypotheses.min_overlap_share,
        options.likeness,
    )
    shown = ~np.isnan(width_px)
    times = shown.sum(1)
    # One arc more than there are, as wide as those that show the line: no chance is 0.
    one_px = np.nansum(width_px, 1) / np.maximum(times, 1)
    chance = np.minimum((beside_px + one_px[:, None]) / (2.0 * options.chance.reach_px + one_px[:, None]), 1.0)
    distance_m = _distances_m(lines, positions_m, arcs)
    near = distance_m <= options.chance.farther * np.where(shown, distance_m, 0.0).max(1, keepdims=True)
    could = shown | (near & (_lengths_px(lines, positions_m, arcs, cameras) >= options.chance.min_length_px))
    return at_least(chance, could, times)


def _distances_m(lines: PlueckerLines, positions_m: Float[np.ndarray, "l 2"], arcs: ViewedArcs) -> Float[np.ndarray, "l m"]:
    """From the middle of each line to each photo."""
    middle = lines.point_at(torch.as_tensor(positions_m.mean(1))).numpy()
    return np.linalg.norm(middle[:, None] - arcs.poses.centre.numpy(), axis=-1)


def _lengths_px(
    lines: PlueckerLines, positions_m: Float[np.ndarray, "l 2"], arcs: ViewedArcs, cameras: Sequence[CameraModel]
) -> Float[np.ndarray, "l m"]:
    """Length of the part of each line in the field of each photo, whether something hides it or not."""
    share = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)
    low, high = torch.as_tensor(positions_m).T[..., None]
    points = lines[:, None].point_at(low + share * (high - low))
    lengths = np.zeros((len(lines), len(cameras)))
    with torch.no_grad():
        for photo, model in enumerate(cameras):
            pixels, valid = (part.numpy() for part in model.project(arcs.poses[photo].transform(points)))
            step = np.diff(pixels, axis=1)
            if model.PERIODIC:
                step[..., 0] -= model.image_size[0] * np.round(step[..., 0] / model.image_size[0])
            inside: Bool[np.ndarray, "l k"] = valid & ((pixels >= -0.5) & (pixels <= np.array(model.image_size) - 0.5)).all(-1)
            lengths[:, photo] = np.where(inside[:, 1:] & inside[:, :-1], np.linalg.norm(step, axis=-1), 0.0).sum(1)
    return lengths
