"""Rotations of photos from the directions that their lines share.

Arcs of parallel lines meet in a direction of the camera frame, whatever its place and however wrong its pose is. Directions that
several photos see, brought into the world by their poses, are those of families of lines: with two families or more the rotation
of a photo follows to a tenth of a degree or better. In the rotation R (camera from world) an arc of the normal n belongs to the
family of the direction d where n . R d is small; rotations and directions are refined in turn, d as the smallest principal axis
of its normals and R by a step w of

    minimise  sum loss(n . (R d + w x R d) / s) + |w|^2 / prior_sigma_rad^2.

Centres stay where they are.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models.pose import Pose, rotation_from_vector
from camera_models.rotations import mean_rotation
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.options import MatchingOptions
from omnilines.matching.photo_starts import meeting_directions

MAX_FAMILIES = 12
ROUNDS = 10
"""Times that rotations and directions are refined in turn."""


def turned_poses(arcs: ViewedArcs, options: MatchingOptions = MatchingOptions()) -> tuple[Pose, Bool[np.ndarray, " m"]]:
    """The poses of all photos with rotations that their arcs' directions ask for, and which photos could be turned.

    A photo that sees fewer than two families keeps its pose.
    """
    given, its = arcs.poses.rotation.numpy(), options.rotations
    photos = [_Photo.of(arcs.of_photo(k), options) for k in range(arcs.images)]
    turned, fixed = given, np.zeros(arcs.images, dtype=bool)
    # First under the given rotations, then under better ones.
    for near, apart in ((its.near_rad, its.apart_rad), (its.fine_near_rad, its.fine_apart_rad)):
        families = _families(photos, turned, near, apart, its.min_photo_share)
        if len(families) < 2:
            return arcs.poses, np.zeros(arcs.images, dtype=bool)
        turned = np.stack([_voted(photo, given[k], families, options) for k, photo in enumerate(photos)])
        first = turned
        for _ in range(ROUNDS):
            families = _refined_families(families, photos, turned, options)
            steps = [_step(photo, turned[k], first[k], families, options) for k, photo in enumerate(photos)]
            turned, fixed = np.stack([one for one, _ in steps]), np.array([sound for _, sound in steps])
    chosen = torch.as_tensor(fixed)
    rotation = torch.as_tensor(turned)
    # The world stays where it was on the whole.
    rotation = rotation @ _common_turn(rotation[chosen], arcs.poses.rotation[chosen])
    rotation = torch.where(chosen[:, None, None], rotation, arcs.poses.rotation)
    return Pose(rotation, -(rotation @ arcs.poses.centre[..., None])[..., 0]), fixed


@dataclass(frozen=True)
class _Photo:
    """The sharpest arcs of one photo, camera frame."""

    normals: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, " n"]
    directions: Float[np.ndarray, "v 3"]
    """In which arcs meet."""
    support: Int[np.ndarray, " v"]

    @staticmethod
    def of(arcs: ViewedArcs, options: MatchingOptions) -> "_Photo":
        """From all arcs of the photo."""
        own = arcs.sharpest(options.directions.sharpest_arcs)
        # Normals of `packed` are in the world of the pose.
        normals = own.packed[:, 6:9] @ arcs.poses.rotation[0].numpy().T
        directions = meeting_directions(normals, options.directions) if len(own) > 1 else np.zeros((0, 3))
        support = (np.abs(directions @ normals.T) < math.sin(options.directions.meeting_rad)).sum(1)
        return _Photo(normals, np.maximum(own.circle_sigma_rad, options.rotations.parallel_sigma_rad), directions, support)


def _families(
    photos: Sequence[_Photo],
    rotations: Float[np.ndarray, "m 3 3"],
    near_rad: float,
    apart_rad: float,
    min_photo_share: float,
) -> Float[np.ndarray, "f 3"]:
    """World directions that many photos see, the one with most arcs first."""
    world = np.concatenate([photo.directions @ rotations[k] for k, photo in enumerate(photos)])
    number = np.repeat(np.arange(len(photos)), [len(photo.directions) for photo in photos])
    weight = np.concatenate([photo.support for photo in photos]).astype(np.float64)
    found: list[np.ndarray] = []
    free = np.ones(len(world), dtype=bool)
    while free.any() and len(found) < MAX_FAMILIES:
        near = (np.abs(world @ world.T) > math.cos(near_rad)) & free
        best = int(np.argmax(np.where(free, near @ weight, -1.0)))
        member = np.flatnonzero(near[best])
        if len(np.unique(number[member])) < max(min_photo_share * len(photos), 2):
            break
        axes = np.einsum("n,ni,nj->ij", weight[member], world[member], world[member])
        found.append(np.linalg.eigh(axes)[1][:, 2])
        free &= np.abs(world @ world[best]) < math.cos(apart_rad)
    return np.array(found).reshape(-1, 3)


def _voted(
    photo: _Photo, rotation: Float[np.ndarray, "3 3"], families: Float[np.ndarray, "f 3"], options: MatchingOptions
) -> Float[np.ndarray, "3 3"]:
    """The rotation near the given one under which most arcs are of families.

    Tried are those that bring a family onto a direction v of the photo, and then some arc of the normal n into another family d:
    turned about v it is where n . exp(t [v]x) d = 0.
    """
    its, meeting_sine = options.rotations, math.sin(options.directions.meeting_rad)
    cosine = photo.directions @ (families @ rotation.T).T
    tried = [rotation[None]]
    for v, f in np.argwhere(np.abs(cosine) > math.cos(its.near_rad)).tolist():
        axis = np.sign(cosine[v, f]) * photo.directions[v]
        onto = _onto(rotation @ families[f], axis) @ rotation
        d = families @ onto.T
        along = photo.normals @ axis
        a, c = photo.normals @ (d - np.outer(d @ axis, axis)).T, np.outer(along, d @ axis)
        b = photo.normals @ np.cross(axis, d).T
        size = np.hypot(a, b)
        angle = np.arctan2(b, a) + np.array([1.0, -1.0])[:, None, None] * np.arccos(np.clip(-c / np.maximum(size, 1e-12), -1, 1))
        angle -= 2.0 * math.pi * np.round(angle / (2.0 * math.pi))
        usable = (np.abs(angle) < its.near_rad) & (size > math.sin(its.apart_rad)) & (np.abs(along) > meeting_sine)[:, None]
        turns = np.sort(angle[usable])
        # Those that lie closer than they are told apart are one.
        turns = turns[np.unique(np.round(turns / (0.5 * its.vote_sigma_rad)), return_index=True)[1]]
        tried.append(rotation_from_vector(torch.as_tensor(turns[:, None] * axis)).numpy() @ onto)
    every = np.concatenate(tried)
    off = np.abs(np.einsum("ni,kij,fj->knf", photo.normals, every, families)).min(-1) / np.hypot(photo.sigma, its.vote_sigma_rad)
    best: Float[np.ndarray, "3 3"] = every[int(np.argmax(np.exp(-0.5 * off**2).sum(-1)))]
    return best


def _onto(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation from one unit vector to another, which is not opposite."""
    across, cosine = np.cross(first, second), float(first @ second)
    h = np.cross(np.eye(3), across)
    return np.eye(3) + h + h @ h / (1.0 + cosine)


