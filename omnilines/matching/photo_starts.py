"""Where a photo could have been taken, from lines that are known, without any idea of its pose.

1. Parallel lines meet in the image: directions v (camera frame) that lie on the great circles of many arcs. Two of them taken for
   two directions of families of the known lines give a rotation.
2. With the rotation R the arc of the normal N = R' n (world) and a line through X that looks like it and is parallel to its plane
   say N . (X - C) = 0 of the camera's centre C. For lines of one family these are lines in the plane across the family: two of
   them give a place there, and the places that most arcs agree with are taken. The height above the plane follows from lines
   of the other families, one each.
"""

import itertools
import math

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models.pose import Pose
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.kernels.hypothesis import likenesses
from omnilines.matching.kernels.place import agreeing
from omnilines.matching.known_lines import KnownLines
from omnilines.matching.options import DirectionOptions, MatchingOptions

MAX_DIRECTIONS, MAX_ROTATIONS = 6, 48
"""That are tried of one photo."""
AXES, TRIED, PLACES, HEIGHTS = 3, 1500, 4, 3
"""Families asked for a place, pairs of their lines tried, places kept of each family, and heights of each place."""
STARTS = 30


def start_poses(arcs: ViewedArcs, known: KnownLines, seed: int, options: MatchingOptions = MatchingOptions()) -> Pose:
    """Poses (STARTS at most, the most likely first) of the one photo of `arcs`, whose own pose is the identity.

    There are none where the arcs, or the lines, have fewer than two directions that many of them share.
    """
    directions = parallel_directions(known.direction, options.directions)
    rng = np.random.default_rng(seed)
    turned, centres, scores = [], [], []
    for rotation in _rotations(arcs, directions, options):
        pairs = _Pairs(arcs, known, rotation, options)
        for direction in directions[:AXES]:
            for centre, score in pairs.places(direction, rng):
                turned.append(rotation)
                centres.append(centre)
                scores.append(score)
    if not scores:
        return Pose.identity(0)
    best = np.argsort(scores)[::-1][:STARTS]
    rotations = torch.as_tensor(np.stack([turned[k] for k in best]))
    places = torch.as_tensor(np.stack([centres[k] for k in best]))
    return Pose(rotations, -(rotations @ places[..., None])[..., 0])


def meeting_directions(
    normals: Float[np.ndarray, "n 3"], options: DirectionOptions = DirectionOptions()
) -> Float[np.ndarray, "k 3"]:
    """Directions that many great circles share, the one that most share first."""
    first, second = np.triu_indices(len(normals), 1)
    direction = np.cross(normals[first], normals[second])
    length = np.linalg.norm(direction, axis=-1)
    across = length > math.sin(options.apart_rad)
    direction = direction[across] / length[across, None]
    found = _most_shared(direction, np.abs(direction @ normals.T) < math.sin(options.meeting_rad), options)
    # Nearest to all the circles: the smallest principal axis of their normals.
    return np.array([np.linalg.eigh(normals[own].T @ normals[own])[1][:, 0] for own in found]).reshape(-1, 3)


def parallel_directions(
    directions: Float[np.ndarray, "l 3"], options: DirectionOptions = DirectionOptions()
) -> Float[np.ndarray, "k 3"]:
    """Directions that many lines have, whatever their signs, the one that most have first."""
    found = _most_shared(directions, np.abs(directions @ directions.T) > math.cos(options.parallel_rad), options)
    return np.array([np.linalg.eigh(directions[own].T @ directions[own])[1][:, 2] for own in found]).reshape(-1, 3)


def _most_shared(
    candidates: Float[np.ndarray, "m 3"], shared_by: Bool[np.ndarray, "m n"], options: DirectionOptions
) -> list[Bool[np.ndarray, " n"]]:
    """What shares the best of the candidates, of which no two are near each other."""
    found: list[np.ndarray] = []
    while len(found) < MAX_DIRECTIONS and len(candidates):
        best = int(np.argmax(shared_by.sum(1)))
        if shared_by[best].sum() < options.min_arcs:
            break
        found.append(shared_by[best])
        away = np.abs(candidates @ candidates[best]) < math.cos(options.apart_rad)
        candidates, shared_by = candidates[away], shared_by[away]
    return found


def _rotations(
    arcs: ViewedArcs, directions: Float[np.ndarray, "f 3"], options: MatchingOptions
) -> list[Float[np.ndarray, "3 3"]]:
    """Rotations (camera from world) under which many arcs are parallel to a family."""
    angle_rad = options.starts.angle_rad
    normals = arcs.sharpest(options.directions.sharpest_arcs).packed[:, 6:9]
    seen = meeting_directions(normals, options.directions)
    tried = []
    for (a, b), (c, d) in itertools.product(
        itertools.permutations(range(len(seen)), 2), itertools.combinations(range(len(directions)), 2)
    ):
        for sign, other in itertools.product((1.0, -1.0), repeat=2):
            cosine = sign * other * float(seen[a] @ seen[b])
            if abs(math.acos(np.clip(cosine, -1, 1)) - math.acos(np.clip(directions[c] @ directions[d], -1, 1))) < angle_rad:
                tried.append(direction_frame(sign * seen[a], other * seen[b]) @ direction_frame(directions[c], directions[d]).T)
    if not tried:
        return []
    rotations = np.stack(tried)
    off = np.abs(np.einsum("ni,kij,fj->knf", normals, rotations, directions))
    parallel = (off < math.sin(options.directions.meeting_rad)).any(-1).sum(-1)
    kept: list[int] = []
    for k in np.argsort(-parallel, kind="stable").tolist():
        if parallel[k] < options.starts.min_arc_share * parallel.max() or len(kept) == MAX_ROTATIONS:
            break
        turn = np.einsum("kij,ij->k", rotations[kept], rotations[k]) if kept else np.zeros(0)
        if not (turn > 1 + 2 * math.cos(angle_rad)).any():
            kept.append(k)
    return [rotations[k] for k in kept]


