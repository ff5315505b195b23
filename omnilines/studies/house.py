"""Line triangulation and adjustment on the Oxford model house (Srestasathiern 2012, section 5.3)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.costs import COSTS
from omnilines.files import read_vgg_lines, read_vgg_points
from omnilines.files.vgg_house import MatchedLines, MatchedPoints
from omnilines.posing.from_matches import poses_from_matches
from omnilines.posing.photo_poses import align_to
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check, ImagePoses
from omnilines.studies.distances import DistanceFigures, figures_of
from omnilines.triangulation import TRIANGULATIONS, WEIGHTS, method_options, triangulate
from omnilines.triangulation.observations import PlaneObservations

PUBLISHED_PX = {"dual, published weights": 0.85, "averaging": 0.63, "svd": 0.62}
"""RMS of the triangulations in the dissertation, whose poses came from the point matches (by a factorisation)."""
FROM_MATRICES, FROM_MATCHES, ADJUSTMENT = "triangulation", "triangulation from matched points", "adjustment"
"""Stages: poses of the given matrices, poses from the point matches, and lines adjusted with the first of these."""
CORNER_SIGMA_PX = 0.5
"""Of the matched corners; it decides what is a gross error."""
SVD_LIMIT_PX, SECTOR_LIMIT_PX = 0.65, 0.435
SHOWN = "sector"
"""The cost whose lines and poses are written."""


@dataclass(frozen=True)
class HouseStudy:
    """Every triangulation from both kinds of poses, and every adjustment."""

    house: MatchedLines
    figures: tuple[DistanceFigures, ...]
    scenes: Mapping[str, AdjustedScene]
    """As each cost adjusts it."""

    @property
    def shown(self) -> AdjustedScene:
        """Whose lines and poses are written."""
        return self.scenes[SHOWN]

    @property
    def checks(self) -> tuple[Check, ...]:
        """What has to hold, each figure with its limit."""
        by_name = {(f.stage, f.method): f for f in self.figures}
        start, adjusted = by_name[FROM_MATRICES, "svd"], by_name[ADJUSTMENT, SHOWN]
        tracks = float(len(self.house.segments.tracks))
        fewest = float(min(start.lines, adjusted.lines))
        svd_holds, sector_holds = start.rms_px <= SVD_LIMIT_PX, adjusted.rms_px <= SECTOR_LIMIT_PX
        return (
            Check("lines of the SVD start and of the sector adjustment", fewest, tracks, "lines", fewest == tracks),
            Check("RMS of the SVD start", start.rms_px, SVD_LIMIT_PX, "px", svd_holds),
            Check("RMS after adjustment with the sector cost", adjusted.rms_px, SECTOR_LIMIT_PX, "px", sector_holds),
        )


def house_study(
    data: str | Path, averaging: Mapping[str, Any] = MappingProxyType({}), progress: ProgressCallback = silent
) -> HouseStudy:
    """Triangulate the lines of the house with every method, adjust lines and poses with every cost, measure the distances.

    Lines are triangulated twice: from the poses of the given matrices, and from poses found anew from the given point matches
    and the calibration, as in the dissertation. `averaging` holds the options of that method. Raises InputError for a folder that
    does not hold the data.
    """
    house = read_vgg_lines(data)
    figures = _triangulations(FROM_MATRICES, house, house.poses, averaging)
    progress("finding poses from point matches", 0, 0)
    figures += _triangulations(FROM_MATCHES, house, poses_of_matches(house, read_vgg_points(data)), averaging)
    scenes: dict[str, AdjustedScene] = {}
    for done, (cost, _) in enumerate(COSTS):
        progress("adjusting lines and poses", done, len(COSTS))
        scenes[cost] = reconstruct_lines(house.segments, house.poses, house.cameras, cost=cost, refine_poses=True)
        distance = np.abs(scenes[cost].residual_px)
        figures.append(figures_of(ADJUSTMENT, cost, int(scenes[cost].lines.known.sum()), distance))
    return HouseStudy(house, tuple(figures), scenes)


def poses_of_matches(house: MatchedLines, points: MatchedPoints) -> ImagePoses:
    """Poses from the point matches, in the world of the matrices: the published weights depend on the world."""
    cameras = list(house.cameras.values())
    bearings, sigma_rad = np.empty((len(points.view), 3)), np.empty(len(points.view))
    for k, camera in enumerate(cameras):
        own = points.view == k
        bearings[own], _ = camera.unproject(points.pixels[own])
        jacobian = camera.unproject_jacobian(torch.as_tensor(points.pixels[own])).detach()
        sigma_rad[own] = CORNER_SIGMA_PX * torch.linalg.matrix_norm(jacobian, ord=2).numpy()
    poses = poses_from_matches(bearings, points.view, points.point, sigma_rad)
    return align_to(replace(house.poses, cam_from_world=poses), house.poses)[0]


def _triangulations(stage: str, house: MatchedLines, given: ImagePoses, averaging: Mapping[str, Any]) -> list[DistanceFigures]:
    """Every method of the registry, and the dual space as published and with the most likely weights, from some poses."""
    arcs = arcs_from_segments(house.segments, given, house.cameras).arcs
    poses = given.cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(arcs.bearings, poses, arcs.track, arcs.tracks, arcs.by_pixel)
    methods = [(name, name, dict(averaging) if name == "averaging" else {}) for name, _ in TRIANGULATIONS]
    methods += [(f"dual, {weights} weights", "dual", method_options("dual", weights=weights)) for weights in WEIGHTS[1:]]
    found = []
    for name, method, options in methods:
        result = triangulate(method, planes, **options)
        distance = arcs.orthogonal_px(result.lines[arcs.track].projection_normal(poses)).abs().numpy()
        published_px = PUBLISHED_PX.get(name, math.nan)
        found.append(figures_of(stage, name, int(result.known.sum()), distance, published_px=published_px))
    return found
