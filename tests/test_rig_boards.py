"""Rigs that see two boards, in known and in unknown relation."""

import numpy as np
import pytest
import torch
from rig_views import (
    FISHEYE_220,
    PINHOLE,
    RigScene,
    boards_at,
    looking_along,
    scene,
    setups,
    worst_pose_error,
)

from camera_models import GeometryError
from camera_models.pose import Pose
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.records import Corners


def two_boards(frames: int, seed: int = 0) -> tuple[RigScene, Corners, Pose]:
    """Two boards at an angle, of which each camera sees one: they meet only where the middle camera sees both."""
    rng = np.random.default_rng(seed)
    axes = np.array([[-0.5, 0.0, 1.0], [0.0, 0.05, 1.0], [0.5, 0.0, 1.0]])
    centres = np.array([[-0.2, 0.0, 0.0], [0.0, 0.02, 0.01], [0.2, 0.0, 0.0]])
    models = (PINHOLE, FISHEYE_220, PINHOLE.with_parameters(PINHOLE.parameters * 1.01))
    target = boards_at(
        np.array([0.0, 0.0, 1.0]) + 0.12 * rng.standard_normal((frames, 3)), rng.uniform(0.8, 1.1, frames), rng, 25
    )
    second = Pose.exp(torch.tensor([0.1, 0.5, 0.05, 0.65, 0.03, -0.1], dtype=torch.float64))
    parts = [scene(models, looking_along(axes, centres), boards) for boards in (target, target @ second)]
    tables = [part.corners for part in parts]
    keep = []
    for b, table in enumerate(tables):
        seen = np.array([camera == "cam1" or camera == ("cam0", "cam2")[b] for camera in table.cameras])
        keep.append(np.flatnonzero(seen))
    views = [(b, v) for b, own in enumerate(keep) for v in own]
    rows = [tables[b].view == v for b, v in views]
    corners = Corners(
        np.repeat(np.arange(len(views)), [row.sum() for row in rows]),
        tuple(f"{tables[b].view_names[v]} board {b}" for b, v in views),
        tuple(tables[b].images[v] for b, v in views),
        np.concatenate([tables[b].board_m[row] for (b, _), row in zip(views, rows, strict=True)]),
        np.concatenate([tables[b].pixels[row] for (b, _), row in zip(views, rows, strict=True)])
        + 0.1 * rng.standard_normal((sum(row.sum() for row in rows), 2)),
        cameras=tuple(tables[b].cameras[v] for b, v in views),
        frames=tuple(tables[b].frames[v] for b, v in views),
        boards=tuple(f"board {b}" for b, _ in views),
    )
    return parts[0], corners, second


@pytest.mark.slow
def test_boards_in_unknown_relation_tie_cameras_together():
    rig, corners, second = two_boards(24)
    result = calibrate_rig(corners, setups(rig), relation="fixed")
    assert len(result.members) == 3 and result.boards == ("board 0", "board 1")
    off = (result.target_from_board[1] @ second.inverse()).log().numpy()
    sigma = np.sqrt(np.diag(result.board_covariance[1]))
    assert (np.abs(off) < 4.5 * sigma).all() and sigma[:3].max() < 1e-3
    turn, shift = worst_pose_error(result, rig)
    assert turn < 0.1 and shift < 1e-3
    # Without the relation, views of different boards say nothing of one another; the middle camera still sees both.
    moving = calibrate_rig(corners, setups(rig), relation="moving")
    assert len(moving.members) == 3 and len(moving.boards) == 1 and len(moving.frames) > len(result.frames)
    known = result.member("cam2").pose_covariance.trace()
    assert known < moving.member("cam2").pose_covariance.trace()


def test_boards_in_known_relation_need_not_be_seen_together():
    """Coordinates of both boards in one frame: cameras that see one board each hang together without any that sees both."""
    rig, corners, second = two_boards(24)
    place = corners.board_m.copy()
    rows = np.array([name == "board 1" for name in corners.boards])[corners.view]
    place[rows] = second.transform(torch.as_tensor(place[rows])).numpy()
    apart = [v for v, camera in enumerate(corners.cameras) if camera != "cam1"]
    keep = np.isin(corners.view, apart)
    number = np.full(len(corners.view_names), -1)
    number[apart] = np.arange(len(apart))
    table = Corners(
        number[corners.view[keep]],
        *(tuple(values[v] for v in apart) for values in (corners.view_names, corners.images)),
        place[keep],
        corners.pixels[keep],
        cameras=tuple(corners.cameras[v] for v in apart),
        frames=tuple(corners.frames[v] for v in apart),
        boards=tuple(corners.boards[v] for v in apart),
    )
    kinds = {name: setup for name, setup in setups(rig).items() if name != "cam1"}
    result = calibrate_rig(table, kinds, relation="known")
    assert [member.name for member in result.members] == ["cam0", "cam2"]
    truth = rig.cam_from_rig[2] @ rig.cam_from_rig[0].inverse()
    off = (result.members[1].cam_from_rig @ truth.inverse()).log().numpy()
    assert (np.abs(off) < 4.5 * np.sqrt(np.diag(result.members[1].pose_covariance))).all()
    given, views = result.as_given()
    np.testing.assert_allclose(given.board_m, place[keep], atol=1e-9)
    used = [v for v, view in enumerate(views) if view.used]
    assert len(used) > 30
    for v in used:
        own = given.view == v
        model = result.member(views[v].camera).model
        pixels, _ = model.project(views[v].cam_from_board.transform(torch.as_tensor(given.board_m[own])))
        assert float((pixels - torch.as_tensor(given.pixels[own])).abs().max()) < 1.0
    with pytest.raises(GeometryError, match="found no two of"):
        calibrate_rig(table, kinds, relation="moving")
