"""Arcs fitted together with the edges beside them.

The frame of a picture, the lip of a shelf, the gap between two books: most edges indoors have another one within a few pixels.
A single step fitted to such a profile lies between both edges, or is pulled from the one towards the other. So a profile across
an arc is fitted with one blurred step for each arc that crosses it.
"""

import math
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from camera_models import CameraModel
from omnilines.extraction.alike import ChromaNoise, ToldChroma, correlations
from omnilines.extraction.arcs import Arcs
from omnilines.extraction.blocks import LEAST_WEIGHT, Blocks, Profiled, StepFit, fit_places, window_weights
from omnilines.extraction.kernels.chroma import LUMA
from omnilines.extraction.kernels.circle import fit_circles
from omnilines.extraction.kernels.step_edge import ROUNDS
from omnilines.extraction.kernels.tables import Places
from omnilines.extraction.options import ExtractionOptions, NeighbourOptions, RefitOptions
from omnilines.extraction.refit import floor_covariance, moved

BLURS_PX = np.concatenate([np.arange(0.4, 1.0, 0.05), np.geomspace(1.0, 2.6, 8)])
BLUR_ARCS, BLUR_STRIDE = 40, 3
"""The longest arcs tell the blur; blurs that are skipped at first."""


def photo_blur(
    model: CameraModel, known: Profiled, contrast: Float[np.ndarray, " n"], options: ExtractionOptions
) -> tuple[float, float]:
    """Standard deviation (px) of the blurred steps that explain the photo's sharp, lone arcs best: the median of them; and that
    of what these steps leave of a profile one pixel wide, in grey levels of 255, 0 where no arc tells it. Where a camera has
    taken noise out of the flats, sharpened, or made a JPEG of it, that is more than the noise in the flats."""
    beside = options.neighbours
    strong = np.flatnonzero((contrast >= options.blur.min_grey) & (np.diff(known.blocks.starts) >= beside.min_blocks))
    blocks = known.crossed(model, strong, beside.min_cosine)
    lone = np.flatnonzero(blocks.mean((blocks.count > 1).astype(np.float64)) < beside.crowded_share)
    # Longest first.
    lone = np.sort(lone[np.argsort(-np.diff(blocks.starts)[lone], kind="stable")[:BLUR_ARCS]])
    if not len(lone):
        return options.blur.typical_px, 0.0
    blocks = known.blocks.keep(strong[lone])
    left = np.full((len(BLURS_PX), len(lone)), np.inf)
    # Some blurs first; then those around the median of the best, on which alone it depends.
    tried = np.arange(0, len(BLURS_PX), BLUR_STRIDE)
    for _ in range(2):
        place = blocks.place
        for k in tried:
            place, _, _, rest = fit_places(blocks, place, step_fit(beside, options.refit.taper_px, float(BLURS_PX[k])))
            left[k] = blocks.mean(rest)
        middle = round(float(np.median(left.argmin(0))))
        near = np.arange(max(middle - BLUR_STRIDE, 0), min(middle + BLUR_STRIDE + 1, len(BLURS_PX)))
        tried = near[np.isinf(left[near, 0])]
    weight = np.square(window_weights(options.refit.taper_px))
    weight = weight[weight >= LEAST_WEIGHT**2]
    # A level, a step and its place are fitted to each channel's values.
    freedom = blocks.profile.shape[1] * float(weight.sum()) * (1.0 - 3.0 / len(weight))
    rest = float(np.median(left.min(0))) * float(np.mean(blocks.length)) / freedom
    return float(np.median(BLURS_PX[left.argmin(0)])), math.sqrt(rest)


def step_fit(options: NeighbourOptions, taper_px: float, blur_px: float, rounds: int = ROUNDS) -> StepFit:
    """How the steps of arcs and their neighbours are fitted in a window."""
    return StepFit(taper_px, blur_px, options.own_sigma_px, options.other_sigma_px, rounds)


def _circles(blocks: Blocks, start: Float[np.ndarray, "m s"], fit: StepFit, options: NeighbourOptions) -> tuple:
    """Great circles through the places of the own steps: `fit_circles`, and all places, and variance and heights of the own
    ones."""
    place, variance, heights, _ = fit_places(blocks, start, fit)
    weight = 1.0 / (variance + options.scatter_px**2)
    places = Places(blocks.angle, blocks.rate, place[:, 0].copy(), weight, blocks.whole)
    return (*fit_circles(blocks.starts, places, options.max_shift_px), place, variance, heights[:, 0])


