"""Which pairs of photos agree on how the photos are turned: those that chance or a repeated thing joined do not.

Rotations of all photos are averaged over the relative rotations of pairs (V. M. Govindu, Lie-algebraic averaging for globally
consistent motion estimation, CVPR 2004), started from the tree of the strongest pairs and reweighted (Geman and McClure), so that
pairs that contradict the others count no more (A. Chatterjee, V. M. Govindu, Efficient and robust large-scale rotation averaging,
ICCV 2013).
"""

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from camera_models.pose import Pose
from omnilines.posing.bearing_residual import near_epipolar_arc
from omnilines.posing.options import MapperOptions

_ROUNDS = 30

Pairs = Mapping[tuple[int, int], tuple[Float[np.ndarray, "3 3"], int]]
"""Of a pair (i, j) of photos j_from_i and the matches that agree with it."""


def averaged_rotations(pairs: Pairs, photos: int, options: MapperOptions = MapperOptions()) -> Float[np.ndarray, "photos 3 3"]:
    """cam_from_world of photos that most pairs agree with; parts that no pair joins have a world each."""
    if not pairs:
        return np.tile(np.eye(3), (photos, 1, 1))
    ends = np.array(list(pairs))
    relative = Rotation.from_matrix(np.stack([matrix for matrix, _ in pairs.values()]))
    strength = np.array([count for _, count in pairs.values()], dtype=float)
    turned = Rotation.from_matrix(_along_strongest(ends, relative.as_matrix(), strength, photos))
    for _ in range(_ROUNDS):
        error = _error(ends, relative, turned)
        weight = strength / (1.0 + np.square(error).sum(1) / options.rotation_loss_scale_rad**2) ** 2
        step = _solved(ends, error, weight, photos)
        turned = turned * Rotation.from_rotvec(step)
        if np.abs(step).max() < 1e-6:
            break
    found: Float[np.ndarray, "photos 3 3"] = turned.as_matrix()
    return found


def agreeing_pairs(
    pairs: Pairs, turned: Float[np.ndarray, "photos 3 3"], options: MapperOptions = MapperOptions()
) -> list[tuple[int, int]]:
    """The pairs whose relative rotation is that of their photos."""
    if not pairs:
        return []
    relative = Rotation.from_matrix(np.stack([matrix for matrix, _ in pairs.values()]))
    off = np.linalg.norm(_error(np.array(list(pairs)), relative, Rotation.from_matrix(turned)), axis=1)
    return [pair for pair, far in zip(pairs, off.tolist(), strict=True) if far < options.max_rotation_rad]


def fits_rotation(
    a: Float[np.ndarray, "m 3"],
    b: Float[np.ndarray, "m 3"],
    turned: Float[np.ndarray, "3 3"],
    limit_rad: float,
    options: MapperOptions = MapperOptions(),
) -> bool:
    """Whether matches of two photos, which have another rotation j_from_i of their own, agree with this one as well, but for a
    little: things in one plane, or in a small part of the image, leave several possible."""
    rays = torch.as_tensor(a), torch.as_tensor(b)
    bound = np.append(np.full(3, options.max_rotation_rad / math.sqrt(3.0)), np.full(3, np.inf))

    def posed(x: Float[np.ndarray, " 6"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        return Rotation.from_rotvec(x[:3]).as_matrix() @ turned, x[3:] / np.linalg.norm(x[3:])

    def off_circle(x: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " m"]:
        """Angles of b from the planes of a and the translation."""
        rotation, translation = posed(x)
        normal = np.cross(a @ rotation.T, translation)
        away: Float[np.ndarray, " m"] = (normal * b).sum(1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
        return away / limit_rad

    def agreeing(translation: Float[np.ndarray, "3"]) -> int:
        """Matches, at best, from this start."""
        start = np.append(np.zeros(3), translation)
        rotation, found = map(torch.as_tensor, posed(least_squares(off_circle, start, loss="cauchy", bounds=(-bound, bound)).x))
        return max(int(near_epipolar_arc(*rays, Pose(rotation, way * found), limit_rad).sum()) for way in (1.0, -1.0))

    normal = np.cross(a @ turned.T, b)
    least, second, _ = np.linalg.eigh(normal.T @ normal)[1].T
    return any(agreeing(start) >= options.settled_share * len(a) for start in (least, second))


def _error(ends: Int[np.ndarray, "n 2"], relative: Rotation, turned: Rotation) -> Float[np.ndarray, "n 3"]:
    """log(R_j' R_ji R_i): what R_j exp(d_j), R_i exp(d_i) should make zero, to first order by d_j - d_i."""
    return np.asarray((turned[ends[:, 1]].inv() * relative * turned[ends[:, 0]]).as_rotvec())


def _solved(
    ends: Int[np.ndarray, "n 2"], error: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"], photos: int
) -> Float[np.ndarray, "photos 3"]:
    """The steps with the least sum of weighted squares; as small as possible where photos are free."""
    incidence = np.zeros((len(ends), photos))
    incidence[np.arange(len(ends)), ends[:, 1]], incidence[np.arange(len(ends)), ends[:, 0]] = 1.0, -1.0
    normal = incidence.T @ (weight[:, None] * incidence)
    step: Float[np.ndarray, "photos 3"] = np.linalg.lstsq(normal, incidence.T @ (weight[:, None] * error), rcond=1e-10)[0]
    return step


def _along_strongest(
    ends: Int[np.ndarray, "n 2"], relative: Float[np.ndarray, "n 3 3"], strength: Float[np.ndarray, " n"], photos: int
) -> Float[np.ndarray, "photos 3 3"]:
    """Rotations chained over the tree of the strongest pairs, of every part from its first photo."""
    of_pair = {tuple(pair): k for k, pair in enumerate(ends.tolist())}
    tree = minimum_spanning_tree(coo_array((1.0 / strength, ends.T), shape=(photos, photos)).tocsr())
    turned = np.tile(np.eye(3), (photos, 1, 1))
    _, part = connected_components(tree, directed=False)
    for first in np.unique(part, return_index=True)[1].tolist():
        order, before = breadth_first_order(tree, first, directed=False)
        for photo in order[1:].tolist():
            other = int(before[photo])
            forward = (other, photo) in of_pair
            step = relative[of_pair[other, photo]] if forward else relative[of_pair[photo, other]].T
            turned[photo] = step @ turned[other]
    return turned
