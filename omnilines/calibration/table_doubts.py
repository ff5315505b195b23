"""Corners that no camera fits: what is wrong with their table, or the board, where the corners themselves tell it."""

from collections.abc import Callable

from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import InputError
from camera_models.wording import rounded
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.thresholds import DoubtThresholds
from omnilines.least_squares import Progress


def refuse_disorder(in_order: Bool[Tensor, " v"]) -> None:
    """Raises InputError where no view has its corners in the order of a board, whatever the camera is (`smooth_corners`)."""
    if not bool(in_order.any()):
        raise InputError(
            f"Corners in the order of a board were expected, found none of {len(in_order)} views in which pixels follow the "
            "places on the board smoothly; check that rows and columns are not exchanged, and which pixel is of which corner."
        )


def refuse_other_squares(
    problem: BoardProblem, found: CameraAndBoards, thresholds: DoubtThresholds, callback: Callable[[Progress], None] | None = None
) -> None:
    """Raises InputError where a board of squares that are less, or more, oblong than written fits far better."""
    left_px = _rms_px(found, problem.points)
    if not found.shape.plain or left_px <= thresholds.good_share * max(found.model.image_size):
        return
    shape = BoardShape.to_refine(("aspect",), problem.points.board)
    oblong = BoardProblem(problem.points, problem.basis, problem.weight, shape)
    end = oblong.solve(CameraAndBoards(found.model, found.cam_from_board, shape), callback=callback).state
    without_px = _rms_px(end, problem.points)
    if abs(_aspect(end)) >= thresholds.oblong and thresholds.fits_better * without_px <= left_px:
        raise InputError(
            f"The corners fit a board whose y is {1 + _aspect(end):.3g} times as long beside x as it is written: with it the "
            f"camera leaves {rounded(without_px)} px, as written {rounded(left_px)} px (root mean square); correct the size "
            "of the "
            "squares, or let `refine_board` find their aspect."
        )


def misfit_notes(
    rms_px_per_axis: float, image_size: tuple[int, int], stated_px: float, thresholds: DoubtThresholds
) -> tuple[str, ...]:
    """A sentence where corners lie farther from where the camera sees them than any detector is off."""
    if rms_px_per_axis <= max(thresholds.rough_share * max(image_size), thresholds.rough_sigmas * stated_px):
        return ()
    return (
        f"The corners lie {rounded(rms_px_per_axis)} px (root mean square, per axis) from where the camera sees them, far "
        "more than "
        "corners are found wrongly by: do not rely on the camera, and check the pattern and the table, that all photos are of "
        "one camera, and the camera model (model `auto` compares all).",
    )


def size_notes(board_m: Float[Tensor, "n 3"], thresholds: DoubtThresholds) -> tuple[str, ...]:
    """A sentence where the board is larger or smaller than boards are. The camera does not depend on it, lengths do."""
    extent = board_m.amax(0) - board_m.amin(0)
    longest = float(extent.max())
    if thresholds.smallest_m <= longest <= thresholds.largest_m:
        return ()
    likely = (
        "are its coordinates in millimetres? Divide them by 1000" if longest > thresholds.largest_m else "are they in metres?"
    )
    return (f"The board is {longest:.3g} m long: {likely}; the camera is the same, but poses and distances are not.",)


def _aspect(state: CameraAndBoards) -> float:
    return float(state.shape.terms[0])


def _rms_px(state: CameraAndBoards, points: BoardPoints) -> float:
    return float(state.residual_px(points).square().mean().sqrt())
