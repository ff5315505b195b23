"""What to shoot next: the expected decrease is the real one, advice beats random poses, and the words say where the board is."""

import itertools
import math

import numpy as np
import pytest
import torch
from board_views import BOARD, board_corners, board_views

import omnilines as ol
from camera_models import OpenCVFisheye, Scaramuzza
from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.calibration.image_field import ImageField, KnownProjection
from omnilines.calibration.next_pose import next_views
from omnilines.calibration.pose_candidates import view_information
from omnilines.calibration.shooting_words import px_words
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.thresholds import ShootingThresholds
from omnilines.calibration.uncertainty import most_stated_px
from omnilines.files import photos_of
from omnilines.pages.calibration import calibration_data, calibration_summaries
from omnilines.pages.next_views import next_views_data, next_views_summary
from omnilines.pages.uncertainty_map import UncertaintyMap
from omnilines.pipelines.next_views import lens_rim_px, seen_rim_px

SIZE = (1280, 960)
LENSES = {
    "opencv-fisheye": OpenCVFisheye([320.0, 320.0, 639.5, 479.5, 0.01, -0.005, 0.001, 0.0], SIZE),
    "scaramuzza": Scaramuzza([645.0, 486.0, 1.001, 3e-4, 3e-4, 338.0, -1.2e-3, 1.27e-6, -2.2e-9], SIZE),
    "mirror": Scaramuzza([640.0, 480.0, 1.0, 0.0, 0.0, -250.0, 1.8e-3, 0.0, 0.0], SIZE),
}
NOISE_PX = 0.2


def calibrated(truth, poses, seed=0):
    corners = board_corners(truth, poses, NOISE_PX, seed)
    options = {"degree": 4} if truth.NAME == "scaramuzza" else None
    mirror = truth.NAME == "scaramuzza" and float(truth.parameters[5]) < 0
    return calibrate_camera(corners, SIZE, truth.NAME, options=options, mirror=mirror), corners


def rim_px(truth, reach_deg):
    """Distance from the centre at which the image ends."""
    angle = math.radians(reach_deg)
    axis = float(torch.sign(truth.unproject(truth.centre_px)[0][2]))
    edge, _ = truth.project(torch.tensor([math.sin(angle), 0.0, axis * math.cos(angle)], dtype=torch.float64))
    return float((edge - truth.centre_px).norm())


def joined(poses: Pose, more: Pose) -> Pose:
    return Pose(torch.cat([poses.rotation, more.rotation]), torch.cat([poses.translation, more.translation]))


def nearest_side(model, cam_from_board) -> str:
    """Where in the image the side of the board lies that is nearest to the camera: of points round its middle."""
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    round_middle = BOARD.mean(0) + 1e-4 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    points = cam_from_board.transform(torch.as_tensor(np.concatenate([BOARD.mean(0)[None], round_middle]))).numpy()
    pixels = model.project(points)[0]
    u, v = pixels[1 + np.linalg.norm(points[1:], axis=-1).argmin()] - pixels[0]
    sides = ("right", "lower right", "lower", "lower left", "left", "upper left", "upper", "upper right")
    return sides[round(math.degrees(math.atan2(v, u)) / 45) % 8]


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LENSES))
def test_the_uncertainty_falls_as_promised(name):
    """Three photos shot as advised: after each the largest uncertainty of the camera calibrated anew is as was promised, and the
    boards are seen whole at tilts and distances that a person can hold."""
    truth = LENSES[name]
    poses = board_views(truth, 70.0, 6, 3, mirror=name == "mirror")
    rim = rim_px(truth, 85.0)
    fit, corners = calibrated(truth, poses)
    advice = next_views(fit, corners, rim_px=rim, board_m=BOARD)
    assert advice is not None and len(advice.poses) == 3
    assert advice.worst_px > advice.poses[0].worst_px > advice.poses[1].worst_px > advice.poses[2].worst_px
    for one, other in itertools.combinations(advice.poses, 2):
        assert math.dist(one.place_px, other.place_px) > 0.14 * SIZE[0]
    distances = poses.transform(torch.as_tensor(BOARD.mean(0)).expand(6, 1, 3))[:, 0].norm(dim=-1)
    for pose in advice.poses:
        seen = pose.cam_from_board.transform(torch.as_tensor(BOARD))
        pixels, valid = truth.project(seen)
        radius = (pixels - truth.centre_px).norm(dim=-1)
        assert float((valid & (radius < 1.02 * rim)).to(torch.float64).mean()) >= 0.79
        straight = (seen * pose.cam_from_board.rotation[:, 2]).sum(-1) / seen.norm(dim=-1)
        assert float(straight[valid].min()) > math.cos(math.radians(65.1))
        assert pose.tilt_deg <= 45 and 0.7 * distances.min() < pose.distance_m < 1.1 * distances.max()
        assert pose.words.startswith(("at the", "in the middle", "half way")) and pose.words.endswith("away")
        if pose.tilt_deg > 0:
            assert f"{nearest_side(fit.model, pose.cam_from_board)} side nearer" in pose.words
        poses = joined(poses, Pose(pose.cam_from_board.rotation[None], pose.cam_from_board.translation[None]))
        again, corners = calibrated(truth, poses, seed=len(poses))
        after = next_views(again, corners, rim_px=rim, board_m=BOARD)
        assert after is not None
        assert 0.8 < after.worst_px / pose.worst_px < 1.25, (after.worst_px, pose.worst_px)


