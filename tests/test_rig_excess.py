"""Rigs whose board is bent, or moves between two shutters: the cause is named, the bend is found, and uncertainty holds both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rig_views import BOARD, SQUARE_M, RigScene, pair, setups

from camera_models import InputError
from camera_models.pose import Pose
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.numbering import Numbering
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.result import RigCalibration
from omnilines.records import Corners

NOISE_PX = 0.1


def seen(rig: RigScene, shape: BoardShape, moved_m: float, seed: int) -> Corners:
    """The corners of a rig's board in this shape, which the second camera sees elsewhere by so much."""
    rng = np.random.default_rng(seed)
    corners = rig.corners
    places = shape.place(torch.as_tensor(corners.board_m))
    pixels = corners.pixels.copy()
    for view, (camera, frame) in enumerate(zip(corners.cameras or (), corners.frames or (), strict=True)):
        rows, c = corners.view == view, rig.names.index(camera)
        away = torch.as_tensor(rng.normal(0.0, moved_m, 3)) if c else torch.zeros(3, dtype=torch.float64)
        motion = Pose(torch.eye(3, dtype=torch.float64), away)
        pose = rig.cam_from_rig[c] @ rig.rig_from_board[int(frame)] @ motion
        pixels[rows] = rig.models[c].project(pose.transform(places[rows]))[0].numpy()
    return replace(corners, pixels=pixels + rng.normal(0.0, NOISE_PX, pixels.shape))


def bent() -> BoardShape:
    shape = BoardShape.to_refine(("surface",), torch.as_tensor(BOARD))
    terms = 1e-3 * torch.tensor([0, 2, -1, 1, 1, 2, 0, -2, 1, 0, 2, 0, 1], dtype=torch.float64)
    return shape.moved(shape.free @ (shape.free.mT @ terms))


def cause(result: RigCalibration) -> str:
    found = [note for note in result.notes if note.startswith("Together the cameras fit")]
    return found[0] if found else ""


@pytest.mark.slow
def test_a_bent_board_is_named_and_its_surface_found() -> None:
    rig, shape = pair(20), bent()
    corners = seen(rig, shape, 0.0, 1)
    flat = calibrate_rig(corners, setups(rig))
    assert "moved between two shutters" not in cause(flat)
    fitted = calibrate_rig(corners, setups(rig), refine_board=("surface",))
    assert cause(fitted) == "" and abs(fitted.rms_px_per_axis - NOISE_PX) < 0.1 * NOISE_PX < flat.rms_px_per_axis - NOISE_PX
    errors = np.array([fitted.board_terms[name] for name in shape.free_names]) - (shape.free.mT @ shape.terms).numpy()
    # Chi-square of 12 degrees of freedom, diagonal only: below 40 but once in ten thousand times.
    assert np.sum((errors / np.array(list(fitted.board_sigma.values()))) ** 2) < 40
    assert [name for name in fitted.names if name.startswith("board.")] == [f"board.{name}" for name in shape.free_names]
    assert np.isfinite(fitted.covariance).all()


@pytest.mark.slow
def test_a_board_that_moves_between_shutters_is_named_and_widens_what_is_stated() -> None:
    rig = pair(20)
    still, moving = (calibrate_rig(seen(rig, BoardShape(), moved_m, 2), setups(rig)) for moved_m in (0.0, 1.5e-3))
    assert cause(still) == ""
    assert "moved between two shutters" in cause(moving) and "not flat" not in cause(moving)
    named = [note for note in moving.notes if note.startswith("The board moved between the shutters")]
    # One of two cameras that see it 1.5 mm apart is 1.06 mm from their mean.
    assert len(named) == 1 and 0.75 < float(named[0].split("by ")[1].split(" mm")[0]) < 1.45
    assert still.one_pose_rms_px is None and (moving.one_pose_rms_px or 0.0) > 1.5 * moving.rms_px_per_point
    assert all(view.used for view in moving.views) and moving.rms_px_per_axis < 1.05 * NOISE_PX
    true = float(rig.cam_from_rig[1].centre.norm())
    link = moving.links[0]
    assert abs(link.baseline_m - true) < 3 * link.baseline_sigma_m and link.baseline_sigma_m > 3 * still.links[0].baseline_sigma_m


@pytest.mark.slow
@pytest.mark.parametrize(
    "numberings", [pytest.param(None, id="lattice", marks=pytest.mark.full), pytest.param({"board": Numbering()}, id="tags")]
)
def test_views_of_another_instant_stay_out_where_the_board_moves(numberings: dict[str, Numbering] | None) -> None:
    """Two photos of one camera exchanged: a motion of the board that held them would be a hundred times that of all others."""
    rig = pair(12)
    corners = seen(rig, BoardShape(), 1.5e-3, 2)
    as_taken = calibrate_rig(corners, setups(rig), numberings=numberings)
    of = {(camera, frame): v for v, (camera, frame) in enumerate(zip(corners.cameras or (), corners.frames or (), strict=True))}
    shared = [frame for camera, frame in of if camera == rig.names[1] and (rig.names[0], frame) in of]
    first, second = (of[rig.names[1], frame] for frame in (shared[2], shared[-2]))
    frames = list(corners.frames or ())
    frames[first], frames[second] = frames[second], frames[first]
    exchanged = calibrate_rig(replace(corners, frames=tuple(frames)), setups(rig), numberings=numberings)
    lost = [view for view in exchanged.views if not view.used]
    # Of the two views of a frame nothing tells which is of another instant.
    assert sorted(view.frame or "" for view in lost) == sorted([shared[2], shared[-2]])
    (note,) = (note for note in exchanged.notes if note.startswith("Left out"))
    assert all("wrong frame" in (view.reason or "") and view.name in note for view in lost)
    assert exchanged.links[0].baseline_sigma_m < 1.3 * as_taken.links[0].baseline_sigma_m


