"""The directions in which the lines of photos meet, as the adjustment of a camera to them takes them."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.lines.options import LineOptions
from omnilines.calibration.lines.problem import Families
from omnilines.calibration.lines.readings import tangent_basis
from omnilines.calibration.lines.weighting import WeightedChains, least_curvature
from omnilines.progress import ProgressCallback, on_all_cores
from omnilines.structure.circles import Circles
from omnilines.structure.manhattan import manhattan_frame
from omnilines.structure.meeting import Meeting, meeting_directions
from omnilines.structure.options import DirectionsOptions

MEDIAN_CHI2 = 0.455
"""Of one degree of freedom."""
BISECTIONS = 30
LARGEST_STRAY_RAD = 0.05


def chain_circles(model: CameraModel, chains: WeightedChains) -> Circles:
    """The great circle of each chain, as directions are found by."""
    blocks, normal = chains.blocks, chains.normal
    basis = tangent_basis(normal)
    lever = (chains.at.by_circle[:, None] @ basis[blocks.chain])[:, 0]
    information = blocks.sum_by_chain((chains.information[:, None] * lever)[:, :, None] * lever[:, None])
    values, vectors = torch.linalg.eigh(information)
    noise = basis @ (vectors * values.clamp_min(1e-6 * values[:, 1:].clamp_min(1.0)).rsqrt()[:, None])
    # Of a chain that the camera sees nowhere nothing is known: its circle is as uncertain as can be, wherever it ends.
    past, most = torch.cumsum(blocks.counts, 0), len(blocks.chain) - 1
    ends_px = torch.stack([blocks.pixels[row.clamp(0, most)] for row in (past - blocks.counts, past - 1)], 1)
    bearings, _ = model.unproject(ends_px)
    v1, v2 = _on_circle(bearings, normal).unbind(1)
    normal = torch.where((torch.linalg.cross(v1, v2) * normal).sum(-1, keepdim=True) < 0, -1.0, 1.0) * normal
    across = torch.linalg.cross(v2, normal), torch.linalg.cross(normal, v1)
    ends = torch.stack([m / (m * v).sum(-1, keepdim=True) for m, v in zip(across, (v1, v2), strict=True)])
    middle = torch.nn.functional.normalize(v1 + v2, dim=-1)
    return Circles(normal.numpy(), middle.numpy(), noise.permute(2, 0, 1).numpy(), ends.numpy())


def _on_circle(bearings: Float[Tensor, "c 2 3"], normal: Float[Tensor, "c 3"]) -> Float[Tensor, "c 2 3"]:
    off = (bearings * normal[:, None]).sum(-1, keepdim=True)
    return torch.nn.functional.normalize(bearings - off * normal[:, None], dim=-1)


def families_of(
    model: CameraModel,
    chains: WeightedChains,
    options: LineOptions,
    directions: DirectionsOptions,
    progress: ProgressCallback,
) -> Families:
    """The frame at right angles of each photo, and its other directions, with the chains of each."""
    with torch.no_grad():
        circles = chain_circles(model, chains)
    counted = chains.weight.numpy() > 0
    rows = [np.flatnonzero((chains.blocks.photo.numpy() == photo) & counted) for photo in range(chains.blocks.photos)]

    def look(own: np.ndarray) -> tuple[Meeting | None, Meeting]:
        """Frame and directions of one photo."""
        if len(own) < directions.min_lines:
            return None, Meeting.none(len(own))
        frame = manhattan_frame(circles.rows(own), directions) if options.right_angles else None
        return None if frame is None else frame.axes, meeting_directions(circles.rows(own), directions)

    found = on_all_cores(look, rows, "finding directions", progress)
    of_chain = np.full(len(counted), -1)
    direction, photo, frames = [np.zeros((0, 3))], list[int](), 0
    for k, (frame, _) in enumerate(found):
        if frame is not None:
            of_chain[rows[k]] = np.where(frame.direction_of >= 0, 3 * frames + frame.direction_of, -1)
            direction.append(frame.direction)
            photo, frames = photo + 3 * [k], frames + 1
    for k, (frame, meeting) in enumerate(found):
        others = np.arange(len(meeting))
        if frame is not None:
            near = np.abs(meeting.direction @ frame.direction.T).max(-1, initial=0.0)
            others = others[near < math.cos(directions.separation_rad)]
        for one in others:
            members = rows[k][(meeting.direction_of == one) & (of_chain[rows[k]] < 0)]
            if len(members) < directions.min_lines:
                continue
            of_chain[members] = len(photo)
            direction.append(meeting.direction[[one]])
            photo = [*photo, k]
    of, axes = torch.as_tensor(of_chain), torch.as_tensor(np.concatenate(direction))
    of_photo = torch.tensor(photo, dtype=torch.long)
    return _strayed(Families(axes, frames, of_photo, torch.ones(len(of), dtype=torch.float64), of), circles, options)


def with_strays(model: CameraModel, chains: WeightedChains, families: Families, options: LineOptions) -> Families:
    """Families of another camera with the strays that their lines have under this one; chains that do not count leave them."""
    left = torch.where(chains.weight > 0, families.of_chain, -1)
    with torch.no_grad():
        return _strayed(replace(families, of_chain=left), chain_circles(model, chains), options)


def _strayed(families: Families, circles: Circles, options: LineOptions) -> Families:
    """With the strays of its lines, those of a frame in one."""
    of_chain, number = families.of_chain.numpy(), np.arange(len(families.direction))
    group = np.where(number < 3 * families.frames, number // 3 * 3, number)
    stray, share = _strays(circles, families.direction.numpy(), of_chain, group, options)
    # Of Student's t with v degrees of freedom, w = (v + 1) / (v + x^2): the mean second derivative over the mean of w.
    told = share[of_chain >= 0]
    curvature = 2.0 * options.freedom / (options.freedom + 1.0) * float((told**2).sum() / told.sum()) - 1.0 if len(told) else 1.0
    curvature = max(curvature, least_curvature(options.freedom))
    return replace(families, stray_rad=torch.as_tensor(stray), curvature=curvature)


def _strays(
    circles: Circles,
    direction: Float[np.ndarray, "k 3"],
    of_chain: Int[np.ndarray, " c"],
    group: Int[np.ndarray, " k"],
    options: LineOptions,
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Standard deviation by which the line of each chain may stray from its direction: that of the median line of its frame, or
    its direction, raised as Student's t has it where the line lies farther off; and the weight by which it is raised."""
    stray, weight = np.full(len(of_chain), options.least_stray_rad), np.ones(len(of_chain))
    member = np.flatnonzero(of_chain >= 0)
    own = direction[of_chain[member]]
    off2 = np.square((circles.normal[member] * own).sum(-1))
    noise2 = np.square((circles.noise[:, member] * own).sum(-1)).sum(0)
    for k in np.unique(group):
        rows = group[of_chain[member]] == k
        if not rows.any():
            continue
        low, high = options.least_stray_rad, LARGEST_STRAY_RAD
        for _ in range(BISECTIONS):
            middle = math.sqrt(low * high)
            wide = np.median(off2[rows] / (noise2[rows] + middle**2)) > MEDIAN_CHI2
            low, high = (middle, high) if wide else (low, middle)
        share = (options.freedom + 1.0) / (options.freedom + off2[rows] / (noise2[rows] + low**2))
        stray[member[rows]], weight[member[rows]] = low / np.sqrt(share), share
    return stray, weight
