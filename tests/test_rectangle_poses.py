"""Poses from a sheet of known size: simulated sides against truth, rendered photos, its half turn, and what has no sheet."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from camera_models import CameraModel, InputError, load
from camera_models.pose import Pose
from omnilines.commands.experiment_book import experiment_book
from omnilines.commands.reconstruct import reconstruct_photos, reconstruct_segments
from omnilines.files import read_corners, read_poses
from omnilines.pages.limits_of_lines import scene_advice
from omnilines.pipelines.arcs import extract
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.poses import estimate_poses, sides_of
from omnilines.pipelines.reconstruct import reconstruct
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.rendered import RenderedScene
from omnilines.posing.features import Features
from omnilines.posing.find_rectangle import BearingArcs, FoundRectangle, find_rectangle
from omnilines.posing.from_corners import poses_from_corners
from omnilines.posing.from_rectangles import half_turns
from omnilines.posing.rectangle import Rectangle, corner_distances, parse_rectangle, pose_of_corners
from omnilines.records import Corners
from omnilines.scenes import scene_camera, sheet_from_world
from omnilines.studies.book import BookOptions

LETTER = Rectangle(0.279, 0.216)
PIXEL_SIGMA = 0.15
BESIDE = np.array([0.0, 0.3, 0.0])
CHI_SQUARE_6_999 = 22.5


def test_the_size_is_read_and_what_is_none_is_refused() -> None:
    assert parse_rectangle("rectangle:279x216mm") == LETTER
    assert parse_rectangle("rectangle:27.9cmx216mm") == LETTER
    wrong = {
        "rectangle:279x216": "with mm, cm or m",
        "rectangle:279x216px": "with mm, cm or m",
        "rectangle:279mm": "WIDTHxHEIGHT",
        "rectangle:279x216m": "check the unit",
        "rectangle:0.2x0.2mm": "check the unit",
        "rectangle:0x216mm": "positive length",
        "rectangle:200x205mm": "quarter turn",
    }
    for text, message in wrong.items():
        with pytest.raises(InputError, match=message):
            parse_rectangle(text)


def sheet_poses(camera: CameraModel, largest_angle: float, count: int, seed: int) -> list[Pose]:
    """Poses from which the camera sees the whole front of the sheet, at any angle off axis up to one."""
    rng, found = np.random.default_rng(seed), []
    middle = torch.tensor([LETTER.width_m / 2, LETTER.height_m / 2, 0.0], dtype=torch.float64)
    while len(found) < count:
        theta, phi = rng.uniform(0.0, largest_angle), rng.uniform(-np.pi, np.pi)
        z = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        x = np.cross([0.3, 1.0, 0.2], z) / np.linalg.norm(np.cross([0.3, 1.0, 0.2], z))
        facing = torch.as_tensor(np.stack([x, np.cross(z, x), z], 1))
        tilt = np.array([*rng.normal(0.0, 0.5, 2), rng.uniform(-np.pi, np.pi), 0.0, 0.0, 0.0])
        rotation = facing @ Pose.exp(torch.as_tensor(tilt)).rotation
        pose = Pose(rotation, torch.as_tensor(rng.uniform(0.4, 0.9) * z) - rotation @ middle)
        pixels, valid = camera.project(pose.transform(torch.as_tensor(LETTER.corners_m)))
        inside = (pixels > 4).all() and (pixels < torch.tensor(camera.image_size, dtype=torch.float64) - 5).all()
        if bool(valid.all()) and bool(inside) and float(rotation[:, 2] @ torch.as_tensor(z)) > 0.4:
            found.append(pose)
    return found


def seen_sides(
    camera: CameraModel, pose: Pose, rng: np.random.Generator, corners_m: np.ndarray = LETTER.corners_m, inside: float = 5.2
) -> BearingArcs:
    """Arcs on the sides of a bright quadrilateral, of either direction and in any order, with noise."""
    corners = torch.as_tensor(corners_m)
    along = torch.tensor([0.07, 0.94], dtype=torch.float64)[None, :, None]
    points = corners[:, None] + (corners.roll(-1, 0) - corners)[:, None] * along
    pixels = camera.project(pose.transform(points))[0].numpy() + rng.normal(0.0, PIXEL_SIGMA, (len(corners), 2, 2))
    ends, _ = camera.unproject(pixels)
    by_pixel = camera.unproject_jacobian(torch.as_tensor(pixels)).numpy()
    colours = np.zeros((len(corners), 2, 3))
    colours[:, 0], colours[:, 1] = inside, 4.0
    swapped = rng.random(len(corners)) < 0.5
    ends[swapped], by_pixel[swapped], colours[swapped] = ends[swapped, ::-1], by_pixel[swapped, ::-1], colours[swapped, ::-1]
    order = rng.permutation(len(corners))
    noise = PIXEL_SIGMA**2 * by_pixel @ by_pixel.swapaxes(-1, -2)
    return BearingArcs(ends[order], noise[order], colours[order])


def together(*parts: BearingArcs) -> BearingArcs:
    return BearingArcs(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("ends", "noise", "colours")))


def error_of(found: Pose, true: Pose) -> np.ndarray:
    """Of the nearer of both poses that look the same."""
    ways = [(found @ way.inverse()).log().numpy() for way in (true, true @ LETTER.half_turn)]
    return min(ways, key=lambda off: float(np.abs(off).sum()))


@pytest.mark.parametrize("model, largest", [("pinhole", 0.5), ("opencv-fisheye", 1.55)])
@pytest.mark.slow
def test_poses_err_as_they_state(model: str, largest: float) -> None:
    camera, _ = scene_camera(model, (1280, 960), 0)
    rng, squares = np.random.default_rng(1), []
    poses = sheet_poses(camera, largest, 60, 2)
    assert model == "pinhole" or max(float(torch.atan2(p.translation[:2].norm(), p.translation[2])) for p in poses) > 1.4
    for pose in poses:
        found = find_rectangle(seen_sides(camera, pose, rng), LETTER)
        assert isinstance(found, FoundRectangle), found
        off = error_of(found.pose, pose)
        squares.append(float(off @ np.linalg.solve(found.covariance, off)))
        assert float(found.pose.rotation[0, 0]) > 0
    # Chi-square of six degrees of freedom: its mean over 60 is known to 7.5 percent.
    assert np.mean(squares) / 6 == pytest.approx(1.0, abs=0.3)
    assert np.mean(np.array(squares) < 12.59) > 0.85


def test_corners_without_noise_give_the_pose_for_any_direction() -> None:
    camera, _ = scene_camera("opencv-fisheye", (1280, 960), 0)
    poses = Pose.stack(sheet_poses(camera, 1.6, 20, 3))
    seen = poses.rotation @ torch.as_tensor(LETTER.corners_m.T)
    seen = seen.mT + poses.translation[:, None]
    bearings = seen / seen.norm(dim=-1, keepdim=True)
    distances, sound = corner_distances(bearings)
    assert bool(sound.all())
    length = seen.norm(dim=-1)
    torch.testing.assert_close(distances, length / length[:, 2:3])
    found, sound = pose_of_corners(bearings, LETTER)
    torch.testing.assert_close(found.rotation, poses.rotation, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.translation, poses.translation, atol=1e-9, rtol=0)
    # Behind the camera there is nothing.
    assert not bool(pose_of_corners(-bearings[:, [0, 3, 1, 2]], LETTER)[1].any())


def test_what_is_no_sheet_gets_one_sentence() -> None:
    camera, _ = scene_camera("pinhole", (1280, 960), 0)
    rng = np.random.default_rng(4)
    pose = sheet_poses(camera, 0.3, 1, 5)[0]
    whole = seen_sides(camera, pose, rng)
    assert isinstance(find_rectangle(whole, LETTER), FoundRectangle)
    three = BearingArcs(whole.ends[:3], whole.noise[:3], whole.colours[:3])
    dark = BearingArcs(whole.ends, whole.noise, whole.colours[:, ::-1])
    folded = seen_sides(camera, pose, rng, LETTER.corners_m * [0.5, 1.0, 1.0])
    beside = seen_sides(camera, pose, rng, LETTER.corners_m + BESIDE)
    faint = seen_sides(camera, pose, rng, LETTER.corners_m + BESIDE, inside=4.8)
    nothing = BearingArcs(np.zeros((0, 2, 3)), np.zeros((0, 2, 3, 3)), np.zeros((0, 2, 3)))
    wanted = {
        "four edges that close": (three, dark, nothing),
        "none of that shape": (folded,),
        "others that are as bright": (together(whole, beside),),
    }
    for message, cases in wanted.items():
        for arcs in cases:
            found = find_rectangle(arcs, LETTER)
            assert isinstance(found, str) and message in found and found.endswith("."), found
    # A darker one of the same shape, and a folded one, are not taken for it.
    for other in (faint, folded):
        found = find_rectangle(together(other, whole), LETTER)
        assert isinstance(found, FoundRectangle)
        assert np.abs(error_of(found.pose, pose)).max() < 0.02


def features_of(points: torch.Tensor, descriptors: torch.Tensor, pose: Pose) -> Features:
    seen = pose.transform(points)
    bearings = seen / seen.norm(dim=-1, keepdim=True)
    count = len(points)
    return Features(bearings, torch.zeros(count, 2, 3).double(), torch.full((count,), 1e-3).double(), descriptors)


def test_features_tell_which_way_the_sheet_lies() -> None:
    rng = np.random.default_rng(6)
    camera, _ = scene_camera("opencv-fisheye", (1280, 960), 0)
    poses = sheet_poses(camera, 0.5, 6, 7)
    points = torch.as_tensor(rng.uniform([-0.5, -0.5, -0.3], [0.8, 0.7, 0.0], (60, 3)))
    descriptors = torch.as_tensor(rng.integers(0, 255, (60, 128)).astype(np.uint8))
    others = torch.as_tensor(rng.integers(0, 255, (60, 128)).astype(np.uint8))
    # The last photo shows other things, and one match in five of the rest is wrong.
    seen = [descriptors[torch.as_tensor(np.where(rng.random(60) < 0.2, rng.permutation(60), np.arange(60)))] for _ in poses[:-1]]
    features = [features_of(points, own, pose) for own, pose in zip([*seen, others], poses, strict=True)]
    turned = np.array([False, True, True, False, True, False])
    given = [pose @ LETTER.half_turn if turn else pose for pose, turn in zip(poses, turned, strict=True)]
    found, known = half_turns(features, Pose.stack(given), LETTER)
    assert known.tolist() == [True] * 5 + [False]
    assert found[:5].tolist() == turned[:5].tolist()


# Rendered photos.


def rendered(folder: Path, model: str, size: tuple[int, int], fov_deg: float | None, views: int = 3) -> RenderedScene:
    made = render_scene("books", model, RenderOptions(fov_deg, views, size, seed=1))
    made.save(folder)
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    "model, size, fov_deg",
    [pytest.param("pinhole", (640, 480), 60.0, marks=pytest.mark.full), ("opencv-fisheye", (640, 640), 190.0)],
)
def test_a_rendered_sheet_gives_the_poses_of_its_photos(
    model: str, size: tuple[int, int], fov_deg: float, tmp_path: Path
) -> None:
    truth = rendered(tmp_path / "photos", model, size, fov_deg)
    cameras = load(tmp_path / "photos" / "calibration.yaml")
    arcs = extract(tmp_path / "photos", cameras, work=tmp_path / "work")
    found = estimate_poses(arcs, cameras, "rectangle:279x216mm")
    assert not found.left_out and found.poses.images == truth.poses.images and found.poses.covariance is not None
    lies = sheet_from_world().inverse()
    ways = [truth.poses.cam_from_world @ (lies @ turn) for turn in (Pose.identity(), LETTER.half_turn)]
    off = min(((found.poses.cam_from_world @ way.inverse()).log().numpy() for way in ways), key=lambda e: float(np.abs(e).sum()))
    # One choice for all photos: no single one is half a turn off.
    assert np.abs(off).max() < 0.01
    square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.poses.covariance), off)
    assert (square < CHI_SQUARE_6_999).all()
    # With another size something else may have that shape, but the sheet outshines it.
    for size_m in ((0.279, 0.14), (0.3, 0.1), (0.25, 0.235)):
        wrong = find_rectangle(sides_of(arcs.photos[0], cameras), Rectangle(*size_m))
        assert isinstance(wrong, str) or wrong.outshone


@pytest.mark.full
def test_a_sheet_of_another_size_is_the_first_advice(tmp_path: Path) -> None:
    """A scene whose poses hang on a book that has the shape of A4 does not pass for one that is known to millimetres."""
    render_scene("books", "pinhole", RenderOptions(60.0, 4, (640, 480), seed=0)).save(tmp_path / "photos")
    cameras = load(tmp_path / "photos" / "calibration.yaml")
    arcs = extract(tmp_path / "photos", cameras)
    for _ in range(2):  # the second time as they were kept
        posed = estimate_poses(arcs, cameras, "rectangle:297x210mm", work=tmp_path / "work")
        (doubt,) = posed.advice
        assert "brighter and larger than the sheet that was taken" in doubt.limit
        assert doubt.do.startswith("Measure the sheet: 297 x 210 mm was given")
    assert scene_advice(reconstruct(arcs, posed, cameras))[0] == doubt
    assert estimate_poses(arcs, cameras, "rectangle:279x216mm").advice == ()


@pytest.mark.slow
def test_reconstruct_takes_the_sheet_and_a_table_of_its_corners(tmp_path: Path) -> None:
    truth = rendered(tmp_path / "photos", "pinhole", (480, 360), 60.0, views=4)
    calibration = tmp_path / "photos" / "calibration.yaml"
    photos = [tmp_path / "photos"]
    out = tmp_path / "sheet"
    result = reconstruct_photos(photos, calibration, "rectangle:279x216mm", out, SceneOptions(min_views=3))
    assert any("The world is the sheet" in note for note in result.warnings)
    poses = read_poses(out / "poses.csv")
    table = tmp_path / "corners.csv"
    with open(table, "w", newline="") as file:
        write = csv.writer(file)
        write.writerow(["view", "image", "board_x_m", "board_y_m", "u_px", "v_px"])
        for k, image in enumerate(poses.images):
            pixels, _ = truth.camera.project(poses.cam_from_world[k].transform(torch.as_tensor(LETTER.corners_m)))
            for (x, y, _), (u, v) in zip(LETTER.corners_m.tolist(), pixels.tolist(), strict=True):
                write.writerow([image, image, x, y, u, v])
    cameras = load(calibration)
    again = poses_from_corners(read_corners(table), cameras, dict.fromkeys(poses.images, "cam0"))
    assert not again.left_out
    off = (again.poses.cam_from_world @ poses.cam_from_world.inverse()).log()
    assert float(off.abs().max()) < 1e-5
    # The same table in place of poses.csv, for segments.
    lines = reconstruct_segments(calibration, table, out / "segments.csv", tmp_path / "lines")
    assert json.loads(json.dumps(lines.data))["status"].get("ok", 0) > 30
    # Corners in another order are of no sheet.
    rows = table.read_text().splitlines()
    rows[1], rows[2] = (
        ",".join([*rows[1].split(",")[:4], *rows[2].split(",")[4:]]),
        ",".join([*rows[2].split(",")[:4], *rows[1].split(",")[4:]]),
    )
    table.write_text("\n".join(rows) + "\n")
    swapped = poses_from_corners(read_corners(table), cameras, dict.fromkeys(poses.images, "cam0"))
    assert list(swapped.left_out) == [poses.images[0]]
    with pytest.raises(InputError, match="check the unit"):
        reconstruct_photos(photos, calibration, "rectangle:279x216m", tmp_path / "none")


def test_corners_of_a_board_that_bends_give_poses_though_they_are_known_better() -> None:
    camera, _ = scene_camera("opencv-fisheye", (1100, 1100), 0)
    grid = np.stack([*np.meshgrid(np.arange(8) * 0.03, np.arange(6) * 0.03), np.zeros((6, 8))], -1).reshape(-1, 3)
    bent = grid + [0.0, 0.0, 1.0] * (0.4 * np.square(grid[:, :1] - 0.105))
    pose = Pose.exp(torch.tensor([0.2, -0.1, 0.05, -0.1, -0.07, 0.25], dtype=torch.float64))
    pixels = camera.project(pose.transform(torch.as_tensor(bent)))[0].numpy()
    assert camera.project(pose.transform(torch.as_tensor(grid)))[0].sub(torch.as_tensor(pixels)).norm(dim=-1).max() > 1.0
    view, names = np.zeros(len(grid), np.int64), ("a.png",)
    stated = Corners(view, names, names, grid, pixels, sigma_px=np.full(len(grid), 0.02))
    found = poses_from_corners(stated, {"cam0": camera}, {"a.png": "cam0"})
    off = (found.poses.cam_from_world[0] @ pose.inverse()).log().numpy()
    assert found.poses.images == names and np.abs(off[:3]).max() < 0.01 and np.abs(off[3:]).max() < 0.005
    np.testing.assert_array_equal(found.points["a.png"].pixels, pixels)
    mixed = np.random.default_rng(0).permutation(pixels)
    with pytest.raises(InputError, match="that fit its camera were expected, found none"):
        poses_from_corners(replace(stated, pixels=mixed), {"cam0": camera}, {"a.png": "cam0"})


@pytest.mark.slow
def test_the_book_experiment_holds_and_the_adjustment_attains_the_noise(tmp_path: Path) -> None:
    result = experiment_book(tmp_path, rendering=RenderOptions(views=4, size_px=(800, 600), seed=1))
    assert result.holds, [check for check in result.checks if not check.holds]
    data = json.loads(json.dumps(result.data, allow_nan=False))
    rows = {(row["stage"], row["method"]): row for row in data["rows"]}
    assert data["posed"] == 4 and data["tracks"] >= 12
    adjusted = rows["by hand, adjustment", "bartoli-sturm"]
    # Ends of 1 px across each line, less what lines and poses take up.
    segments, unknowns = 4 * data["tracks"], 4 * data["tracks"] + 6 * 4 - 7
    assert adjusted["rms_px"] == pytest.approx(np.sqrt(1 - unknowns / (2 * segments)), rel=0.15)
    assert rows["by hand, triangulation", "dual"]["rms_px"] > 1.2 * adjusted["rms_px"]
    assert rows["found, adjustment", "sector"]["rms_3d_m"] < 0.002
    assert data["poses"]["found"]["rms_m"] < 0.001 < data["poses"]["by hand"]["rms_m"]
    with pytest.raises(InputError, match="`hand_px` above 0"):
        BookOptions(hand_px=0.0)
