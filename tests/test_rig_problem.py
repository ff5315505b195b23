"""The joint problem of a rig: residuals by hand, normal equations and covariance against dense ones from autograd."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_views import FISHEYE_220, MIRROR, PINHOLE, pair, setups

from camera_models.pose import Pose, adjoint
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.links import links, relative_pose, weakest_link
from omnilines.calibration.rig.own_motion import OwnMotion
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigProblem, RigState
from omnilines.calibration.rig.systematic import moved_by_radial_shifts
from omnilines.calibration.thresholds import NoiseThresholds
from omnilines.least_squares import solve
from omnilines.least_squares.groups import Groups
from omnilines.least_squares.schur import normal_equations, reduce

SHIFT_PX = NoiseThresholds().radial_shift_px
MODELS = (PINHOLE, FISHEYE_220, MIRROR)


def problem_of(free_boards: bool, held: tuple[int, ...] = (), boards: int = 2, noise_px: float = 0.3):
    """Three cameras, five frames, two boards; some views missing and uneven; a target about 0.6 m in front of all cameras."""
    generator = torch.Generator().manual_seed(3)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera, frame, board, view, place = [], [], [], [], []
    for c in range(3):
        for b in range(boards):
            for f in range(5):
                if (c + b + f) % 4 == 3:
                    continue
                count = 6 + (f + 2 * b) % 3
                view += [len(camera)] * count
                place.append(torch.cat([0.08 * random(count, 2), torch.zeros(count, 1, dtype=torch.float64)], -1))
                camera.append(c)
                frame.append(f)
                board.append(b)
    in_rig = Pose.exp(torch.cat([0.1 * random(3, 3), 0.1 * random(3, 3)], -1))
    backwards = Pose(torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64))
    cam_from_rig = Pose.stack([Pose.identity(), in_rig[1], backwards @ in_rig[2]])
    on_target = Pose.exp(torch.cat([0.2 * random(2, 3), 0.1 * random(2, 3)], -1))
    frames = Pose.exp(torch.cat([0.2 * random(5, 3), 0.05 * random(5, 3)], -1))
    ahead = Pose(torch.eye(3, dtype=torch.float64).expand(5, 3, 3), torch.tensor([0.0, 0.0, 0.6]).double().expand(5, 3))
    state = RigState(MODELS, cam_from_rig, Pose.stack([Pose.identity(), on_target[1]])[:boards], ahead @ frames)
    points = RigPoints(
        torch.tensor(view),
        torch.cat(place),
        torch.zeros(len(view), 2, dtype=torch.float64),
        0.5 + torch.rand(len(view), generator=generator, dtype=torch.float64),
        torch.tensor(camera),
        torch.tensor(frame),
        torch.tensor(frame),
        torch.tensor(board),
    )
    clean = state.residual_px(points)
    points = RigPoints(
        points.view,
        points.board_m,
        clean + noise_px * random(len(view), 2),
        points.weight,
        points.camera,
        points.frame,
        points.frame,
        points.board,
    )
    bases = [model.calibration_basis()[:, : 0 if c in held else None] for c, model in enumerate(MODELS)]
    return RigProblem(points, bases, boards, free_boards, 5), state


def flat_residual(problem, state, step):
    """All residuals after a step (kept, then eliminated), by the definition and not by the code's own chain."""
    k = problem.structure.kept_size
    moved = problem.retract(state, step[:k], step[k:].view(-1, 6))
    points, found = problem.points, []
    for c, model in enumerate(moved.models):
        rows = points.camera[points.view] == c
        view = points.view[rows]
        place = points.board_m[rows]
        for pose in (
            moved.target_from_board[points.board[view]],
            moved.rig_from_target[points.frame[view]],
            moved.cam_from_rig[c],
        ):
            rotation = pose.rotation if pose.rotation.ndim == 3 else pose.rotation[None]
            place = (rotation @ place[..., None])[..., 0] + pose.translation
        found.append((model.project(place)[0] - points.pixels[rows]) * points.weight[rows, None])
    return torch.cat(found).flatten()


