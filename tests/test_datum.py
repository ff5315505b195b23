"""The frame of a scene that nothing holds: photos count in it by what is known of them, in state and covariances alike."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_scene import RigScene, disturbed
from test_adjustment import NOISE_PX, Scene, none_held, rotation_vector
from torch import Tensor

from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.datum import constraint, framed, known_of_poses
from omnilines.adjustment.information import pose_information
from omnilines.adjustment.lines import adjust_lines, end_sigma_m
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome
from omnilines.least_squares.datum import weighed

FEW = 4


def with_few(arcs: MatchedArcs, photo: int = 0) -> MatchedArcs:
    """Arcs of which one photo has a few only."""
    own = torch.nonzero(arcs.image == photo).flatten()
    kept = torch.ones(len(arcs), dtype=torch.bool)
    kept[own[FEW:]] = False
    return arcs.rows(kept)


def problem_at(scene: Scene, arcs: MatchedArcs, state: LinesAndPoses, held_lines: Tensor | None = None) -> LineProblem:
    return LineProblem(arcs, "whitened", Freedom(none_held(scene), held_lines), state)


def test_the_constraint_tells_the_similarity_that_is_nearest_in_standard_deviations() -> None:
    rng = np.random.default_rng(0)
    blocks, dim, size = 7, 6, 4
    roots = rng.standard_normal((blocks, dim, dim)) * 10 ** rng.uniform(-2, 2, (blocks, 1, 1))
    gauge, step = rng.standard_normal((blocks * dim, size)), rng.standard_normal(blocks * dim)
    found = weighed(gauge, roots.transpose(0, 2, 1) @ roots)
    np.testing.assert_allclose(found.T @ gauge, np.eye(size), atol=1e-9)
    rooted = np.zeros((blocks * dim, blocks * dim))
    for k, root in enumerate(roots):
        rooted[dim * k : dim * k + dim, dim * k : dim * k + dim] = root
    nearest = np.linalg.lstsq(rooted @ gauge, rooted @ step, rcond=None)[0]
    np.testing.assert_allclose(found.T @ step, nearest, rtol=1e-8, atol=1e-10)
    # What no block tells is not made up.
    assert np.isnan(weighed(gauge, np.zeros((blocks, dim, dim)))).all()


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["sector", "whitened"])
def test_a_photo_of_few_arcs_makes_nothing_else_uncertain(cost: str) -> None:
    """From the true poses errors are plain differences, those of the frame included; their squared z-scores average to one."""
    scene = Scene(cameras=10, lines=30)
    whole: list[Tensor] = []
    few: list[Tensor] = []
    of_poses, of_lines = [], []
    for seed in range(10):
        arcs = scene.arcs(NOISE_PX, seed, stated_px=NOISE_PX)
        plain = adjust_lines(arcs.rows(arcs.image != 0), scene.lines, scene.poses, cost=cost)
        found = adjust_lines(with_few(arcs), scene.lines, scene.poses, cost=cost)
        assert plain.outcome is found.outcome is Outcome.CONVERGED
        chart = found.state.chart
        for sigmas, one in ((whole, plain), (few, found)):
            sigmas.append(end_sigma_m(one.state.chart, one.line_covariance, scene.ends))
        error = (found.state.cam_from_world @ scene.poses.inverse()).log()
        of_poses.append((error * torch.linalg.solve(found.pose_covariance, error)).sum(-1) / 6)
        true = LineChart.from_lines(scene.lines, chart.centre, chart.scale)
        step = torch.cat([rotation_vector(chart.S.mT @ true.S), (true.phi - chart.phi)[:, None]], 1)
        of_lines.append((step * torch.linalg.solve(found.line_covariance, step)).sum(-1) / 4)
    # With all photos alike it is up to several times as much, by how badly the one is known.
    assert 0.97 < float((torch.stack(few) / torch.stack(whole)).mean()) < 1.01
    assert 0.75 < float(torch.stack(of_poses).mean()) < 1.3
    assert 0.8 < float(torch.stack(of_lines).mean()) < 1.25


def test_uncertainties_do_not_depend_on_the_unit_of_length() -> None:
    scene = Scene(cameras=6, lines=15)
    found = {}
    for unit in (1.0, 1000.0):
        poses = replace(scene.poses, translation=scene.poses.translation * unit)
        lines = replace(scene.lines, moment=scene.lines.moment * unit)
        arcs = scene.arcs(NOISE_PX, stated_px=NOISE_PX)
        found[unit] = adjust_lines(arcs, lines, poses, cost="whitened")
    one, other = found.values()
    sizes = torch.tensor([1.0, 1.0, 1.0, 1000.0, 1000.0, 1000.0], dtype=torch.float64)
    expected = sizes[:, None] * one.pose_covariance * sizes
    spread = expected.diagonal(dim1=1, dim2=2).sqrt()
    assert bool(((other.pose_covariance - expected).abs() < 1e-4 * spread[:, :, None] * spread[:, None]).all())
    sigma, sigma_mm = (
        end_sigma_m(adjusted.state.chart, adjusted.line_covariance, unit * scene.ends) for unit, adjusted in found.items()
    )
    torch.testing.assert_close(sigma_mm, 1000.0 * sigma, rtol=1e-4, atol=0)


@pytest.mark.parametrize("away", [0.05, 0.7])
@pytest.mark.parametrize("held", [False, True])
def test_a_scene_is_framed_by_a_similarity_of_what_is_free(held: bool, away: float) -> None:
    """Turned, moved and grown as a whole it comes back, but for what holds it."""
    scene = Scene(cameras=6, lines=12)
    arcs = with_few(scene.arcs())
    start = LinesAndPoses(scene.poses, LineChart.about_cameras(scene.lines, scene.poses.centre[arcs.image], arcs.track))
    lines = torch.zeros(len(scene.lines), dtype=torch.bool)
    lines[0] = held
    problem = problem_at(scene, arcs, start, lines)
    similarities = problem.similarities(start)
    size = similarities.columns.shape[1]
    assert size == (3 if held else 7)
    much = away * torch.randn(size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    scale, motion = similarities.after(much)
    gone = start.chart.after_similarity(scale, motion)
    moved = LinesAndPoses(scene.poses.after_similarity(scale, motion), gone)
    # Points that move along look as before.
    points = scale * scene.ends[:, 0] @ motion.rotation.mT + motion.translation
    seen = moved.cam_from_world[:, None].transform(points[None, :, None])
    torch.testing.assert_close(seen, scale * scene.poses[:, None].transform(scene.ends[None, :, :1]), rtol=0, atol=1e-10)
    assert float(gone.lines().distance_to(points).max()) < 1e-10
    if held:
        # The held line is where it was: along itself, about itself and about a place on it.
        assert float(gone.lines()[:1, None].distance_to(scene.ends[:1]).max()) < 1e-12
    back = framed(problem_at(scene, arcs, moved, lines), moved, start)
    torch.testing.assert_close(back.cam_from_world.rotation, scene.poses.rotation, rtol=0, atol=1e-10)
    torch.testing.assert_close(back.cam_from_world.translation, scene.poses.translation, rtol=0, atol=1e-10)
    assert float(back.chart.lines()[:, None].distance_to(scene.ends).max()) < 1e-10


def steps_of(start: Pose, end: Pose) -> Tensor:
    """Turns, and centres that moved, in the cameras."""
    moved = -(end.rotation @ (end.centre - start.centre)[..., None])[..., 0]
    return torch.cat([rotation_vector(end.rotation @ start.rotation.mT), moved], -1)


def test_an_adjusted_scene_is_in_the_frame_of_its_start() -> None:
    """The photos that are known say where it is; one that has gone astray, with few arcs, comes back alone."""
    scene = Scene(cameras=8, lines=25)
    arcs = with_few(scene.arcs(NOISE_PX, stated_px=NOISE_PX))
    off = torch.zeros(len(scene.poses), 6, dtype=torch.float64)
    off[0] = torch.tensor([0.01, -0.01, 0.01, 0.2, -0.1, 0.1])
    start = Pose.exp(off) @ scene.poses
    exact, found = (adjust_lines(arcs, scene.lines, poses) for poses in (scene.poses, start))
    away = found.state.chart.lines()[:, None].distance_to(exact.state.chart.lines()[:, None].closest_point(scene.ends))
    # 39 mm with all photos alike.
    assert float(away.amax(-1).median()) < 0.012
    problem = problem_at(scene, arcs, found.state)
    in_step = constraint(problem, found.state, known_of_poses(problem, found.state))
    assert float((in_step.mT @ steps_of(start, found.state.cam_from_world).flatten()).abs().max()) < 1e-9


def test_a_refined_rig_is_framed_with_its_baselines() -> None:
    scene = RigScene(frames=8, lines=40)
    start = disturbed(scene.rig_from_world, 0.3, 0.01)
    found = adjust_lines(scene.arcs(0.2), scene.lines, start, rig=scene.rig, refine_rig=True, cost="whitened")
    assert found.outcome is Outcome.CONVERGED and found.state.rig is not None
    free = torch.zeros(len(start), dtype=torch.bool)
    problem = LineProblem(scene.arcs(0.2), "whitened", Freedom(free, rig=True), found.state)
    known = known_of_poses(problem, found.state)
    assert known is not None and len(known) == len(start) + len(problem.rig_cameras)
    mounts = [rig.cam_from_rig[problem.rig_cameras] for rig in (scene.rig, found.state.rig)]
    steps = torch.cat([steps_of(start, found.state.rig_from_world), steps_of(*mounts)]).flatten()
    in_step = constraint(problem, found.state, known)
    assert in_step.shape[1] == 7 and float((in_step.mT @ steps).abs().max()) < 1e-9


def test_what_arcs_say_of_poses_is_that_of_a_dense_jacobian() -> None:
    scene = Scene(cameras=5, lines=10)
    arcs = scene.arcs(NOISE_PX, stated_px=NOISE_PX)
    state = LinesAndPoses(scene.poses, LineChart.about_cameras(scene.lines, scene.poses.centre[arcs.image], arcs.track))
    problem = problem_at(scene, arcs, state)
    kept = torch.zeros(problem.structure.kept_size, dtype=torch.float64)
    none = torch.zeros(arcs.tracks, 4, dtype=torch.float64)
    jacobian = torch.func.jacrev(lambda k: problem.linearise(problem.retract(state, k, none)).residual.flatten())(kept)
    known, of_rig = pose_information(arcs, state)
    torch.testing.assert_close(torch.block_diag(*known), jacobian.mT @ jacobian, rtol=1e-9, atol=1e-6)
    assert not len(of_rig)


def test_photos_count_as_they_are_known() -> None:
    """One that is alike counts alike, one of few arcs little, one that its arcs leave undetermined not at all."""
    scene = Scene(cameras=8, lines=25)
    arcs = with_few(scene.arcs(), photo=3)
    arcs = arcs.rows((arcs.image != 5) | (torch.cumsum(arcs.image == 5, 0) <= 2))
    state = LinesAndPoses(scene.poses, LineChart.about_cameras(scene.lines, scene.poses.centre[arcs.image], arcs.track))
    known = known_of_poses(problem_at(scene, arcs, state), state)
    assert known is not None
    share = known[:, 0, 0] / known[:, 0, 0].max()
    assert float(known[5].abs().max()) == 0.0 and float(share[3]) < 0.1
    rest = share[[0, 1, 2, 4, 6, 7]]
    assert float(rest.min()) > 0.2
    # Turns in radians, shifts over the distance of the lines, about 3 m.
    torch.testing.assert_close(known, torch.diag_embed(known.diagonal(dim1=1, dim2=2)), rtol=0, atol=0)
    assert 2.0 < float((known[0, 0, 0] / known[0, 5, 5]).sqrt()) < 5.0


@pytest.mark.parametrize("of", ["nothing", "a camera"])
def test_degenerate_scenes_keep_finite_poses(of: str) -> None:
    """Without a line they stay as they are; the lines of others all lie in the one centre of all cameras."""
    scene = Scene(cameras=4, lines=6)
    arcs = scene.arcs()
    poses = Pose(scene.poses.rotation, torch.zeros_like(scene.poses.translation))
    lines = PlueckerLines.from_points(torch.zeros(6, 3, dtype=torch.float64), scene.ends[:, 1])
    chart = LineChart.from_lines(lines, scene.ends[:, 0], torch.ones(6, dtype=torch.float64))
    if of == "nothing":
        chart = replace(chart, phi=torch.full_like(chart.phi, torch.nan))
    state = LinesAndPoses(poses, chart)
    problem = problem_at(scene, arcs, state)
    known = known_of_poses(problem, state)
    assert known is not None and torch.isfinite(known).all()
    end = framed(problem, state, LinesAndPoses(scene.poses, chart))
    if of == "nothing":
        assert float(known.abs().max()) == 0.0 and end is state
    assert torch.isfinite(end.cam_from_world.rotation).all() and torch.isfinite(end.cam_from_world.translation).all()
