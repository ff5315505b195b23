"""Simulated rigs: cameras that are mounted together, boards all around, and the corners that each camera sees, with noise."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from camera_models import CameraModel, OpenCVFisheye, Pinhole, Scaramuzza
from camera_models.pose import Pose, rotation_from_vector
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.result import RigCalibration
from omnilines.records import Corners
from omnilines.synthetic.targets import example_camera

COLUMNS, ROWS, SQUARE_M = 9, 6, 0.05
BOARD = np.array([[x * SQUARE_M, y * SQUARE_M, 0.0] for y in range(ROWS) for x in range(COLUMNS)])
FISHEYE_220 = OpenCVFisheye([235.0, 236.0, 510.0, 498.0, 0.01, -0.004, 0.001, -0.0001], (1020, 1000))
PINHOLE = Pinhole([700.0, 702.0, 655.0, 466.0, 0, -0.28, 0.09, 2e-4, -3e-4, -0.012, 0, 0, 0], (1280, 960))
MIRROR = Scaramuzza([318.2, 241.5, 0.9997, 1e-4, 1e-4, -121.0, 2.4e-3, -1.0e-6, 2.0e-9], (640, 480))
MARGIN_PX = 2.0


@dataclass(frozen=True)
class RigScene:
    """True cameras, where they are, where the board is in every frame, and which corners each camera sees."""

    models: tuple[CameraModel, ...]
    cam_from_rig: Pose
    rig_from_board: Pose
    corners: Corners
    """Without noise."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"cam{c}" for c in range(len(self.models)))

    def noisy(self, sigma_px: float, seed: int) -> Corners:
        random = np.random.default_rng(seed).standard_normal(self.corners.pixels.shape)
        return replace(self.corners, pixels=self.corners.pixels + sigma_px * random)


def looking_along(axes: np.ndarray, centres_m: np.ndarray) -> Pose:
    """`cam_from_middle` of cameras at these places that look along the rows of `axes`, y as far down as can be."""
    rotations = []
    for axis in torch.as_tensor(axes):
        z = axis / axis.norm()
        down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        y = down - (down @ z) * z
        rotations.append(torch.stack([torch.linalg.cross(y / y.norm(), z), y / y.norm(), z]))
    rotation = torch.stack(rotations)
    return Pose(rotation, -(rotation @ torch.as_tensor(centres_m)[..., None])[..., 0])


def boards_at(directions: np.ndarray, distance_m: np.ndarray, rng: np.random.Generator, tilt_deg: float = 40.0) -> Pose:
    """`rig_from_board` of boards whose middle is in these directions of the rig frame, facing it, tilted and rolled at random."""
    rotations, translations = [], []
    for direction, distance in zip(directions, distance_m, strict=True):
        z = torch.as_tensor(direction / np.linalg.norm(direction))
        helper = torch.eye(3, dtype=torch.float64)[int(z.abs().argmin())]
        x = torch.linalg.cross(helper, z)
        x = x / x.norm()
        facing = torch.stack([x, torch.linalg.cross(z, x), z], -1)
        lean, roll = rng.uniform(0, 2 * math.pi, 2)
        tilt = math.radians(tilt_deg) * math.sqrt(rng.uniform())
        leaning = rotation_from_vector(torch.tensor([math.cos(lean) * tilt, math.sin(lean) * tilt, 0.0], dtype=torch.float64))
        rolled = rotation_from_vector(torch.tensor([0.0, 0.0, roll], dtype=torch.float64))
        rotations.append(facing @ leaning @ rolled)
        translations.append(float(distance) * z - rotations[-1] @ torch.as_tensor(BOARD.mean(0)))
    return Pose(torch.stack(rotations), torch.stack(translations))


