"""Poses that are given: COLMAP models, a rig, boards; and moving them into the frame of others."""

import numpy as np
import pycolmap
import pytest
import torch

import omnilines as ol
from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, GeometryError, InputError, OpenCVFisheye
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.pipelines.pose_tables import unit_of_poses, unpaired_note
from omnilines.pipelines.render import RenderOptions, render_targets
from omnilines.posing.from_boards import is_mirrored, poses_from_boards
from omnilines.posing.from_colmap import poses_from_colmap
from omnilines.posing.from_rig import complete_from_rig, poses_from_rig, with_rig
from omnilines.posing.instant_names import instants
from omnilines.posing.photo_poses import PhotoPoses, align_to, moved_poses
from omnilines.records import ImagePoses, LengthUnit
from omnilines.scenes import scene_camera

CAMERA = OpenCVFisheye([300.0, 302.0, 319.5, 239.5, 0.01, -0.004, 0.002, 0.0], (640, 480))


def some_poses(count: int, seed: int = 0) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose.exp(torch.as_tensor(rng.normal(size=(count, 6))))


def colmap_model(names: list[str], poses: Pose, *, rig: bool) -> pycolmap.Reconstruction:
    """A model as COLMAP keeps it; with `rig` two sensors a frame, the second at a pose of its own."""
    model = pycolmap.Reconstruction()
    cameras = [pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24], camera_id=k + 1) for k in range(2)]
    sensor = some_poses(1, 5)[0]
    if rig:
        record = pycolmap.Rig()
        record.rig_id = 1
        record.add_ref_sensor(cameras[0].sensor_id)
        record.add_sensor(cameras[1].sensor_id, rigid(sensor))
        for camera in cameras:
            model.add_camera(camera)
        model.add_rig(record)
    else:
        model.add_camera_with_trivial_rig(cameras[0])
    for k, name in enumerate(names):
        image = pycolmap.Image(name=name, camera_id=1 + (k % 2 if rig else 0), image_id=k + 1)
        if not rig:
            model.add_image_with_trivial_frame(image, rigid(poses[k]))
            continue
        if k % 2 == 0:
            frame = pycolmap.Frame()
            frame.frame_id, frame.rig_id, frame.rig_from_world = k // 2 + 1, 1, rigid(poses[k])
            for j in (k, k + 1):
                frame.add_data_id(pycolmap.data_t(cameras[j % 2].sensor_id, j + 1))
            model.add_frame(frame)
        image.frame_id = k // 2 + 1
        model.add_image(image)
    for frame_id in model.frames:
        model.register_frame(frame_id)
    return model


def rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation.numpy()), pose.translation.numpy())


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("rig", [True, False])
@pytest.mark.parametrize("below", ["", "sparse/0"])
def test_colmap_models_come_back_as_pycolmap_wrote_them(tmp_path, binary, rig, below):
    names = ["left/0.png", "right/0.png", "left/1.png", "right/1.png"]
    poses = some_poses(4)
    if rig:
        sensor = some_poses(1, 5)[0]
        poses = Pose.stack([poses[0], sensor @ poses[0], poses[2], sensor @ poses[2]])
    model = colmap_model(names, poses, rig=rig)
    folder = tmp_path / below
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_binary if binary else model.write_text)(str(folder))
    # In another order than the model's, and one photo that it does not know.
    photos = ["right/1.png", "left/0.png", "left/9.png"]
    found = poses_from_colmap(tmp_path, photos, dict.fromkeys(photos, "cam0"))
    assert found.poses.images == ("right/1.png", "left/0.png")
    assert found.poses.cameras == ("cam0", "cam0")
    expected = poses[[3, 0]]
    torch.testing.assert_close(found.poses.cam_from_world.rotation, expected.rotation, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.poses.cam_from_world.translation, expected.translation, rtol=0, atol=1e-12)
    assert len(found.left_out) == 1
    assert "left/9.png has no pose" in found.left_out["left/9.png"]