CASES = [(True, ()), (False, ()), (True, (0,)), (False, (0, 1, 2))]


@pytest.mark.parametrize(("free_boards", "held"), CASES)
def test_normal_equations_are_those_of_the_dense_jacobian(free_boards, held):
    problem, state = problem_of(free_boards, held)
    k, count = problem.structure.kept_size, 5
    zero = torch.zeros(k + 6 * count, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda step: flat_residual(problem, state, step), zero)
    at = problem.linearise(state)
    torch.testing.assert_close(at.residual.flatten(), flat_residual(problem, state, zero), rtol=1e-12, atol=1e-9)
    weight = 0.5 + torch.rand(len(at.residual), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    full = jacobian * weight.repeat_interleave(2)[:, None]
    dense, right = jacobian.mT @ full, -full.mT @ at.residual.flatten()
    found = normal_equations(problem.structure, at, weight)
    size = float(dense.abs().max())
    torch.testing.assert_close(found.kept, dense[:k, :k], rtol=1e-8, atol=1e-10 * size)
    torch.testing.assert_close(found.kept_gradient, right[:k], rtol=1e-8, atol=1e-10 * size)
    torch.testing.assert_close(found.eliminated_gradient.flatten(), right[k:], rtol=1e-8, atol=1e-10 * size)
    for f in range(count):
        own = slice(k + 6 * f, k + 6 * f + 6)
        torch.testing.assert_close(found.eliminated[f], dense[own, own], rtol=1e-8, atol=1e-10 * size)
    coupling = torch.zeros(k, 6 * count, dtype=torch.float64)
    for part in problem.structure.size_classes:
        for block, columns, rows in zip(part.blocks.tolist(), part.columns, part.rows, strict=True):
            coupling[columns, 6 * block : 6 * block + 6] = found.coupling[rows]
    torch.testing.assert_close(coupling, dense[:k, k:], rtol=1e-8, atol=1e-10 * size)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("free_boards", "held"), CASES)
def test_what_each_frame_adds_is_what_it_adds_alone(free_boards, held, moving):
    problem, state = problem_of(free_boards, held)
    points = problem.points
    if moving:
        sigma = torch.full((len(points.camera), 6), 1e-3, dtype=torch.float64)
        points = replace(points, motion=OwnMotion(sigma, torch.zeros(3, dtype=torch.float64)))
        state = replace(state, moved=torch.zeros(len(points.camera), 6, dtype=torch.float64))

    def of(some):
        return RigProblem(some, problem.bases, 2, free_boards, 5)

    frames = torch.tensor([3, 0, 4])
    found = Groups.of_blocks(of(points).structure, of(points).linearise(state), frames)
    for k, frame in enumerate(frames.tolist()):
        alone = of(points.chosen(points.frame[points.view] == frame))
        at = alone.linearise(state)
        reduced = reduce(normal_equations(alone.structure, at, torch.ones(len(at.residual), dtype=torch.float64)), 0.0)
        size = float(reduced.matrix.abs().max()) + 1e-300
        torch.testing.assert_close(found.matrix[k], reduced.matrix, rtol=1e-8, atol=1e-10 * size)
        torch.testing.assert_close(found.gradient[k], reduced.right_side, rtol=1e-8, atol=1e-10 * size)


@pytest.mark.slow
def test_frames_are_compared_in_one_pass_over_them(monkeypatch):
    """Taken out one by one, each of F frames took a pass over all F: of 600 frames two thirds of the time of a calibration."""
    passes = []
    linearise = RigProblem.linearise
    monkeypatch.setattr(RigProblem, "linearise", lambda problem, state: passes.append(1) or linearise(problem, state))
    counts = []
    for frames in (20, 60):
        rig = pair(frames)
        passes.clear()
        result = calibrate_rig(rig.noisy(0.2, 1), setups(rig))
        assert len(result.frames) == frames
        counts.append(len(passes))
    assert counts[1] < counts[0] + 20