@pytest.mark.full
def test_a_bent_board_that_moves_loses_no_view_where_its_surface_is_estimated() -> None:
    """Each camera alone, on a flat board, fits worse than the rig on the bent one, moved though it is."""
    rig, shape = pair(20), bent()
    fitted = calibrate_rig(seen(rig, shape, 0.8e-3, 3), setups(rig), refine_board=("surface",))
    assert "moved between two shutters" in cause(fitted) and all(view.used for view in fitted.views)
    assert fitted.rms_px_per_axis < 1.05 * NOISE_PX
    assert all(abs(member.rms_px_per_point / member.alone_rms_px_per_point - 1) < 0.05 for member in fitted.members)
    errors = np.array([fitted.board_terms[name] for name in shape.free_names]) - (shape.free.mT @ shape.terms).numpy()
    assert np.sum((errors / np.array(list(fitted.board_sigma.values()))) ** 2) < 40


def test_one_board_only_is_refined() -> None:
    rig = pair(8)
    two = replace(rig.corners, boards=tuple("ab"[k % 2] for k in range(len(rig.corners.view_names))))
    with pytest.raises(InputError, match="One board was expected with `refine_board`, found 2"):
        calibrate_rig(two, setups(rig), refine_board=("flatness",))


RIGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "rigs"


@pytest.mark.full
@pytest.mark.skipif(not RIGS.is_dir(), reason="shared data are not there")
def test_the_cause_in_a_real_pair_is_named() -> None:
    """A hand-held paper board: bent, and moved or bent anew in every view; what is left once its surface is known is its pose."""
    import omnilines as ol

    found = ol.detect_rig(RIGS / "stereo_fisheye", "checkerboard:9x6:24.23mm")
    drawn = ol.calibrate_rig(found, model="opencv-fisheye")
    surface = ol.calibrate_rig(found, model="opencv-fisheye", refine_board=("surface",))
    assert "is a board that is not flat" in cause(drawn.fit) and "moved between two shutters" in cause(drawn.fit)
    assert surface.rms_px_per_point < 0.8 * drawn.rms_px_per_point and all(view.used for view in surface.fit.views)
    assert surface.fit.links[0].translation_sigma_m < drawn.fit.links[0].translation_sigma_m
    assert "not flat" not in cause(surface.fit) and len(surface.fit.board_terms) == 12


@pytest.mark.slow
def test_frames_in_which_the_board_is_at_one_place_count_once() -> None:
    """A bent board that stands still while cameras film it: five frames of each place are wrong alike."""
    rig = pair(10, seed=3)
    once = seen(rig, bent(), 0.0, 3)
    rng, views, count = np.random.default_rng(7), range(len(once.view_names)), 5
    order = [view for view in views for _ in range(count)]
    rows = [np.flatnonzero(once.view == view) for view in order]
    every, names = np.concatenate(rows), tuple(f"{once.view_names[view]} {k}" for k, view in enumerate(order))
    filmed = replace(
        once,
        view=np.repeat(np.arange(len(order)), [len(own) for own in rows]),
        view_names=names,
        images=names,
        board_m=once.board_m[every],
        pixels=once.pixels[every] + rng.normal(0.0, NOISE_PX, (len(every), 2)),
        cameras=tuple((once.cameras or ())[view] for view in order),
        frames=tuple(f"{(once.frames or ())[view]} {k % count}" for k, view in enumerate(order)),
    )
    found, often = calibrate_rig(once, setups(rig)), calibrate_rig(filmed, setups(rig))
    true = float(rig.cam_from_rig[1].centre.norm())
    assert often.links[0].baseline_sigma_m > 0.8 * found.links[0].baseline_sigma_m
    assert abs(often.links[0].baseline_m - true) < 3 * often.links[0].baseline_sigma_m
    # It is the board and no lens that does not follow, in five frames as in one.
    assert all(member.misfit is None for member in often.members)
    assert often.unmodelled is not None and often.unmodelled.kind == "flatness"


@pytest.mark.parametrize("stated", [NOISE_PX, 5 * NOISE_PX])
def test_few_corners_that_follow_no_pose_of_their_own_are_not_taken_for_a_worse_fit(stated: float) -> None:
    """Of every view only every other column and row; the second camera counts as little as its table states."""
    rig = pair(20, seed=2)
    corners = rig.noisy(NOISE_PX, 2)
    some = (np.rint(corners.board_m[:, :2] / SQUARE_M) % 2 == 0).all(1)
    sigma = np.where(np.array(corners.cameras)[corners.view] == "cam1", stated, NOISE_PX)[some]
    few = replace(corners, view=corners.view[some], board_m=corners.board_m[some], pixels=corners.pixels[some], sigma_px=sigma)
    found = calibrate_rig(few, setups(rig))
    assert found.member("cam1").rms_px_per_point > 1.08 * found.member("cam1").alone_rms_px_per_point
    assert not any(member.worse for member in found.members)
    assert not any("worse than alone" in note or "contradict" in note for note in found.notes)
