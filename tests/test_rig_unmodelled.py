"""What all frames of a rig share, a bent board, oblong squares or a pupil that moves: told once for the board by all cameras, and
by none where there is nothing of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_views import BOARD, RigScene, outward_rig, pair, setups

from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.pages.limits import rig_advice
from omnilines.records import Corners

HALF_M = 0.2


def seen(
    rig: RigScene,
    noise_px: float,
    aspect: float = 0.0,
    bend_m: float = 0.0,
    pupil: tuple[int, float] | None = None,
    seed: int = 0,
) -> Corners:
    """The corners of a board that is so much higher than drawn and so much bent; the pupil of one camera moves by so many metres
    a squared radian."""
    corners = rig.corners
    board = torch.as_tensor(corners.board_m).clone()
    board[:, 2] = bend_m * ((board[:, 0] - BOARD[:, 0].mean()) / HALF_M) ** 2
    board[:, 1] *= 1 + aspect
    camera = torch.tensor([int(name[3:]) for name in corners.cameras or ()])[torch.as_tensor(corners.view)]
    frame = torch.tensor([int(name) for name in corners.frames or ()])[torch.as_tensor(corners.view)]
    place = (rig.cam_from_rig[camera] @ rig.rig_from_board[frame]).transform(board[:, None])[:, 0]
    pixels = np.empty_like(corners.pixels)
    for c, model in enumerate(rig.models):
        own = place[camera == c].clone()
        if pupil is not None and pupil[0] == c:
            from_axis = own[:, 2].clone()
            for _ in range(20):
                own[:, 2] = from_axis - pupil[1] * torch.atan2(own[:, :2].norm(dim=-1), own[:, 2]).square()
        pixels[(camera == c).numpy()] = model.project(own)[0].numpy()
    return replace(corners, pixels=pixels + noise_px * np.random.default_rng(0).standard_normal(pixels.shape))


@pytest.mark.slow
def test_a_bend_is_told_by_all_cameras() -> None:
    rig = pair(24, seed=1)
    found = calibrate_rig(seen(rig, 0.05, bend_m=1e-3), setups(rig))
    assert found.unmodelled is not None and found.unmodelled.kind == "flatness"
    # A parabola along the longer side leaves its plane by two thirds of its height at the most, at its ends.
    x = (BOARD[:, 0] - BOARD[:, 0].mean()) / HALF_M
    true_m = 1e-3 * np.abs(x**2 - (x**2).mean()).max()
    assert found.unmodelled.size == pytest.approx(true_m, rel=0.2)
    assert f"the projection of camera {found.unmodelled.camera} moves by" in " ".join(found.notes)
    assert any("The board is not flat" in advice.limit for advice in rig_advice(found, {}))


def test_a_board_as_drawn_is_not_blamed() -> None:
    rig = pair(24, seed=2)
    assert calibrate_rig(seen(rig, 0.1), setups(rig)).unmodelled is None


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "size"), [("aspect", 0.005), ("pupil", 1.5e-3)])
def test_oblong_squares_and_the_pupil_of_one_camera_are_told(kind: str, size: float) -> None:
    """Four cameras that look outwards: the print by all of them, the pupil of the one whose it is."""
    rig = outward_rig(40, seed=1)
    aspect, pupil = (size, None) if kind == "aspect" else (0.0, (1, size))
    found = calibrate_rig(seen(rig, 0.05, aspect=aspect, pupil=pupil), setups(rig)).unmodelled
    assert found is not None and found.kind == kind and found.moved_px > found.stated_px
    true = size if kind == "aspect" else size * np.radians(found.reach_deg) ** 2
    assert found.size == pytest.approx(true, rel=0.1)
    assert kind == "aspect" or found.camera == "cam1"