@pytest.mark.slow
@pytest.mark.parametrize(("free_boards", "held"), CASES)
def test_covariance_is_the_dense_inverse(free_boards, held):
    problem, state = problem_of(free_boards, held)
    solution = solve(problem, state)
    k = problem.structure.kept_size
    zero = torch.zeros(k + 30, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda step: flat_residual(problem, solution.state, step), zero)
    scale = jacobian.norm(dim=0)
    assert float(((jacobian / scale).mT @ flat_residual(problem, solution.state, zero)).abs().max()) < 1e-5
    inverse = torch.linalg.inv((jacobian / scale).mT @ (jacobian / scale)) / scale[:, None] / scale
    sigma = inverse.diagonal().sqrt()
    correlation = inverse / sigma[:, None] / sigma
    found = solution.kept_covariance() / sigma[:k, None] / sigma[:k]
    torch.testing.assert_close(found, correlation[:k, :k], rtol=0, atol=1e-6)
    blocks = solution.eliminated_covariance()
    assert len(blocks) == 5
    for f in range(5):
        own = slice(k + 6 * f, k + 6 * f + 6)
        torch.testing.assert_close(blocks[f] / sigma[own, None] / sigma[own], correlation[own, own], rtol=0, atol=1e-6)


def test_frames_without_a_corner_stay_where_they_are():
    problem, state = problem_of(True)
    rows = problem.points.frame[problem.points.view] != 2
    fewer = RigProblem(problem.points.chosen(rows), problem.bases, 2, True, 5)
    solution = solve(fewer, state)
    assert torch.equal(solution.state.rig_from_target.rotation[2], state.rig_from_target.rotation[2])
    assert bool(torch.isnan(solution.eliminated_covariance()[2]).all())
    assert bool(torch.isfinite(solution.kept_covariance()).all())


def test_common_shift_of_a_cameras_corners_moves_the_solution_as_predicted():
    """Against solving anew with the corners of one camera moved outwards, from corners without noise."""
    problem, state = problem_of(True, noise_px=0.0)
    solution = solve(problem, state)
    kept, frames = moved_by_radial_shifts(problem, solution, SHIFT_PX)
    points = problem.points
    sigma = solution.kept_covariance().diagonal().sqrt()
    for camera, model in enumerate(solution.state.models):
        rows = (points.camera[points.view] == camera)[:, None]
        away = points.pixels - model.centre_px
        away = away / away.norm(dim=-1, keepdim=True)
        again = RigProblem(replace(points, pixels=points.pixels + SHIFT_PX * away * rows), problem.bases, 2, True, 5)
        moved = solve(again, solution.state, damping=1e-12).state
        cameras = (moved.cam_from_rig @ solution.state.cam_from_rig.inverse()).log()[1:]
        boards = (moved.target_from_board @ solution.state.target_from_board.inverse()).log()[1:]
        values = zip(moved.models, solution.state.models, problem.bases, strict=True)
        steps = [torch.linalg.lstsq(basis, (a.parameters - b.parameters)[:, None]).solution[:, 0] for a, b, basis in values]
        found = torch.cat([*steps, cameras.flatten(), boards.flatten()])
        assert float((kept[camera] / sigma).norm()) > 1e-3
        torch.testing.assert_close(found / sigma, kept[camera] / sigma, rtol=0, atol=0.02 * float((kept[camera] / sigma).norm()))
        poses = (moved.rig_from_target @ solution.state.rig_from_target.inverse()).log()
        assert float((poses - frames[camera]).norm()) < 0.02 * float(frames[camera].norm())


