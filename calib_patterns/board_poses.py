"""Board poses for rendered calibration photos: tilted, near and far, spread over the whole field of view of any camera."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from calib_patterns._pattern import Pattern
from camera_models._model import CameraModel
from camera_models.errors import GeometryError
from camera_models.pose import Pose

_CANDIDATES = 24
_BISECTIONS = 24
_MAX_ROUNDS = 30


@dataclass(frozen=True)
class _Boards:
    """A batch of candidate poses cam_from_board."""

    rotation: Float[np.ndarray, "k 3 3"]
    translation: Float[np.ndarray, "k 3"]

    def transform(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k n 3"]:
        return points @ self.rotation.transpose(0, 2, 1) + self.translation[:, None]

    def swung(self, turn: Float[np.ndarray, "k 3 3"]) -> "_Boards":
        """Turned about the camera centre."""
        return _Boards(turn @ self.rotation, (turn @ self.translation[..., None])[..., 0])

    @property
    def shows_front(self) -> Bool[np.ndarray, " k"]:
        return np.einsum("ki,ki->k", self.rotation[:, :, 2], self.translation) > 0


def _outline(pattern: Pattern, inset_share: float) -> Float[np.ndarray, "m 3"]:
    """Points round the printed sheet, whose edges are drawn in by a share of the way to the outermost corners."""
    low = np.array(pattern.top_left_m)
    high = low + np.array(pattern.size_m)
    corners = pattern.points_m[:, :2]
    low = low + inset_share * (corners.min(0) - low)
    high = high + inset_share * (corners.max(0) - high)
    s = np.linspace(0.0, 1.0, 12)
    sides = [(s, 0 * s), (s, 0 * s + 1), (0 * s, s), (0 * s + 1, s)]
    xy = np.concatenate([np.stack(side, -1) for side in sides]) * (high - low) + low
    return np.concatenate([xy, np.zeros((len(xy), 1))], 1)


class _Sampler:
    """Draws batches of candidate poses and says which of them a camera sees well."""

    def __init__(
        self, pattern: Pattern, model: CameraModel, max_angle_rad: float, max_tilt_rad: float, min_spacing_px: float, seed: int
    ) -> None:
        self.pattern, self.model, self.rng = pattern, model, np.random.default_rng(seed)
        self.max_angle, self.max_tilt, self.min_spacing_px = max_angle_rad, max_tilt_rad, min_spacing_px
        self.points = pattern.points_m
        self.outline = _outline(pattern, 0.25)
        # While boards are swung out, the corners of the corners' convex hull stand for all.
        self.hull = self.points[ConvexHull(self.points[:, :2]).vertices]
        tree = cKDTree(self.points)
        nearest = np.asarray(tree.query(self.points, k=2)[0])[:, 1].max()
        self.neighbours = tree.query_pairs(1.01 * nearest, output_type="ndarray")
        axis, _ = model.unproject(model.centre_px.detach()[None].numpy())
        # The bearing of the centre pixel is +z, or -z for a mirror: angles are measured from it.
        self.axis_sign = 1.0 if axis[0, 2] >= 0 else -1.0

    def _boards_on_axis(self) -> _Boards:
        """Boards of random tilt, roll and distance whose middle is on the +z axis, seen from the front."""
        k = _CANDIDATES
        tilt = self.max_tilt * np.sqrt(self.rng.uniform(0.05, 1.0, k))
        direction, roll = self.rng.uniform(0, 2 * np.pi, (2, k))
        axis = np.stack([np.cos(direction), np.sin(direction), np.zeros(k)], -1)
        rotation = (
            Rotation.from_rotvec(axis * tilt[:, None]) * Rotation.from_rotvec(roll[:, None] * [0.0, 0.0, 1.0])
        ).as_matrix()
        # From a board that spans two thirds of the field (at most 70 degrees) to one of a quarter of that size.
        widest = min(math.radians(70.0), 2.0 * self.max_angle / 1.5)
        diagonal = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        distance = 0.5 * diagonal / math.tan(0.5 * widest) * 4.0 ** self.rng.uniform(0.0, 1.0, k)
        return _Boards(rotation, distance[:, None] * [0.0, 0.0, 1.0] - rotation @ self.points.mean(0))

    def _turn(self, theta: Float[np.ndarray, " k"], azimuth: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 3 3"]:
        """The rotations that carry +z to the bearings at theta off the camera's axis, by the shortest way."""
        angle = theta if self.axis_sign > 0 else math.pi - theta
        axis = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], -1)
        return Rotation.from_rotvec(angle[:, None] * axis).as_matrix()

    def _farthest(self, boards: _Boards, azimuth: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Angle off axis to which each board can be swung until its corners reach the largest angle or the photo's border."""
        low, high = np.zeros(len(azimuth)), np.full(len(azimuth), self.max_angle)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            seen = self._seen_whole(boards.swung(self._turn(middle, azimuth)), self.hull)
            low, high = np.where(seen, middle, low), np.where(seen, high, middle)
        return low

    def draw(self, low: float, high: float, azimuth: float) -> tuple[_Boards, Bool[np.ndarray, " k"]]:
        """Candidates with their middles at a share low to high of the farthest way out, and which of them are seen well.

        The azimuths stray from the wanted one, the last candidates by up to half a turn.
        """
        boards = self._boards_on_axis()
        azimuths = azimuth + np.pi * np.linspace(0.05, 1.0, _CANDIDATES) * self.rng.uniform(-1.0, 1.0, _CANDIDATES)
        share = self.rng.uniform(low, high, _CANDIDATES)
        boards = boards.swung(self._turn(share * self._farthest(boards, azimuths), azimuths))
        return boards, self._seen_whole(boards, self.points) & self._resolved(boards)

    def _seen_whole(self, boards: _Boards, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " k"]:
        """These points within the largest angle, the squares and most of the margin inside the photo, from the front."""
        width, height = self.model.image_size
        corners = boards.transform(points)
        angles = np.arctan2(np.linalg.norm(corners[..., :2], axis=-1), self.axis_sign * corners[..., 2])
        pixels, valid = (np.asarray(a) for a in self.model.project(np.concatenate([corners, boards.transform(self.outline)], 1)))
        inside = (pixels >= 1.0).all(-1) & (pixels[..., 0] <= width - 2.0) & (pixels[..., 1] <= height - 2.0)
        return (valid & inside).all(1) & (angles.max(1) <= self.max_angle) & boards.shows_front

    def _resolved(self, boards: _Boards) -> Bool[np.ndarray, " k"]:
        """Whether neighbouring corners are far enough apart in the photo."""
        pixels, _ = self.model.project(boards.transform(self.points))
        first, second = self.neighbours.T
        distance = np.linalg.norm(pixels[:, first] - pixels[:, second], axis=-1)
        return distance.min(1) >= self.min_spacing_px

    def first_seen_well(self, low: float, high: float, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and translation of one board; raises GeometryError when no round of candidates holds one."""
        for _ in range(_MAX_ROUNDS):
            boards, seen = self.draw(low, high, azimuth)
            if seen.any():
                chosen = int(seen.argmax())
                return boards.rotation[chosen], boards.translation[chosen]
        angle = math.degrees(self.max_angle)
        raise GeometryError(
            f"Expected the camera to see a {self.pattern.specification} whole within {angle:.0f} degrees of its axis, "
            f"corners {self.min_spacing_px:g} px apart, found no such pose; lower the spacing or the number of corners."
        )


def random_board_poses(
    pattern: Pattern,
    model: CameraModel,
    count: int,
    max_angle_rad: float,
    *,
    max_tilt_rad: float = math.radians(45.0),
    min_spacing_px: float = 12.0,
    rim_share: float = 0.4,
    seed: int = 0,
) -> Pose:
    """A batch of `count` cam_from_board whose targets are seen whole, from the front.

    Every corner is at most `max_angle_rad` off the axis, inside the photo, and at least `min_spacing_px` from the next one. The
    boards are tilted by up to `max_tilt_rad` against the ray to their middle and turned about it at random; their middles are
    spread over angle and azimuth, and `rim_share` of them reach as far out as they can: to `max_angle_rad` with their farthest
    corner, or to the photo's border where that comes first. Deterministic in `seed`.
    Raises GeometryError when the camera cannot see the target so.
    """
    sampler = _Sampler(pattern, model, max_angle_rad, max_tilt_rad, min_spacing_px, seed)
    rim = math.ceil(rim_share * count)
    start = sampler.rng.uniform(0, 2 * np.pi)
    golden_angle = math.pi * (3.0 - math.sqrt(5.0))
    # Equal rings of the way out for the boards that are not at the rim.
    rings = [(1.0, 1.0)] * rim + [(k / (count - rim), (k + 1) / (count - rim)) for k in range(count - rim)]
    boards = [sampler.first_seen_well(low, high, start + golden_angle * k) for k, (low, high) in enumerate(rings)]
    return Pose.of(np.stack([rotation for rotation, _ in boards]), np.stack([translation for _, translation in boards]))