def direction_frame(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Orthonormal columns; of the angle between both vectors' bisector and each nothing is preferred."""
    middle, across = first + second, np.cross(first, second)
    middle, across = middle / np.linalg.norm(middle), across / np.linalg.norm(across)
    return np.stack([middle, across, np.cross(middle, across)], -1)


class _Pairs:
    """Arcs and the known lines that could be theirs under a rotation, sorted by arc."""

    def __init__(self, arcs: ViewedArcs, known: KnownLines, rotation: Float[np.ndarray, "3 3"], options: MatchingOptions) -> None:
        self.options = options.directions
        packed = arcs.packed
        normal = packed[:, 6:9] @ rotation
        towards = (packed[:, :3] + packed[:, 3:6]) @ rotation
        along = (packed[:, 3:6] - packed[:, :3]) @ rotation
        arc, line = np.nonzero(np.abs(normal @ known.direction.T) < math.sin(self.options.parallel_rad))
        against = (along[arc] * known.direction[line]).sum(-1) < 0
        alike = likenesses(known.colours, arcs.colours, line, arc, against, options.likeness)
        kept = alike >= options.starts.min_likeness
        self.arc, self.line, self.alike = arc[kept], line[kept], alike[kept]
        self.normal, self.towards = normal[self.arc], towards[self.arc]
        self.direction = known.direction[self.line]
        middle = np.nan_to_num(known.spans, posinf=0.0, neginf=0.0).mean(-1)
        self.point = (np.cross(known.direction, known.moment) + middle[:, None] * known.direction)[self.line]
        self.offset = (self.normal * self.point).sum(-1)

    def places(self, axis: Float[np.ndarray, "3"], rng: np.random.Generator) -> list[tuple[Float[np.ndarray, "3"], float]]:
        """Centres on which most arcs of lines along `axis` agree, with how many arcs of all lines do."""
        own = np.flatnonzero(np.abs(self.direction @ axis) > math.cos(self.options.parallel_rad))
        if len(np.unique(self.arc[own])) < 2:
            return []
        basis = np.linalg.svd(axis[None])[2][1:]
        across, offset = self.normal[own] @ basis.T, self.offset[own]
        chance = self.alike[own] / self.alike[own].sum()
        first, second = rng.choice(len(own), (2, TRIED), p=chance)
        determinant = across[first, 0] * across[second, 1] - across[first, 1] * across[second, 0]
        usable = np.abs(determinant) > math.sin(self.options.apart_rad)
        first, second, determinant = first[usable], second[usable], determinant[usable]
        x = (offset[first] * across[second, 1] - offset[second] * across[first, 1]) / determinant
        y = (across[first, 0] * offset[second] - across[second, 0] * offset[first]) / determinant
        place = np.stack([x, y], -1) @ basis
        normal, point, ahead = (part[own] @ basis.T @ basis for part in (self.normal, self.point, self.towards))
        size = float(np.linalg.norm(point - np.median(point, axis=0), axis=-1).max()) + 1e-12
        sine = math.sin(self.options.parallel_rad)
        score = agreeing(self.arc[own], self.alike[own], normal, offset, point, ahead, place, sine)
        chosen: list[int] = []
        for k in np.argsort(-score, kind="stable").tolist():
            if len(chosen) == PLACES:
                break
            if not chosen or np.linalg.norm(place[chosen] - place[k], axis=-1).min() > 0.05 * size:
                chosen.append(k)
        return [found for k in chosen for found in self._heights(axis, place[k])]

    def _heights(self, axis: Float[np.ndarray, "3"], base: Float[np.ndarray, "3"]) -> list[tuple[Float[np.ndarray, "3"], float]]:
        """Centres base + t axis on which most arcs agree."""
        slope = self.normal @ axis
        other = np.flatnonzero(np.abs(slope) > math.sin(self.options.apart_rad))
        if not len(other):
            return []
        gap = self.point[other] - base
        height = (self.normal[other] * gap).sum(-1) / slope[other]
        order = np.argsort(height)
        height, weight = height[order], self.alike[other][order]
        sine = math.sin(self.options.parallel_rad)
        width = sine * float(np.median(np.linalg.norm(gap - (gap @ axis)[:, None] * axis, axis=-1)))
        total = np.concatenate([[0.0], np.cumsum(weight)])
        inside = total[np.searchsorted(height, height + width)] - total[np.searchsorted(height, height - width)]
        chosen: list[int] = []
        for k in np.argsort(-inside, kind="stable").tolist():
            if len(chosen) == HEIGHTS:
                break
            if not chosen or np.abs(height[chosen] - height[k]).min() > 2 * width:
                chosen.append(k)
        centres = base + height[chosen, None] * axis
        score = agreeing(self.arc, self.alike, self.normal, self.offset, self.point, self.towards, centres, sine)
        return list(zip(centres, score.tolist(), strict=True))
