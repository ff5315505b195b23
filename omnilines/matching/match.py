"""Arcs of photos with poses -> tracks: which arcs show one line of the world, and where that line is.

found = match_arcs(arcs)        # ViewedArcs: both ends of every arc as bearings, their noise, colours beside them, poses
found.tracks.track              # (n,) line of every arc or -1; found.tracks.lines: a `Triangulation`

How far arcs of one line may lie apart follows from their stated noise and from a slack for what no arc knows of: errors of poses
and cameras (`tolerance_px`). Unless given, the slack is chosen by the data (`evidence_of_lines`).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models.errors import GeometryError, InputError
from camera_models.pose import Pose
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import Hypotheses, find_hypotheses, neighbouring_photos
from omnilines.matching.kernels.supporters import supporting_photos
from omnilines.matching.options import MatchingOptions
from omnilines.matching.shared_view import neighbours_in_view
from omnilines.matching.tracks import Tracks, build_tracks
from omnilines.progress import Each, ProgressCallback, on_all_cores, silent
from omnilines.triangulation.robust import noise_level

SAMPLED_PAIRS, MIN_SAMPLED = 2_000_000, 250
"""Arcs that the slack is chosen by: as many as give so many pairs with another arc, or the least number."""
LEAST_VIEWS = 4
CASES_AT_ONCE = 8
"""Slacks that are tried at a time: each takes half a kilobyte an arc of all photos."""


@dataclass(frozen=True)
class Matched:
    """The tracks with what led to them."""

    arcs: ViewedArcs
    """As given, widened by the slack."""
    hypotheses: Hypotheses
    tracks: Tracks
    tolerance_px: float
    """The slack."""
    beyond_chance: bool = True
    """Whether lines stand out by more than sampling explains, where the slack was chosen by that."""

    def agreeing_photos(self) -> Int[np.ndarray, " n"]:
        """Number of other photos that support the best line of every arc."""
        every, together = np.arange(len(self.arcs)), np.zeros(len(self.arcs), dtype=np.int64)
        count: Int[np.ndarray, " n"] = supporting_photos(
            every, self.hypotheses.support, together, self.arcs.image, self.arcs.images
        )
        return count


def match_arcs(
    arcs: ViewedArcs,
    *,
    min_views: int = LEAST_VIEWS,
    tolerance_px: float | None = None,
    options: MatchingOptions = MatchingOptions(),
    seed: int = 0,
    progress: ProgressCallback = silent,
    workers: Each | None = None,
) -> Matched:
    """Put arcs into tracks that at least `min_views` photos (3 or more) see. Where `workers` are given, they compare the arcs.

    Raises InputError on a wrong option and GeometryError where fewer than three photos have arcs, or all of them stand at one
    place: then nothing has a depth.
    """
    neighbours = options.hypotheses.max_neighbours
    if min_views < 3 or neighbours < 2 or (tolerance_px is not None and not tolerance_px > 0):
        raise InputError(
            "Matching expects `min_views` of 3 or more, 2 neighbours of a photo and a `tolerance_px` above 0, found "
            f"{min_views}, {neighbours} and {tolerance_px}; correct the option."
        )
    _require_parallax(arcs)
    near = _near(arcs, neighbours)
    beyond_chance = True
    if tolerance_px is None:
        its = evidence_of_lines(arcs, near, seed, options, progress)
        tolerance_px, beyond_chance = its.tolerance_px, its.beyond_chance
    widened = arcs.widened(tolerance_px)
    near = neighbours_in_view(widened, near, min_views, options, progress, workers)
    found = find_hypotheses(widened, near, options=options, progress=progress, workers=workers)
    tracks = build_tracks(widened, found, min_views, options, progress)
    return Matched(widened, found, tracks, tolerance_px, beyond_chance)


def _near(arcs: ViewedArcs, neighbours: int) -> Bool[np.ndarray, "m m"]:
    return neighbouring_photos(arcs.poses.centre.numpy(), arcs.poses.rotation[:, 2].numpy(), neighbours)


@dataclass(frozen=True)
class Evidence:
    """What arcs say of the poses of their photos."""

    tolerance_px: float
    """The slack that they ask for."""
    gain: float
    """Photos by which the best line of an arc stands out from its best rival, less those by which it does by chance; the mean."""
    sigmas: float
    """That, in standard deviations of what sampling explains."""
    beyond_chance: bool
    """Whether that is more than sampling explains."""


def evidence_of_poses(arcs: ViewedArcs, seed: int = 0, options: MatchingOptions = MatchingOptions()) -> Evidence:
    """How well the arcs of all photos agree under the poses that they have. The same arcs are asked whatever the poses."""
    _require_parallax(arcs)
    return evidence_of_lines(arcs, _near(arcs, options.hypotheses.max_neighbours), seed, options)


def evidence_of_lines(
    arcs: ViewedArcs,
    neighbours: Bool[np.ndarray, "m m"],
    seed: int,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
) -> Evidence:
    """The slack (px) that the arcs themselves ask for: the smallest that is enough, over a sample of the precise ones.

    Too little of it and true partners miss each other: the best line of an arc stands out less from its best rival than under
    another slack, or the residuals of the lines that stand out most show more noise than was allowed for. Chance gains too, and
    the more the larger the slack: none is taken beyond the one that gains most over chance, and the smallest where nothing
    stands out more than by chance.
    """
    its, tried = options.tolerance, options.tolerance.tried_px
    rng = np.random.default_rng(seed)
    chosen = _sample(arcs, max(SAMPLED_PAIRS // len(arcs), MIN_SAMPLED), its.precise_share, rng)
    turned = arcs.with_poses(_turned(arcs.poses, its.min_chance_turn_rad, its.max_chance_turn_rad, rng))

    def compared(case: tuple[ViewedArcs, float]) -> Hypotheses:
        """Of the chosen arcs, in photos that stand as they do or are turned, under a slack."""
        seen, slack = case
        return find_hypotheses(seen.widened(slack), neighbours, rows=chosen, options=options)

    # So few arcs are one piece of work: it is the cases that cores share.
    progress("choosing the slack", 0, 2 * len(tried))
    cases = [(seen, slack) for seen in (arcs, turned) for slack in tried]
    of_cases = on_all_cores(compared, cases, "choosing the slack", progress, CASES_AT_ONCE)
    found, chance = of_cases[: len(tried)], of_cases[len(tried) :]
    gain = np.array([float((one.score - one.rival).mean()) for one in found])
    by_chance = np.array([float((one.score - one.rival).mean()) for one in chance])
    most = int(np.argmax(gain - by_chance))
    excess = (found[most].score - found[most].rival) - (chance[most].score - chance[most].rival)
    over = float((gain - by_chance)[most])
    deviation = float(excess.std()) / math.sqrt(len(excess))
    sigmas = over / deviation if deviation > 0 else 0.0
    if sigmas <= its.chance_sigmas:
        return Evidence(tried[0], over, sigmas, False)
    for k in np.flatnonzero(gain[:most] >= its.enough_share * gain.max()).tolist():
        if _shown_slack(arcs, chosen, found[k], tried[k], its.showing_share) <= tried[k]:
            return Evidence(tried[k], over, sigmas, True)
    return Evidence(tried[most], over, sigmas, True)


def _sample(arcs: ViewedArcs, count: int, precise_share: float, rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """Arcs drawn from the precise ones of each photo.

    Among dense texture, a slack below the noise of short arcs is lost in what that noise is misstated by, and a larger one lets
    arcs of neighbouring edges agree: their lines gain, and leave no rival.
    """
    order = np.lexsort((_stated_px(arcs), arcs.image))
    rank = np.arange(len(arcs)) - arcs.starts[arcs.image]
    of_photo = np.bincount(arcs.image, minlength=arcs.images)[arcs.image]
    precise = order[rank < max(precise_share, count / len(arcs)) * of_photo]
    return np.sort(rng.permutation(precise)[:count])


def _stated_px(arcs: ViewedArcs) -> Float[np.ndarray, " n"]:
    """Standard deviation (px) of each arc across it, of its worse end."""
    return arcs.packed[:, 12:].max(-1) / arcs.px_rad


def lines_need_poses(
    arcs: ViewedArcs, tolerance_px: float, turn_px: float, seed: int = 0, options: MatchingOptions = MatchingOptions()
) -> bool:
    """Whether lines stand out less where each camera is turned by `turn_px`, by more than sampling explains.

    Where they do not, the poses are off by about as much. The slack does not tell that: among real texture arcs of neighbouring
    edges agree under rough poses, and ask for little of it.
    """
    rng = np.random.default_rng(seed)
    near = _near(arcs, options.hypotheses.max_neighbours)
    chosen = _sample(arcs, max(SAMPLED_PAIRS // len(arcs), MIN_SAMPLED), options.tolerance.precise_share, rng)
    turn_rad = turn_px * float(np.median(arcs.px_rad))
    turned = arcs.with_poses(_turned(arcs.poses, turn_rad, turn_rad, rng))
    own, other = (find_hypotheses(some.widened(tolerance_px), near, rows=chosen, options=options) for some in (arcs, turned))
    less = (own.score - own.rival) - (other.score - other.rival)
    return bool(less.mean() > options.tolerance.chance_sigmas * less.std() / math.sqrt(len(less)))


def _turned(poses: Pose, least_rad: float, most_rad: float, rng: np.random.Generator) -> Pose:
    """Cameras at the same places, each turned a little about an axis of its own: by some degrees, arcs fit each other by chance
    alone, and what photos have in common hardly changes."""
    axis = rng.standard_normal((len(poses), 3))
    angle = rng.uniform(least_rad, most_rad, (len(poses), 1))
    axis *= angle / np.linalg.norm(axis, axis=-1, keepdims=True)
    return Pose.exp(torch.as_tensor(np.concatenate([axis, np.zeros_like(axis)], -1))) @ poses


def _shown_slack(
    arcs: ViewedArcs, rows: Int[np.ndarray, " k"], found: Hypotheses, tolerance_px: float, showing_share: float
) -> float:
    """What the residuals show beyond the stated noise: of the arcs whose line stands out most, with their supporters."""
    best = np.argsort(found.rival - found.score, kind="stable")[: max(1, math.ceil(showing_share * len(rows)))]
    support = found.support[best]
    member = np.concatenate([rows[best], support[support >= 0]])
    track = np.concatenate([np.arange(len(best)), np.nonzero(support >= 0)[0]])
    level = noise_level(arcs.widened(tolerance_px).tracks(member, track, len(best)))
    stated = float(np.median(_stated_px(arcs)[member]))
    square = level**2 * (stated**2 + tolerance_px**2) - stated**2
    return math.sqrt(square) if square > 0 else (0.0 if math.isfinite(level) else tolerance_px)


def _require_parallax(arcs: ViewedArcs) -> None:
    seen = np.unique(arcs.image)
    if len(seen) < 3:
        raise GeometryError(
            f"Arcs in at least 3 photos with poses were expected to match lines, found {len(seen)}; give more photos."
        )
    centres = arcs.poses.centre.numpy()[seen]
    spread = float(np.linalg.norm(centres - centres.mean(0), axis=-1).max())
    if spread <= 1e-9 * (1.0 + float(np.abs(centres).max())):
        raise GeometryError(
            f"Photos from different places were expected, found all {len(seen)} at one place, from where no line has a depth; "
            "move the camera between photos."
        )
