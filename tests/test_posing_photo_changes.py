"""What changes between photos that are posed by points: rows read one after the other, zoom, crops; and what all photos share."""

import numpy as np
import pytest
import torch
from sfm_scenes import places, world

from camera_models import CameraModel, OpenCVFisheye, Pinhole
from camera_models.pose import Pose
from omnilines.posing.bearing_residual import placed
from omnilines.posing.growth import Grown
from omnilines.posing.photo_changes import MEANT, change_doubts
from omnilines.posing.point_adjustment import Frames, PosesAndPoints, adjust_points
from omnilines.posing.tracks import Observations

VIEWS, NOISE_PX = 8, 0.35
FISHEYE = OpenCVFisheye([230.0, 230.0, 402.0, 297.0, 0.01, -0.002, 0.0, 0.0], (800, 600))
PINHOLE = Pinhole([420.0, 420.0, 402.0, 297.0, 0.0, -0.1, 0.01, *[0.0] * 6], (800, 600))
MODELS = pytest.mark.parametrize("model", [FISHEYE, PINHOLE], ids=["fisheye", "pinhole"])


def grown(model: CameraModel, used: list[CameraModel], points: int, seed: int, **changes: float) -> Grown:
    """Photos of a room through `model`, adjusted with those `used`, each with a change of its own: standard deviations of `rows`
    and `columns` (turn while all are read, rad), `focal` (relative) and `centre` (px)."""
    rng = np.random.default_rng(seed)
    poses, places_m = places(VIEWS, seed, 2.0), torch.as_tensor(world(points, seed)[0])
    centre, size = model.centre_px, torch.tensor(model.image_size, dtype=torch.float64)
    seen = []
    for view in range(VIEWS):
        at = placed(poses[[view]], places_m)
        pixels, valid = model.project(at)
        for axis, kind in ((1, "rows"), (0, "columns")):
            turn = torch.as_tensor(changes.get(kind, 0.0) * rng.standard_normal(3))
            for _ in range(4 if kind in changes else 0):
                shift = (pixels[:, axis : axis + 1] + 0.5) / size[axis] - 0.5
                moved = Pose.exp(torch.cat([shift * turn, torch.zeros(len(at), 3, dtype=torch.float64)], 1))
                pixels, valid = model.project(placed(moved, at))
        pixels = centre + (1 + changes.get("focal", 0.0) * rng.standard_normal()) * (pixels - centre)
        pixels = pixels + torch.as_tensor(changes.get("centre", 0.0) * rng.standard_normal(2))
        pixels = pixels + NOISE_PX * torch.as_tensor(rng.standard_normal(tuple(pixels.shape)))
        inside = torch.nonzero(valid & ((pixels > 0) & (pixels < size - 1)).all(-1)).flatten()
        seen.append((torch.full_like(inside, view), inside, pixels[inside]))
    photo, point, pixels = (torch.cat(part) for part in zip(*seen, strict=True))
    twice = torch.bincount(point, minlength=points)[point] > 1
    number = torch.unique(point[twice], return_inverse=True)[1]
    photo, pixels = photo[twice], pixels[twice]
    bearings = torch.cat([used[view].unproject(pixels[photo == view])[0] for view in range(VIEWS)])
    by_pixel = torch.cat([used[view].unproject_jacobian(pixels[photo == view]) for view in range(VIEWS)])
    observed = Observations(photo, torch.arange(len(number)), number, bearings, torch.linalg.pinv(by_pixel) / NOISE_PX)
    frames = Frames(torch.arange(VIEWS), Pose.identity(VIEWS))
    start = PosesAndPoints(poses, places_m[torch.unique(point[twice])])
    found = adjust_points(observed, frames, start)
    state, known = found.state, np.ones(VIEWS, bool)
    return Grown(frames, state.rig_from_world, known, observed, state.points, observed, state.points, None, found.scale)


def said(used: list[CameraModel], grown_so: Grown) -> tuple[str, ...]:
    """Of a camera for each calibration."""
    names = [f"cam{used.index(model)}" for model in used]
    return change_doubts(grown_so, dict(zip(names, used, strict=True)), names)


@MODELS
@pytest.mark.parametrize("change", [("rows", 0.02), ("columns", 0.02), ("focal", 0.02), ("centre", 8.0)], ids=lambda one: one[0])
def test_what_changes_between_photos_is_named(model: CameraModel, change: tuple[str, float]) -> None:
    """Lines and poses were many of their standard deviations off, and nothing was said."""
    kind, size = change
    used = [model] * VIEWS
    (note,) = said(used, grown(model, used, 600, 2, **{kind: size}))
    assert MEANT[kind][0] in note and MEANT[kind][1] in note


@MODELS
def test_what_photos_share_does_not_change(model: CameraModel) -> None:
    """Right photos, few points, and calibrations of another focal length: of all photos, and of one of two cameras."""
    right = [model] * VIEWS
    for seed in range(3):
        assert said(right, grown(model, right, 600, seed)) == ()
        assert said(right, grown(model, right, 30, seed)) == ()
    factor = torch.ones_like(model.parameters)
    factor[:2] = 1.01
    other = model.with_parameters(model.parameters * factor)
    for used in ([other] * VIEWS, [model, other] * (VIEWS // 2)):
        assert said(used, grown(model, used, 600, 0)) == ()
