"""Mean profiles of colour across pieces of arcs, and the blurred steps that explain them: one for each edge beside the arc."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from camera_models import CameraModel
from omnilines.extraction.arcs import Arcs, across_px
from omnilines.extraction.curves import samples
from omnilines.extraction.kernels.crossing import crossings
from omnilines.extraction.kernels.profile import mean_profiles
from omnilines.extraction.kernels.step_algebra import MOST_STEPS
from omnilines.extraction.kernels.step_edge import ROUNDS, fit_steps
from omnilines.extraction.kernels.tables import Crossed, Samples, Stepped, Window
from omnilines.extraction.options import NeighbourOptions
from omnilines.extraction.refit import Photo, joined

OFFSETS_PX = np.arange(-12, 13) * 0.5
BEYOND_PX = 3
"""Edges are taken to go on beyond the ends of their arcs."""
LEAST_WEIGHT = 0.03
"""Of the outermost value of a profile in a fit."""


def pieces(at: Samples, wanted: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m1"]:
    """Where the pieces begin that each arc is cut into, at least one each, and one more: numbers of samples."""
    number = np.arange(len(at.owner)) - at.starts[at.owner]
    count = np.maximum(wanted, 1)[at.owner]
    piece = number * count // np.diff(at.starts)[at.owner]
    begins = np.flatnonzero((np.diff(at.owner, prepend=-1) != 0) | (np.diff(piece, prepend=-1) != 0))
    return np.append(begins, len(at.owner))


def window_weights(taper_px: float) -> Float[np.ndarray, " k"]:
    """Weights of the values of a profile, whose squares have a standard deviation of `taper_px`."""
    return np.exp(-0.25 * (OFFSETS_PX / taper_px) ** 2)


@dataclass(frozen=True)
class Blocks:
    """Pieces of arcs, arc after arc."""

    arcs: int
    """How many there are."""
    owner: Int[np.ndarray, " m"]
    length: Int[np.ndarray, " m"]
    whole: Bool[np.ndarray, " m"]
    """All of its profiles lie in the image."""
    angle: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]
    pixel: Float[np.ndarray, "m 2"]
    """In the middle, as the direction across."""
    across: Float[np.ndarray, "m 2"]
    profile: Float32[np.ndarray, "m c k"]
    """Mean grey levels of 255 at OFFSETS_PX; 0 for arcs of too few blocks, which are then not `whole`."""
    sigma: Float[np.ndarray, " m"]
    place: Float[np.ndarray, "m s"]
    """Where its profile is crossed: by its own arc at 0, then by its neighbours."""
    count: Int[np.ndarray, " m"]

    @cached_property
    def starts(self) -> Int[np.ndarray, " n1"]:
        """Where the blocks of each arc begin, and one more."""
        return np.searchsorted(self.owner, np.arange(self.arcs + 1))

    def keep(self, rows: Int[np.ndarray, " k"]) -> "Blocks":
        """Those of some arcs, in order, numbered anew."""
        return _kept(self, rows)

    def mean(self, values: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
        """Of each arc's blocks."""
        return np.bincount(self.owner, values, self.arcs) / np.maximum(np.diff(self.starts), 1)


@dataclass(frozen=True)
class Path:
    """Points a pixel apart along arcs and BEYOND_PX beyond their ends."""

    arcs: int
    owner: Int[np.ndarray, " m"]
    pixel: Float[np.ndarray, "m 2"]
    across: Float[np.ndarray, "m 2"]


_Table = TypeVar("_Table", Blocks, Path)


def _kept(table: _Table, arcs: Int[np.ndarray, " k"]) -> _Table:
    if len(arcs) == table.arcs and (np.diff(arcs) > 0).all():
        return table
    number = np.full(table.arcs, -1)
    number[arcs] = np.arange(len(arcs))
    rows = np.flatnonzero(number[table.owner] >= 0)
    return type(table)(len(arcs), number[table.owner[rows]], *(getattr(table, field.name)[rows] for field in fields(table)[2:]))


def _appended(table: _Table, more: _Table) -> _Table:
    owner = np.concatenate([table.owner, table.arcs + more.owner])
    names = [field.name for field in fields(table)[2:]]
    columns = (np.concatenate([getattr(table, name), getattr(more, name)]) for name in names)
    return type(table)(table.arcs + more.arcs, owner, *columns)