def seen_by_all(
    models: tuple[CameraModel, ...], cam_from_rig: Pose, rig_from_board: Pose, max_angle_deg: float = 180.0
) -> Corners:
    """The corners that each camera sees from the printed side, views in the order of cameras, then frames."""
    views: list[tuple[str, str]] = []
    parts = []
    for c, model in enumerate(models):
        pose = cam_from_rig[c] @ rig_from_board
        place = pose.transform(torch.as_tensor(BOARD))
        pixels, valid = model.project(place)
        axis, _ = model.unproject(model.centre_px)
        off_axis = torch.atan2(torch.linalg.cross(place, axis.expand_as(place)).norm(dim=-1), place @ axis)
        limit = torch.tensor(model.image_size, dtype=torch.float64) - 1 - MARGIN_PX
        inside = valid & ((pixels >= MARGIN_PX) & (pixels <= limit)).all(-1) & (off_axis <= math.radians(max_angle_deg))
        facing = (pose.rotation[..., 2] * place.mean(1)).sum(-1) > 0.2 * place.mean(1).norm(dim=-1)
        inside &= facing[:, None]
        for f in torch.nonzero(inside.any(-1)).flatten().tolist():
            parts.append((len(views), BOARD[inside[f].numpy()], pixels[f][inside[f]].numpy()))
            views.append((f"cam{c}", f"{f:03d}"))
    return table_of(views, parts)


def table_of(views: list[tuple[str, str]], parts: list[tuple[int, np.ndarray, np.ndarray]]) -> Corners:
    """Of views (camera, frame) and, for each, its number, its corners on the board and in the image."""
    images = tuple(f"{camera}/{frame}.png" for camera, frame in views)
    return Corners(
        np.concatenate([np.full(len(board), v) for v, board, _ in parts]),
        images,
        images,
        np.concatenate([board for _, board, _ in parts]),
        np.concatenate([pixels for _, _, pixels in parts]),
        cameras=tuple(camera for camera, _ in views),
        frames=tuple(frame for _, frame in views),
    )


def scene(models: tuple[CameraModel, ...], cam_from_middle: Pose, boards: Pose, max_angle_deg: float = 180.0) -> RigScene:
    """The scene in the frame of the first camera."""
    rig = cam_from_middle[0]
    cam_from_rig, rig_from_board = cam_from_middle @ rig.inverse(), rig @ boards
    return RigScene(models, cam_from_rig, rig_from_board, seen_by_all(models, cam_from_rig, rig_from_board, max_angle_deg))


def outward_rig(frames: int, seed: int = 0) -> RigScene:
    """Four cameras of 220 degrees on a tetrahedron: two see the same only between 55 and 110 degrees off their axes."""
    axes = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
    rng = np.random.default_rng(seed)
    steps = torch.tensor([1.0, -1.0, 3.0, -2.0, 0.002, 0, 0, 0], dtype=torch.float64)
    models = tuple(FISHEYE_220.with_parameters(FISHEYE_220.parameters + c * steps) for c in range(4))
    directions = rng.standard_normal((frames, 3))
    # Every third board stands where two neighbours meet.
    for f in range(0, frames, 3):
        a, b = rng.choice(4, 2, replace=False)
        directions[f] = axes[a] + axes[b] + 0.3 * rng.standard_normal(3)
    boards = boards_at(directions, rng.uniform(0.3, 0.8, frames), rng)
    return scene(models, looking_along(axes, 0.08 * axes), boards, 110.0)


def twin_lenses(model_name: str, side_px: int) -> tuple[CameraModel, CameraModel]:
    """Two of 200 degrees that differ as two of a kind do."""
    one = example_camera(model_name, 200.0, (side_px, side_px), 0)
    values = one.named_parameters()
    if "e" in values:
        # Which turn about its axis such a lens has is open: what is calibrated has e = d.
        values["e"] = values["d"]
    bent = {"xi": 1.01, "alpha": 0.998, "a2": 1.01}
    other = {name: value * bent.get(name, 1.0) for name, value in values.items()}
    other |= {"cx": values["cx"] - 0.01 * side_px, "cy": values["cy"] + 0.006 * side_px}
    return one.from_mapping(values, one.image_size), one.from_mapping(other, one.image_size)


def back_to_back(model_name: str, frames: int = 40, in_rim: int = 10, reach_deg: float = 100.0, seed: int = 0) -> RigScene:
    """A 360 degree camera: two lenses of 200 degrees back to back, 3 cm apart, the board in hand around them, in `in_rim` of the
    frames between both. Corners are found up to `reach_deg` off axis, so that both see them only in a rim."""
    first, second = twin_lenses(model_name, 960)
    rng = np.random.default_rng(seed)
    axes = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    directions = rng.standard_normal((frames, 3))
    directions[:, 2] = np.copysign(np.abs(directions[:, 2]) + 0.5, np.where(np.arange(frames) % 2, -1.0, 1.0))
    directions[np.linspace(0, frames - 1, in_rim).round().astype(int), 2] *= 0.1
    boards = boards_at(directions, rng.uniform(0.3, 0.6, frames), rng)
    return scene((first, second), looking_along(axes, 0.015 * axes), boards, reach_deg)