def test_colmap_names_are_matched_by_their_ends_and_stems_but_never_ambiguously(tmp_path):
    names = ["run/left/1.jpg", "run/right/1.jpg", "a/unique.jpg"]
    colmap_model(names, some_poses(3), rig=False).write_text(str(tmp_path))
    photos = ["left/1.jpg", "1.jpg", "unique.png", "other/left/1.jpg"]
    found = poses_from_colmap(tmp_path, photos[:3], dict.fromkeys(photos, "c"))
    assert found.poses.images == ("left/1.jpg", "unique.png")
    torch.testing.assert_close(found.poses.cam_from_world.translation, some_poses(3).translation[[0, 2]])
    assert "2 images of the COLMAP model are named like it" in "".join(found.left_out.values())
    with pytest.raises(InputError, match="were expected in the COLMAP model"):
        poses_from_colmap(tmp_path, ["left/1.jpg", "other/left/1.jpg"], dict.fromkeys(photos, "c"))


def test_what_is_no_colmap_model_is_refused(tmp_path):
    with pytest.raises(InputError, match="sparse/0"):
        poses_from_colmap(tmp_path, ["a.png"], {"a.png": "c"})
    colmap_model(["b.png"], some_poses(1), rig=False).write_binary(str(tmp_path))
    with pytest.raises(InputError, match="named like the photos"):
        poses_from_colmap(tmp_path, ["a.png"], {"a.png": "c"})


def rig_calibration() -> Calibration:
    poses = some_poses(2, 3)
    in_rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(poses[0]), "up": RigCamera(poses[1])}
    return Calibration(dict.fromkeys(in_rig, CAMERA), {}, in_rig)


def test_one_instant_of_a_rig_has_the_poses_of_its_cameras():
    calibration = rig_calibration()
    photos = ["right/1.png", "left/1.png"]
    found = poses_from_rig(calibration, photos, {p: p.split("/")[0] for p in photos}, dict.fromkeys(photos, "1"))
    torch.testing.assert_close(found.poses.cam_from_world[0].rotation, calibration.rig["right"].cam_from_rig.rotation)
    torch.testing.assert_close(found.poses.cam_from_world[1].translation, torch.zeros(3, dtype=torch.float64))
    assert found.poses.frames == ("1", "1")
    with pytest.raises(InputError, match=r"poses.csv with the column frame, or --poses sfm"):
        poses_from_rig(calibration, photos, {p: p.split("/")[0] for p in photos}, {photos[0]: "1", photos[1]: "2"})
    with pytest.raises(InputError, match="One photo of each camera"):
        poses_from_rig(calibration, photos, dict.fromkeys(photos, "left"), dict.fromkeys(photos, "1"))
    with pytest.raises(InputError, match="calibration with a rig"):
        poses_from_rig(Calibration({"left": CAMERA}), photos, dict.fromkeys(photos, "left"), dict.fromkeys(photos, "1"))


@pytest.mark.parametrize(
    ("photos", "named"),
    [
        (["left/1.png", "right/1.png", "left/2.png"], ["1", "1", "2"]),
        (["left/left1.jpg", "right/right1.jpg", "left/left2.jpg"], ["1", "1", "2"]),
        (["room/left/1.png", "room/right/1.png"], ["1", "1"]),
        (["a/left/1.png", "a/right/1.png", "b/left/1.png"], ["a/1", "a/1", "b/1"]),
        (["left/data/1.png", "right/images/1.png"], ["1", "1"]),
        (["left/left.png", "right/right.png"], ["left", "right"]),
    ],
)
def test_instants_of_a_rig_are_told_by_names(photos: list[str], named: list[str]) -> None:
    """Those of left/left1.jpg and right/right1.jpg were two, though `calibrate` takes them for one; two walks were one."""
    camera_of = {photo: "right" if "right/" in photo else "left" for photo in photos}
    assert list(instants(photos, camera_of).values()) == named


def test_a_rig_whose_photos_share_no_instant_gives_no_metres() -> None:
    """They were called metres, of a scale that nothing tells."""
    calibration = rig_calibration()
    alone = {"left/L1.png": "left", "left/L2.png": "left", "right/R1.png": "right"}
    assert unit_of_poses("sfm", calibration, alone) is LengthUnit.OPEN
    assert "as left/L1.png and right/R1.png have not" in unpaired_note(calibration, alone)[0]
    together = {"left/left1.png": "left", "left/left2.png": "left", "right/right1.png": "right"}
    assert unit_of_poses("sfm", calibration, together) is LengthUnit.METRES
    assert not unpaired_note(calibration, together)
    assert not unpaired_note(calibration, {"left/1.png": "left", "left/2.png": "left"})


