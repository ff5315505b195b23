"""Photos that are flipped, turned, or of another camera than the calibration, and poses of other axes, are told by lines."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from courtyard import read_courtyard

import omnilines as ol
from camera_models import Calibration, InputError, Pinhole
from camera_models.pose import Pose
from omnilines.files import photos_of
from omnilines.pipelines.judged_photos import doubted_photos, refuse_reading
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.progress import silent
from omnilines.records import ImagePoses

LENS = Pinhole.from_mapping({"fx": 420.0, "fy": 420.0, "cx": 318.0, "cy": 322.0}, (640, 640))
MIDDLE = 319.5
ROBOT = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""Forward, left, up from right, down, forward."""
OPTIONS = ol.SceneOptions()


def photos(seed: int = 0, noise_px: float = 0.3, lens: Pinhole = LENS) -> tuple[list[FoundArcs], ImagePoses]:
    """Lines that eight cameras look at, each seen where it lies in the image."""
    rng = np.random.default_rng(seed)
    twists = torch.from_numpy(rng.uniform(-1, 1, (8, 6)) * np.array([0.25, 0.25, 0.5, 0.9, 0.9, 0.5]))
    poses = Pose.exp(twists)
    ends = rng.uniform([-2.5, -2.5, 3.0], [2.5, 2.5, 7.0], (80, 1, 3)) + rng.uniform(-1, 1, (80, 2, 3))
    names = tuple(f"{k}.png" for k in range(8))
    refs = photos_of({name: np.zeros((640, 640), dtype=np.uint8) for name in names})
    found = []
    for k, photo in enumerate(refs):
        pixels, valid = (part.numpy() for part in lens.project(poses[k].transform(torch.from_numpy(ends))))
        own = (valid & (pixels >= 0).all(-1) & (pixels <= 639).all(-1)).all(-1)
        pixels = pixels[own] + noise_px * rng.standard_normal((own.sum(), 2, 2))
        found.append(_arcs(photo, pixels, noise_px))
    return found, ImagePoses(names, poses, ("cam0",) * 8)


def _arcs(photo, pixels: np.ndarray, noise_px: float) -> FoundArcs:
    covariance = np.broadcast_to(noise_px**2 * np.eye(2), (len(pixels), 2, 2, 2)).copy()
    length = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=-1)
    return FoundArcs(photo, "cam0", pixels, covariance, length, np.full((len(pixels), 2, 3), np.nan))


def mapped(found: list[FoundArcs], matrix: list[list[float]]) -> list[FoundArcs]:
    """The arcs of photos whose pixels were taken elsewhere about their middle."""
    taken = [(one.endpoints_px - MIDDLE) @ np.array(matrix).T + MIDDLE for one in found]
    return [replace(one, endpoints_px=pixels) for one, pixels in zip(found, taken, strict=True)]


def judge(found: list[FoundArcs], poses: ImagePoses, lens: Pinhole = LENS) -> None:
    refuse_reading(found, PhotoPoses(poses, source="table"), Calibration({"cam0": lens}), OPTIONS, silent)


def focal(times: float) -> Pinhole:
    own = LENS.named_parameters()
    return Pinhole.from_mapping({**own, "fx": times * own["fx"], "fy": times * own["fy"]}, LENS.image_size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("says", "matrix"),
    [
        ("mirrored", [[-1, 0], [0, 1]]),
        ("flipped upside down", [[1, 0], [0, -1]]),
        ("turned by 180 degrees", [[-1, 0], [0, -1]]),
        ("turned by 90 degrees to the right", [[0, -1], [1, 0]]),
        ("turned by 90 degrees to the left", [[0, 1], [-1, 0]]),
    ],
)
def test_flipped_and_turned_photos_are_named(says: str, matrix: list[list[float]]) -> None:
    """They ended in "No line was left: check the poses"."""
    found, poses = photos()
    with pytest.raises(InputError, match=f"The photos look {says}: .* Flip or turn them back") as told:
        judge(mapped(found, matrix), poses)
    assert ("left-handed world" in str(told.value)) == (np.linalg.det(matrix) < 0)


@pytest.mark.slow
@pytest.mark.parametrize(("times", "says"), [(1.6, "0.6[0-9]"), (0.65, "1.[56]")])
def test_the_focal_length_of_another_camera_is_told(times: float, says: str) -> None:
    found, poses = photos()
    with pytest.raises(InputError, match=f"like those of a camera whose focal length is {says} times that of the calibration"):
        judge(found, poses, focal(times))


@pytest.mark.slow
def test_poses_of_a_robot_are_named() -> None:
    """x forward, y left, z up; world from camera."""
    found, poses = photos()
    own = poses.cam_from_world
    robot = Pose(ROBOT @ own.rotation, own.translation @ ROBOT.T).inverse()
    with pytest.raises(InputError, match=r"inverted .* cameras whose right, down and forward are -y, -z, x: .* invert them"):
        judge(found, replace(poses, cam_from_world=robot))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full), pytest.param(2, marks=pytest.mark.full)])