@pytest.mark.slow
def test_advice_needs_at_most_half_the_photos_of_random_poses():
    truth, rim = LENSES["opencv-fisheye"], rim_px(LENSES["opencv-fisheye"], 85.0)
    pool = board_views(truth, 85.0, 20, 11)
    fit, corners = calibrated(truth, pool)
    random_poses = next_views(fit, corners, rim_px=rim, board_m=BOARD)
    poses = pool[:4]
    for _ in range(6):
        fit, corners = calibrated(truth, poses)
        advice = next_views(fit, corners, rim_px=rim, board_m=BOARD, thresholds=ShootingThresholds(poses=1))
        one = advice.poses[0].cam_from_board
        poses = joined(poses, Pose(one.rotation[None], one.translation[None]))
    fit, corners = calibrated(truth, poses)
    advised = next_views(fit, corners, rim_px=rim, board_m=BOARD)
    assert len(poses) == 10 and advised.worst_px <= random_poses.worst_px, (advised.worst_px, random_poses.worst_px)


def test_information_is_the_inverse_of_the_covariance():
    """The views of a calibration, one by one, tell together what its covariance says."""
    truth = LENSES["opencv-fisheye"]
    poses = board_views(truth, 80.0, 8, 5)
    fit, _ = calibrated(truth, poses)
    used = Pose.stack([view.cam_from_board for view in fit.views])
    total = view_information(ImageField(fit.model), used, torch.as_tensor(BOARD)).sum(0) / fit.corner_sigma_px**2
    product = total @ torch.as_tensor(fit.covariance)
    assert float((product - torch.eye(8, dtype=torch.float64)).abs().max()) < 1e-3


def test_one_view_more_is_the_same_alone_and_among_many():
    truth = LENSES["scaramuzza"]
    fit, _ = calibrated(truth, board_views(truth, 70.0, 6, 2))
    field = ImageField(fit.model, rim_px(truth, 85.0))
    known = KnownProjection.of(field, torch.as_tensor(fit.covariance), 0.0, math.radians(fit.max_angle_deg))
    views = board_views(truth, 70.0, 3, 9)
    information = view_information(field, views, torch.as_tensor(BOARD)) / fit.corner_sigma_px**2
    information = known.factor.mT @ information @ known.factor
    after = known.sigma_after_px(information)
    later, change = known.with_view(information[0])
    assert torch.allclose(later.sigma_px, after[0], rtol=1e-9)
    second = later.sigma_after_px((change @ information[1] @ change.mT)[None])[0]
    both = known.sigma_after_px(information[:2].sum(0)[None])[0]
    assert torch.allclose(second, both, rtol=1e-7)
    assert bool((both <= after[0] * (1 + 1e-9)).all())


