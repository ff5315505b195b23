"""What lines ask of the cameras that they were found with: nothing of the right one, and what is wrong of another."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_calibration_errors import CAMERA, CAMERAS, LINES, calibration, covariance, world

import omnilines as ol
from camera_models import Calibration, CameraModel, Equirectangular
from camera_models.formats.calibration_data import CameraEstimate
from camera_models.pose import Pose
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.pages.limits_of_lines import scene_advice
from omnilines.pages.scene import scene_data, scene_summary
from omnilines.pipelines import asked_cameras as asking
from omnilines.pipelines.asked_cameras import AskedCamera, asked_by_points, asked_cameras
from omnilines.pipelines.options import OF_TABLES, SceneOptions
from omnilines.posing.photo_poses import CameraByPoints
from omnilines.records import ImagePoses, Segments

NOISE_PX = 0.03


def asked(cameras: Calibration, seed: int, options: SceneOptions = OF_TABLES) -> tuple[AskedCamera, ...]:
    """Of segments with noise that the right camera took, given to another, with the lines and poses that it makes of them."""
    segments, poses, _ = world()
    noise = np.random.default_rng(seed).normal(0.0, NOISE_PX, segments.endpoints_px.shape)
    known = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(noise), 2, 2, 2)).copy()
    segments = replace(segments, endpoints_px=segments.endpoints_px + noise, covariance_px2=known)
    scene = ol.adjust(segments, poses, cameras, options)
    arcs = arcs_from_segments(segments, scene.poses, cameras.cameras).arcs
    return asked_cameras(scene.lines, arcs, np.arange(len(scene.lines)), scene.poses, cameras, options)


def two_worlds() -> tuple[Segments, ImagePoses]:
    """The photos of a world, and as many of one beside it that share no line with them, with noise."""
    segments, poses, _ = world()
    beside = poses.cam_from_world
    beside = Pose(beside.rotation, beside.translation - beside.rotation @ torch.tensor([100.0, 0.0, 0.0]).double())
    both = tuple(f"{place}/{name}" for place in "ab" for name in poses.images)
    pixels = np.tile(segments.endpoints_px, (2, 1, 1))
    pixels += np.random.default_rng(1).normal(0.0, NOISE_PX, pixels.shape)
    image, track = (np.append(one, one + count) for one, count in ((segments.image, CAMERAS), (segments.track, LINES)))
    tracks = tuple(f"t{k}" for k in range(2 * LINES))
    every = Segments(image, both, track, tracks, pixels, sigma_px=np.full(len(pixels), NOISE_PX))
    return every, ImagePoses(both, joined([poses.cam_from_world, beside]), ("cam0",) * len(both))


def joined(poses: list[Pose]) -> Pose:
    return Pose(torch.cat([one.rotation for one in poses]), torch.cat([one.translation for one in poses]))


@pytest.mark.parametrize(("scale", "contradicted"), [(1.0, False), (1.02, True)])
@pytest.mark.slow
def test_of_many_photos_some_are_asked_that_share_lines(
    scale: float, contradicted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too few segments for all of them are enough for these; they tell a wrong camera as all would."""
    monkeypatch.setattr(asking, "MOST_ARCS", 200)
    monkeypatch.setattr(asking, "MOST_PHOTOS", 6)
    chosen, own = [], asking._of_photos_together
    monkeypatch.setattr(asking, "_of_photos_together", lambda arcs: chosen.append(own(arcs)) or chosen[-1])
    parameters = CAMERA.parameters.clone()
    parameters[:2] *= scale
    scene = ol.adjust(*two_worlds(), CAMERA.with_parameters(parameters))
    (arcs,) = chosen
    photos = torch.unique(arcs.image)
    assert len(photos) == 6 and len(torch.unique(photos // CAMERAS)) == 1, "all of one place"
    assert len(torch.unique(arcs.track)) == LINES and len(arcs) == 6 * LINES
    assert len(scene.asked) == 1 and bool(scene.contradicted) is contradicted


@pytest.mark.slow
def test_nothing_is_asked_of_the_right_camera_but_what_noise_makes() -> None:
    """By Monte Carlo: the motion is as large as is stated, and the right camera is among those that are possible."""
    found = [asked(Calibration({"cam0": CAMERA}), seed)[0] for seed in range(12)]
    assert all(one.least_px == 0.0 for one in found)
    drift, sigma = (np.sqrt(np.mean([getattr(one, name) ** 2 for one in found])) for name in ("drift_px", "sigma_px"))
    assert 0.6 < drift / sigma < 1.6


@pytest.mark.parametrize("refine", [("lines",), ("lines", "poses")])
@pytest.mark.slow
def test_a_camera_that_is_off_is_contradicted(refine: tuple[str, ...]) -> None:
    off = CAMERA.parameters.clone()
    off[:2] *= 1.02
    found = asked(Calibration({"cam0": CAMERA.with_parameters(off)}), 0, replace(OF_TABLES, refine=refine))[0]
    assert found.least_px > 0.3 and found.drift_px > 5.0 * found.sigma_px


@pytest.mark.slow
def test_what_a_calibration_states_of_itself_is_no_contradiction() -> None:
    """Moved by two standard deviations of its covariance, which is far more than the lines leave open."""
    own = 6.0**2 * covariance()
    values, axes = np.linalg.eigh(own)
    moved = CAMERA.with_parameters(CAMERA.parameters + torch.as_tensor(2.0 * np.sqrt(values[-1]) * axes[:, -1]))
    exact, known = Calibration({"cam0": moved}), Calibration({"cam0": moved}, {"cam0": CameraEstimate(covariance=own)})
    alone = asked(exact, 0)[0]
    assert alone.least_px > 0.5
    within = asked(known, 0)[0]
    assert within.least_px == 0.0 and within.sigma_px > 4.0 * alone.sigma_px


@pytest.mark.slow
def test_nothing_is_asked_of_what_has_no_parameters_or_was_refined() -> None:
    segments, poses, _ = world()
    scene = ol.adjust(segments, poses, CAMERA, OF_TABLES)
    arcs = arcs_from_segments(segments, scene.poses, {"cam0": CAMERA}).arcs
    panorama: CameraModel = Equirectangular([], (2048, 1024))
    every, refined = np.arange(LINES), replace(OF_TABLES, refine=("lines", "poses", "intrinsics"))
    assert asked_cameras(scene.lines, arcs, every, scene.poses, Calibration({"cam0": panorama}), OF_TABLES) == ()
    assert asked_cameras(scene.lines, arcs, every, scene.poses, calibration(), refined) == ()
    assert CAMERAS == len(scene.poses)


@pytest.mark.slow
def test_an_adjustment_of_segments_says_that_they_contradict_its_calibration() -> None:
    """Poses take up two percent of the focal length: residuals are those of noise, and nothing but this tells."""
    segments, poses, _ = world()
    noise = np.random.default_rng(3).normal(0.0, NOISE_PX, segments.endpoints_px.shape)
    segments = replace(segments, endpoints_px=segments.endpoints_px + noise, sigma_px=np.full(len(noise), NOISE_PX))
    right = ol.adjust(segments, poses, CAMERA)
    assert len(right.asked) == 1 and not right.contradicted
    tables = f"Lines(lines={right.lines.known.sum()} of {len(right.lines)}, unit='m'), {poses}, {right.segments}"
    assert repr(right) == f"Scene({tables})"
    assert repr(segments) == f"Segments(segments={len(segments)}, images={len(poses)}, tracks={len(segments.tracks)})"
    off = CAMERA.parameters.clone()
    off[:2] *= 1.02
    wrong = ol.adjust(segments, poses, CAMERA.with_parameters(off))
    (found,) = wrong.contradicted
    assert found.least_px > 3 * wrong.options.advice.detector_error_px
    assert "contradict the calibration" in scene_advice(wrong)[0].limit
    # Where photos or poses are at fault nothing is asked, nor of photos that show too few segments each.
    few = segments.rows(np.arange(0, len(segments), 4))
    assert not ol.adjust(few, poses, CAMERA).asked


@pytest.mark.slow
def test_a_scene_says_that_lines_contradict_its_calibration() -> None:
    segments, poses, _ = world()
    scene = ol.adjust(segments, poses, CAMERA, OF_TABLES)
    assert not scene.contradicted and "contradict" not in str(scene_summary(scene).verdict)
    wrong = replace(scene, asked=(AskedCamera("cam0", "lines", 4.4, 0.3, 3.1), AskedCamera("cam1", "points", 0.1, 0.1, 0.0)))
    told = scene_advice(wrong)[0]
    assert "by cam0 4.4 px (3.1 at least)." in told.limit and "cam1" not in told.limit and "omnilines check" in told.do
    assert str(scene_summary(wrong).verdict).endswith("but they contradict the calibration.")
    by_points = replace(scene, asked=(AskedCamera("cam0", "lines", 1.7, 0.9, 0.1), AskedCamera("cam0", "points", 1.4, 0.1, 0.6)))
    told = scene_advice(by_points)[0]
    assert told.limit.startswith(
        "Points contradict the calibration: adjusted beside points, the cameras move the image by cam0 1.4"
    )
    assert str(scene_summary(by_points).verdict).endswith("but points contradict the calibration.")
    both = replace(scene, asked=tuple(AskedCamera("cam0", by, 4.4, 0.3, 3.1) for by in ("lines", "points")))
    told = scene_advice(both)[0]
    assert told.limit.startswith(
        "Lines and points contradict the calibration: adjusted beside lines, the cameras move the image by"
    )
    assert "; beside points, the cameras move" in told.limit


def test_points_are_asked_of_cameras_that_are_not_refined() -> None:
    """Beside what the calibration states of itself."""
    change = torch.zeros(len(CAMERA.parameters)).double()
    change[:2] = 5.0
    found = {"cam0": CameraByPoints(change.numpy(), np.diag([0.01] * 4 + [1e-8] * (len(change) - 4)), 0.5)}
    (wrong,) = asked_by_points(found, calibration(), SceneOptions())
    assert (wrong.name, wrong.by) == ("cam0", "points") and wrong.least_px > 0.0 and wrong.drift_px > 3.0 * wrong.sigma_px
    known = Calibration({"cam0": CAMERA}, {"cam0": CameraEstimate(covariance=25.0 * np.eye(len(change)))})
    (within,) = asked_by_points(found, known, SceneOptions())
    assert within.least_px == 0.0 and within.drift_px == pytest.approx(wrong.drift_px)
    assert asked_by_points(found, calibration(), SceneOptions(refine=("lines", "poses", "intrinsics"))) == ()


@pytest.mark.slow
def test_figures_of_a_room_say_what_its_lines_ask_of_the_camera() -> None:
    made = ol.render("plain-room", "opencv-fisheye", views=5, size_px=(480, 480), seed=1)
    scene = ol.reconstruct(ol.extract(made.photos, made.camera), made.poses, made.camera)
    rows, (found,) = dict(scene_summary(scene).rows), scene_data(scene)["asked_cameras"]
    assert not found["contradicted"] and found["least_px"] <= found["drift_px"] < 0.3
    assert rows["change of the calibration that lines ask for"].startswith("cam0 ")
