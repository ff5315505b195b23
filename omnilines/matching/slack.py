"""How far arcs of one line may lie apart beyond their stated noise, told by the arcs themselves: errors of poses and cameras.

Under the right slack the best line of an arc stands out most from its best rival (`hypotheses.py`). How much it does also tells
how well poses fit the arcs (`evidence_of_poses`, `lines_need_poses`).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int
from scipy import ndimage

from camera_models.pose import Pose
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import Hypotheses, find_hypotheses, near_photos
from omnilines.matching.options import MatchingOptions
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.triangulation.robust import noise_level

SAMPLED_PAIRS, MIN_SAMPLED = 2_000_000, 250
"""Arcs that are compared under every slack: as many as give so many pairs with another arc, or the least number."""
SHOWING_ARCS = 1000
"""Arcs that are compared, at least, for what their residuals show."""
CASES_AT_ONCE = 8
"""Slacks that are tried at a time: each takes half a kilobyte an arc of all photos."""


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
    arcs.require_parallax()
    return evidence_of_lines(arcs, near_photos(arcs, options.hypotheses.max_neighbours), seed, options)


def evidence_of_lines(
    arcs: ViewedArcs,
    neighbours: Bool[np.ndarray, "m m"],
    seed: int,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
) -> Evidence:
    """The slack (px) that the arcs themselves ask for: the smallest that is enough, over a sample of the precise ones.

    Too little of it and true partners miss each other: the best line of an arc stands out less from its best rival than under
    another slack. What is enough for that may still be less than the residuals of the lines that stand out most show: then it is
    as much as they do. Chance gains too, and the more the larger the slack: none is taken beyond the one that gains most over
    chance, and the smallest where nothing stands out more than by chance.
    """
    its, tried = options.tolerance, options.tolerance.tried_px
    rng = np.random.default_rng(seed)
    chosen = _sample(arcs, MIN_SAMPLED, its.precise_share, rng)
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
    least = tried[int(np.flatnonzero(gain >= its.enough_share * gain[most])[0])]
    showing = _sample(arcs, SHOWING_ARCS, its.precise_share, rng)
    shown_px = _shown_slack(arcs, neighbours, showing, least, options) if least < tried[most] else 0.0
    # Two digits, since they are printed, and no more is known of it.
    return Evidence(min(max(least, float(f"{shown_px:.2g}")), tried[most]), over, sigmas, True)


def lines_need_poses(
    arcs: ViewedArcs, tolerance_px: float, turn_px: float, seed: int = 0, options: MatchingOptions = MatchingOptions()
) -> bool:
    """Whether lines stand out less where each camera is turned by `turn_px`, by more than sampling explains.

    Where they do not, the poses are off by about as much. The slack does not tell that: among real texture arcs of neighbouring
    edges agree under rough poses, and ask for little of it.
    """
    rng = np.random.default_rng(seed)
    near = near_photos(arcs, options.hypotheses.max_neighbours)
    chosen = _sample(arcs, MIN_SAMPLED, options.tolerance.precise_share, rng)
    turn_rad = turn_px * float(np.median(arcs.px_rad))
    turned = arcs.with_poses(_turned(arcs.poses, turn_rad, turn_rad, rng))
    own, other = (find_hypotheses(some.widened(tolerance_px), near, rows=chosen, options=options) for some in (arcs, turned))
    less = (own.score - own.rival) - (other.score - other.rival)
    return bool(less.mean() > options.tolerance.chance_sigmas * less.std() / math.sqrt(len(less)))


def _sample(arcs: ViewedArcs, least: int, precise_share: float, rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """Arcs drawn from the precise ones of each photo: SAMPLED_PAIRS over all arcs, or the least number.

    Among dense texture, a slack below the noise of short arcs is lost in what that noise is misstated by, and a larger one lets
    arcs of neighbouring edges agree: their lines gain, and leave no rival.
    """
    count = max(SAMPLED_PAIRS // len(arcs), least)
    order = np.lexsort((arcs.sigma_px, arcs.image))
    rank = np.arange(len(arcs)) - arcs.starts[arcs.image]
    of_photo = np.bincount(arcs.image, minlength=arcs.images)[arcs.image]
    precise = order[rank < max(precise_share, count / len(arcs)) * of_photo]
    return np.sort(rng.permutation(precise)[:count])


def _turned(poses: Pose, least_rad: float, most_rad: float, rng: np.random.Generator) -> Pose:
    """Cameras at the same places, each turned a little about an axis of its own: by some degrees, arcs fit each other by chance
    alone, and what photos have in common hardly changes."""
    axis = rng.standard_normal((len(poses), 3))
    angle = rng.uniform(least_rad, most_rad, (len(poses), 1))
    axis *= angle / np.linalg.norm(axis, axis=-1, keepdims=True)
    return Pose.exp(torch.as_tensor(np.concatenate([axis, np.zeros_like(axis)], -1))) @ poses


def _shown_slack(
    arcs: ViewedArcs,
    neighbours: Bool[np.ndarray, "m m"],
    rows: Int[np.ndarray, " k"],
    tolerance_px: float,
    options: MatchingOptions,
) -> float:
    """What residuals show beyond the noise of arcs (px): those of the `rows` whose line stands out most, and of their supporters.

    Arcs may err more than they state, most of them by a common factor: the edges of real photos are no ideal steps. That is no
    slack, and would make a large one for the precise arcs of long edges, which tell lines of near edges apart. What lines of
    precise arcs and of others show tells both: r^2 = factor^2 stated^2 + slack^2.
    """
    its, widened = options.tolerance, arcs.widened(tolerance_px)
    found = find_hypotheses(widened, neighbours, rows=rows, options=options)
    member, track = found.clearest(rows, its.showing_share)
    stated_px = arcs.sigma_px[member]
    typical_px = ndimage.median(stated_px, track, np.arange(int(track.max()) + 1))
    precise = typical_px <= np.median(typical_px)

    def squares_px2(some: Bool[np.ndarray, " t"]) -> tuple[float, float]:
        """What the members of some of the tracks state, and what their residuals show; NaN where there are none."""
        own = some[track]
        if not own.any():
            return math.nan, math.nan
        place = np.cumsum(some) - 1
        level = noise_level(widened.tracks(member[own], place[track[own]], int(some.sum())))
        stated = float(np.median(stated_px[own])) ** 2
        return stated, level**2 * (stated + tolerance_px**2)

    (fine, shown_fine), (coarse, shown_coarse) = squares_px2(precise), squares_px2(~precise)
    # Lines that state nearly the same tell no factor.
    factor = (shown_coarse - shown_fine) / (coarse - fine) if coarse > its.min_coarser**2 * fine else math.nan
    if factor > 1.0:
        slack = shown_fine - min(factor, its.max_noise_factor**2) * fine
    else:
        stated, shown = squares_px2(np.ones_like(precise))
        slack = shown - stated
    return math.sqrt(slack) if slack > 0 else (0.0 if math.isfinite(slack) else tolerance_px)
