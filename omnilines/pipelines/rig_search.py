"""Photos of a rig searched once more: where the other cameras say that the board is, and in the rig's numbering."""

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from calib_patterns import Pattern
from camera_models.pose import Pose
from omnilines.calibration.rig.result import RigCalibration
from omnilines.pipelines.detect import search_again
from omnilines.pipelines.detect_rig import corners_of_cameras
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.pipelines.rig_corners import CameraCorners, RigCorners
from omnilines.posing.instant_names import frame_of
from omnilines.progress import ProgressCallback

SAME_CORNER_M = 1e-6


def searched_with_rig(
    source: RigCorners, result: RigCalibration, executor: Executor | None, progress: ProgressCallback
) -> RigCorners | None:
    """The corners found and those that the rig leads to, fitted along the edges that its cameras see; None where no photo is
    at hand."""
    members = {member.name for member in result.members}
    found: list[CameraCorners] = []
    gained, looked = 0, False
    for item in source.cameras:
        known, poses = item.found, dict[str, Pose]()
        if item.camera in members:
            known, poses, model = _as_the_rig_numbers(item, result), _predicted(item, result), result.member(item.camera).model
        elif item.camera in result.left_out_alone:
            # A camera that hangs together with no other may do so with the corners that it leads to itself.
            alone = result.left_out_alone[item.camera]
            model = alone.model
            poses = {view.name: view.cam_from_board for view in alone.views if view.cam_from_board is not None}
        else:
            found.append(item)
            continue
        again = search_again(known, model, poses, first=True, executor=executor, progress=progress)
        gained += len(again.corners) - len(item.found.corners)
        looked = looked or bool(poses)
        found.append(replace(item, found=again))
    if not looked:
        return None
    notes = (f"The rig led to {gained} corners that had been missed.",) if gained > 0 else ()
    fresh = corners_of_cameras(found, source.corners.boards is not None, source.times_s)
    return replace(source, corners=fresh.corners, skipped=fresh.skipped, cameras=fresh.cameras, notes=(*source.notes, *notes))


def _predicted(item: CameraCorners, result: RigCalibration) -> dict[str, Pose]:
    """cam_from_board of every photo of a camera in whose frame the rig knows where the target is."""
    board = item.pattern.specification
    boards = list(result.boards)
    member = result.member(item.camera)
    place = {name: k for k, name in enumerate(result.frames)}
    found = {}
    for photo in item.found.photos:
        frame = frame_of(PurePosixPath(photo.name))
        # Boards that move by themselves have a pose of their own in every frame.
        key = place.get(frame, place.get(f"{frame} {board}"))
        part = boards.index(board) if board in boards else 0
        if key is not None:
            found[photo.name] = member.cam_from_rig @ result.rig_from_target[key] @ result.target_from_board[part]
    return found


def _as_the_rig_numbers(item: CameraCorners, result: RigCalibration) -> PhotoCorners:
    """What was found, with the ids that the rig gives to the corners of plain boards; views that it numbers beyond the board
    are left out."""
    corners, own = result.corners, item.found.corners
    names = {name: v for v, name in enumerate(own.view_names)}
    boards = corners.boards or (item.pattern.specification,) * len(corners.view_names)
    views = zip(corners.view_names, boards, strict=True)
    place = np.array([names.get(name, -1) if board == item.pattern.specification else -1 for name, board in views])
    # The rig's table holds those of all cameras one after another: these are all of this camera, in their order.
    rows = place[corners.view] >= 0
    ids, known = _ids(item.pattern, corners.board_m[rows])
    keep = (np.bincount(own.view, ~known, len(names)) == 0)[own.view]
    table = replace(
        own,
        view=own.view[keep],
        board_m=corners.board_m[rows][keep],
        pixels=own.pixels[keep],
        sigma_px=None if own.sigma_px is None else own.sigma_px[keep],
        ids=ids[keep],
    )
    return replace(item.found, corners=table, blur_px=None if item.found.blur_px is None else item.found.blur_px[keep])


def _ids(pattern: Pattern, board_m: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The corner of the pattern at each place, and whether there is one."""
    distance, index = cKDTree(pattern.points_m).query(board_m)
    return np.asarray(index, dtype=np.int64), np.asarray(distance) < SAME_CORNER_M
