"""Numberings of plain boards and sides of mirrors, resolved by the consistency of a rig."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_views import (
    BOARD,
    COLUMNS,
    FISHEYE_220,
    MIRROR,
    ROWS,
    SQUARE_M,
    boards_at,
    looking_along,
    mixed_rig,
    pair,
    renumbered,
    scene,
    setups,
    worst_pose_error,
)

from camera_models import GeometryError, Scaramuzza
from omnilines.calibration.numbering import Lattice, Numbering
from omnilines.calibration.rig.calibrate import calibrate_rig


def half_a_turn(board):
    return np.array([(COLUMNS - 1) * SQUARE_M, (ROWS - 1) * SQUARE_M, 0.0]) - board


def test_placements_are_the_motions_of_the_lattice_onto_itself():
    """Against a search of all turns and shifts by brute force."""
    lattice = Lattice.of(BOARD)
    assert lattice is not None and lattice.last.tolist() == [COLUMNS - 1, ROWS - 1]
    names = {tuple(np.rint(p[:2] / SQUARE_M).astype(int)) for p in BOARD}
    for low, high in (((0, 0), (8, 5)), ((2, 1), (6, 4)), ((0, 0), (2, 2))):
        patch = BOARD[[low[0] <= x <= high[0] and low[1] <= y <= high[1] for x, y in np.rint(BOARD[:, :2] / SQUARE_M)]]
        found = set()
        for mirrored in (False, True):
            motions = Numbering(lattice).placements(np.array(low), np.array(high), np.zeros(2, dtype=np.int64), mirrored)
            assert torch.equal(motions.rotation[0], torch.eye(3, dtype=torch.float64))
            assert bool((torch.linalg.det(motions.rotation) > 0.99).all())
            places = motions.transform(torch.as_tensor(patch)).numpy()
            assert np.abs(places[..., 2]).max() == 0
            images = [tuple(map(tuple, np.rint(place[:, :2] / SQUARE_M).astype(int).tolist())) for place in places]
            assert all(set(image) <= names for image in images) and len(set(images)) == len(images)
            found = set(images)
            expected = set()
            turns = [np.array(m) for m in ([[1, 0], [0, 1]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]], [[0, 1], [-1, 0]])]
            if mirrored:
                turns += [t @ np.array([[1, 0], [0, -1]]) for t in turns]
            index = np.rint(patch[:, :2] / SQUARE_M).astype(int)
            for turn in turns:
                for x in range(-20, 21):
                    for y in range(-20, 21):
                        image = tuple(map(tuple, (index @ turn.T + [x, y]).tolist()))
                        if set(image) <= names:
                            expected.add(image)
            assert found == expected and len(expected) >= 2


def test_colours_leave_fewer_numberings():
    """The whole of a board with 9 x 6 inner corners has one numbering with a black first square, one of 8 x 6 has two."""
    none = np.zeros(2, dtype=np.int64)
    for columns, rows, count in ((9, 6, 1), (8, 6, 2), (5, 5, 2), (4, 4, 4)):
        board = np.array([[x, y, 0.0] for y in range(rows) for x in range(columns)])
        lattice = Lattice.of(board)
        assert lattice is not None
        assert len(Numbering(lattice, coloured=True).placements(none, lattice.last, none, False)) == count


def test_tags_form_no_lattice():
    x = np.array([0.0, 0.035, 0.0455, 0.0805])
    assert Lattice.of(np.array([[a, -b, 0.0] for b in x for a in x])) is None


@pytest.mark.slow
def test_half_turns_are_undone():
    rig = pair(16)
    turned = [
        v
        for v, (camera, frame) in enumerate(zip(rig.corners.cameras, rig.corners.frames, strict=True))
        if camera == "cam1" and int(frame) % 2
    ]
    assert len(turned) > 5
    plain, fixed = (
        calibrate_rig(corners, setups(rig)) for corners in (rig.noisy(0.1, 1), renumbered(rig.noisy(0.1, 1), turned, half_a_turn))
    )
    assert fixed.kept.all() and all(view.used for view in fixed.views)
    # In every such frame one of the two views is numbered as the other.
    anew = [view.frame for view in fixed.views if view.remarks]
    assert sorted(anew) == sorted(rig.corners.frames[v] for v in turned)
    assert abs(fixed.rms_px_per_axis - plain.rms_px_per_axis) < 1e-9
    np.testing.assert_allclose(fixed.members[1].cam_from_rig.translation, plain.members[1].cam_from_rig.translation, atol=1e-9)


def test_shifts_of_partly_seen_boards_are_undone():
    """Both cameras see parts only, each numbered from its own first corner."""
    rig = pair(18, seed=2)
    rng = np.random.default_rng(5)
    keep = np.ones(len(rig.corners), dtype=bool)
    board = rig.corners.board_m.copy()
    for v in range(len(rig.corners.view_names)):
        rows = np.flatnonzero(rig.corners.view == v)
        index = np.rint(board[rows, :2] / SQUARE_M).astype(int)
        # Parts of 5 to 7 columns; every fourth view is whole.
        width = COLUMNS if v % 4 == 0 else rng.integers(5, 8)
        first = rng.integers(0, COLUMNS - width + 1)
        inside = (index[:, 0] >= first) & (index[:, 0] < first + width)
        keep[rows] = inside
        board[rows, 0] -= first * SQUARE_M
    corners = rig.noisy(0.1, 3)
    corners = replace(corners, view=corners.view[keep], board_m=board[keep], pixels=corners.pixels[keep])
    result = calibrate_rig(corners, setups(rig))
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.1 and shift < 1e-3
    assert np.mean([view.used for view in result.views]) > 0.9
    assert sum(bool(view.remarks) for view in result.views) > 5


def test_views_in_the_wrong_frame_are_dropped_with_their_reason():
    rig = pair(14)
    names = rig.corners.frames
    own = [v for v, camera in enumerate(rig.corners.cameras) if camera == "cam1"]
    frames = list(names)
    frames[own[2]], frames[own[3]] = frames[own[3]], frames[own[2]]
    result = calibrate_rig(replace(rig.noisy(0.1, 2), frames=tuple(frames)), setups(rig))
    dropped = [v for v, view in enumerate(result.views) if not view.used]
    # Of two views that contradict each other either may be the wrong one.
    pairs = [{v, names.index(frames[v])} for v in (own[2], own[3])]
    assert len(dropped) == 2 and all(any(v in two for v in dropped) for two in pairs)
    assert all("wrong frame" in result.views[v].reason for v in dropped)
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.1 and shift < 1e-3


@pytest.mark.slow
def test_half_turns_that_one_common_frame_cannot_tell_are_not_guessed():
    """One common frame: with numberings that are not to be trusted, the camera is left out and the reason says so."""
    rig = pair(12)
    frames = tuple(
        f"{camera} {frame}" if frame != "003" else frame
        for camera, frame in zip(rig.corners.cameras, rig.corners.frames, strict=True)
    )
    corners = replace(rig.noisy(0.1, 2), frames=frames)
    trusted = calibrate_rig(corners, setups(rig))
    turn, shift = worst_pose_error(trusted, rig)
    assert len(trusted.members) == 2 and turn < 1 and shift < 0.01
    lattice = Lattice.of(BOARD)
    with pytest.raises(GeometryError, match="do not tell how the corners of the plain board are numbered"):
        calibrate_rig(corners, setups(rig), numberings={"board": Numbering(lattice, trusted=False)})


@pytest.mark.parametrize("mirrored_numbers", [False, True])
@pytest.mark.slow
def test_side_of_a_mirror_follows_from_the_rig(mirrored_numbers):
    """A mirror camera beside a pinhole and a fisheye, its corners numbered as on the print or as they look in the mirror."""
    rig = mixed_rig(20)
    corners = rig.noisy(0.1, 1)
    if mirrored_numbers:
        views = [v for v, camera in enumerate(corners.cameras) if camera == "cam2"]
        corners = renumbered(corners, views, lambda b: b * [-1, 1, 1] + [(COLUMNS - 1) * SQUARE_M, 0, 0])
    # In some frames no other camera sees the board.
    frames = [f"lone {f}" if c == "cam2" and int(f) > 15 else f for c, f in zip(corners.cameras, corners.frames, strict=True)]
    result = calibrate_rig(replace(corners, frames=tuple(frames)), setups(rig))
    assert all(view.used for view in result.views) and len(result.frames) == 24
    member = result.member("cam2")
    assert member.sign_source == "rig" and float(member.model.parameters[5]) < 0
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.1 and shift < 1e-3
    assert all(result.member(name).sign_source is None for name in ("cam0", "cam1"))


@pytest.mark.slow
def test_side_of_a_lens_follows_from_the_rig():
    """A lens with a polynomial beside one of known side keeps a0 > 0; where all are polynomials, their common side is assumed."""
    lens = Scaramuzza([512.0, 500.0, 1.0, 0.0, 0.0, 250.0, -1.4e-3, 0.0, -1.2e-9], (1020, 1000))
    rng = np.random.default_rng(1)
    axes = np.array([[0.0, 0.0, 1.0], [0.5, 0.05, 1.0]])
    boards = boards_at(np.array([0.2, 0.0, 1.0]) + 0.5 * rng.standard_normal((16, 3)), rng.uniform(0.3, 0.6, 16), rng)
    for first, source in ((FISHEYE_220, "rig"), (lens, "assumed")):
        rig = scene((first, lens), looking_along(axes, np.array([[0.0, 0, 0], [0.2, 0.02, 0.01]])), boards)
        result = calibrate_rig(rig.noisy(0.1, 1), setups(rig))
        assert float(result.members[1].model.parameters[5]) > 0
        assert result.members[1].sign_source == source
        turn, shift = worst_pose_error(result, rig)
        assert turn < 0.1 and shift < 1e-3


@pytest.mark.slow
def test_numbers_of_the_printed_side_tell_a_mirror_by_themselves():
    """Two mirror cameras and nothing else: corners named by tags are seen from the printed side."""
    other = MIRROR.with_parameters(MIRROR.parameters + torch.tensor([3.0, -2, 0, 0, 0, 2, 0, 0, 0], dtype=torch.float64))
    rng = np.random.default_rng(1)
    axes = np.array([[0.0, 0.0, -1.0], [0.2, 0.05, -1.0]])
    boards = boards_at(np.array([0.0, 0.0, 1.0]) + 0.6 * rng.standard_normal((20, 3)), rng.uniform(0.4, 0.6, 20), rng)
    rig = scene((MIRROR, other), looking_along(axes, np.array([[0.0, 0, 0], [0.2, 0.02, 0.01]])), boards)
    result = calibrate_rig(rig.noisy(0.1, 1), setups(rig), numberings={"board": Numbering()}, seen_from_front=True)
    assert all(member.sign_source == "tags" and float(member.model.parameters[5]) < 0 for member in result.members)
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.2 and shift < 2e-3
    # From plain boards the same rig is found with all cameras turned over: the mirror image.
    assumed = calibrate_rig(rig.noisy(0.1, 1), setups(rig))
    assert all(member.sign_source == "assumed" and float(member.model.parameters[5]) > 0 for member in assumed.members)
    assert abs(assumed.rms_px_per_axis - result.rms_px_per_axis) < 1e-6