def _members(
    normals: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, " n"],
    directions: Float[np.ndarray, "f 3"],
    options: MatchingOptions,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The family of each arc, how far it is from it, and its weight: none where it is not on the circle."""
    off = normals @ directions.T
    family = np.abs(off).argmin(1)
    residual = off[np.arange(len(off)), family]
    loss = 1.0 + (residual / (options.resection.loss_scale * sigma)) ** 2
    weight = np.where(np.abs(residual) < math.sin(options.directions.meeting_rad), 1.0 / (sigma**2 * loss), 0.0)
    return family, residual, weight


def _refined_families(
    families: Float[np.ndarray, "f 3"], photos: Sequence[_Photo], rotations: Float[np.ndarray, "m 3 3"], options: MatchingOptions
) -> Float[np.ndarray, "f 3"]:
    world = np.concatenate([photo.normals @ rotations[k] for k, photo in enumerate(photos)])
    family, _, weight = _members(world, np.concatenate([photo.sigma for photo in photos]), families, options)
    refined = families.copy()
    for f in range(len(families)):
        own = world[family == f] * np.sqrt(weight[family == f, None])
        if (weight[family == f] > 0).sum() >= options.directions.min_arcs:
            axis = np.linalg.eigh(own.T @ own)[1][:, 0]
            refined[f] = axis * np.sign(axis @ families[f])
    return refined


def _step(
    photo: _Photo,
    rotation: Float[np.ndarray, "3 3"],
    start: Float[np.ndarray, "3 3"],
    families: Float[np.ndarray, "f 3"],
    options: MatchingOptions,
) -> tuple[Float[np.ndarray, "3 3"], bool]:
    """A rotation after one step, and whether two families that are not one fix it."""
    its, directions = options.rotations, families @ rotation.T
    family, residual, weight = _members(photo.normals, photo.sigma, directions, options)
    jacobian = np.cross(directions[family], photo.normals)
    normal = (jacobian * weight[:, None]).T @ jacobian + np.eye(3) / its.prior_sigma_rad**2
    # The prior is about the start; of a small turn the rotation vector is the odd part.
    turn = rotation @ start.T
    away = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    step = -np.linalg.solve(normal, (jacobian * weight[:, None]).T @ residual + away / its.prior_sigma_rad**2)
    # Of n arcs n sin(meeting_rad) lie so near any direction.
    by_chance = len(family) * math.sin(options.directions.meeting_rad)
    enough = max(options.directions.min_arcs, by_chance + its.chance_sigmas * math.sqrt(by_chance))
    seen = directions[np.bincount(family[weight > 0], minlength=len(families)) >= enough]
    fixed = bool((np.abs(seen @ seen.T) < math.cos(its.apart_rad)).any())
    return rotation_from_vector(torch.as_tensor(step)).numpy() @ rotation, fixed


def _common_turn(rotations: Float[torch.Tensor, "k 3 3"], given: Float[torch.Tensor, "k 3 3"]) -> Float[torch.Tensor, "3 3"]:
    """The turn of the world after which rotations are the given ones on the whole: the mean of those of the photos, without the
    half that is farthest from it."""
    if not len(rotations):
        return torch.eye(3, dtype=torch.float64)
    turns = rotations.mT @ given
    mean = mean_rotation(turns)
    near = (turns * mean).sum((-1, -2)).argsort(descending=True)[: (len(turns) + 1) // 2]
    return mean_rotation(turns[near])
