"""A camera of a rig whose model, or whose given calibration, does not follow its lens is named, and no other camera is."""

from dataclasses import replace

import pytest
import torch
from rig_views import pair, setups
from test_rig_excess import seen

from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.result import RigCalibration
from omnilines.pages.limits import rig_advice

NOISE_PX = 0.1
RIG = pair(24, seed=1)
"""A pinhole camera and a fisheye."""
CORNERS = RIG.noisy(NOISE_PX, 1)


def named(found: RigCalibration) -> list[str]:
    return [member.name for member in found.members if member.misfit is not None]


@pytest.mark.slow
def test_a_model_that_does_not_follow_the_lens_of_one_camera_is_named() -> None:
    others = setups(RIG)
    found = calibrate_rig(CORNERS, others | {"cam1": replace(others["cam1"], model="pinhole", options={})})
    assert named(found) == ["cam1"] and found.unmodelled is None
    assert found.notes[0].startswith("Camera cam1: The pinhole model does not follow this lens")
    (advice,) = [one for one in rig_advice(found, {}) if "does not follow" in one.limit]
    assert advice.limit.startswith("cam1: ") and advice.do == "Try `model` auto, which compares all."


@pytest.mark.slow
@pytest.mark.parametrize(("bent", "blamed"), [(0.0, []), (0.02, ["cam1"])])
def test_a_calibration_that_is_held_is_named_where_it_is_of_another_lens(bent: float, blamed: list[str]) -> None:
    """All intrinsics are held: nothing but the residuals tells. k1 of the fisheye is other than given."""
    given = list(RIG.models)
    given[1] = given[1].with_parameters(given[1].parameters + bent * torch.eye(8, dtype=torch.float64)[4])
    held = {name: CameraSetup(model.image_size, start=model, hold=True) for name, model in zip(RIG.names, given, strict=True)}
    found = calibrate_rig(CORNERS, held)
    assert named(found) == blamed
    advice = " ".join(one.limit + one.do for one in rig_advice(found, {}))
    assert ("cam1: The given calibration does not follow this lens" in advice) == bool(blamed)
    assert ("`hold`" in advice) == bool(blamed)


def test_models_that_follow_are_not_blamed() -> None:
    assert named(calibrate_rig(CORNERS, setups(RIG))) == []


@pytest.mark.slow
def test_a_calibration_that_is_held_and_of_another_focus_is_told_from_a_board_that_moves() -> None:
    """A focal length 1 percent too long shows in two cameras as a board that is at two places; right ones and a board that does
    move are not taken for it."""
    held = {
        name: CameraSetup(model.image_size, start=model, hold=True) for name, model in zip(RIG.names, RIG.models, strict=True)
    }
    scale = torch.tensor([1.01, 1.01, 1, 1, 1, 1, 1, 1], dtype=torch.float64)
    longer = RIG.models[1].with_parameters(scale * RIG.models[1].parameters)
    found = calibrate_rig(CORNERS, held | {"cam1": replace(held["cam1"], start=longer)})
    (other,) = [member for member in found.members if member.other is not None]
    assert other.name == "cam1" and other.other is not None and -0.012 < other.other.focal_share < -0.007
    assert not any("The board moved" in note for note in found.notes)
    assert any("not from the board" in note for note in found.notes)
    advice = " ".join(one.limit + one.do for one in rig_advice(found, {}))
    assert "cam1: The given calibration is not that of these photos" in advice and "refine_board" not in advice
    moving = calibrate_rig(seen(RIG, BoardShape(), 1.5e-3, 2), held)
    assert all(member.other is None for member in moving.members)
    assert any("The board moved" in note for note in moving.notes)
