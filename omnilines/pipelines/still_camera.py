"""Whether a camera stood still while what its poses come from, a board, was moved: then only the board is rebuilt."""

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models.pose import rotation_from_vector
from omnilines.matching.arcs import ViewedArcs
from omnilines.pipelines.kept_lines import KeptLines

PAIRS, ARCS = 8, 100
"""Of photos that are compared, and of arcs of each, at most."""
NEAR_PX = 2.0
"""Distance within which an arc is taken to show the same as one of another photo, in the same place of the image."""
MOVED = 10.0
"""So many times farther the lines have to move."""
TURN_RAD = 0.1
"""By which arcs are turned to see how many lie near others by chance."""


def still_share(scene: KeptLines) -> float:
    """Share of the arcs in no line that lie where an arc of another photo of their camera lies, beyond what chance gives, the
    median of pairs of photos between which the lines move; NaN where there is no such pair."""
    cameras, images = scene.scene.poses.cameras or (), scene.scene.poses.images
    arcs, in_line = scene.matched.arcs.with_poses(scene.scene.poses.cam_from_world), scene.segments.track >= 0
    pairs = [(a, a + 1) for a in range(len(images) - 1) if not cameras or cameras[a] == cameras[a + 1]]
    found = [_share(scene, arcs, in_line, pair) for pair in pairs[:: 1 + len(pairs) // PAIRS]]
    known = [share for share in found if np.isfinite(share)]
    return float(np.median(known)) if known else float("nan")


def _share(scene: KeptLines, arcs: ViewedArcs, in_line: Bool[np.ndarray, " n"], pair: tuple[int, int]) -> float:
    rest = np.flatnonzero((arcs.image == pair[0]) & ~in_line)
    rest = rest[:: 1 + len(rest) // ARCS]
    others = np.flatnonzero(arcs.image == pair[1])
    if not len(rest) or not len(others):
        return float("nan")
    near_rad = NEAR_PX * float(np.median(np.linalg.norm(arcs.by_pixel[rest], ord=2, axis=(-2, -1))))
    if not _lines_move(scene, arcs, in_line, pair) > MOVED * near_rad:
        return float("nan")
    own, other = arcs.bearings[rest], arcs.bearings[others]
    turns = rotation_from_vector(TURN_RAD * torch.cat([torch.eye(3), -torch.eye(3)]).double()).numpy()
    chance = float(np.mean([lies_near(own @ turn.T, other, near_rad).mean() for turn in turns]))
    return float(lies_near(own, other, near_rad).mean()) - chance


def _lines_move(scene: KeptLines, arcs: ViewedArcs, in_line: Bool[np.ndarray, " n"], pair: tuple[int, int]) -> float:
    """Median angle (rad) by which the ends of the lines of the first photo are elsewhere in the second."""
    shown = np.unique(scene.segments.track[(arcs.image == pair[0]) & in_line])
    if not len(shown):
        return 0.0
    ends = torch.as_tensor(scene.scene.lines.ends_m[shown].reshape(-1, 3))
    a, b = (torch.nn.functional.normalize(arcs.poses[k].transform(ends), dim=-1) for k in pair)
    return float(torch.linalg.cross(a, b).norm(dim=-1).clamp(max=1.0).asin().median())


def lies_near(own: Float[np.ndarray, "n 2 3"], other: Float[np.ndarray, "m 2 3"], near_rad: float) -> Bool[np.ndarray, " n"]:
    """Arcs of which both ends are near the great circle of one of the others, and the middle beside it."""
    normal = np.cross(other[:, 0], other[:, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-12)
    row, column = np.nonzero(np.abs(own[:, 0] @ normal.T) < near_rad)
    along = np.abs((own[row, 1] * normal[column]).sum(-1)) < near_rad
    row, column = row[along], column[along]
    middle, start, end = own[row].sum(1), other[column, 0], other[column, 1]
    after = (np.cross(normal[column], start) * middle).sum(-1) > 0.0
    before = (np.cross(end, normal[column]) * middle).sum(-1) > 0.0
    near = np.zeros(len(own), dtype=bool)
    near[row[after & before]] = True
    return near