def test_words_say_what_is_missing():
    """Boards of the middle only, all facing the camera, few, with much noise; and where they are missing on one side."""
    truth = LENSES["opencv-fisheye"]
    fit, corners = calibrated(truth, board_views(truth, 45.0, 5, 1, tilt_deg=30.0))
    advice = next_views(fit, corners, rim_px=rim_px(truth, 85.0), board_m=BOARD)
    assert "beyond 4" in advice.limits[0] and "where the image reaches to 8" in advice.limits[0]
    assert "only 5 views" in " ".join(advice.limits)
    assert "rim of the image" in advice.poses[0].words and "rim" in advice.worst_where
    pool = board_views(truth, 85.0, 60, 6)
    middle = pool.transform(torch.as_tensor(BOARD.mean(0)).expand(60, 1, 3))[:, 0]
    left = pool[(middle[:, 0] < 0.01).nonzero()[:, 0]]
    assert len(left) > 10
    fit, corners = calibrated(truth, left)
    advice = next_views(fit, corners, rim_px=rim_px(truth, 85.0), board_m=BOARD)
    assert "right" in advice.limits[0] and "the left rim" not in advice.limits[0]


def test_where_errors_are_not_small_the_projection_is_said_not_to_be_known():
    """Corners of the middle alone extrapolate to hundreds of pixels, which no derivative tells; the numbers stay in the data."""
    truth = LENSES["opencv-fisheye"]
    corners = board_corners(truth, board_views(truth, 50.0, 5, 1, tilt_deg=30.0), NOISE_PX, 0)
    result = ol.calibrate(corners, SIZE, model="opencv-fisheye")
    advice = next_views(result.fit, corners, rim_px=rim_px(truth, 85.0), board_m=BOARD)
    limit = most_stated_px(result.camera)
    assert advice.median_px < limit == 16.0 < advice.worst_px and next_views_data(advice)["worst_px"] == advice.worst_px
    assert f"px in the median of the image, but not {advice.worst_where}, a single" in advice.conclusion
    assert "the largest uncertainty, not known now, would be" in advice.sentences[0]
    rows = dict(next_views_summary(advice).rows)
    assert rows["largest uncertainty"].startswith(f"not known {advice.worst_where}; {px_words(advice.median_px)} px in the")
    assert not any(px_words(advice.worst_px) in text for text in (*rows.values(), advice.conclusion, *advice.sentences))
    found = UncertaintyMap.of(result.fit)
    assert np.nanmax(found.sigma_px) > limit >= np.nanmax(found.stated_px) and found.stated_largest[0] == math.inf
    assert advice.stated_worst_px == math.inf


def test_much_is_said_to_be_good_enough():
    truth = LENSES["opencv-fisheye"]
    fit, corners = calibrated(truth, board_views(truth, 85.0, 80, 1))
    advice = next_views(fit, corners, rim_px=rim_px(truth, 84.0), board_m=BOARD)
    assert advice.conclusion.startswith("It is good enough") and "about 6 percent" in advice.conclusion


def test_the_rim_is_where_photos_are_dark():
    radii = np.arange(1.0, 501.0)
    bright = np.where(radii < 380, 200.0, 8.0)
    assert lens_rim_px(radii, bright, 300.0, 0.25) == pytest.approx(380)
    assert lens_rim_px(radii, np.full(500, 90.0), 300.0, 0.25) is None
    # A blind centre is dark too, and light returns outside a mirror.
    mirror = np.where(radii < 60, 3.0, np.where((radii > 390) & (radii < 410), 10.0, 150.0))
    assert lens_rim_px(radii, mirror, 300.0, 0.25) == pytest.approx(391)


def test_the_rim_is_found_in_photos() -> None:
    camera = LENSES["opencv-fisheye"]
    centre = camera.centre_px.numpy()
    column, row = np.meshgrid(*(np.arange(side) for side in camera.image_size))
    photo = np.where(np.hypot(column - centre[0], row - centre[1]) < 330, 180, 4).astype(np.uint8)
    seen = centre + np.array([[250.0, 0.0], [0.0, -200.0]])
    assert seen_rim_px(photos_of([photo] * 3), camera, seen) == pytest.approx(330, abs=2)
    assert seen_rim_px(photos_of([np.full_like(photo, 180)]), camera, seen) is None
    assert seen_rim_px([], camera, seen) is None


