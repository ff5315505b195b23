"""Corners found where a camera says they are: boards at the rim, covered boards, wrong poses, poor cameras, shifted parts."""

import math
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from tag_views import View

from calib_patterns import Detection, DetectionOptions, pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.fitted_again import fitted_again
from calib_patterns.guided import GuidedCorners, guided_search, seen_ids
from calib_patterns.guided_part import guided_search_of_part
from calib_patterns.rendering import render_target
from calib_patterns.tag_board import TagBoard
from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose
from camera_models.pose_fit import refit_pose
from omnilines.calibration.single import calibrate_camera
from omnilines.synthetic.targets import example_camera, simulate_corners

SIZE = (1280, 960)
LENS_190 = OpenCVFisheye([286.0, 286.0, 639.5, 479.5, -0.01, 0.003, -0.001, 0.0001], SIZE)
LENS_220 = OpenCVFisheye([246.0, 246.0, 639.5, 479.5, -0.01, 0.003, -0.001, 0.0001], SIZE)
LENSES: dict[str, tuple[CameraModel, float, float]] = {"190": (LENS_190, 85.0, 81.0), "220": (LENS_220, 105.0, 95.0)}
"""Camera, how far off axis boards reach (degrees), and how far the outermost corner of each lies at least."""
PLAIN, CHARUCO, APRIL = "checkerboard:8x6:30mm", "charuco:9x7:30mm:22mm:DICT_5X5_100", "aprilgrid:4x4:35mm:0.3:36h11"
SPECS = (PLAIN, CHARUCO, APRIL)
SPACING_PX = {PLAIN: 12.0, CHARUCO: 12.0, APRIL: 8.0}


@lru_cache(maxsize=8)
def rim_views(spec: str, lens: str, count: int = 2) -> tuple[tuple[View, Pose], ...]:
    """Photos of boards swung out as far as they are seen, with noise, and their poses."""
    board, (model, reach_deg, least_deg) = pattern(spec), LENSES[lens]
    poses = random_board_poses(board, model, 5, math.radians(reach_deg), min_spacing_px=SPACING_PX[spec], seed=3)
    found = []
    for k in range(count):
        seen = poses[k].transform(torch.as_tensor(board.points_m)).numpy()
        assert np.degrees(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])).max() > least_deg
        image = render_target(board, model, poses[k], blur_px=0.5, noise_grey=2.0, vignetting=0.2, seed=k)
        everything = np.ones(len(seen), dtype=bool)
        found.append((View(image, model.project(seen)[0], everything, ~everything), poses[k]))
    return tuple(found)


def nudged(pose: Pose, seed: int, angle: float = 0.02, shift_m: float = 0.004) -> Pose:
    """A pose some pixels off."""
    size = np.repeat([angle, shift_m], 3)
    return Pose.exp(torch.as_tensor(np.random.default_rng(seed).normal(0.0, 1.0, 6) * size)) @ pose


def some(view: View, ids: np.ndarray, seed: int, sigma_px: float = 0.05) -> Detection:
    """Corners found before."""
    ids = np.sort(ids)
    noise = np.random.default_rng(seed).normal(0.0, sigma_px, (len(ids), 2))
    return Detection(ids, view.truth[ids] + noise, np.full(len(ids), sigma_px))


def gained(guided: GuidedCorners, before: Detection, view: View) -> np.ndarray:
    """Errors (k, 2) of the corners that were not known before."""
    new = ~np.isin(guided.detection.ids, before.ids)
    assert new.sum() == guided.gained
    return (guided.detection.pixels - view.truth[guided.detection.ids])[new]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.slow
def test_all_corners_of_boards_at_the_rim(spec: str, lens: str) -> None:
    """From six scattered corners, and from four at one end, in a pose some pixels off."""
    board, model = pattern(spec), LENSES[lens][0]
    checked = 0
    for seed, (view, pose) in enumerate(rim_views(spec, lens)):
        count = len(view.truth)
        wide = int(np.flatnonzero(np.diff(board.points_m[:, 1]) != 0)[0]) + 1
        scattered = np.random.default_rng(seed).choice(count, 6, replace=False)
        for ids in (scattered, np.array([0, 1, wide, wide + 1])):
            before = some(view, ids, seed)
            guided = guided_search(view.image, board, model, nudged(pose, seed), before)
            assert guided.fits and guided.detection.ids.tolist() == list(range(count))
            kept = np.isin(guided.detection.ids, before.ids)
            assert (guided.detection.pixels[kept] == before.pixels).all()
            error = gained(guided, before, view)
            assert np.sqrt((error**2).mean()) < 0.03 and np.abs(error).max() < 0.15  # the issue asks for 0.06
            assert guided.detection.sigma_px.max() < 0.3 and guided.detection.blur_px is not None
            checked += 1
    assert checked == 4