def test_photos_that_belong_to_poses_and_calibration_are_not_doubted(seed: int) -> None:
    """Nor where poses are those of other photos."""
    found, poses = photos(seed)
    assert not doubted_photos(found, PhotoPoses(poses, source="table"), Calibration({"cam0": LENS}), 0.0, OPTIONS, silent)
    exchanged = poses.cam_from_world[torch.as_tensor(np.random.default_rng(seed).permutation(8))]
    judge(found, replace(poses, cam_from_world=exchanged))


@pytest.mark.slow
@pytest.mark.parametrize(("step", "has"), [(1, 0), (-1, 2)])
def test_poses_slipped_by_a_row_are_named(step: int, has: int) -> None:
    """Nothing named what was wrong with lines that agree by chance."""
    found, poses = photos()
    slipped = poses.cam_from_world[np.roll(np.arange(8), step)]
    with pytest.raises(InputError, match=f"slipped by one row: 1.png has that of {has}.png, .* Write each beside its own photo"):
        judge(found, replace(poses, cam_from_world=slipped))


COURTYARD = tuple(f"{k:04d}.jpg" for k in range(10))
SIZE = (768, 512)


@pytest.fixture(scope="module")
def courtyard(shared_data: Path) -> tuple[Mapping[str, np.ndarray], ImagePoses, Pinhole]:
    """Photos of a courtyard at a quarter of their size, and their surveyed cameras."""
    data = shared_data / "lines" / "castle30"
    poses, half = read_courtyard(data)
    own = half.named_parameters()
    quarter = {name: (own[name] + 0.5) / 2 - 0.5 if name in ("cx", "cy") else own[name] / 2 for name in ("fx", "fy", "cx", "cy")}
    photos = {name: cv2.resize(cv2.imread(str(data / "images" / name)), SIZE, interpolation=cv2.INTER_AREA) for name in COURTYARD}
    rows = [poses.images.index(name) for name in COURTYARD]
    return photos, ImagePoses(COURTYARD, poses.cam_from_world[rows], ("cam0",) * len(rows)), Pinhole.from_mapping(quarter, SIZE)


@pytest.mark.slow
def test_mirrored_photos_of_a_courtyard_are_named(courtyard) -> None:
    photos, poses, camera = courtyard
    mirrored = {name: cv2.flip(photo, 1) for name, photo in photos.items()}
    with pytest.raises(InputError, match="The photos look mirrored: "):
        ol.reconstruct(ol.extract(mirrored, camera), poses, camera)


@pytest.mark.slow
def test_a_courtyard_by_the_calibration_of_another_zoom_is_doubted(courtyard) -> None:
    """There are some lines, and the poses are right: nothing else says that the focal length is 10 percent off."""
    photos, poses, camera = courtyard
    own = camera.named_parameters()
    other = Pinhole.from_mapping({**own, "fx": 1.1 * own["fx"], "fy": 1.1 * own["fy"]}, SIZE)
    scene = ol.reconstruct(ol.extract(photos, other), poses, other)
    assert "focal length is 0.91 times that of the calibration" in scene.advice[0].limit
    arcs = ol.extract(photos, camera)
    assert not doubted_photos(arcs.photos, PhotoPoses(poses, source="table"), Calibration({"cam0": camera}), 0.0, OPTIONS, silent)


@pytest.mark.slow
def test_a_sign_of_t_is_named() -> None:
    """It ended in a line or two that agree by chance, or in none."""
    found, poses = photos()
    own = poses.cam_from_world
    slipped = Pose(own.rotation, own.translation * torch.tensor([1.0, 1.0, -1.0]).double())
    with pytest.raises(InputError, match="The poses look to hold tz with the other sign"):
        judge(found, replace(poses, cam_from_world=slipped))


@pytest.mark.slow
def test_photos_with_exchanged_names_are_named() -> None:
    """They were said to show what no others do, and photos between them were asked for."""
    found, poses = photos()
    order = [0, 1, 5, 3, 4, 2, 6, 7]
    exchanged = replace(poses, cam_from_world=poses.cam_from_world[order])
    arcs = PhotoArcs(tuple(found), Calibration({"cam0": LENS}), (), {})
    scene = ol.reconstruct(arcs, exchanged, LENS, OPTIONS)
    told = [one.limit for one in scene.advice]
    assert told[0] == "The lines of the other photos put 2.png where 5.png is said to be, 5.png where 2.png is said to be."
    assert not any("2.png" in one for one in told[1:])


EXCHANGED = {"cx": 390.0, "cy": 250.0}, {"cx": 250.0, "cy": 390.0}
HALF = {}, {"cx": 158.75, "cy": 160.75, "fx": 210.0, "fy": 210.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("says", "numbers"),
    [("whose cx and cy are exchanged", EXCHANGED), ("that was calibrated with photos of half their size", HALF)],
)
def test_slips_of_a_calibration_are_named(says: str, numbers: tuple[dict[str, float], dict[str, float]]) -> None:
    """They ended in lines that agree by chance."""
    lens, slipped = (Pinhole.from_mapping({**LENS.named_parameters(), **own}, LENS.image_size) for own in numbers)
    found, poses = photos(lens=lens)
    with pytest.raises(InputError, match=f"The photos look like those of a camera {says}: "):
        judge(found, poses, slipped)
