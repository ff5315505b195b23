"""Adjustment of lines and poses: Jacobians against autograd, the gauge, convergence, and covariances against Monte Carlo."""

import math

import pytest
import torch
from torch import Tensor

from camera_models import GeometryError, InputError, OpenCVFisheye
from camera_models.pose import Pose, rotation_from_vector
from omnilines.adjustment.accuracy import align_lines, predict_error
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs, Observed
from omnilines.adjustment.lines import adjust_lines, end_sigma_m
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.costs import COSTS
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome
from omnilines.least_squares.schur import normal_equations

CAMERA = OpenCVFisheye([320.0, 322.0, 510.0, 390.0, 0.02, -0.01, 0.002, 0.0], (1032, 778))
NOISE_PX = 0.3


class Scene:
    """Cameras around a cloud of segments about 3 m away, every segment seen by most of them."""

    def __init__(self, cameras: int = 8, lines: int = 25, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self.ends = normal(lines, 2, 3) + torch.tensor([0.0, 0.0, 3.0])
        rotation = rotation_from_vector(0.15 * normal(cameras, 3))
        centre = normal(cameras, 3) * torch.tensor([1.0, 1.0, 0.3])
        self.poses = Pose(rotation, -(rotation @ centre[..., None])[..., 0])
        self.lines = PlueckerLines.from_points(self.ends[:, 0], self.ends[:, 1])
        image, track = (grid.flatten() for grid in torch.meshgrid(torch.arange(cameras), torch.arange(lines), indexing="ij"))
        seen, valid = CAMERA.project(self.poses[image].transform(self.ends[track]))
        keep = valid.all(-1) & (torch.rand(len(image), generator=generator) < 0.9)
        self.image, self.track, self.pixels = image[keep], track[keep], seen[keep]

    def arcs(self, noise_px: float = 0.0, seed: int = 0, stated_px: float | None = None) -> MatchedArcs:
        random = torch.randn(self.pixels.shape, generator=torch.Generator().manual_seed(1000 + seed), dtype=torch.float64)
        pixels = self.pixels + noise_px * random
        bearings, valid = CAMERA.unproject(pixels)
        assert valid.all()
        covariance = (stated_px or 1.0) ** 2 * torch.eye(2, dtype=torch.float64).expand(len(pixels), 2, 2, 2)
        jacobian = CAMERA.unproject_jacobian(pixels)
        observed = Observed(pixels, torch.zeros_like(self.image))
        plain = MatchedArcs(
            self.image,
            self.track,
            len(self.poses),
            len(self.ends),
            bearings,
            jacobian,
            covariance,
            stated_px is not None,
            observed=observed,
        )
        return plain.seen_by([CAMERA])

    def disturbed(self, angle_deg: float, shift_m: float, seed: int = 0) -> Pose:
        random = torch.randn(len(self.poses), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return Pose.exp(random * torch.tensor([math.radians(angle_deg)] * 3 + [shift_m] * 3)) @ self.poses


def state_of(scene: Scene, arcs: MatchedArcs, poses: Pose | None = None) -> LinesAndPoses:
    poses = poses or scene.poses
    return LinesAndPoses(poses, LineChart.about_cameras(scene.lines, poses.centre[arcs.image], arcs.track))


def none_held(scene: Scene, *held: int) -> Tensor:
    mask = torch.zeros(len(scene.poses), dtype=torch.bool)
    mask[list(held)] = True
    return mask


def dense_jacobian(problem: LineProblem, state: LinesAndPoses) -> tuple[Tensor, Tensor]:
    """d residual / d kept and / d eliminated, by automatic differentiation through the retraction."""
    kept = torch.zeros(problem.structure.kept_size, dtype=torch.float64)
    eliminated = torch.zeros(problem.arcs.tracks, 4, dtype=torch.float64)

    def residual(k: Tensor, e: Tensor) -> Tensor:
        return problem.linearise(problem.retract(state, k, e)).residual.flatten()

    by_kept, by_line = torch.func.jacrev(residual, argnums=(0, 1))(kept, eliminated)
    return by_kept, by_line.flatten(1)


@pytest.mark.parametrize("cost", [name for name, _ in COSTS])
@pytest.mark.parametrize("held", [(), (2,), (0, 3)])
def test_analytic_jacobian_is_that_of_autograd_through_the_retraction(cost: str, held: tuple[int, ...]) -> None:
    scene = Scene(cameras=5, lines=8)
    arcs = scene.arcs(NOISE_PX)
    state = state_of(scene, arcs, scene.disturbed(1.0, 0.01))
    problem = LineProblem(arcs, cost, Freedom(none_held(scene, *held)), state)
    at = problem.linearise(state)
    by_kept, by_line = dense_jacobian(problem, state)
    rows = torch.arange(len(arcs))
    size = at.residual.shape[1]
    dense_line = torch.zeros(len(arcs), size, arcs.tracks, 4, dtype=torch.float64)
    dense_line[rows, :, arcs.track] = at.by_eliminated
    group = problem.structure.groups[0]
    dense_kept = torch.zeros(len(arcs), size, group.count, 6, dtype=torch.float64)
    free = group.index >= 0
    dense_kept[rows[free], :, group.index[free]] = at.by_kept[0][free]
    scale = float(by_line.abs().max())
    torch.testing.assert_close(dense_line.reshape(by_line.shape), by_line, rtol=0, atol=1e-10 * scale)
    torch.testing.assert_close(dense_kept.reshape(by_kept.shape), by_kept, rtol=0, atol=1e-10 * scale)


@pytest.mark.parametrize(("held", "columns"), [((), 7), ((3,), 1), ((1, 4), 0)])
def test_gauge_columns_are_exact_null_directions(held: tuple[int, ...], columns: int) -> None:
    scene = Scene(cameras=6, lines=12)
    arcs = scene.arcs(NOISE_PX)
    # Away from the solution too: a common similarity changes no residual anywhere.
    state = state_of(scene, arcs, scene.disturbed(2.0, 0.05))
    problem = LineProblem(arcs, "sector", Freedom(none_held(scene, *held)), state)
    gauge = problem.motions(state)
    assert gauge.shape == (problem.structure.kept_size, columns)
    by_kept, by_line = dense_jacobian(problem, state)
    # The lines move along with the poses: J (gauge column, some line step) = 0.
    moved = by_kept @ gauge
    lines = torch.linalg.lstsq(by_line, -moved).solution
    torch.testing.assert_close(by_line @ lines, -moved, rtol=0, atol=1e-11)
    rank = int(torch.linalg.matrix_rank(torch.cat([by_kept, by_line], 1), rtol=1e-10))
    assert rank == by_kept.shape[1] + by_line.shape[1] - columns


# Of the scene's lines 0 and 1 are skew; 0 and its parallel leave a shift, 0 and one that meets it a growth.
@pytest.mark.parametrize(
    ("second", "poses", "columns"),
    [(None, (), 3), ("parallel", (), 1), ("meets", (), 1), ("skew", (), 0), (None, (2,), 0)],
)
def test_held_lines_leave_open_what_moves_none_of_them(second: str | None, poses: tuple[int, ...], columns: int) -> None:
    scene = Scene(cameras=6, lines=12)
    if second in ("parallel", "meets"):
        first = scene.ends[0]
        shift = torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64)
        scene.ends[1] = first + shift if second == "parallel" else torch.stack([first[0], first[1] + shift])
        scene.lines = PlueckerLines.from_points(scene.ends[:, 0], scene.ends[:, 1])
    arcs = scene.arcs(NOISE_PX)
    held = torch.zeros(arcs.tracks, dtype=torch.bool)
    held[: 1 if second is None else 2] = True
    state = state_of(scene, arcs)
    problem = LineProblem(arcs, "sector", Freedom(none_held(scene, *poses), held), state)
    gauge = problem.motions(state)
    assert gauge.shape[1] == columns
    by_kept, by_line = dense_jacobian(problem, state)
    by_line = by_line.unflatten(1, (-1, 4))[:, ~held].flatten(1)
    moved = by_kept @ gauge
    if columns:
        lines = torch.linalg.lstsq(by_line, -moved).solution
        torch.testing.assert_close(by_line @ lines, -moved, rtol=0, atol=1e-11)
    rank = int(torch.linalg.matrix_rank(torch.cat([by_kept, by_line], 1), rtol=1e-10))
    assert rank == by_kept.shape[1] + by_line.shape[1] - columns


def test_one_held_line_gives_finite_covariances() -> None:
    scene = Scene()
    held = torch.zeros(len(scene.lines), dtype=torch.bool)
    held[0] = True
    for cost in ("sector", "taylor-kriegman"):
        found = adjust_lines(scene.arcs(NOISE_PX), scene.lines, scene.disturbed(0.2, 0.005), cost=cost, held_lines=held)
        assert found.outcome is Outcome.CONVERGED
        assert torch.isfinite(found.line_covariance).all() and torch.isfinite(found.pose_covariance).all()


@pytest.mark.parametrize("apart_m", [0.0, 1e-6])
def test_held_poses_at_one_place_are_named(apart_m: float) -> None:
    """Two held photos from one tripod give no scale: the standard deviations would be kilometres."""
    scene = Scene()
    turn = Pose.exp(torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    second = turn.rotation @ scene.poses.rotation[0]
    rotation, translation = scene.poses.rotation.clone(), scene.poses.translation.clone()
    rotation[1], translation[1] = second, -(second @ (scene.poses.centre[0] + apart_m))
    with pytest.raises(GeometryError, match="found 2 at one place"):
        adjust_lines(scene.arcs(NOISE_PX), scene.lines, Pose(rotation, translation), held=none_held(scene, 0, 1))


def test_a_photo_without_an_arc_anchors_nothing() -> None:
    scene = Scene()
    arcs = scene.arcs(NOISE_PX)
    rest = arcs.rows(arcs.image != 2)
    adjusted = adjust_lines(rest, scene.lines, scene.disturbed(0.2, 0.005))
    assert adjusted.outcome is Outcome.CONVERGED
    assert torch.isfinite(adjusted.line_covariance).all()
    assert float(adjusted.pose_covariance[2].abs().max()) == 0


@pytest.mark.parametrize("cost", ["sector", "whitened"])
def test_same_optimum_from_poses_off_by_a_degree_and_a_centimetre(cost: str) -> None:
    scene = Scene()
    arcs = scene.arcs(NOISE_PX)
    reference = adjust_lines(arcs, scene.lines, scene.poses, cost=cost)
    assert reference.outcome is Outcome.CONVERGED
    compared = 0
    for seed in range(3):
        adjusted = adjust_lines(arcs, scene.lines, scene.disturbed(1.0, 0.01, seed), cost=cost)
        assert adjusted.outcome is Outcome.CONVERGED
        assert adjusted.initial_cost > 3 * reference.cost
        assert adjusted.cost == pytest.approx(reference.cost, rel=1e-6)
        ours, theirs = (a.state.chart.lines() for a in (adjusted, reference))
        points = scene.lines[:, None].closest_point(scene.ends)
        aligned = align_lines(ours, points, theirs[:, None].closest_point(points))
        assert aligned.rms_m < 1e-5
        compared += 1
    assert compared == 3


def test_held_poses_do_not_move_and_only_lines_are_refined_when_asked() -> None:
    scene = Scene()
    arcs = scene.arcs(NOISE_PX)
    start = scene.disturbed(0.3, 0.005)
    adjusted = adjust_lines(arcs, scene.lines, start, held=none_held(scene, 1, 5))
    for k in (1, 5):
        assert torch.equal(adjusted.state.cam_from_world.rotation[k], start.rotation[k])
        assert torch.equal(adjusted.state.cam_from_world.translation[k], start.translation[k])
        assert float(adjusted.pose_covariance[k].abs().max()) == 0
    assert float((adjusted.state.cam_from_world.rotation[0] - start.rotation[0]).abs().max()) > 1e-4
    only_lines = adjust_lines(arcs, scene.lines, scene.poses, refine_poses=False)
    assert torch.equal(only_lines.state.cam_from_world.rotation, scene.poses.rotation)
    assert only_lines.outcome is Outcome.CONVERGED
    # Each line by itself against Gauss-Newton with the dense Jacobian: nothing is left to gain.
    problem = LineProblem(arcs, "sector", Freedom(torch.ones(len(start), dtype=torch.bool)), only_lines.state)
    at = problem.linearise(only_lines.state)
    gradient = normal_equations(problem.structure, at, torch.ones(len(arcs), dtype=torch.float64)).eliminated_gradient
    assert float(gradient.abs().max()) < 1e-7
    with pytest.raises(InputError, match="not held was expected"):
        adjust_lines(arcs, scene.lines, start, held=torch.ones(len(start), dtype=torch.bool))
    with pytest.raises(InputError, match="one of sector, whitened, taylor-kriegman, bartoli-sturm, found 'huber'"):
        adjust_lines(arcs, scene.lines, start, cost="huber")


def adjusted_runs(scene: Scene, seeds: int, cost: str, held: Tensor) -> list[tuple[MatchedArcs, Adjusted]]:
    runs = []
    for seed in range(seeds):
        arcs = scene.arcs(NOISE_PX, seed, stated_px=NOISE_PX)
        runs.append((arcs, adjust_lines(arcs, scene.lines, scene.poses, cost=cost, held=held)))
    return runs


@pytest.mark.parametrize("cost", ["sector", "whitened"])
def test_covariances_are_those_of_monte_carlo(cost: str) -> None:
    """Two held poses fix the frame, so that errors are plain differences; their squared z-scores average to one."""
    scene = Scene(cameras=8, lines=20)
    squares_of_poses, squares_of_lines, ratios = [], [], []
    for arcs, adjusted in adjusted_runs(scene, 10, cost, none_held(scene, 0, 7)):
        assert adjusted.outcome is Outcome.CONVERGED
        assert adjusted.noise_factor == pytest.approx(1.0, abs=0.15)
        free = torch.arange(1, 7)
        error = (adjusted.state.cam_from_world[free] @ scene.poses[free].inverse()).log()
        weight = torch.linalg.inv(adjusted.pose_covariance[free])
        squares_of_poses.append((error[:, None] @ weight @ error[..., None]).flatten() / 6)
        chart = adjusted.state.chart
        # The chart of the truth about the same centres; a small step between the two is their difference.
        true = LineChart.from_lines(scene.lines, chart.centre, chart.scale)
        step = torch.cat([rotation_vector(chart.S.mT @ true.S), (true.phi - chart.phi)[:, None]], 1)
        line_weight = torch.linalg.inv(adjusted.line_covariance)
        squares_of_lines.append((step[:, None] @ line_weight @ step[..., None]).flatten() / 4)
        sigma = end_sigma_m(chart, adjusted.line_covariance, scene.ends)
        distance = adjusted.state.chart.lines()[:, None].distance_to(scene.ends)
        ratios.append(distance.amax(-1) / sigma)
        assert len(arcs) == len(scene.track)
    # 10 runs of 6 x 6 and 20 x 4 squares, partly dependent: the standard deviation of the means is below 0.15.
    assert 0.7 < float(torch.cat(squares_of_poses).mean()) < 1.4
    assert 0.8 < float(torch.cat(squares_of_lines).mean()) < 1.25
    assert 0.5 < float(torch.cat(ratios).square().mean().sqrt()) < 2.0


def rotation_vector(rotation: Tensor) -> Tensor:
    return Pose(rotation, torch.zeros(len(rotation), 3, dtype=torch.float64)).log()[:, :3]


def test_free_gauge_lines_agree_with_the_truth_after_alignment_as_predicted() -> None:
    scene = Scene(cameras=8, lines=20)
    share = []
    for _, adjusted in adjusted_runs(scene, 10, "whitened", none_held(scene)):
        lines = adjusted.state.chart.lines()
        aligned = align_lines(lines, lines[:, None].closest_point(scene.ends), scene.ends)
        # The optimum: no similarity moves the lines closer.
        free = torch.cat([aligned.error_m.sum((0, 1)), torch.linalg.cross(aligned.points_m, aligned.error_m).sum((0, 1))])
        assert float(free.abs().max()) < 1e-6
        share.append((aligned.rms_m / predict_error(adjusted, aligned).rms_m) ** 2)
    assert len(share) == 10
    assert 0.75 < sum(share) / len(share) < 1.3


def test_joint_covariance_holds_the_single_ones_and_is_the_dense_inverse() -> None:
    scene = Scene(cameras=5, lines=8)
    arcs = scene.arcs(NOISE_PX, stated_px=NOISE_PX)
    adjusted = adjust_lines(arcs, scene.lines, scene.poses, cost="whitened", held=none_held(scene, 0, 4))
    tracks = torch.tensor([5, 0, 3])
    joint = adjusted.joint_line_covariance(tracks).reshape(3, 4, 3, 4)
    problem = LineProblem(arcs, "whitened", Freedom(none_held(scene, 0, 4)), adjusted.state)
    by_kept, by_line = dense_jacobian(problem, adjusted.state)
    jacobian = torch.cat([by_kept, by_line], 1)
    dense = torch.linalg.inv(jacobian.mT @ jacobian)[by_kept.shape[1] :, by_kept.shape[1] :].reshape(8, 4, 8, 4)
    expected = dense[tracks][:, :, tracks] * adjusted.noise_factor**2
    torch.testing.assert_close(joint, expected, rtol=1e-5, atol=1e-9 * float(expected.abs().max()))
    for k, track in enumerate(tracks.tolist()):
        torch.testing.assert_close(joint[k, :, k], adjusted.line_covariance[track], rtol=1e-9, atol=0)


def test_joint_covariance_of_lines_with_all_poses_held_is_that_of_each() -> None:
    scene = Scene(cameras=5, lines=8)
    adjusted = adjust_lines(scene.arcs(NOISE_PX, stated_px=NOISE_PX), scene.lines, scene.poses, refine_poses=False)
    tracks = torch.tensor([6, 1])
    joint = adjusted.joint_line_covariance(tracks).reshape(2, 4, 2, 4)
    for k, track in enumerate(tracks.tolist()):
        torch.testing.assert_close(joint[k, :, k], adjusted.line_covariance[track], rtol=1e-9, atol=0)
    assert float(joint[0, :, 1].abs().max()) == 0


def test_sector_and_whitened_costs_differ_by_less_than_their_uncertainty() -> None:
    scene = Scene()
    arcs = scene.arcs(NOISE_PX, stated_px=NOISE_PX)
    held = none_held(scene, 0, 7)
    sector, whitened = (adjust_lines(arcs, scene.lines, scene.poses, cost=cost, held=held) for cost in ("sector", "whitened"))
    apart = whitened.state.chart.lines()[:, None].distance_to(sector.state.chart.lines()[:, None].closest_point(scene.ends))
    sigma = end_sigma_m(whitened.state.chart, whitened.line_covariance, scene.ends)
    assert 0 < float((apart.amax(-1) / sigma).median()) < 0.7
    # The whitened optimum has the least whitened residuals, by little.
    normal_of = {name: a.state.normals(arcs) for name, a in (("sector", sector), ("whitened", whitened))}
    px = {name: float(arcs.orthogonal_px(normal).square().sum()) for name, normal in normal_of.items()}
    assert px["whitened"] <= px["sector"] * (1 + 1e-6) < 1.05 * px["whitened"]


def test_exact_arcs_are_fitted_exactly() -> None:
    scene = Scene()
    adjusted = adjust_lines(scene.arcs(), scene.lines, scene.disturbed(1.0, 0.01))
    assert adjusted.outcome is Outcome.CONVERGED
    lines = adjusted.state.chart.lines()
    aligned = align_lines(lines, lines[:, None].closest_point(scene.ends), scene.ends)
    assert aligned.rms_m < 1e-7
