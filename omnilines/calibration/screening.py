"""Gross errors found before any camera is known: within a view, a pixel is a smooth function of the place on the board.

A polynomial of the board coordinates is fitted to the pixels of every view by least absolute deviations (iteratively
reweighted least squares; E. J. Schlossmacher 1973), which a fifth of wrong corners does not move. Lens distortion over one
board is smooth, so that what it leaves beyond the polynomial sets the scale, and corners far beyond that scale are wrong.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.thresholds import ScreeningThresholds

DEGREES = ((3, 24), (2, 14))
"""Degree of the polynomial, and the corners that a view must have for it: more than twice its terms."""
ROUNDS = 12


def smooth_corners(
    points: BoardPoints, thresholds: ScreeningThresholds = ScreeningThresholds()
) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " v"]]:
    """Corners without gross error, and views whose corners are in an order that fits a board.

    Views with too few corners to tell are left as they are.
    """
    kept = torch.ones(len(points.view), dtype=torch.bool)
    in_order = torch.ones(points.views, dtype=torch.bool)
    upper = None
    for degree, least in DEGREES:
        wanted = (points.counts >= least) & (points.counts < (upper or torch.inf))
        upper = least
        views = torch.nonzero(wanted).flatten().tolist()
        if not views:
            continue
        rows = wanted[points.view]
        chosen = points.of_views(views)
        distance = _distance_from_polynomial(chosen, degree)
        typical = _median_by_view(distance, chosen)
        kept[rows] = distance <= (thresholds.far_factor * typical[chosen.view]).clamp_min(thresholds.near_px)
        middle = chosen.mean_by_view(chosen.pixels)
        extent = chosen.mean_by_view(((chosen.pixels - middle[chosen.view]) ** 2).sum(-1)).sqrt()
        in_order[views] = typical <= (thresholds.disorder_share * extent).clamp_min(thresholds.near_px)
    return kept, in_order


def _distance_from_polynomial(points: BoardPoints, degree: int) -> Float[Tensor, " n"]:
    """Distance (px) of every corner from the polynomial of its view, fitted by least absolute deviations."""
    middle = points.mean_by_view(points.board[:, :2])
    local = points.board[:, :2] - middle[points.view]
    local = local / points.mean_by_view((local**2).sum(-1)).sqrt().clamp_min(1e-300)[points.view, None]
    terms = [local[:, 0] ** i * local[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = torch.stack(terms, -1)
    columns = design.shape[1]
    joint = torch.cat([design, points.pixels], -1)
    weight = torch.ones_like(local[:, 0])
    ridge = 1e-10 * torch.eye(columns, dtype=joint.dtype)
    distance = weight
    for _ in range(ROUNDS):
        gram = points.cells.gram((joint * weight.sqrt()[:, None])[:, None, :])
        normal = gram[:, :columns, :columns]
        size = normal.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None].clamp_min(1e-300)
        solution = torch.linalg.solve(normal + ridge * size, gram[:, :columns, columns:])
        distance = (points.pixels - (design[:, None, :] @ solution[points.view])[:, 0]).norm(dim=-1)
        # The weights of least absolute deviations, bounded where the fit passes through a corner.
        floor = 0.1 * points.mean_by_view(distance[:, None])[:, 0]
        weight = 1 / torch.maximum(distance, floor[points.view]).clamp_min(1e-9)
    return distance


def _median_by_view(values: Float[Tensor, " n"], points: BoardPoints) -> Float[Tensor, " v"]:
    """Lower median of the values of every view."""
    order = torch.argsort(values)
    order = order[torch.argsort(points.view[order], stable=True)]
    first = torch.cumsum(points.counts, 0) - points.counts
    return values[order][first + (points.counts - 1) // 2]