def test_part_of_the_result_its_table_and_its_data(tmp_path):
    """A result in Python, its rows, its data for --json and its page tell the same."""
    truth = LENSES["opencv-fisheye"]
    corners = board_corners(truth, board_views(truth, 72.0, 8, 3), NOISE_PX, 0)
    result = ol.calibrate(corners, SIZE, model="opencv-fisheye")
    advice = result.next_views
    assert advice is not None and result.next_views is advice
    summary = next(s for s in calibration_summaries(result) if s.title == "What to shoot next")
    rows = dict(summary.rows)
    assert rows["next photo"].startswith("Hold the board") and rows["all in all"] == advice.conclusion
    verdict = calibration_summaries(result)[0].verdict
    assert verdict.startswith("The camera is known to ") and verdict.endswith("degrees off axis.")
    told = calibration_summaries(result)[0].advice
    assert told[0].limit == " ".join(advice.limits) and told[0].do.lower().startswith(advice.sentences[0].lower())
    data = calibration_data(result)["next_views"]
    assert [pose["worst_px"] for pose in data["poses"]] == [pose.worst_px for pose in advice.poses]
    values = [data["worst_px"], *(pose["worst_px"] for pose in data["poses"])]
    assert all(later < before for before, later in itertools.pairwise(values))
    page = result.report(tmp_path / "report.html").read_text()
    assert f'<p class="verdict">{verdict}</p>' in page and f"<td>{told[0].limit}</td><td>{told[0].do}</td>" in page
    assert page.index('class="verdict"') < page.index("Boards to shoot next over the image") < page.index('class="facts"')
    assert advice.poses[0].words in page and "Boards to shoot next over the image" in page
    worst, median = px_words(advice.worst_px), px_words(advice.median_px)
    known = (
        f"The projection is known to {median} px in the median of {advice.image} and to {worst} px at worst, a single corner to"
    )
    assert advice.conclusion.startswith(known)
    u, v = advice.worst_at_px
    assert f"Over {advice.image} it is at most {rounded(advice.worst_px)} px, at ({u:.0f}, {v:.0f}) px." in page


def test_without_photos_the_words_say_of_which_part_of_the_image_they_speak(tmp_path):
    """Corners alone do not tell how far the lens shows the world: nothing is promised of what lies beyond the nearest border."""
    truth = LENSES["opencv-fisheye"]
    corners = board_corners(truth, board_views(truth, 72.0, 8, 3), NOISE_PX, 0)
    result = ol.calibrate(corners, SIZE, model="opencv-fisheye")
    rim = result.next_views.known.field.rim_px
    part = f"the image within {rim:.0f} px of its centre (no photo shows where it ends)"
    assert 470 < rim < 640 and f"px in the median of {part} and to" in result.next_views.conclusion
    summary = next(s for s in calibration_summaries(result) if s.title == "What to shoot next")
    assert dict(summary.rows)["largest uncertainty"].endswith(f"in the median of {part}")
    assert f"Over {part} it is at most" in result.report(tmp_path / "report.html").read_text()
    seen = next_views(result.fit, corners, rim_px=rim, board_m=BOARD)
    assert seen.worst_px == pytest.approx(result.next_views.worst_px) and "in the median of the image and to" in seen.conclusion


def test_the_map_ends_where_the_lens_does():
    """The corners of the image, which show nothing, are the worst places of the whole of it."""
    truth = LENSES["opencv-fisheye"]
    fit, corners = calibrated(truth, board_views(truth, 60.0, 6, 3))
    field = next_views(fit, corners, rim_px=rim_px(truth, 80.0), board_m=BOARD).known.field
    every, shown = UncertaintyMap.of(fit), UncertaintyMap.of(fit, field)
    v, u = np.meshgrid(shown.v_px, shown.u_px, indexing="ij")
    inside = np.hypot(u - float(fit.model.centre_px[0]), v - float(fit.model.centre_px[1])) <= field.rim_px
    assert np.array_equal(np.isfinite(shown.sigma_px), inside & np.isfinite(every.sigma_px))
    assert np.nanmax(every.sigma_px) > 1.5 * np.nanmax(shown.sigma_px)
    assert shown.figures == every.figures


@pytest.mark.parametrize("seed", range(4))
def test_nowhere_in_the_image_is_less_known_than_the_image(seed: int) -> None:
    """Photos that reach all over it: what is said of the image at worst is not below what is said of the part with corners."""
    truth = LENSES["scaramuzza"]
    fit, corners = calibrated(truth, board_views(truth, 95.0, 12, seed))
    advice = next_views(fit, corners, board_m=BOARD)
    found = UncertaintyMap.of(fit, advice.known.field)
    assert advice.worst_px == pytest.approx(np.nanmax(found.sigma_px), rel=1e-9) and advice.worst_px >= found.figures[1]
