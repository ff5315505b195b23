"""Nearest, mean and common rotations and similarities against SciPy and minimisation."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch
from scipy.spatial.transform import Rotation

from camera_models.errors import GeometryError, InputError
from camera_models.pose import Pose, rotation_from_vector
from camera_models.rotations import common_rotation, mean_rotation, nearest_rotation, similarity_alignment


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(*shape: int, seed: int) -> torch.Tensor:
    v = normal(*shape, 3, seed=seed)
    return v / v.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("reflected", [False, True])
def test_the_nearest_rotation_is_proper_and_the_minimum(reflected: bool) -> None:
    matrix = rotation_from_vector(normal(5, 3, seed=1)) + 0.2 * normal(5, 3, 3, seed=2)
    matrix[..., 0] *= -1.0 if reflected else 1.0
    nearest = nearest_rotation(matrix)
    torch.testing.assert_close(nearest @ nearest.mT, torch.eye(3, dtype=torch.float64).expand(5, 3, 3), rtol=0, atol=1e-13)
    torch.testing.assert_close(torch.linalg.det(nearest), torch.ones(5, dtype=torch.float64))
    others = rotation_from_vector(0.05 * normal(200, 1, 3, seed=3)) @ nearest
    assert bool(((others - matrix).square().sum((-1, -2)) > (nearest - matrix).square().sum((-1, -2))).all())


def test_a_rotation_is_its_own_nearest_one() -> None:
    rotation = rotation_from_vector(normal(50, 3, seed=4))
    torch.testing.assert_close(nearest_rotation(rotation), rotation, rtol=0, atol=1e-14)


def test_the_mean_rotation_is_that_of_scipy_for_every_batch_and_weight() -> None:
    rotations = rotation_from_vector(normal(4, 7, 3, seed=5))
    weight = normal(4, 7, seed=6).abs()
    mean, weighted = mean_rotation(rotations), mean_rotation(rotations, weight)
    for k in range(4):
        each = Rotation.from_matrix(rotations[k].numpy())
        np.testing.assert_allclose(mean[k], each.mean().as_matrix(), atol=1e-12)
        np.testing.assert_allclose(weighted[k], each.mean(weight[k].numpy()).as_matrix(), atol=1e-12)


def test_common_rotation_is_that_of_scipy() -> None:
    source = unit(30, seed=3)
    target = source @ torch.tensor(Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix()).mT + 0.05 * normal(30, 3, seed=4)
    expected, _ = Rotation.align_vectors(target.numpy(), source.numpy())
    np.testing.assert_allclose(common_rotation(source.numpy(), target.numpy()), expected.as_matrix(), atol=1e-7)
    with pytest.raises(GeometryError, match="on one axis"):
        common_rotation(source[:1].expand(5, 3), target[:1].expand(5, 3))


@pytest.mark.parametrize("batch", [(), (4,)])
def test_poses_take_arrays_and_answer_in_kind(batch: tuple[int, ...]) -> None:
    twist, points = normal(*batch, 6, seed=30), normal(*batch, 5, 3, seed=31)
    pose = Pose.exp(twist)
    torch.testing.assert_close(pose.log(), twist)
    moved = pose.transform(points)
    for given in (twist.numpy(), twist.tolist()):
        torch.testing.assert_close(Pose.exp(given).rotation, pose.rotation, rtol=0, atol=0)
    for given in (points.numpy(), points.tolist()):
        found = pose.transform(given)
        assert isinstance(found, np.ndarray)
        np.testing.assert_array_equal(found, moved.numpy())
    single = pose.transform(points.float())
    assert isinstance(single, torch.Tensor) and single.dtype == Pose.exp(twist.float()).rotation.dtype == torch.float64
    torch.testing.assert_close(single, moved, rtol=0, atol=1e-5)


def test_a_single_pose_is_no_batch() -> None:
    pose = Pose.exp(normal(6, seed=32))
    with pytest.raises(TypeError, match="found a single pose"):
        len(pose)
    for index in (0, slice(1), torch.tensor([0, 0, 1])):
        with pytest.raises(InputError, match="found a single pose; use it as it is"):
            pose[index]
    assert len(pose[None]) == 1
    torch.testing.assert_close(pose[None][0].translation, pose.translation)


def test_similarity_alignment_recovers_the_similarity_and_is_the_minimum() -> None:
    source = normal(4, 20, 3, seed=27)
    truth = Pose.exp(normal(4, 6, seed=28))
    scale = torch.tensor([0.1, 1.0, 3.0, 50.0], dtype=torch.float64)
    found, pose = similarity_alignment(source, truth.transform(scale[:, None, None] * source))
    torch.testing.assert_close(found, scale)
    torch.testing.assert_close(pose.rotation, truth.rotation, rtol=0, atol=1e-12)
    torch.testing.assert_close(pose.translation, truth.translation, rtol=0, atol=1e-11)
    noisy = normal(20, 3, seed=29)
    s, best = similarity_alignment(source[0].numpy(), noisy.numpy())

    def cost(x: np.ndarray) -> float:
        step = Pose.exp(torch.tensor(x[:6]))
        return float((noisy - (step @ best).transform(s * math.exp(x[6]) * source[0])).square().sum())

    assert scipy.optimize.minimize(cost, np.zeros(7), tol=1e-12).fun == pytest.approx(cost(np.zeros(7)), rel=1e-9)


def test_similarity_of_collinear_points_is_refused() -> None:
    line = torch.linspace(0, 1, 10, dtype=torch.float64)[:, None] * unit(seed=30)
    with pytest.raises(GeometryError, match="collinear"):
        similarity_alignment(line, line)