def test_a_rig_that_photos_tell_is_kept_with_their_poses(tmp_path, monkeypatch) -> None:
    calibration = rig_calibration()
    found = {name: some_poses(1, k)[0] for k, name in enumerate(calibration)}
    photos = {f"{name}/1.png": np.zeros(calibration[name].image_size[::-1], np.uint8) for name in calibration}
    poses = ImagePoses(tuple(photos), Pose.stack(list(found.values())), tuple(calibration), None, ("1",) * len(photos))
    calls = []

    def looks(*_: object, refine_rig: bool, **__: object) -> PhotoPoses:
        calls.append(refine_rig)
        return PhotoPoses(poses, rig=found if refine_rig else {})

    monkeypatch.setattr("omnilines.pipelines.poses.sfm_poses", looks)
    for refine_rig in (True, True, False):
        posed = ol.estimate_poses(photos, calibration, refine_rig=refine_rig, work=tmp_path)
        changed = with_rig(calibration, posed.rig)
        if not refine_rig:
            assert changed is calibration
            continue
        for name, pose in found.items():
            torch.testing.assert_close(changed.rig[name].cam_from_rig.rotation, pose.rotation)
            torch.testing.assert_close(changed.rig[name].cam_from_rig.translation, pose.translation)
    assert calls == [True, False]  # the second of the three is read from the folder


def test_missing_photos_of_a_rig_follow_from_the_known_ones():
    calibration = rig_calibration()
    at = some_poses(2, 9)
    photos = [f"{camera}/{k}.png" for k in range(3) for camera in calibration]
    camera_of, frame_of = {p: p.split("/")[0] for p in photos}, {p: p.split("/")[1] for p in photos}
    truth = {p: calibration.rig[camera_of[p]].cam_from_rig @ at[int(frame_of[p][0])] for p in photos if frame_of[p] < "2"}
    known = ["right/0.png", "left/1.png", "up/1.png"]
    given = ImagePoses(tuple(known), Pose.stack([truth[p] for p in known]))
    found = complete_from_rig(calibration, given, photos, camera_of, frame_of)
    assert found.poses.images == tuple(truth)
    torch.testing.assert_close(found.poses.cam_from_world.translation, torch.stack([p.translation for p in truth.values()]))
    assert len(found.left_out) == 3
    assert all("2.png" in line for line in found.left_out.values())
    wrong = ImagePoses(("left/1.png", "up/1.png"), Pose.stack([truth["left/1.png"], truth["left/1.png"]]))
    with pytest.raises(InputError, match="degrees off"):
        complete_from_rig(calibration, wrong, photos, camera_of, frame_of)


@pytest.mark.parametrize("spec", ["charuco:8x6:40mm:30mm:DICT_5X5_100", "checkerboard:8x5:30mm"])
@pytest.mark.slow
def test_boards_give_the_poses_of_rendered_photos(spec):
    rendered = render_targets(spec, "scaramuzza", RenderOptions(fov_deg=200.0, views=3, size_px=(640, 480), seed=2))
    images = rendered.poses.images
    cameras = {"cam0": rendered.camera}
    found = poses_from_boards(
        images,
        rendered.photos.__getitem__,
        cameras,
        dict.fromkeys(images, "cam0"),
        rendered.pattern,
    )
    assert len(found.poses) >= 2
    assert len(found.poses) + len(found.left_out) == 3
    truth = rendered.cam_from_board[[images.index(name) for name in found.poses.images]]
    delta = (found.poses.cam_from_world @ truth.inverse()).log().numpy()
    assert np.abs(delta[:, :3]).max() < np.radians(0.3)
    assert np.linalg.norm(delta[:, 3:], axis=1).max() < 3e-3
    assert found.poses.covariance is not None
    distance = [d @ np.linalg.solve(c, d) / 6 for d, c in zip(delta, found.poses.covariance, strict=True)]
    assert max(distance) < 6.0


