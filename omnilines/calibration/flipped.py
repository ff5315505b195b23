"""Photos that fit the camera of the others mirrored or turned, and not as they are: some programs flip what they save.

The corners of a plain board are found in a mirror image too, and look as those of a board seen from behind. That the lens is not
centred in the image tells them apart; of one that is, a flip does no harm.
"""

import torch
from jaxtyping import Float
from scipy.stats import f
from torch import Tensor

from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards

FLIPS = (
    ("like a mirror image", (-1.0, 1.0)),
    ("like an upside down mirror image", (1.0, -1.0)),
    ("turned by 180 degrees", (-1.0, -1.0)),
)
"""What a photo looks like, and the signs of its pixels, from the middle of the image, beside those of the others."""


def flipped_views(
    points: BoardPoints, state: CameraAndBoards, least_px: float, fits_better: float, significance: float
) -> dict[int, str]:
    """The views that fit a camera more than `fits_better` times as well (root mean square) flipped, beyond chance, and how they
    look; `points` have no gross error, and residuals below `least_px` say nothing. Flipped, they have to fit about as well as
    half of the views do as they are: a lens that the model does not follow favours a flip at times, which fits badly too.

    What else moves the corners of a view, such as a bent board, does so flipped or not.
    """
    freedom = (2 * points.counts - 6).clamp_min(1)
    variance = points.sum_by_view(state.residual_px(points).square().sum(-1)) / freedom
    # None fits better flipped than the best view as it is.
    views = torch.nonzero(variance > fits_better**2 * variance.min().clamp_min(least_px**2)).flatten().tolist()
    if not views:
        return {}
    some, freedom = points.of_views(views), freedom[views]
    as_it_is, *flipped = (_squares_px2(some, state, signs) for signs in ((1.0, 1.0), *(signs for _, signs in FLIPS)))
    least, which = torch.stack(flipped).min(0)
    better = torch.from_numpy(f.sf(as_it_is / least / fits_better**2, freedom, freedom)) < significance
    told = better & (least <= freedom * fits_better**2 * variance.median())
    return {views[k]: FLIPS[int(which[k])][0] for k in torch.nonzero(told).flatten().tolist()}


def _squares_px2(points: BoardPoints, state: CameraAndBoards, signs: tuple[float, float]) -> Float[Tensor, " v"]:
    """Sums of the squared residuals of views whose pixels are flipped, at the poses that they then have."""
    model = state.model
    middle = (torch.tensor(model.image_size, dtype=torch.float64) - 1) / 2
    flipped = BoardPoints(points.view, points.views, points.board, middle + (points.pixels - middle) * torch.tensor(signs))
    poses = resect_boards(flipped, model.unproject(flipped.pixels)[0])
    held = torch.zeros(len(model.parameters), 0, dtype=torch.float64)
    end = BoardProblem(flipped, held).solve(CameraAndBoards(model, poses, state.shape)).state
    return flipped.sum_by_view(end.residual_px(flipped).square().sum(-1))