def test_relative_pose_of_two_cameras_is_propagated():
    """Against poses drawn from the covariance."""
    generator = torch.Generator().manual_seed(5)
    poses = Pose.exp(torch.randn(3, 6, generator=generator, dtype=torch.float64))
    root = 1e-3 * torch.randn(18, 18, generator=generator, dtype=torch.float64)
    root[:6] = 0
    relative, covariance = relative_pose(poses, root @ root.mT, 2, 1)
    torch.testing.assert_close(relative.rotation, poses.rotation[2] @ poses.rotation[1].mT)
    steps = (root @ torch.randn(18, 20_000, generator=generator, dtype=torch.float64)).mT.reshape(-1, 3, 6)
    drawn = (Pose.exp(steps[:, 2]) @ poses[2]) @ (Pose.exp(steps[:, 1]) @ poses[1]).inverse()
    off = (drawn @ relative.inverse()).log()
    measured = off.mT @ off / len(off)
    sigma = covariance.diagonal().sqrt()
    torch.testing.assert_close(measured / sigma[:, None] / sigma, covariance / sigma[:, None] / sigma, rtol=0, atol=0.05)
    assert adjoint(relative).shape == (6, 6)


def test_weakest_link_is_the_bottleneck_of_the_best_ties():
    """Cameras 0-1-2 well tied, 3 by few corners to 2 and by more to 1."""
    seen = {(0, 0): 60, (1, 0): 60, (1, 1): 50, (2, 1): 50, (2, 2): 10, (3, 2): 10, (1, 3): 20, (3, 3): 20, (0, 4): 9}
    rows = [(c, f, k) for (c, f), count in seen.items() for k in range(count)]
    camera, frame, place = (np.array(column) for column in zip(*rows, strict=True))
    poses = Pose.exp(torch.randn(4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    found = links(
        camera,
        frame,
        place[:, None],
        np.ones((len(rows), 2)),
        cam_from_rig=poses,
        covariance=torch.zeros(24, 24, dtype=torch.float64),
    )
    assert {(link.first, link.second): (link.frames, link.corners) for link in found} == {
        (0, 1): (1, 60),
        (1, 2): (1, 50),
        (2, 3): (1, 10),
        (1, 3): (1, 20),
    }
    assert all(abs(link.rms_px_per_point - 2**0.5) < 1e-12 for link in found)
    weakest = weakest_link(found, 4)
    assert weakest is not None and (weakest.first, weakest.second, weakest.corners) == (1, 3, 20)
    centre = poses.centre
    assert abs(found[0].baseline_m - float((centre[0] - centre[1]).norm())) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("free_boards", [False, True])
def test_a_bent_board_moves_residuals_as_its_derivatives_say(free_boards):
    """Against automatic derivatives of the residuals, with the terms of the shape behind those of cameras and boards."""
    problem, state = problem_of(free_boards)
    shape = BoardShape.to_refine(("aspect", "surface"), problem.points.board_m)
    shape = shape.moved(torch.linspace(-1e-3, 2e-3, len(shape.terms), dtype=torch.float64))
    bent = RigProblem(problem.points, problem.bases, 2, free_boards, 5, shape)
    state = replace(state, shape=shape)
    k, terms = bent.structure.kept_size, shape.free.shape[1]
    assert terms == 13 and k == problem.structure.kept_size + terms

    def residual(step):
        moved = bent.retract(state, step, torch.zeros(5, 6, dtype=torch.float64))
        return (moved.residual_px(bent.points) * bent.points.weight[:, None]).flatten()

    jacobian = torch.autograd.functional.jacobian(residual, torch.zeros(k, dtype=torch.float64))
    at = bent.linearise(state)
    found = normal_equations(bent.structure, at, torch.ones(len(at.residual), dtype=torch.float64))
    dense = jacobian.mT @ jacobian
    torch.testing.assert_close(found.kept, dense, rtol=1e-8, atol=1e-10 * float(dense.abs().max()))
