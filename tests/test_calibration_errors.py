"""What errors of a calibration leave uncertain of lines: against cameras that are drawn from its covariance."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import omnilines as ol
from camera_models import Calibration, CameraModel, InputError, OpenCVFisheye, Pinhole, Scaramuzza
from camera_models.formats.calibration_data import CameraEstimate, RigCamera
from camera_models.pose import Pose
from camera_models.pose_fit import refit_pose
from omnilines.adjustment.by_calibration import KnownCalibration, camera_steps, followed_poses
from omnilines.adjustment.lines import motion_across
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.pages.limits_of_lines import length, scene_advice
from omnilines.pages.scene import scene_summary
from omnilines.pipelines import supposed_errors as _supposed
from omnilines.pipelines.assumed_errors import assumed_covariance
from omnilines.pipelines.calibration_errors import beside_stated, errors_by_calibration
from omnilines.pipelines.frame_notes import OF_GIVEN, OF_GIVEN_AND_RIG, OF_PRIOR
from omnilines.pipelines.options import OF_TABLES
from omnilines.records import ImagePoses, LengthUnit, Lines, PosePoints, Segments

CAMERA = OpenCVFisheye([320.0, 322.0, 510.0, 390.0, 0.02, -0.01, 0.002, 0.0], (1032, 778))
SIGMA = np.array([0.5, 0.5, 0.3, 0.3, 1e-3, 5e-4, 0.0, 0.0])
CAMERAS, LINES, DRAWS = 8, 24, 40
OF_LINES = replace(OF_TABLES, refine=("lines",))
PARTS = (("lines", "poses"), ("lines",))


def covariance() -> np.ndarray:
    """Of fx, fy, cx, cy, k1 and k2; fx and fy go together, and k1 against both."""
    mix = np.eye(8)
    mix[1, 0], mix[4, 0], mix[5, 4] = 0.9, -0.5, -0.7
    root = SIGMA[:, None] * mix / np.linalg.norm(mix, axis=1)[:, None]
    return root @ root.T


def calibration(camera: OpenCVFisheye = CAMERA) -> Calibration:
    return Calibration({"cam0": camera}, {"cam0": CameraEstimate(covariance=covariance())})


def world() -> tuple[Segments, ImagePoses, np.ndarray]:
    """Exact segments of lines that all cameras see, their poses, and the ends of the lines."""
    rng = np.random.default_rng(5)
    centre = rng.uniform(-0.8, 0.8, (CAMERAS, 3)) * [1.5, 1.0, 0.3]
    turn = torch.as_tensor(np.concatenate([0.1 * rng.standard_normal((CAMERAS, 3)), np.zeros((CAMERAS, 3))], 1))
    rotation = Pose.exp(turn).rotation
    poses = Pose(rotation, -(rotation @ torch.as_tensor(centre)[..., None])[..., 0])
    middle = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 3.5], (LINES, 3))
    way = rng.standard_normal((LINES, 3))
    way *= 0.5 / np.linalg.norm(way, axis=1, keepdims=True)
    ends = np.stack([middle - way, middle + way], 1)
    image, track = np.repeat(np.arange(CAMERAS), LINES), np.tile(np.arange(LINES), CAMERAS)
    pixels, seen = CAMERA.project(poses[torch.as_tensor(image)].transform(torch.as_tensor(ends[track])))
    assert bool(seen.all())
    names = tuple(f"{k}.png" for k in range(CAMERAS))
    noise = np.broadcast_to(0.3**2 * np.eye(2), (len(track), 2, 2, 2)).copy()
    segments = Segments(image, names, track, tuple(f"t{k}" for k in range(LINES)), pixels.numpy(), covariance_px2=noise)
    return segments, ImagePoses(names, poses, ("cam0",) * CAMERAS), ends


def charts(lines: Lines) -> LineChart:
    assert lines.chart_centre_m is not None and lines.chart_scale_m is not None
    ends = torch.as_tensor(lines.ends_m)
    own = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    return LineChart.from_lines(own, torch.as_tensor(lines.chart_centre_m), torch.as_tensor(lines.chart_scale_m))


def squares_m2(lines: Lines, covariance: np.ndarray) -> np.ndarray:
    """Expected squared motion of both ends of each line across it."""
    across = motion_across(charts(lines), torch.as_tensor(lines.ends_m))
    return np.einsum("tkii->tk", (across @ torch.as_tensor(covariance)[:, None] @ across.mT).numpy()).sum(1)


@pytest.mark.slow
@pytest.mark.parametrize("draws", [10, pytest.param(DRAWS, marks=pytest.mark.full)])
@pytest.mark.parametrize("refine", PARTS)
def test_lines_scatter_as_is_stated_where_cameras_are_drawn_from_the_covariance(refine: tuple[str, ...], draws: int) -> None:
    segments, poses, _ = world()
    options = replace(OF_TABLES, refine=refine)
    own, exact = (ol.adjust(segments, poses, one, options) for one in (calibration(), CAMERA))
    stated, plain = own.lines, exact.lines
    assert plain.calibration_sigma_m is None and plain.covariance is not None and stated.covariance is not None
    np.testing.assert_allclose(stated.ends_m, plain.ends_m, atol=1e-12)
    expected = squares_m2(plain, stated.covariance - plain.covariance)
    rng, at = np.random.default_rng(1), torch.as_tensor(plain.ends_m)
    moved, apart = np.zeros(LINES), torch.zeros(CAMERAS, 6, dtype=torch.float64)
    for draw in rng.multivariate_normal(np.zeros(8), covariance(), draws):
        camera = CAMERA.with_parameters(CAMERA.parameters + torch.as_tensor(draw))
        found = ol.adjust(segments, poses, camera, options)
        ends = torch.as_tensor(found.lines.ends_m)
        apart += (found.poses.cam_from_world @ exact.poses.cam_from_world.inverse()).log().square() / draws
        there = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[:, None].closest_point(at)
        moved += (there - at).square().sum((1, 2)).numpy() / draws
    wider = math.sqrt(DRAWS / draws)
    assert 0.75**wider < moved.sum() / expected.sum() < 1.33**wider
    assert (moved < 3.0**wider * expected).all() and (moved > expected / 3.0**wider).all()
    if "poses" in refine:
        assert own.poses.covariance is not None and exact.poses.covariance is not None
        of_poses = (own.poses.covariance - exact.poses.covariance).diagonal(axis1=1, axis2=2).reshape(-1, 2, 3).sum((0, 2))
        ratio = apart.numpy().reshape(-1, 2, 3).sum((0, 2)) / of_poses
        assert (ratio > 0.7**wider).all() and (ratio < 1.4**wider).all()


@pytest.mark.slow
def test_lines_whose_loss_leaves_arcs_out_follow_the_camera_to_the_end() -> None:
    """Against whole adjustments with the camera moved along the axes of its covariance; two of eight arcs are of other lines."""
    segments, poses, _ = world()
    off = np.random.default_rng(3).uniform(-8.0, 8.0, (len(segments.image), 1, 2)) * (segments.image < 2)[:, None, None]
    segments = replace(segments, endpoints_px=segments.endpoints_px + off)
    options = replace(OF_TABLES, refine=("lines",), loss="cauchy")
    stated, plain = (ol.adjust(segments, poses, one, options).lines for one in (calibration(), CAMERA))
    assert stated.covariance is not None and plain.covariance is not None
    at, moved = torch.as_tensor(plain.ends_m), np.zeros(LINES)
    variance, axes = np.linalg.eigh(covariance())
    for step in 0.25 * (axes * np.sqrt(variance.clip(0.0)))[:, variance > 1e-12 * variance.max()].T:
        camera = CAMERA.with_parameters(CAMERA.parameters + torch.as_tensor(step))
        ends = torch.as_tensor(ol.adjust(segments, poses, camera, options).lines.ends_m)
        there = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[:, None].closest_point(at)
        moved += (there - at).square().sum((1, 2)).numpy() / 0.25**2
    expected = squares_m2(plain, stated.covariance - plain.covariance)
    np.testing.assert_allclose(expected, moved, rtol=0.1)


@pytest.mark.slow
def test_the_share_of_the_calibration_is_stated_and_adds_up() -> None:
    segments, poses, _ = world()
    stated, plain = (ol.adjust(segments, poses, one).lines for one in (calibration(), CAMERA))
    share = stated.calibration_sigma_m
    assert share is not None and (share > 0).all() and (stated.sigma_m > plain.sigma_m).all() and (share < stated.sigma_m).all()
    # Each is the largest in some direction, at some end: together at most as if these were the same.
    assert (stated.sigma_m <= np.hypot(share, plain.sigma_m) * (1 + 1e-9)).all()
    refined = ol.adjust(segments, poses, calibration(), replace(OF_TABLES, refine=("lines", "poses", "intrinsics")))
    assert refined.lines.calibration_sigma_m is None


def test_lines_that_errors_of_the_calibration_leave_uncertain_are_weak() -> None:
    segments, poses, _ = world()
    wide = Calibration({"cam0": CAMERA}, {"cam0": CameraEstimate(covariance=2500.0 * covariance())})
    known, unknown = (ol.adjust(segments, poses, one, replace(OF_TABLES, refine=("lines",))).lines for one in (CAMERA, wide))
    assert set(known.status) == {"ok"} and unknown.chart_scale_m is not None
    assert [one == "weak" for one in unknown.status] == (unknown.sigma_m > 0.1 * unknown.chart_scale_m).tolist()
    assert unknown.status.count("weak") >= 5


@pytest.mark.slow
def test_errors_that_are_not_followed_are_named() -> None:
    segments, poses, second = stereo()
    mounts = {"cam0": RigCamera(Pose.identity(1)[0]), "cam1": RigCamera(second)}
    some = Calibration({"cam0": CAMERA, "cam1": CAMERA}, {"cam0": CameraEstimate(covariance=covariance())}, mounts)
    both = replace(some, estimates={name: some.estimates["cam0"] for name in some})
    told = [ol.adjust(segments, poses, one, replace(OF_TABLES, refine=("lines",))).told for one in (some, both)]
    assert [any("Errors of cam1 are not in" in said for said in one) for one in told] == [True, False]
    segments, poses, _ = world()
    none = ol.adjust(segments, poses, CAMERA, replace(OF_TABLES, refine=("lines",))).told
    assert any("Errors of cam0 are not in" in said and "`scene.calibration_error_px` takes" in said for said in none)
    refined = ol.adjust(segments, poses, CAMERA, replace(OF_TABLES, refine=("lines", "poses", "intrinsics"))).told
    assert not any("no covariance" in said for said in refined)
    parts = ol.adjust(segments, poses, calibration(), replace(OF_TABLES, partition=4))
    assert parts.lines.calibration_sigma_m is None and any("in parts" in said for said in parts.told)


@pytest.mark.parametrize(
    "camera", [CAMERA, Scaramuzza([516.0, 389.0, 1.001, 3e-4, 3e-4, -180.0, 1.5e-3, 0.0, 1e-9], (1032, 778)),
               Pinhole([500.0, 500.0, 515.5, 388.5, *[0.0] * 9], (1032, 778), coefficients=5)],
    ids=["fisheye", "mirror", "pinhole"],
)  # fmt: skip
def test_cameras_drawn_as_somebody_says_move_pixels_so_far(camera: CameraModel) -> None:
    covariance, reach = assumed_covariance(camera, 0.5, math.radians(60.0)), math.radians(60.0)
    pixels = torch.stack(torch.meshgrid(*(torch.arange(0.0, n, 23, dtype=torch.float64) for n in (1032, 778)), indexing="ij"), -1)
    pixels = pixels.reshape(-1, 2)
    pixels = pixels[angles_off_axis(camera, pixels) < reach]
    bearings, seen = camera.unproject(pixels)
    rng, squares = np.random.default_rng(0), []
    for step in rng.multivariate_normal(np.zeros(len(covariance)), covariance, 300):
        moved, valid = camera.with_parameters(camera.parameters + 0.01 * torch.as_tensor(step)).project(bearings[seen])
        squares.append(float(((moved - pixels[seen]) / 0.01)[valid].square().sum(-1).mean()))
    # The mean square over k directions of draws has a standard deviation of sqrt(2 / 300 k).
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.5, rel=0.08)
    np.testing.assert_allclose(assumed_covariance(camera, 1.0, reach), 4.0 * covariance, rtol=1e-9, atol=1e-30)


@pytest.mark.slow
def test_what_somebody_says_of_the_calibration_is_in_the_uncertainty_of_lines() -> None:
    segments, poses, _ = world()
    plain = replace(OF_TABLES, refine=("lines",))
    exact, half, one = (
        ol.adjust(segments, poses, CAMERA, replace(plain, calibration_error_px=error)) for error in (None, 0.5, 1.0)
    )
    assert exact.lines.calibration_sigma_m is None and not any("Errors of cam0" in said for said in half.told)
    np.testing.assert_allclose(one.lines.calibration_sigma_m, 2.0 * half.lines.calibration_sigma_m, rtol=0.05)
    assert (half.lines.sigma_m > exact.lines.sigma_m).all() and half.cameras.estimates["cam0"].sigma["fx"] > 0
    # Of what a calibration states nothing else counts.
    stated = [
        ol.adjust(segments, poses, calibration(), replace(plain, calibration_error_px=e)).lines.sigma_m for e in (None, 9.0)
    ]
    np.testing.assert_array_equal(*stated)
    with pytest.raises(InputError, match=r"above 0 was expected, found -1\.0"):
        ol.adjust(segments, poses, CAMERA, replace(plain, calibration_error_px=-1.0))
    with pytest.raises(InputError, match="counts only with cameras that are held"):
        ol.adjust(segments, poses, CAMERA, replace(plain, refine=("lines", "poses", "intrinsics"), calibration_error_px=1.0))


@pytest.mark.slow
@pytest.mark.parametrize("refine", PARTS)
def test_what_exact_cameras_leave_out_is_told(refine: tuple[str, ...]) -> None:
    """How many times as uncertain lines and photos are with cameras off by half a pixel, as a run that is told so states."""
    segments, poses, _ = world()
    plain = replace(OF_TABLES, refine=refine)
    exact, half = (ol.adjust(segments, poses, CAMERA, replace(plain, calibration_error_px=error)) for error in (None, 0.5))
    times = float(np.median(half.lines.sigma_m / exact.lines.sigma_m))
    said = next(note for note in exact.told if "Errors of cam0 are not in" in note)
    found = [float(number) for number in re.findall(r"([0-9.]+) times", said)]
    assert found[0] == pytest.approx(times, rel=0.1) and times > 1.2 and "Where it is off by 0.5 px (RMS)" in said
    assert len(found) == (2 if "poses" in refine else 1)
    if "poses" in refine:
        of_photos = [np.trace(one.poses.covariance[1:, 3:, 3:], axis1=1, axis2=2) for one in (half, exact)]
        assert found[1] == pytest.approx(float(np.median(np.sqrt(of_photos[0] / of_photos[1]))), rel=0.2)
    # What limits lines is what a run that is told so names.
    assert times > math.sqrt(2.0)
    assert all("more photos do not lower" in scene_advice(one)[0].limit for one in (exact, half))
    assert (
        "states its errors" in scene_advice(exact)[0].do
        and f"{1e3 * exact.median_sigma_m():.2g} mm" in scene_advice(exact)[0].limit
    )
    # Before other advice, and in the verdict, which tells how well lines are known.
    adjusted = exact.adjusted
    open_scale = replace(exact, adjusted=replace(adjusted, lines=replace(adjusted.lines, unit=LengthUnit.OPEN)))
    first, scale = scene_advice(open_scale)[:2]
    assert first.do == scene_advice(exact)[0].do and "how large the scene is" in scale.limit
    assert exact.supposed is not None
    assert "places of photos are" not in first.limit and (exact.supposed.of_photos or 1.0) < math.sqrt(2.0)
    of_places = replace(exact, supposed=replace(exact.supposed, of_photos=3.0))
    assert "places of photos are 3 times as uncertain" in scene_advice(of_places)[0].limit
    with_them = length(exact.supposed.of_lines * exact.median_sigma_m(), exact.lines.unit)
    assert f"(to {with_them} if the calibration is off by 0.5 px)" in str(scene_summary(exact).verdict)
    assert "if the calibration" not in str(scene_summary(half).verdict)


@pytest.mark.slow
def test_a_prior_on_poses_holds_them_as_it_holds_them_in_the_adjustment() -> None:
    segments, poses, _ = world()
    free, held = (ol.adjust(segments, poses, calibration(), replace(OF_TABLES, refine=r)).lines for r in PARTS)
    shares = [ol.adjust(segments, poses, calibration(), pose_sigma=(s, s)).lines.calibration_sigma_m for s in (1e-6, 1.0)]
    np.testing.assert_allclose(shares[0], held.calibration_sigma_m, rtol=0.02)
    # A prior on where all photos are fixes the scale, which without it is free.
    assert np.median(shares[1] / free.calibration_sigma_m) < 2.0  # type: ignore[operator]


def noisy() -> tuple[Segments, ImagePoses]:
    """The world with the noise that is stated of its segments."""
    segments, poses, _ = world()
    noise = 0.3 * np.random.default_rng(0).standard_normal(segments.endpoints_px.shape)
    return replace(segments, endpoints_px=segments.endpoints_px + noise), poses


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [1e-4, 1e-3, 1e-2])
def test_what_exact_cameras_leave_out_beside_a_prior_on_poses_is_told(sigma: float, monkeypatch: pytest.MonkeyPatch) -> None:
    segments, poses = noisy()
    prior = (sigma, 2.0 * sigma)
    exact, half = (
        ol.adjust(segments, poses, CAMERA, replace(OF_TABLES, calibration_error_px=error), pose_sigma=prior)
        for error in (None, 0.5)
    )
    assert exact.supposed is not None and half.supposed is None
    times = float(np.median(half.lines.sigma_m / exact.lines.sigma_m))
    of_photos = [np.trace(one.poses.covariance[:, 3:, 3:], axis1=1, axis2=2) for one in (half, exact)]
    assert exact.supposed.of_lines == pytest.approx(times, rel=0.05)
    assert exact.supposed.of_photos == pytest.approx(float(np.median(np.sqrt(of_photos[0] / of_photos[1]))), rel=0.05)
    assert "more photos do not lower" in scene_advice(exact)[0].limit
    # Some of the lines tell the same as all: the prior weighs as much beside them.
    monkeypatch.setattr(_supposed, "LINES", LINES // 3)
    monkeypatch.setattr(_supposed, "LINES_OF_PHOTO", 0)
    some = ol.adjust(segments, poses, CAMERA, OF_TABLES, pose_sigma=prior).supposed
    assert some is not None and some.of_lines == pytest.approx(times, rel=0.2)


@pytest.mark.slow
def test_what_tells_the_place_and_size_of_a_scene_is_said() -> None:
    """Given poses as a whole, a prior on them, or a rig; and which photos lines draw beyond a prior that is too strict."""
    segments, poses = noisy()
    free = ol.adjust(segments, poses, CAMERA)
    assert OF_GIVEN in free.told and OF_PRIOR not in free.told
    assert not any("The given poses" in one for one in ol.adjust(segments, poses, CAMERA, OF_LINES).told)
    held = ol.adjust(segments, poses, CAMERA, pose_sigma=(1e-3, 2e-3))
    assert OF_PRIOR in held.told and OF_GIVEN not in held.told and not any("Lines draw" in one for one in held.told)
    turned = Pose.exp(torch.tensor([[0.0, 5e-3, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)) @ poses.cam_from_world[:1]
    rotation, translation = poses.cam_from_world.rotation.clone(), poses.cam_from_world.translation.clone()
    rotation[:1], translation[:1] = turned.rotation, turned.translation
    strict = ol.adjust(segments, replace(poses, cam_from_world=Pose(rotation, translation)), CAMERA, pose_sigma=(1e-4, 2e-4))
    assert any(one.startswith("Lines draw 0.png farther") for one in strict.told)
    rigs, places, second = stereo()
    mounts = {"cam0": RigCamera(Pose.identity(1)[0]), "cam1": RigCamera(second)}
    rig = Calibration({"cam0": CAMERA, "cam1": CAMERA}, rig=mounts)
    assert OF_GIVEN_AND_RIG in ol.adjust(rigs, places, rig).told
    refined = ol.adjust(rigs, places, rig, replace(OF_TABLES, refine=("lines", "poses", "rig")))
    assert OF_GIVEN in refined.told and OF_GIVEN_AND_RIG not in refined.told


@pytest.mark.slow
def test_lines_and_poses_follow_the_camera_beside_a_prior_as_in_the_adjustment_where_noise_is_not_what_is_stated() -> None:
    """Arcs of photos state more noise than they show, which weighs a prior. Against adjustments with the camera moved."""
    segments, poses = noisy()
    assert segments.covariance_px2 is not None
    segments, known = replace(segments, covariance_px2=4.0 * segments.covariance_px2), KnownPoses(poses, 1e-3, 2e-3)

    def adjusted(camera: CameraModel) -> AdjustedScene:
        """As `reconstruct` does it."""
        return reconstruct_lines(
            segments, poses, {"cam0": camera}, triangulation="ml", cost="whitened", refine_poses=True, known=known, cautious=True
        )

    exact = adjusted(CAMERA)
    at, moved, apart = torch.as_tensor(exact.lines.ends_m), np.zeros(LINES), torch.zeros(CAMERAS, 6, dtype=torch.float64)
    variance, axes = np.linalg.eigh(covariance())
    for step in 0.25 * (axes * np.sqrt(variance.clip(0.0)))[:, variance > 1e-12 * variance.max()].T:
        found = adjusted(CAMERA.with_parameters(CAMERA.parameters + torch.as_tensor(step)))
        ends = torch.as_tensor(found.lines.ends_m)
        there = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[:, None].closest_point(at)
        moved += (there - at).square().sum((1, 2)).numpy() / 0.25**2
        apart += (found.poses.cam_from_world @ exact.poses.cam_from_world.inverse()).log().square() / 0.25**2
    prior = beside_stated(known, exact.adjusted.noise)
    errors = errors_by_calibration(
        exact.lines,
        exact.table.arcs,
        np.arange(LINES),
        exact.poses,
        calibration(),
        OF_TABLES,
        {},
        prior=prior,  # type: ignore[arg-type]
    )
    assert errors is not None and exact.adjusted.noise.level < 0.6
    np.testing.assert_allclose(squares_m2(exact.lines, errors.lines.numpy()), moved, rtol=0.02)
    np.testing.assert_allclose(errors.poses.diagonal(dim1=1, dim2=2).sum(0), apart.sum(0), rtol=0.02)


def test_errors_that_move_no_pixel_are_left_out() -> None:
    pixels = torch.as_tensor(world()[0].endpoints_px.reshape(-1, 2))
    steps = camera_steps(CAMERA, covariance(), pixels)
    assert 3 <= len(steps) <= 6
    bearings, _ = CAMERA.unproject(pixels)
    moved = [CAMERA.with_parameters(CAMERA.parameters + torch.as_tensor(one)).project(bearings)[0] - pixels for one in steps]
    size = [float(one.square().sum()) for one in moved]
    assert size == sorted(size, reverse=True)
    assert camera_steps(CAMERA, np.zeros((8, 8)), pixels).shape == (0, 8)


def test_poses_that_were_found_from_points_follow_the_camera() -> None:
    _, poses, ends = world()
    points, pose = ends.reshape(-1, 3), poses.cam_from_world[2]
    seen, _ = CAMERA.project(pose.transform(torch.as_tensor(points)))
    seen = seen + 0.1 * torch.randn(len(points), 2, generator=torch.Generator().manual_seed(0)).double()
    start, _ = refit_pose(CAMERA, pose, points, seen.numpy())
    table = Pose(poses.cam_from_world.rotation.clone(), poses.cam_from_world.translation.clone())
    table.rotation[2], table.translation[2] = start.rotation, start.translation
    moved = CAMERA.with_parameters(CAMERA.parameters + torch.as_tensor(SIGMA))
    known = KnownCalibration((moved,), (None,), torch.zeros(CAMERAS, dtype=torch.long))
    found = followed_poses(table, {2: PosePoints(points, seen.numpy())}, known)
    before = followed_poses(table, {2: PosePoints(points, seen.numpy())}, replace(known, models=(CAMERA,)))
    expected = (refit_pose(moved, start, points, seen.numpy())[0] @ start.inverse()).log()
    off = (found[2] @ before[2].inverse()).log() - expected
    assert float(off.norm()) < 0.1 * float(expected.norm())
    assert torch.equal(found.rotation[0], table.rotation[0])


def stereo() -> tuple[Segments, ImagePoses, Pose]:
    """The same lines through two cameras that are mounted together, 0.3 m apart; where the second is."""
    segments, poses, ends = world()
    second = Pose.exp(torch.tensor([0.0, 0.0, 0.0, 0.3, 0.0, 0.0], dtype=torch.float64))
    rotation, translation = poses.cam_from_world.rotation.clone(), poses.cam_from_world.translation.clone()
    placed = second @ poses.cam_from_world[0::2]
    rotation[1::2], translation[1::2] = placed.rotation, placed.translation
    own = Pose(rotation, translation)
    pixels, _ = CAMERA.project(own[torch.as_tensor(segments.image)].transform(torch.as_tensor(ends)[segments.track]))
    names = tuple(f"cam{k % 2}" for k in range(CAMERAS))
    table = ImagePoses(poses.images, own, names, frames=tuple(str(k // 2) for k in range(CAMERAS)))
    return replace(segments, endpoints_px=pixels.numpy(), cameras=names), table, second


@pytest.mark.slow
@pytest.mark.parametrize("draws", [10, pytest.param(DRAWS, marks=pytest.mark.full)])
@pytest.mark.parametrize("refine", PARTS)
def test_lines_scatter_as_is_stated_where_a_rig_is_drawn_from_its_covariance(refine: tuple[str, ...], draws: int) -> None:
    segments, poses, second = stereo()
    sigma = np.array([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4])
    options = replace(OF_TABLES, refine=refine)

    def adjusted(place: Pose, known: np.ndarray | None, table: ImagePoses) -> Lines:
        mounts = {"cam0": RigCamera(Pose.identity(1)[0]), "cam1": RigCamera(place, covariance=known)}
        return ol.adjust(segments, table, Calibration({"cam0": CAMERA, "cam1": CAMERA}, rig=mounts), options).lines

    stated, plain = adjusted(second, np.diag(sigma**2), poses), adjusted(second, None, poses)
    assert stated.covariance is not None and plain.covariance is not None
    expected = squares_m2(plain, stated.covariance - plain.covariance)
    rng, at = np.random.default_rng(2), torch.as_tensor(plain.ends_m)
    moved = np.zeros(LINES)
    for draw in sigma * rng.standard_normal((draws, 6)):
        place = Pose.exp(torch.as_tensor(draw)) @ second
        rotation, translation = poses.cam_from_world.rotation.clone(), poses.cam_from_world.translation.clone()
        placed = place @ poses.cam_from_world[0::2]
        rotation[1::2], translation[1::2] = placed.rotation, placed.translation
        ends = torch.as_tensor(adjusted(place, None, replace(poses, cam_from_world=Pose(rotation, translation))).ends_m)
        found = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[:, None].closest_point(at)
        moved += (found - at).square().sum((1, 2)).numpy() / draws
    wider = math.sqrt(DRAWS / draws)
    assert 0.7**wider < moved.sum() / expected.sum() < 1.4**wider
