"""The views of a rig: who saw which board when, the corners of one camera, and boards whose relation is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models import InputError
from camera_models.pose import Pose
from omnilines.records import Corners

BOARDS = ("fixed", "known", "moving")
"""How several boards stand to one another: mounted together in an unknown way, mounted together with their coordinates in one
common frame, each moving by itself."""
ONE_BOARD = "board"
"""The name of the board where the table names none."""
FLAT = 1e-6
"""Corners of a board lie in a plane up to this share of their extent."""


@dataclass(frozen=True, eq=False)
class RigViews:
    """Camera, frame and board of every view, as numbers."""

    corners: Corners
    """With plane boards, z = 0."""
    cameras: tuple[str, ...]
    boards: tuple[str, ...]
    frames: tuple[str, ...]
    camera: Int[np.ndarray, " v"]
    board: Int[np.ndarray, " v"]
    frame: Int[np.ndarray, " v"]
    tied: Pose | None
    """`target_from_board` of every board where it is known."""
    moving: bool

    @staticmethod
    def of(corners: Corners, cameras: Sequence[str], relation: str) -> "RigViews":
        """The views of these cameras; a table without frames has the view as the instant. Raises InputError."""
        if relation not in BOARDS:
            raise InputError(f"Boards are {', '.join(BOARDS)}, found '{relation}'; choose one of these.")
        count = len(corners.view_names)
        camera_names = corners.cameras or (cameras[0],) * count
        unknown = sorted(set(camera_names) - set(cameras))
        if unknown:
            raise InputError(f"The cameras {', '.join(cameras)} were expected, found views of '{unknown[0]}'; name that one too.")
        board_names = corners.boards or (ONE_BOARD,) * count
        boards, frames = tuple(dict.fromkeys(board_names)), tuple(dict.fromkeys(corners.frames or corners.view_names))
        board = np.array([boards.index(name) for name in board_names])
        place = {name: k for k, name in enumerate(frames)}
        frame = np.array([place[name] for name in corners.frames or corners.view_names])
        tied = None
        if relation == "known":
            corners, tied = _in_planes(corners, board, boards)
        camera = np.array([tuple(cameras).index(name) for name in camera_names])
        _require_distinct(corners, camera, frame, board)
        return RigViews(
            corners=corners,
            cameras=tuple(cameras),
            boards=boards,
            frames=frames,
            camera=camera,
            board=board,
            frame=frame,
            tied=tied,
            moving=relation == "moving" and len(boards) > 1,
        )

    @property
    def block(self) -> Int[np.ndarray, " v"]:
        """The pose of the target that each view belongs to: its frame's, or with boards that move by themselves its own."""
        return self.frame * len(self.boards) + self.board if self.moving else self.frame

    @property
    def blocks(self) -> int:
        """Number of those poses."""
        return len(self.frames) * (len(self.boards) if self.moving else 1)

    @property
    def part(self) -> Int[np.ndarray, " v"]:
        """The board within its target; boards that move by themselves are a target each."""
        return np.zeros_like(self.board) if self.moving else self.board

    @property
    def parts(self) -> int:
        """Number of boards of a target."""
        return 1 if self.moving else len(self.boards)

    def of_camera(self, camera: int) -> tuple[Corners, Int[np.ndarray, " w"], Bool[np.ndarray, " n"]]:
        """The corners of one camera as a table of their own, with the numbers of its views and its rows."""
        views = np.flatnonzero(self.camera == camera)
        rows = np.isin(self.corners.view, views)
        return views_of(self.corners, views, rows), views, rows


def views_of(corners: Corners, views: Int[np.ndarray, " w"], rows: Bool[np.ndarray, " n"]) -> Corners:
    """Some views of a table, renumbered, with the chosen rows."""
    place = np.full(len(corners.view_names), -1)
    place[views] = np.arange(len(views))
    return Corners(
        view=place[corners.view[rows]],
        view_names=tuple(corners.view_names[v] for v in views),
        images=tuple(corners.images[v] for v in views),
        board_m=corners.board_m[rows],
        pixels=corners.pixels[rows],
        sigma_px=None if corners.sigma_px is None else corners.sigma_px[rows],
        ids=None if corners.ids is None else corners.ids[rows],
    )


def _require_distinct(
    corners: Corners, camera: Int[np.ndarray, " v"], frame: Int[np.ndarray, " v"], board: Int[np.ndarray, " v"]
) -> None:
    keys = np.stack([camera, frame, board], -1)
    _, first, counts = np.unique(keys, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        view = int(first[np.argmax(counts > 1)])
        again = [corners.images[v] for v in np.flatnonzero((keys == keys[view]).all(1))]
        raise InputError(
            f"One view of a board by a camera in a frame was expected, found {again[0]} and {again[1]}; correct the columns "
            "camera, frame and board."
        )


def _in_planes(corners: Corners, board: Int[np.ndarray, " v"], boards: Sequence[str]) -> tuple[Corners, Pose]:
    """Coordinates in the plane of each board, and where that plane is in the common frame."""
    place, poses = corners.board_m.copy(), []
    of_row = board[corners.view]
    for index, name in enumerate(boards):
        rows = of_row == index
        points = np.unique(np.round(corners.board_m[rows], 9), axis=0)
        middle = points.mean(0)
        _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
        if len(points) < 3 or size[1] <= FLAT * size[0] or size[2] > FLAT * size[0]:
            raise InputError(
                f"A plane board was expected, found that the {len(points)} corners of '{name}' lie on a line or out of a plane; "
                "give each plane a name of its own in the column board."
            )
        rotation = _axes(points, axes[2])
        poses.append(Pose.of(rotation.T, middle))
        place[rows] = (corners.board_m[rows] - middle) @ rotation.T
        place[rows, 2] = 0.0
    return replace(corners, board_m=place), Pose.stack(poses)


def _axes(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rows x, y, z of a plane: x towards the nearest neighbour of the first corner, z to the positive side."""
    largest = int(np.abs(normal).argmax())
    z = normal * np.sign(normal[largest])
    steps = points[1:] - points[0]
    x = steps[np.linalg.norm(steps, axis=1).argmin()]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
