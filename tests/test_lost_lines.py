"""A line that comes to lie in a camera while it is adjusted is named; the others, and the poses, keep their covariances."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from matching_scenes import MatchingScene, room

import omnilines.adjustment.scene as scene_adjustment
from camera_models import Calibration
from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs, arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, lost_lines
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome
from omnilines.records import ImagePoses, Segments

NOISE_PX, LOST = 0.1, 7


def tables(scene: MatchingScene) -> tuple[Segments, ImagePoses]:
    rng = np.random.default_rng(0)
    pixels = scene.pixels.numpy() + NOISE_PX * rng.standard_normal(scene.pixels.shape)
    names = tuple(f"{k}.png" for k in range(len(scene.poses)))
    tracks = tuple(f"line{k}" for k in range(len(scene.ends_m)))
    covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(pixels), 2, 2, 2)).copy()
    cameras = ("cam0",) * len(names)
    segments = Segments(scene.image, names, scene.line, tracks, pixels, covariance_px2=covariance, cameras=cameras)
    return segments, ImagePoses(names, scene.poses, cameras)


def in_a_camera(state: LinesAndPoses, arcs: MatchedArcs, line: int) -> LinesAndPoses:
    """That line as it is, but through the centre of the first camera that sees it."""
    direction = state.chart.lines().direction.clone()
    moment = state.chart.lines().moment.clone()
    centre = state.cam_from_world.centre[arcs.image[arcs.track == line][0]]
    moment[line] = torch.linalg.cross(centre, direction[line])
    moved = PlueckerLines(direction, moment)
    return replace(state, chart=LineChart.from_lines(moved, state.chart.centre, state.chart.scale))


def named(arcs: MatchedArcs, state: LinesAndPoses) -> dict[str, list[int]]:
    return {status: torch.nonzero(some).flatten().tolist() for status, some in lost_lines(arcs, state).items()}


def test_lines_whose_planes_coincide_are_told_from_those_in_a_camera() -> None:
    """All cameras at one place, and none of the centres that lines are charted about."""
    scene = room("panorama")
    segments, poses = tables(scene)
    arcs = arcs_from_segments(segments, poses, Calibration({"cam0": scene.camera})).arcs
    centre = scene.poses.centre.mean(0).expand(len(scene.poses), 3)
    together = Pose(scene.poses.rotation, -(scene.poses.rotation @ centre[..., None])[..., 0])
    chart = LineChart.about_cameras(scene.truth(), scene.poses.centre[arcs.image], arcs.track)
    found = named(arcs, LinesAndPoses(together, chart))
    assert found == {"through_centre": [], "parallel_planes": list(range(len(scene.ends_m)))}


def test_a_lost_line_is_left_out_and_the_others_are_adjusted(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, turns = room("panorama"), []
    segments, poses = tables(scene)

    def losing(arcs: MatchedArcs, *given: Any, **more: Any) -> Adjusted:
        found = adjust_lines(arcs, *given, **more)
        turns.append(arcs.tracks)
        if len(turns) > 1:
            return found
        assert not any(some.any() for some in lost_lines(arcs, found.state).values())
        lost = in_a_camera(found.state, arcs, LOST)
        assert named(arcs, lost) == {"through_centre": [LOST], "parallel_planes": []}
        return replace(found, state=lost, outcome=Outcome.DEGENERATE)

    monkeypatch.setattr(scene_adjustment, "adjust_lines", losing)
    cameras = Calibration({"cam0": scene.camera})
    found = scene_adjustment.reconstruct_lines(segments, poses, cameras, refine_poses=True)
    assert turns == [len(scene.ends_m), len(scene.ends_m) - 1] and found.adjusted.outcome is Outcome.CONVERGED
    others = np.arange(len(scene.ends_m)) != LOST
    assert found.lines.status[LOST] == "through_centre" and not found.lines.known[LOST]
    assert found.lines.known[others].all() and np.isfinite(found.lines.sigma_m[others]).all()
    assert found.poses.covariance is not None and np.isfinite(found.poses.covariance).all()