@dataclass(frozen=True)
class Profiled:
    """Arcs with the profiles across them, read once, and where they pass."""

    arcs: Arcs
    blocks: Blocks
    """Without neighbours."""
    path: Path

    def keep(self, rows: Int[np.ndarray, " k"]) -> "Profiled":
        """Some of the arcs, in order."""
        return Profiled(self.arcs.keep(rows), _kept(self.blocks, rows), _kept(self.path, rows))

    def with_more(self, more: "Profiled") -> "Profiled":
        """These arcs, and others after them."""
        return Profiled(joined([self.arcs, more.arcs]), _appended(self.blocks, more.blocks), _appended(self.path, more.path))

    def crossed(self, model: CameraModel, rows: Int[np.ndarray, " k"], min_cosine: float) -> Blocks:
        """The blocks of some of the arcs, and where all others that are as parallel as this cross them."""
        blocks, path = _kept(self.blocks, rows), self.path
        place, count = crossings(
            Crossed(rows[blocks.owner], blocks.pixel, blocks.across),
            Crossed(path.owner, path.pixel, path.across),
            size=model.image_size,
            closed=model.PERIODIC,
            reach_px=float(OFFSETS_PX[-1]),
            min_cosine=min_cosine,
        )
        return replace(blocks, place=place, count=count)


def profiled(photo: Photo, arcs: Arcs, noise: float, options: NeighbourOptions) -> Profiled:
    """Profiles across arcs in a photo whose grey levels of 255 have `noise`."""
    at = samples(photo.model, arcs, 0.0)
    starts = pieces(at, np.diff(at.starts) // options.block_px)
    begins, length = starts[:-1], np.diff(starts)
    wanted = np.bincount(at.owner[begins], minlength=len(arcs))[at.owner[begins]] >= options.min_blocks
    mean, whole = mean_profiles(photo.picture, at, starts, wanted, OFFSETS_PX)
    middle, count = begins + length // 2, len(begins)
    blocks = Blocks(
        arcs=len(arcs),
        owner=at.owner[begins],
        length=length,
        whole=whole,
        angle=np.add.reduceat(at.angle, begins) / length,
        rate=np.add.reduceat(at.rate, begins) / length,
        pixel=at.pixel[middle],
        across=at.across[middle],
        profile=mean,
        sigma=noise / np.sqrt(length),
        place=np.zeros((count, MOST_STEPS)),
        count=np.ones(count, dtype=np.int64),
    )
    return Profiled(arcs, blocks, _path(photo.model, arcs, at))


def _path(model: CameraModel, arcs: Arcs, at: Samples) -> Path:
    """The samples, and as many pixels beyond either end at the same steps."""
    number = np.arange(1, BEYOND_PX + 1)
    first, last = at.starts[:-1], at.starts[1:] - 1
    before = at.angle[first, None] - number * (at.angle[first + 1] - at.angle[first])[:, None]
    after = at.angle[last, None] + number * (at.angle[last] - at.angle[last - 1])[:, None]
    owner = np.repeat(np.arange(len(arcs)), 2 * BEYOND_PX)
    pixel, across, _, _ = across_px(model, arcs, owner, np.concatenate([before, after], 1).ravel())
    if model.PERIODIC:
        pixel[:, 0] = np.mod(pixel[:, 0] + 0.5, model.image_size[0]) - 0.5
    names = (np.concatenate(pair) for pair in ((at.owner, owner), (at.pixel, pixel), (at.across, across)))
    return Path(len(arcs), *names)


@dataclass(frozen=True)
class StepFit:
    """How steps are fitted to profiles: the standard deviation of the weights of a profile, the photo's blur, those of the places
    of the own step and of the others about where their arcs are, and rounds at most."""

    taper_px: float
    blur_px: float
    own_sigma_px: float
    other_sigma_px: float
    rounds: int = ROUNDS


def fit_places(
    blocks: Blocks, start: Float[np.ndarray, "m s"], fit: StepFit
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`fit_steps` of the profiles of blocks, begun at `start`."""
    weight = window_weights(fit.taper_px)
    near = np.flatnonzero(weight >= LEAST_WEIGHT)
    return fit_steps(
        Stepped(blocks.profile, start, blocks.count),
        blocks.sigma,
        Window(int(near[0]), OFFSETS_PX[near], weight[near]),
        stiff=np.array([fit.own_sigma_px, fit.other_sigma_px]),
        blur=fit.blur_px,
        rounds=fit.rounds,
    )
