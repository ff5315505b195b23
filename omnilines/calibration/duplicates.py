"""Photos that show the same twice: copies, frames of a video that stood still, two shots of a camera and a board on stands.

They are no new data: the noise of their corners may be new, but the pose and with it every systematic error is the same, so
a set that counts them as independent promises more than it holds.

Two views are duplicates where their common corners lie at the same pixels up to noise. A pair of duplicates has at least one
common corner that is no farther apart than their RMS distance, so it is enough to compare views that share such a corner:

1. Corners are put into square cells of that distance, one set of cells for each corner of the board. A view is compared with
   the first view in the cells around each of its corners. This finds nearly all, however many copies there are of one view.
2. Among the views that are left, which are mostly different from each other, all pairs that share a near corner are compared,
   until no pair is found any more. So none is missed.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from camera_models.errors import InputError
from omnilines.calibration.thresholds import DuplicateThresholds
from omnilines.records import Corners

_PAIRS_PER_BATCH = 2048

Pairs = Int[np.ndarray, "_ 2"]


def duplicate_views(
    corners: Corners, sigma_px: float, thresholds: DuplicateThresholds = DuplicateThresholds()
) -> list[tuple[int, int]]:
    """Pairs (first, later) of views of one camera that show the same, by increasing first and later.

    Two views are duplicates where at least `least_common` corners, more than half of those of either, are common to both (the
    same position on the board) and differ by at most max(`noise_factor` sigma_px, `least_tolerance_px`), root mean square per
    axis. `sigma_px` is the standard deviation of the noise of one coordinate of one corner. Each view is paired with the first
    that it duplicates and that is itself no duplicate: three copies a, b, c give (a, b) and (a, c). So a slow drift is cut into
    pieces, and of every piece the first view is left unnamed.

    A view whose corners are numbered the other way round, as a plain symmetric board allows after half a turn, is no duplicate
    even where all pixels are the same: corners are compared by name. A detector numbers copies of one photo alike, and a board
    that has been turned in between is never put back to within 0.1 px.

    Time and memory grow about linearly with the number of views; the table of pixels takes 16 bytes for each view and corner of
    the board. Raises InputError where sigma_px is negative or not finite.
    """
    if not (np.isfinite(sigma_px) and sigma_px >= 0):
        raise InputError(
            f"The noise of corners was expected as a standard deviation in pixels, at least 0, found {sigma_px}; estimate it "
            "from the residuals of a calibration."
        )
    if not len(corners):
        return []
    tolerance_px = max(thresholds.noise_factor * sigma_px, thresholds.least_tolerance_px)
    # The distance of two corners is root two times the RMS per axis.
    reach_px = np.sqrt(2.0) * tolerance_px
    _, corner = np.unique(np.round(corners.board_m, 8), axis=0, return_inverse=True)
    corner = corner.reshape(-1)
    table: Float[np.ndarray, "views corners 2"] = np.full((int(corners.view.max()) + 1, int(corner.max()) + 1, 2), np.nan)
    table[corners.view, corner] = corners.pixels

    pairs = _alike(table, _with_first_in_cell(corners.view, corner, corners.pixels, reach_px), tolerance_px, thresholds)
    while True:
        chosen = _to_first(pairs)
        left = ~np.isin(corners.view, chosen[:, 1])
        more = _alike(table, _near(corners.view[left], corner[left], corners.pixels[left], reach_px), tolerance_px, thresholds)
        if not len(more):
            return [(int(first), int(second)) for first, second in chosen]
        # A pair among those left is new, and may turn a first view into a duplicate: then look again at those paired with it.
        pairs = np.concatenate([pairs, more])


def _with_first_in_cell(
    view: Int[np.ndarray, " n"], corner: Int[np.ndarray, " n"], pixels: Float[np.ndarray, "n 2"], cell_px: float
) -> Pairs:
    """Each view with the first view in each of the nine cells around each of its corners."""
    cell = np.floor((pixels - pixels.min(0)) / cell_px).astype(np.int64) + 1
    columns, rows = cell.max(0) + 2
    code = (corner * rows + cell[:, 1]) * columns + cell[:, 0]
    order = np.lexsort((view, code))
    occupied, at = np.unique(code[order], return_index=True)
    first = view[order][at]
    found = []
    for step in (dv * columns + du for dv in (-1, 0, 1) for du in (-1, 0, 1)):
        at = np.minimum(np.searchsorted(occupied, code + step), len(occupied) - 1)
        hit = (occupied[at] == code + step) & (first[at] < view)
        found.append(np.stack([first[at][hit], view[hit]], 1))
    return np.unique(np.concatenate(found), axis=0)


def _near(view: Int[np.ndarray, " n"], corner: Int[np.ndarray, " n"], pixels: Float[np.ndarray, "n 2"], reach_px: float) -> Pairs:
    """All pairs of views that share a corner within reach."""
    # The third coordinate keeps different corners of the board apart.
    points = np.column_stack([pixels, 2.0 * reach_px * corner])
    rows = cKDTree(points).query_pairs(reach_px, output_type="ndarray")
    return np.unique(np.sort(view[rows].reshape(-1, 2), axis=1), axis=0)


def _alike(
    table: Float[np.ndarray, "views corners 2"], pairs: Pairs, tolerance_px: float, thresholds: DuplicateThresholds
) -> Pairs:
    """The pairs that are duplicates."""
    counts = np.isfinite(table[..., 0]).sum(1)
    kept: list[Bool[np.ndarray, " k"]] = [np.zeros(0, dtype=bool)]
    for start in range(0, len(pairs), _PAIRS_PER_BATCH):
        first, second = pairs[start : start + _PAIRS_PER_BATCH].T
        squares = ((table[first] - table[second]) ** 2).sum(-1)
        common = np.isfinite(squares).sum(1)
        enough = (common >= thresholds.least_common) & (2 * common > np.maximum(counts[first], counts[second]))
        kept.append(enough & (np.nansum(squares, axis=1) <= 2 * common * tolerance_px**2))
    return pairs[np.concatenate(kept)]


def _to_first(pairs: Pairs) -> Pairs:
    """Of sorted or unsorted pairs of duplicates those that lead to the first view that is itself no duplicate."""
    chosen: dict[int, int] = {}
    # In this order it is decided whether a view is a duplicate before its own pairs come.
    for first, second in np.unique(pairs, axis=0).tolist():
        if first not in chosen and second not in chosen:
            chosen[second] = first
    found = sorted((first, second) for second, first in chosen.items())
    return np.array(found, dtype=np.int64).reshape(-1, 2)
