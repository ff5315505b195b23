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
from omnilines.adjustment.lines import adjust_lines, lost_frames, lost_lines
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome
from omnilines.pipelines.adjust import adjust
from omnilines.pipelines.frame_notes import unplaced_notes
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


@pytest.mark.parametrize(("shown", "placed"), [(1, False), (2, False), (5, True)])
@pytest.mark.parametrize("cost", ["whitened", "sector"])
def test_a_photo_that_shows_too_few_lines_to_be_placed_leaves_the_others_their_covariances(
    shown: int, placed: bool, cost: str
) -> None:
    scene, photo = room("panorama"), 2
    segments, poses = tables(scene)
    of_photo = np.flatnonzero(segments.image == photo)
    segments = segments.rows(np.setdiff1d(np.arange(len(segments)), of_photo[shown:]))
    found = scene_adjustment.reconstruct_lines(
        segments, poses, Calibration({"cam0": scene.camera}), triangulation="ml", cost=cost, refine_poses=True
    )
    others = [k for k in range(len(poses)) if k != photo]
    assert found.adjusted.outcome is Outcome.CONVERGED and found.poses.covariance is not None
    assert np.isfinite(found.lines.sigma_m[found.lines.known]).all() and (found.poses.covariance[others] != 0.0).any((1, 2)).all()
    assert found.unplaced == (() if placed else (poses.images[photo],)) and len(found.residual_px) == len(found.table.rows)
    assert bool(np.isfinite(found.poses.covariance[photo]).all()) is placed
    moved = (found.poses.cam_from_world[photo] @ scene.poses[photo].inverse()).log()
    assert bool((moved.abs() > 1e-12).any()) is placed
    (note,) = unplaced_notes(found) or ("",)
    assert ("2.png shows too few lines to tell where it was taken" in note) is not placed
    # As if the photo were not there.
    if not placed:
        rest = segments.rows(np.flatnonzero(segments.image != photo))
        alone = scene_adjustment.reconstruct_lines(
            rest, poses, Calibration({"cam0": scene.camera}), triangulation="ml", cost=cost, refine_poses=True
        )
        np.testing.assert_array_equal(found.lines.sigma_m, alone.lines.sigma_m)
        assert found.lines.status == alone.lines.status


def test_photos_that_all_show_too_few_lines_are_told_that_nothing_is_determined() -> None:
    scene = room("panorama")
    segments, poses = tables(scene)
    some = np.flatnonzero(np.isin(segments.track, np.unique(segments.track)[:2]))
    found = adjust(segments.rows(some), poses, scene.camera)
    assert found.adjusted.adjusted.outcome is Outcome.DEGENERATE and found.adjusted.unplaced == ()
    assert any("No uncertainty is stated: hold the poses" in note for note in found.notes)


def test_a_pose_is_lost_where_its_lines_tell_it_no_better_than_asked() -> None:
    """Against the covariance of that pose alone, adjusted to lines that are held."""
    scene, photo = room("panorama"), 2
    segments, poses = tables(scene)
    of_photo = np.flatnonzero(segments.image == photo)
    rows = np.setdiff1d(np.arange(len(segments)), np.random.default_rng(1).permutation(of_photo)[3:])
    arcs = arcs_from_segments(segments.rows(rows), poses, Calibration({"cam0": scene.camera})).arcs
    held, every = torch.arange(len(poses)) != photo, torch.ones(arcs.tracks, dtype=torch.bool)
    alone = adjust_lines(arcs, scene.truth(), scene.poses, cost="whitened", held=held, held_lines=every)
    turn, move = np.sqrt(np.diagonal(alone.pose_covariance[photo].numpy())).reshape(2, 3).max(1) / alone.noise_factor
    centre = alone.state.cam_from_world.centre[photo]
    distance = float(scene.truth()[arcs.track[arcs.image == photo]].distance_to(centre[None]).median())
    least = max(float(turn), float(move) / distance)
    for share, lost in ((0.99 * least, [photo]), (1.01 * least, [])):
        assert torch.nonzero(lost_frames(arcs, alone.state, share)).flatten().tolist() == lost
        assert torch.nonzero(lost_frames(arcs, alone.state, 5.0 * share, 5.0)).flatten().tolist() == lost