@pytest.mark.slow
def test_boards_that_cannot_tell_their_ends_are_refused_and_photos_without_one_left_out():
    spec = "checkerboard:7x5:30mm"
    rendered = render_targets(spec, "opencv-fisheye", RenderOptions(fov_deg=150.0, views=2, size_px=(640, 480), seed=1))
    photos = dict(rendered.photos)
    first = rendered.poses.images[0]
    photos["blank.png"] = np.full((480, 640), 128, dtype=np.uint8)
    cameras, camera_of = {"cam0": rendered.camera}, dict.fromkeys(photos, "cam0")
    with pytest.raises(InputError, match="same after half a turn"):
        poses_from_boards(list(photos), photos.__getitem__, cameras, camera_of, rendered.pattern)
    one = poses_from_boards([first, "blank.png"], photos.__getitem__, cameras, camera_of, rendered.pattern)
    assert one.poses.images == (first,)
    assert "blank.png has no pose" in one.left_out["blank.png"]
    assert any("half a turn" in note for note in one.notes)
    with pytest.raises(InputError, match="in some photo"):
        poses_from_boards(
            ["blank.png"], photos.__getitem__, cameras, camera_of, parse_pattern("charuco:5x4:40mm:30mm:DICT_5X5_100")
        )


@pytest.mark.slow
def test_a_board_that_is_printed_otherwise_than_given_gives_poses_as_it_gives_cameras() -> None:
    """White on black: `calibrate` took the board for what it is, and found the same photos to show none."""
    spec = "charuco:6x5:40mm:30mm:DICT_5X5_100"
    rendered = render_targets(
        f"{spec}:inverted", "opencv-fisheye", RenderOptions(fov_deg=150.0, views=2, size_px=(640, 480), seed=1)
    )
    found = ol.estimate_poses(dict(rendered.photos), rendered.camera, "boards", pattern=spec)
    assert found.poses.images == rendered.poses.images
    assert any(note.startswith(f"The board is {spec}:inverted, not {spec}: ") for note in found.notes)


def test_mirrors_are_known_by_their_camera():
    assert is_mirrored(scene_camera("scaramuzza", (640, 480), 0, 200.0, mirror=True)[0])
    for name in ("scaramuzza", "opencv-fisheye", "pinhole", "equirectangular", "unified"):
        assert not is_mirrored(scene_camera(name, (640, 480), 0)[0])


@pytest.mark.parametrize("line", [False, True])
def test_poses_are_moved_into_the_frame_of_others_also_from_a_straight_line(line):
    poses = some_poses(6)
    if line:
        centre = torch.linspace(-2, 3, 6, dtype=torch.float64)[:, None] * torch.tensor([1.0, -2.0, 0.3], dtype=torch.float64)
        poses = Pose(poses.rotation, -(poses.rotation @ centre[..., None])[..., 0])
    names = tuple("abcdef")
    covariance = np.stack([np.eye(6)] * 6)
    reference = ImagePoses(names, poses)
    similarity, scale = some_poses(1, 4)[0], 2.5
    moved = moved_poses(ImagePoses(names, poses, None, covariance), scale, similarity)
    assert moved.covariance is not None
    np.testing.assert_allclose(np.diagonal(moved.covariance[0]), [1, 1, 1, 6.25, 6.25, 6.25])
    # A world point keeps its bearing.
    point = torch.tensor([[0.3, -0.2, 4.0]], dtype=torch.float64)
    before = poses.transform(point)[:, 0]
    after = moved.cam_from_world.transform(similarity.transform(scale * point))[:, 0]
    torch.testing.assert_close(after, scale * before)
    some = ImagePoses(moved.images[1:], moved.cam_from_world[1:])
    back, found_scale, _ = align_to(some, reference)
    assert found_scale == pytest.approx(1 / scale)
    torch.testing.assert_close(back.cam_from_world.rotation, poses.rotation[1:], rtol=0, atol=1e-9)
    torch.testing.assert_close(back.cam_from_world.translation, poses.translation[1:], rtol=0, atol=1e-8)


def test_alignment_needs_two_places():
    poses = ImagePoses(("a", "b"), some_poses(2))
    with pytest.raises(GeometryError, match="At least two photos"):
        align_to(poses, ImagePoses(("a", "c"), some_poses(2)))
    turned = ImagePoses(("a", "b"), Pose(some_poses(2).rotation, torch.zeros(2, 3, dtype=torch.float64)))
    with pytest.raises(GeometryError, match="one place"):
        align_to(turned, poses)
