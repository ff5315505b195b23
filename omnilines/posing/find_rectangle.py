"""A bright sheet of known size among the arcs of one photo: four arcs that close, each with its brighter side inside.

Arcs are turned so that the brighter side is that of their normal V1 x V2; round a sheet they then follow one another clockwise,
and the next one turns towards the normal of the last. Cycles of four in this order are quadrilaterals, whatever the lens; those
that a rectangle of the known sides fits are kept. Of those about as bright as the brightest, the largest is the sheet; of two as
large none is taken.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models.pose import Pose
from omnilines.posing.options import RectangleOptions
from omnilines.posing.rectangle import Rectangle, corner_distances, pose_of_corners, pose_of_sides


@dataclass(frozen=True)
class BearingArcs:
    """Arcs of one photo."""

    ends: Float[np.ndarray, "n 2 3"]
    """Unit bearings, camera frame."""
    noise: Float[np.ndarray, "n 2 3 3"]
    """Covariance of each, rad^2."""
    colours: Float[np.ndarray, "n 2 3"]
    """Logarithms of the colours on the side of V1 x V2 and on the other."""


@dataclass(frozen=True)
class FoundRectangle:
    """The sheet in one photo, right up to half a turn about its middle."""

    pose: Pose
    """cam_from_sheet; the x axis points to the right."""
    covariance: Float[np.ndarray, "6 6"]
    """For the stated noise of the arcs."""
    chi_square: float
    """Of two degrees of freedom."""
    corners: Float[np.ndarray, "4 3"]
    """Unit bearings of (0, 0), (width, 0), (width, height), (0, height)."""
    outshone: bool
    """Whether other four edges close round something larger and brighter, of another shape."""
    misfit: float
    """Distance of the arc ends from the sides, RMS, over the mean angle of a side."""


@dataclass(frozen=True)
class _Fits:
    """What fits, one row each."""

    pose: Pose
    covariance: Float[np.ndarray, "n 6 6"]
    chi_square: Float[np.ndarray, " n"]
    misfit: Float[np.ndarray, " n"]
    corners: Float[np.ndarray, "n 4 3"]
    inside: Float[np.ndarray, " n"]
    """Logarithm of the grey level inside, along the darkest side."""
    unsure: bool
    """Whether others fit, but are too small or too oblique."""


def find_rectangle(
    arcs: BearingArcs, rectangle: Rectangle, options: RectangleOptions = RectangleOptions()
) -> FoundRectangle | str:
    """The sheet, or one sentence why there is none."""
    ends, noise, inside = _turned(arcs, options)
    cycle = np.array(_cycles(_successors(ends, options)), dtype=np.int64).reshape(-1, 4)
    if not len(cycle):
        return "four edges that close round something brighter than its surroundings were expected, found none."
    cycle, corners = _closed(ends, cycle, options.min_covered_share)
    fits = _fitted(ends, noise, inside, cycle, rectangle, options)
    if not len(fits.misfit) and fits.unsure:
        return "a larger or less oblique sheet was expected, found one whose distance is uncertain by over 1 percent; go nearer."
    if not len(fits.misfit):
        return (
            f"a sheet of {1e3 * rectangle.width_m:g} x {1e3 * rectangle.height_m:g} mm was expected, found {len(cycle)} bright "
            "quadrilaterals and none of that shape; check the size, and that all four corners are in the photo."
        )
    size, bright = _mean_side(fits.corners), fits.inside >= fits.inside.max() - options.as_bright
    largest = int(np.where(bright, size, 0.0).argmax())
    turned = np.stack([np.roll(fits.corners, k, 1) for k in range(4)])
    off = np.linalg.norm(turned - fits.corners[largest], axis=-1).max(-1).min(0)
    same = off <= options.same_share * size[largest]
    if (bright & ~same & (size >= options.as_large * size[largest])).any():
        return (
            "one sheet of that shape was expected, found others that are as bright and as large; take away what looks like it, "
            "or give the corners in a table."
        )
    alike = np.flatnonzero(same)
    right = alike[(fits.pose.rotation[alike, 0, 0] > 0).numpy()]
    best = int(right[fits.misfit[right].argmin()]) if len(right) else int(alike[fits.misfit[alike].argmin()])
    brighter = inside[cycle].min(-1) > fits.inside[best] + options.min_contrast
    outshone = bool((brighter & (_mean_side(corners) > size[best])).any())
    chi_square, misfit = float(fits.chi_square[best]), float(fits.misfit[best])
    return FoundRectangle(fits.pose[best], fits.covariance[best], chi_square, fits.corners[best], outshone, misfit)


def _turned(
    arcs: BearingArcs, options: RectangleOptions
) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 3 3"], Float[np.ndarray, " n"]]:
    """The arcs of enough contrast with their brighter side towards V1 x V2, the longest, and the logarithm of its grey level."""
    grey = arcs.colours.mean(-1)
    step = grey[:, 0] - grey[:, 1]
    length = np.linalg.norm(arcs.ends[:, 1] - arcs.ends[:, 0], axis=-1)
    kept = np.flatnonzero(np.abs(step) >= options.min_contrast)
    kept = kept[np.argsort(-length[kept], kind="stable")][: options.max_arcs]
    flipped = (step[kept] < 0)[:, None]
    ends, noise = arcs.ends[kept], arcs.noise[kept]
    ends = np.where(flipped[..., None], ends[:, ::-1], ends)
    noise = np.where(flipped[..., None, None], noise[:, ::-1], noise)
    return ends, noise, grey[kept].max(-1)


def _normals(ends: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 3"]:
    normal = np.cross(ends[:, 0], ends[:, 1])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _corner(before: Float[np.ndarray, "*n 3"], after: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*k 3"]:
    """Where one circle turns towards the normal of another."""
    across = np.cross(before, after)
    return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)


def _successors(ends: Float[np.ndarray, "n 2 3"], options: RectangleOptions) -> Bool[np.ndarray, "n n"]:
    """Whether arc j may be the side that follows arc i."""
    normal = _normals(ends)
    corner = _corner(normal[:, None], normal[None])
    length = np.arctan2(np.linalg.norm(np.cross(ends[:, 0], ends[:, 1]), axis=-1), (ends[:, 0] * ends[:, 1]).sum(-1))
    end, start = ends[:, 1, None], ends[None, :, 0]
    after = np.arctan2((np.cross(end, corner) * normal[:, None]).sum(-1), (end * corner).sum(-1)) / length[:, None]
    ahead = np.arctan2((np.cross(corner, start) * normal[None]).sum(-1), (corner * start).sum(-1)) / length[None]
    turn = np.arccos(np.clip(normal @ normal.T, -1.0, 1.0))
    turns = (turn > options.min_turn_rad) & (turn < np.pi - options.min_turn_rad)
    least, most = -options.max_beyond_share, options.max_gap_share
    near = (after > least) & (after < most) & (ahead > least) & (ahead < most)
    found: Bool[np.ndarray, "n n"] = turns & near
    return found


def _cycles(successor: Bool[np.ndarray, "n n"]) -> list[tuple[int, int, int, int]]:
    """All cycles a -> b -> c -> d -> a of four different arcs, from the least."""
    following = [np.flatnonzero(row).tolist() for row in successor]
    between: dict[tuple[int, int], list[int]] = {}
    for a, direct in enumerate(following):
        for b in direct:
            for c in following[b]:
                between.setdefault((a, c), []).append(b)
    return [
        (a, b, c, d)
        for (a, c), middle in between.items()
        if a != c
        for b, d in itertools.product(middle, between.get((c, a), []))
        if b != d and a < min(b, c, d)
    ]


def _mean_side(corners: Float[np.ndarray, "n 4 3"]) -> Float[np.ndarray, " n"]:
    side: Float[np.ndarray, " n"] = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=-1).mean(-1)
    return side


def _closed(
    ends: Float[np.ndarray, "n 2 3"], cycle: Int[np.ndarray, "m 4"], min_covered_share: float
) -> tuple[Int[np.ndarray, "k 4"], Float[np.ndarray, "k 4 3"]]:
    """The quadrilaterals with all corners on the inner side of every arc, and arcs along most of the way round."""
    normal = _normals(ends)
    corners = _corner(np.roll(normal[cycle], 1, 1), normal[cycle])
    convex = (np.einsum("mki,mji->mkj", normal[cycle], corners) > -1e-9).all((1, 2))
    covered = np.linalg.norm(ends[cycle][:, :, 1] - ends[cycle][:, :, 0], axis=-1).sum(-1) / 4
    kept = convex & (covered >= min_covered_share * _mean_side(corners))
    return cycle[kept], corners[kept]


def _fitted(
    ends: Float[np.ndarray, "n 2 3"],
    noise: Float[np.ndarray, "n 2 3 3"],
    inside: Float[np.ndarray, " n"],
    cycle: Int[np.ndarray, "m 4"],
    rectangle: Rectangle,
    options: RectangleOptions,
) -> _Fits:
    """The poses of all quadrilaterals that the sheet fits, each corner of them at the origin where it may be."""
    # Every arc may be the first side.
    normal = _normals(ends)
    cycle = np.concatenate([np.roll(cycle, k, 1) for k in range(4)])
    corners = _corner(np.roll(normal[cycle], 1, 1), normal[cycle])
    near = _nearly(corners, rectangle, options.nearly)
    cycle, corners = cycle[near], corners[near]
    start, sound = pose_of_corners(torch.as_tensor(corners), rectangle)
    rows = torch.nonzero(sound).flatten()
    cycle, corners = cycle[rows.numpy()], corners[rows.numpy()]
    fit = pose_of_sides(torch.as_tensor(ends[cycle]), torch.as_tensor(noise[cycle]), start[rows], rectangle)
    misfit = fit.misfit_rad.numpy() / _mean_side(corners)
    distance = fit.pose.translation.norm(dim=-1).numpy()
    doubt = np.sqrt(np.linalg.eigvalsh(fit.covariance[:, 3:, 3:].numpy())[:, -1]) / distance
    chi_square = fit.chi_square.numpy()
    shaped = (misfit <= options.max_misfit) | (chi_square <= options.max_chi_square)
    good = np.flatnonzero(shaped & (doubt <= options.max_distance_sigma_share))
    chosen = torch.as_tensor(good)
    return _Fits(
        fit.pose[chosen],
        fit.covariance[chosen].numpy(),
        chi_square[good],
        misfit[good],
        corners[good],
        inside[cycle[good]].min(-1),
        bool(shaped.any()),
    )


def _nearly(corners: Float[np.ndarray, "m 4 3"], rectangle: Rectangle, most: float) -> Bool[np.ndarray, " m"]:
    """Whether the parallelogram with corners along these bearings is the rectangle but for an error of `most`."""
    distances, sound = corner_distances(torch.as_tensor(corners))
    at = distances.numpy()[..., None] * corners
    along, down = at[:, 1] - at[:, 0], at[:, 3] - at[:, 0]
    width, height = np.linalg.norm(along, axis=-1), np.linalg.norm(down, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(np.log(width / height * rectangle.height_m / rectangle.width_m))
        cosine = np.abs((along * down).sum(-1) / (width * height))
    near: Bool[np.ndarray, " m"] = sound.numpy() & (ratio < most) & (cosine < most)
    return near