@pytest.mark.parametrize("flat", [False, True], ids=["textured", "flat"])
@pytest.mark.parametrize("spec", SPECS)
def test_covered_boards(spec: str, flat: bool) -> None:
    """All that is seen clearly, nothing that is hidden, none far off."""
    board, model = pattern(spec), LENS_190
    checked = 0
    for k, (view, pose) in enumerate(rim_views(spec, "190")):
        for share in (0.4, 0.6):
            part = view.covered(share, 2.0 * k + share, k)
            image = np.where(part.image != view.image, np.uint8(60), view.image) if flat else part.image
            before = some(view, np.random.default_rng(k).choice(np.flatnonzero(part.visible), 6, replace=False), k)
            guided = guided_search(image, board, model, nudged(pose, k), before)
            missed = np.setdiff1d(np.flatnonzero(part.visible), guided.detection.ids)
            assert guided.fits and len(missed) == 0 and not part.hidden[guided.detection.ids].any()
            error = np.linalg.norm(gained(guided, before, view), axis=1)
            # Corners whose window the cover touches may be off; a calibration judges them again.
            assert error.max() < 1.0 and np.percentile(error, 80) < 0.1
            checked += 1
    assert checked == 4


@pytest.mark.parametrize("spec", SPECS)
def test_a_corner_in_the_wrong_place_is_not_taken(spec: str) -> None:
    """The surroundings of some corners are drawn again three pixels away: perfect saddles, but not where the board has them."""
    board = pattern(spec)
    view, pose = rim_views(spec, "190")[0]
    image = view.image.copy()
    rng = np.random.default_rng(5)
    step = np.linalg.norm(view.truth[:, None] - view.truth, axis=-1)
    np.fill_diagonal(step, np.inf)
    wide = np.flatnonzero(step.min(1) > 14.0)
    moved = wide[:: max(1, len(wide) // 6)]
    for corner in moved:
        u, v = np.rint(view.truth[corner]).astype(int)
        du, dv = np.rint(3.0 * np.array([math.cos(a := rng.uniform(0, 2 * math.pi)), math.sin(a)])).astype(int)
        image[v + dv - 5 : v + dv + 6, u + du - 5 : u + du + 6] = view.image[v - 5 : v + 6, u - 5 : u + 6]
    before = some(view, np.setdiff1d(np.arange(len(view.truth)), moved)[::4], 0)
    guided = guided_search(image, board, LENS_190, pose, before)
    assert guided.fits and len(moved) >= 4 and not np.isin(moved, guided.detection.ids).any()
    assert np.abs(gained(guided, before, view)).max() < 1.0 and guided.gained > 0.4 * len(view.truth)


@pytest.mark.parametrize("spec", SPECS)
def test_a_wrong_pose_yields_nothing(spec: str) -> None:
    board, model = pattern(spec), LENS_190
    view, pose = rim_views(spec, "190")[0]
    others = random_board_poses(board, model, 4, math.radians(85.0), min_spacing_px=SPACING_PX[spec], seed=99)
    spacing = float(np.linalg.norm(board.points_m[1] - board.points_m[0]))
    wrong = [others[k] for k in range(4)]
    wrong += [pose @ Pose.of(np.eye(3), np.array([share * spacing, 0.0, 0.0])) for share in (0.5, 1.0, 1.4)]
    wrong += [pose @ Pose.exp(torch.tensor([0, 0, math.radians(20.0), 0, 0, 0], dtype=torch.float64))]
    # Tags also tell where the board was shifted by whole periods of its print, which look alike but for the tags.
    period = board.points_m[2, 0] - board.points_m[0, 0]
    wrong += [pose @ Pose.of(np.eye(3), np.array([period, 0.0, 0.0]))] if isinstance(board, TagBoard) else []
    for number, false_pose in enumerate(wrong):
        guided = guided_search(view.image, board, model, false_pose, Detection.empty())
        assert not guided.fits and len(guided.detection) == 0, number
    assert len(wrong) >= 8
    # Corners that are no board, and corners of this board that the camera contradicts: they come back as they are.
    false = some(view, np.arange(0, len(view.truth), 3), 1, sigma_px=8.0)
    other_lens = OpenCVFisheye([500.0, 500.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0], SIZE)
    for camera, before in ((model, false), (other_lens, some(view, false.ids, 1))):
        guided = guided_search(view.image, board, camera, pose, before)
        assert not guided.fits and guided.detection is before and guided.gained == 0


@pytest.mark.parametrize("spec", SPECS)
def test_a_pose_alone_is_enough(spec: str) -> None:
    """Where it is right to a pixel or two."""
    board = pattern(spec)
    checked = 0
    for k, (view, pose) in enumerate(rim_views(spec, "220")):
        guided = guided_search(view.image, board, LENS_220, nudged(pose, k, 0.001, 0.0001), Detection.empty())
        error = gained(guided, Detection.empty(), view)
        assert guided.fits and guided.gained == len(view.truth) and np.abs(error).max() < 0.15
        checked += 1
    assert checked == 2


def test_a_few_wrong_corners_lead_nowhere_else() -> None:
    """They stay, for the calibration to judge, and the others are found all the same."""
    board = pattern(PLAIN)
    view, pose = rim_views(PLAIN, "190")[0]
    before = some(view, np.arange(0, 48, 2), 0)
    before.pixels[[3, 10]] += [[5.0, 0.0], [-3.0, 4.0]]
    guided = guided_search(view.image, board, LENS_190, pose, before)
    assert guided.detection.ids.tolist() == list(range(48)) and np.abs(gained(guided, before, view)).max() < 0.15


def test_depth_and_colours_make_no_difference() -> None:
    """16 bits, BGR, and a board whose first square is white (only a plain board may be printed so)."""
    board = pattern(PLAIN)
    view, pose = rim_views(PLAIN, "190")[0]
    before = some(view, np.arange(0, 48, 5), 0)
    wanted = guided_search(view.image, board, LENS_190, pose, before)
    assert len(wanted.detection) == 48
    for image in (view.image.astype(np.uint16) * 200, cv2.cvtColor(view.image, cv2.COLOR_GRAY2BGR), 255 - view.image):
        found = guided_search(image, board, LENS_190, pose, before)
        np.testing.assert_allclose(found.detection.pixels, wanted.detection.pixels, atol=0.02)
    with pytest.raises(InputError, match="Expected a photo"):
        guided_search(view.image.astype(np.float64), board, LENS_190, pose, before)


def test_only_corners_in_the_image_are_looked_for() -> None:
    board = pattern(CHARUCO)
    view, pose = rim_views(CHARUCO, "190")[0]
    assert seen_ids(board, LENS_190, pose).tolist() == list(range(48))
    low, high = view.truth[:, 0].min(), view.truth[:, 0].max()
    width = int(0.5 * (low + high))
    cropped = OpenCVFisheye(LENS_190.parameters, (width, SIZE[1]))
    seen = seen_ids(board, cropped, pose)
    assert 8 < len(seen) < 40 and (view.truth[seen, 0] < width - 1).all()
    image = np.ascontiguousarray(view.image[:, :width])
    guided = guided_search(image, board, cropped, pose, some(view, seen[::4], 0))
    clear = np.flatnonzero(view.truth[:, 0] < width - 6)
    assert np.isin(clear, guided.detection.ids).all() and np.isin(guided.detection.ids, seen).all()
    assert np.linalg.norm(guided.detection.pixels - view.truth[guided.detection.ids], axis=1).max() < 0.5


@pytest.mark.parametrize("name", ["scaramuzza", "opencv-fisheye"])
@pytest.mark.slow
def test_a_first_camera_leads_beyond_what_it_was_calibrated_with(name: str) -> None:
    """Calibrated out to 60 degrees it is off by pixels at 85; from the inner half of a board it finds the next row, often all."""
    board = pattern(PLAIN)
    poses = random_board_poses(board, LENS_190, 10, math.radians(60.0), seed=2)
    camera = calibrate_camera(simulate_corners(LENS_190, board, poses, 0.05, 1), SIZE, name).model
    rim = np.array([[math.sin(math.radians(85.0)), 0.0, math.cos(math.radians(85.0))]])
    assert 0.5 < np.linalg.norm(camera.project(rim)[0] - LENS_190.project(rim)[0]) < 40.0
    for view, pose in rim_views(PLAIN, "190"):
        seen = pose.transform(torch.as_tensor(board.points_m)).numpy()
        theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        before = some(view, np.flatnonzero(theta < np.median(theta)), 0, sigma_px=0.02)
        guided = guided_search(view.image, board, camera, pose, before)
        assert guided.fits and guided.gained >= 8 and np.abs(gained(guided, before, view)).max() < 0.15


def test_a_part_of_a_plain_board_finds_its_place() -> None:
    """Three columns were found and taken for the first ones; a strip covers the two columns before them."""
    board = pattern(PLAIN)
    checked = 0
    for k, (view, pose) in enumerate(rim_views(PLAIN, "190")):
        grid = view.truth.reshape(6, 8, 2)
        left, right = 0.4 * grid[:, 2] + 0.6 * grid[:, 3], 0.6 * grid[:, 4] + 0.4 * grid[:, 5]
        left, right = (
            np.concatenate([[3 * side[0] - 2 * side[1]], side, [3 * side[-1] - 2 * side[-2]]]) for side in (left, right)
        )
        strip = np.zeros(SIZE[::-1], dtype=np.uint8)
        cv2.fillPoly(strip, [np.rint(np.concatenate([left, right[::-1]])).astype(np.int32)], 1)
        image = np.where(strip > 0, np.uint8(110), view.image)
        column = np.arange(48) % 8
        part = some(view, np.flatnonzero(column >= 5), k, sigma_px=0.02)
        shifted = replace(part, ids=part.ids - 5)
        thought = pose @ Pose.of(np.eye(3), np.array([5 * 0.03, 0.0, 0.0]))
        guided = guided_search_of_part(image, board, LENS_190, thought, shifted)
        ids = guided.detection.ids
        assert np.isin(np.flatnonzero((column <= 2) | (column >= 5)), ids).all() and not np.isin(column[ids], (3, 4)).any()
        assert np.linalg.norm(guided.detection.pixels - view.truth[ids], axis=1).max() < 0.3 and guided.gained == 18
        there = LENS_190.project(guided.cam_from_board.transform(torch.as_tensor(board.points_m)))[0].numpy()
        np.testing.assert_allclose(there, view.truth, atol=0.1)
        checked += 1
    assert checked == 2


@pytest.mark.parametrize("spec", SPECS)
def test_corners_are_fitted_again_along_the_edges_that_the_camera_sees(spec: str) -> None:
    """From places off by a fifth of a pixel, and a pose off by pixels, to the noise of the photo."""
    board = pattern(spec)
    for seed, (view, pose) in enumerate(rim_views(spec, "220")):
        before = some(view, np.arange(len(view.truth)), seed)
        again = fitted_again(view.image, board, LENS_220, nudged(pose, seed), before)
        error = again.pixels - view.truth
        assert again.ids.tolist() == before.ids.tolist() and (again.sigma_px < 0.2).all()
        assert np.sqrt(np.mean((error / again.sigma_px[:, None]) ** 2)) < 1.1
    assert len(rim_views(spec, "220")) == 2


@pytest.mark.slow
def test_bends_of_a_camera_correct_the_ends_of_a_board() -> None:
    """Boards in hand beside a lens of 200 degrees, beyond its rim: what the detection finds there is off by several sigma."""
    board, lens = pattern("charuco:7x5:60mm:45mm:DICT_4X4_50"), example_camera("double-sphere", 200.0, (480, 480), 0)
    beside = Pose.exp(torch.tensor([0.0, 0.5 * math.pi, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    poses = random_board_poses(board, lens, 8, math.radians(98.0), min_spacing_px=12.0, seed=1)
    before, after = [], []
    for k in range(8):
        pose = beside @ poses[k]
        image = render_target(board, lens, pose, supersample=8, blur_px=0.5, noise_grey=2.0, seed=k)
        found, _ = board.detect(image)
        again = fitted_again(image, board, lens, pose, found)
        truth = lens.project(pose.transform(torch.as_tensor(board.points_m[found.ids])))[0].numpy()
        before.append((found.pixels - truth) / found.sigma_px[:, None])
        after.append((again.pixels - truth) / again.sigma_px[:, None])
    first, second = (np.concatenate(parts) for parts in (before, after))
    assert np.abs(first).max() > 5.0 and np.abs(second).max() < 4.5
    assert np.sqrt((first**2).mean()) > 1.2 and np.sqrt((second**2).mean()) < 1.0


@pytest.mark.slow
def test_blurred_tags_beside_corners_do_not_draw_them() -> None:
    """Squares of 10 to 20 px, tags an eighth of a square from their sides, a blur of 0.7 px: the lens compresses squares towards
    its rim, so that what is dark beside a corner draws it inwards."""
    board, lens = pattern("charuco:7x5:60mm:45mm:DICT_4X4_50"), example_camera("double-sphere", 200.0, (480, 480), 0)
    beside = Pose.exp(torch.tensor([0.0, 0.5 * math.pi, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    poses = random_board_poses(board, lens, 8, math.radians(98.0), min_spacing_px=12.0, seed=2)
    as_they_are, clear = DetectionOptions(), []
    near_tags = replace(as_they_are, fit=as_they_are.fit._replace(tag_clear_blurs=0.0))
    for options in (near_tags, as_they_are):
        inwards = []
        for k in range(8):
            pose = beside @ poses[k]
            image = render_target(board, lens, pose, supersample=8, blur_px=0.7, seed=k)
            found, _ = board.detect(image, options=options)
            again = fitted_again(image, board, lens, pose, found, options)
            truth = lens.project(pose.transform(torch.as_tensor(board.points_m[found.ids])))[0].numpy()
            towards = lens.centre_px.numpy() - truth
            inwards.append(((again.pixels - truth) * towards).sum(1) / np.linalg.norm(towards, axis=1))
        clear.append(float(np.concatenate(inwards).mean()))
    assert clear[0] > 0.006 and abs(clear[1]) < 0.004, clear


def test_what_is_no_corner_any_more_stays_as_it_was() -> None:
    """Something that lies beside a corner, a place that the camera does not see, and no corner at all."""
    board = pattern(PLAIN)
    view, pose = rim_views(PLAIN, "190")[0]
    image, before = view.image.copy(), some(view, np.arange(48), 0, sigma_px=0.02)
    u, v = np.rint(view.truth[20]).astype(int)
    image[v - 9 : v + 10, u + 3 : u + 12] = 110
    again = fitted_again(image, board, LENS_190, pose, before)
    assert (again.pixels[20] == before.pixels[20]).all() and again.sigma_px[20] == 0.02
    assert (again.pixels != before.pixels).all(1).sum() > 40
    behind = Pose.exp(torch.tensor([0.0, math.pi, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)) @ pose
    narrow = Pinhole([500.0, 500.0, 639.5, 479.5, *np.zeros(9)], SIZE)
    assert fitted_again(image, board, narrow, behind, before) is before
    assert len(fitted_again(image, board, LENS_190, pose, Detection.empty())) == 0


def test_pose_is_the_robust_least_squares_one() -> None:
    """Against SciPy's Cauchy loss at the same scale, and against the truth with a fifth of wrong corners."""
    board = pattern(PLAIN)
    _, pose = rim_views(PLAIN, "220")[0]
    rng = np.random.default_rng(4)
    truth = LENS_220.project(pose.transform(torch.as_tensor(board.points_m)))[0].numpy()
    pixels = truth + rng.normal(0.0, 0.1, truth.shape)
    pixels[::5] += rng.normal(0.0, 20.0, pixels[::5].shape)
    fitted, residual = refit_pose(LENS_220, nudged(pose, 1), board.points_m, pixels)
    inliers = np.arange(48) % 5 != 0

    def off(delta: np.ndarray) -> np.ndarray:
        moved = Pose.exp(torch.as_tensor(delta)) @ pose
        return (LENS_220.project(moved.transform(torch.as_tensor(board.points_m)))[0].numpy() - pixels)[inliers].ravel()

    theirs = Pose.exp(torch.as_tensor(least_squares(off, np.zeros(6), x_scale=[1e-2] * 3 + [1e-3] * 3).x)) @ pose
    (ours_px, theirs_px) = (LENS_220.project(p.transform(torch.as_tensor(board.points_m)))[0].numpy() for p in (fitted, theirs))
    assert np.abs(ours_px - truth).max() < 0.2 and np.abs(ours_px - theirs_px).max() < 0.1
    np.testing.assert_allclose(residual, pixels - ours_px, atol=1e-9)