def mixed_rig(frames: int, seed: int = 0) -> RigScene:
    """A pinhole camera, a fisheye and a mirror camera, side by side, looking about the same way (the mirror camera backwards)."""
    rng = np.random.default_rng(seed)
    axes = np.array([[0.0, 0.0, 1.0], [0.3, 0.05, 1.0], [0.1, 0.0, -1.0]])
    centres = np.array([[0.0, 0.0, 0.0], [0.15, 0.02, 0.01], [-0.12, 0.03, 0.05]])
    directions = np.array([0.1, 0.0, 1.0]) + 0.45 * rng.standard_normal((frames, 3))
    boards = boards_at(directions, rng.uniform(0.5, 0.9, frames), rng)
    return scene((PINHOLE, FISHEYE_220, MIRROR), looking_along(axes, centres), boards)


def chain_rig(frames_a_link: int, cameras: int = 8, seed: int = 0) -> RigScene:
    """Cameras in a row, each of which sees the boards between it and its neighbours and no others."""
    rng = np.random.default_rng(seed)
    narrow = OpenCVFisheye([520.0, 521.0, 400.0, 300.0, -0.02, 0.004, -0.001, 0.0], (801, 601))
    models = tuple(
        narrow.with_parameters(narrow.parameters + 2.0 * c * torch.eye(8, dtype=torch.float64)[0]) for c in range(cameras)
    )
    turns = 0.05 * rng.standard_normal((cameras, 3))
    centres = np.column_stack([0.5 * np.arange(cameras), *(0.02 * rng.standard_normal((2, cameras)))])
    axes = np.array([0.0, 0.0, 1.0]) + turns
    link = np.repeat(np.arange(cameras - 1), frames_a_link)
    middle = 0.5 * (centres[link] + centres[link + 1])
    depth = rng.uniform(0.55, 0.75, len(link))
    place = middle + np.column_stack([*(0.06 * rng.standard_normal((2, len(link)))), depth])
    boards = boards_at(np.tile([0.0, 0.0, 1.0], (len(link), 1)), np.zeros(len(link)), rng, 45.0)
    boards = Pose(boards.rotation, boards.translation + torch.as_tensor(place))
    return scene(models, looking_along(axes, centres), boards)


def setups(rig: RigScene) -> dict[str, CameraSetup]:
    """Every camera anew, by its own model."""
    return {
        name: CameraSetup(model.image_size, model.NAME, {"degree": 4} if model.NAME == "scaramuzza" else {})
        for name, model in zip(rig.names, rig.models, strict=True)
    }


def worst_pose_error(result: RigCalibration, rig: RigScene) -> tuple[float, float]:
    """Largest error of a camera's pose: degrees, metres."""
    off = []
    for member in result.members:
        truth = rig.cam_from_rig[int(member.name[3:])]
        off.append((member.cam_from_rig @ truth.inverse()).log())
    both = torch.stack(off)
    return math.degrees(float(both[:, :3].norm(dim=-1).max())), float(both[:, 3:].norm(dim=-1).max())


def pair(frames: int, seed: int = 0) -> RigScene:
    """A pinhole camera and a fisheye side by side."""
    rng = np.random.default_rng(seed)
    axes = np.array([[0.0, 0.0, 1.0], [0.2, 0.05, 1.0]])
    boards = boards_at(np.array([0.1, 0.0, 1.0]) + 0.3 * rng.standard_normal((frames, 3)), rng.uniform(0.5, 0.9, frames), rng)
    return scene((PINHOLE, FISHEYE_220), looking_along(axes, np.array([[0.0, 0, 0], [0.2, 0.02, 0.01]])), boards)


def renumbered(corners: Corners, views: Iterable[int], motion: Callable[[np.ndarray], np.ndarray]) -> Corners:
    """The corners of some views under other board coordinates."""
    board = corners.board_m.copy()
    rows = np.isin(corners.view, list(views))
    board[rows] = motion(board[rows])
    return replace(corners, board_m=board)