def fit_together(model: CameraModel, known: Profiled, blur_px: float, options: NeighbourOptions, refit: RefitOptions) -> Arcs:
    """Arcs that have others beside them over much of their length, fitted anew with them; the others are as they were.

    The covariance holds the scatter of the places, and how much the arc moves where the window is wider or the blur another:
    the first tells of edges beside it that are not known. Where that makes it much worse than that of the arc by itself, the
    steps are not those of the photo (sharpened or rounded edges), and the arc stays as it was; how far both are apart goes into
    its covariance.
    """
    arcs = known.arcs
    whole = known.crossed(model, np.arange(len(arcs)), options.min_cosine)
    crowded_share = whole.mean((whole.count > 1).astype(np.float64))
    blocks_read = np.bincount(whole.owner, whole.whole, whole.arcs)
    rows = np.flatnonzero((crowded_share >= options.crowded_share) & (blocks_read >= options.min_blocks))
    if not len(rows):
        return arcs
    crowded, blocks = arcs.keep(rows), whole.keep(rows)
    narrow = step_fit(options, refit.taper_px, blur_px)
    change, inverse, scatter, used, residual, place, variance, height = _circles(blocks, blocks.place, narrow, options)
    noise = _chroma_noise(blocks, place, height, residual, replace(narrow, rounds=1))
    alike = correlations(noise, ToldChroma().with_more(noise), 1.0)
    # Few places tell little of their scatter: Student's t in the place of the normal distribution.
    few = (stdtrit(np.maximum(used - 2.0, 1.0), 0.975) / 1.96) ** 2
    floor = floor_covariance(crowded, blocks.owner, blocks.rate, options.floor_px)
    covariance = inverse * (scatter * few * alike)[:, None, None] + floor
    # To first order: it is a standard deviation.
    wide = step_fit(options, options.wide_taper_px, blur_px, 1)
    blurred = step_fit(options, refit.taper_px, options.blur_factor * blur_px, 1)
    for fit, sigmas in ((wide, refit.bias_sigmas), (blurred, options.blur_sigmas)):
        bias = _circles(blocks, place, fit, options)[0] - change
        covariance += sigmas**2 * bias[:, :, None] * bias[:, None]
    low, high = _trimmed(crowded, blocks, residual, variance, refit.max_end_px)
    fitted = replace(moved(crowded, change, covariance), low=low, high=high)
    alone = crowded.covariance + refit.bias_sigmas**2 * change[:, :, None] * change[:, None]
    worse = _across(crowded, covariance) > options.max_worse * _across(crowded, crowded.covariance)
    stays = replace(crowded, covariance=alone)
    result = arcs.keep(np.arange(len(arcs)))
    for better, those in ((fitted, ~worse), (stays, worse)):
        those &= used >= options.min_blocks
        for field in fields(Arcs):
            getattr(result, field.name)[rows[those]] = getattr(better, field.name)[those]
    return result.centred()


def _chroma_noise(
    blocks: Blocks,
    place: Float[np.ndarray, "m s"],
    height: Float[np.ndarray, "m c"],
    residual: Float[np.ndarray, " m"],
    fit: StepFit,
) -> ChromaNoise:
    """What chroma adds to the places of own steps of these heights, as in a refit: the rest of what luma by itself says, by its
    share. Where luma has no step, its share is none."""
    if height.shape[1] != len(LUMA):
        return ChromaNoise(*np.zeros((4, blocks.arcs)))
    luma = height.sum(-1) * (height @ LUMA) / np.maximum(np.square(height).sum(-1), 1e-6)
    # As much signal as in three channels that are all alike, against the same noise and the same stiffness of the places.
    profile = math.sqrt(len(LUMA)) * np.einsum("c,mck->mk", LUMA, blocks.profile)[:, None]
    # One round each: both differ from `place` by what it lacks of its limit.
    every, bright = (fit_places(some, place, fit)[0][:, 0] for some in (blocks, replace(blocks, profile=profile)))
    noise = luma * (every - bright) + (1.0 - luma) * residual
    used = np.isfinite(residual)
    values = np.stack([1.0 - luma, noise, noise**2, residual**2, np.ones(len(noise))], -1)
    sums = np.stack([np.bincount(blocks.owner[used], column[used], blocks.arcs) for column in values.T])
    return ChromaNoise(sums[0] / np.maximum(sums[4], 1.0), *sums[1:4])


def _across(arcs: Arcs, covariance: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, " n"]:
    """Mean variance across arcs, rad^2."""
    half = 0.5 * (arcs.high - arcs.low)
    return covariance[:, 0, 0] + covariance[:, 1, 1] * half**2 / 3.0


def _trimmed(
    arcs: Arcs, blocks: Blocks, residual: Float[np.ndarray, " m"], variance: Float[np.ndarray, " m"], max_end_px: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Ends of arcs moved inwards to where their edge lies on the circle: beyond, they follow another one."""
    on = np.abs(residual) <= np.maximum(max_end_px, 3.0 * np.sqrt(variance))
    index = np.arange(len(on))
    filled = np.diff(blocks.starts) > 0
    first, last = np.zeros(len(arcs), dtype=np.int64), np.zeros(len(arcs), dtype=np.int64)
    first[filled] = np.minimum.reduceat(np.where(on, index, len(on)), blocks.starts[:-1][filled])
    last[filled] = np.maximum.reduceat(np.where(on, index, -1), blocks.starts[:-1][filled])
    shorter = filled & (last > first)
    low, high = arcs.low.copy(), arcs.high.copy()
    rows = np.flatnonzero(shorter & (first > blocks.starts[:-1]))
    low[rows] = 0.5 * (blocks.angle[first[rows] - 1] + blocks.angle[first[rows]])
    rows = np.flatnonzero(shorter & (last < blocks.starts[1:] - 1))
    high[rows] = 0.5 * (blocks.angle[last[rows]] + blocks.angle[last[rows] + 1])
    return low, high
