"""Cameras that never see the same board at once: a rig that moves between two walls with a board on each."""

import numpy as np
import pytest
import scipy.stats
import torch
from rig_views import BOARD, PINHOLE, RigScene, looking_along, seen_by_all, setups, worst_pose_error

from camera_models import GeometryError
from camera_models.pose import Pose, rotation_from_vector
from omnilines.calibration.rig.apart import camera_and_board
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.thresholds import RigThresholds
from omnilines.records import Corners

AXES = np.array([[0.0, 0.0, 1.0], [0.1, 0.05, -1.0]])
MOUNTED = looking_along(AXES, 0.1 * AXES)


def between_walls(frames: int, seed: int = 0, turns: tuple[float, float, float] = (25.0, 25.0, 50.0)) -> RigScene:
    """Two cameras that look apart, carried about (turned by up to `turns`, degrees) between two walls with a board on each."""
    rng = np.random.default_rng(seed)
    rotation = rotation_from_vector(torch.as_tensor(np.radians(turns) * rng.uniform(-1, 1, (frames, 3))))
    places = torch.as_tensor(rng.uniform(-0.25, 0.25, (frames, 3)))
    rig_from_world = Pose(rotation, -(rotation @ places[..., None])[..., 0])
    walls = torch.stack([torch.eye(3, dtype=torch.float64), torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))])
    ends = torch.tensor([[0.0, 0.0, 0.9], [0.05, 0.02, -0.95]], dtype=torch.float64)
    world_from_board = Pose(walls, ends - walls @ torch.as_tensor(BOARD.mean(0)))
    models = (PINHOLE, PINHOLE.with_parameters(PINHOLE.parameters * 1.01))
    cam_from_rig = MOUNTED @ MOUNTED[0].inverse()
    of_boards = [rig_from_world @ world_from_board[b] for b in (0, 1)]
    parts = [seen_by_all(models, cam_from_rig, MOUNTED[0] @ poses) for poses in of_boards]
    starts = (0, len(parts[0].view_names))
    names = tuple(f"{name}/{b}" for b, part in enumerate(parts) for name in part.view_names)
    corners = Corners(
        np.concatenate([part.view + start for part, start in zip(parts, starts, strict=True)]),
        names,
        parts[0].images + parts[1].images,
        np.concatenate([part.board_m for part in parts]),
        np.concatenate([part.pixels for part in parts]),
        cameras=(parts[0].cameras or ()) + (parts[1].cameras or ()),
        frames=(parts[0].frames or ()) + (parts[1].frames or ()),
        boards=("front",) * len(parts[0].view_names) + ("back",) * len(parts[1].view_names),
    )
    return RigScene(models, cam_from_rig, of_boards[0], corners)


def test_each_camera_sees_a_board_of_its_own() -> None:
    rig = between_walls(16)
    pairs = set(zip(rig.corners.cameras or (), rig.corners.boards or (), strict=True))
    assert pairs == {("cam0", "front"), ("cam1", "back")}
    result = calibrate_rig(rig.noisy(0.1, 1), setups(rig), relation="fixed")
    assert [member.name for member in result.members] == ["cam0", "cam1"]
    off = (result.members[1].cam_from_rig @ rig.cam_from_rig[1].inverse()).log().numpy()
    assert off @ np.linalg.solve(result.members[1].pose_covariance, off) < scipy.stats.chi2.ppf(0.999, 6)
    turned_deg, moved_m = worst_pose_error(result, rig)
    assert turned_deg < 0.1 and moved_m < 4e-3


def test_turns_about_one_axis_do_not_tell_how_they_stand() -> None:
    rig = between_walls(16, turns=(0.0, 40.0, 0.0))
    with pytest.raises(GeometryError) as refused:
        calibrate_rig(rig.noisy(0.1, 1), setups(rig), relation="fixed")
    print(refused.value)
    assert "two axes" in str(refused.value)


def test_exact_poses_give_the_exact_start() -> None:
    rng = np.random.default_rng(0)

    def poses(count: int, size: float) -> Pose:
        turns, places = rng.standard_normal((2, count, 3))
        return Pose(rotation_from_vector(torch.as_tensor(size * turns)), torch.as_tensor(places))

    for size in (0.15, 0.5, 1.5):
        rig_from_target, camera, board = poses(6, size), poses(1, 2.0)[0], poses(1, 2.0)[0]
        found = camera_and_board(rig_from_target, camera @ rig_from_target @ board, RigThresholds())
        assert found is not None
        for truth, own in zip((camera, board), found, strict=True):
            np.testing.assert_allclose((truth @ own.inverse()).log(), 0.0, atol=1e-9)
    about_one = Pose(
        rotation_from_vector(torch.tensor([[0.0, 0.3 * k, 0.0] for k in range(6)], dtype=torch.float64)),
        poses(6, 1.0).translation,
    )
    assert camera_and_board(about_one, camera @ about_one @ board, RigThresholds()) is None
    assert camera_and_board(rig_from_target[:3], (camera @ rig_from_target @ board)[:3], RigThresholds()) is None
