"""The sector cost against quadrature of its defining integral and against automatic differentiation."""

import math

import numpy as np
import pytest
import scipy.integrate
import torch

from camera_models.pose import Pose
from omnilines.costs import sector
from omnilines.costs._cost import line_residual
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart


def unit(*shape: int, seed: int) -> torch.Tensor:
    v = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return v / v.norm(dim=-1, keepdim=True)


def arc(phi: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b orthonormal and V2 at the angle phi from V1 = a."""
    a, helper = unit(2, seed=seed).numpy()
    b = np.cross(np.cross(a, helper), a)
    b /= np.linalg.norm(b)
    return a, b, a * math.cos(phi) + b * math.sin(phi)


def boundary_integral(a: np.ndarray, b: np.ndarray, v2: np.ndarray, phi: float, normal: np.ndarray) -> float:
    """Integral of the squared plane distance over both radii and the arc, by quadrature."""
    m = normal / np.linalg.norm(normal)
    # Gauss-Legendre of 20 nodes integrates these smooth functions to rounding, and no term is negative.
    radii = sum(scipy.integrate.fixed_quad(lambda r, v=v: (r * (v @ m)) ** 2, 0, 1, n=20)[0] for v in (a, v2))
    on_arc = scipy.integrate.fixed_quad(lambda t: ((a @ m) * np.cos(t) + (b @ m) * np.sin(t)) ** 2, 0, phi, n=20)[0]
    return float(radii + on_arc)


@pytest.mark.parametrize("phi", [1e-4, 1e-3, 0.029, 0.031, 0.3, 1.0, math.pi / 2, 2.0, 3.0])
def test_squared_residual_is_the_integral_over_the_sector(phi: float) -> None:
    a, b, v2 = arc(phi, seed=int(phi * 1000))
    factor = sector.prepare(a, v2)
    assert isinstance(factor, np.ndarray)
    compared = 0
    # Any normal, and normals nearly across the arc: there only the small singular value of F is at work.
    for normal in [*unit(5, seed=3).numpy(), b, np.cross(a, b) + 1e-4 * b, np.cross(a, b) - 1e-4 * a + 1e-4 * b]:
        r = sector.residual(factor, normal * 7.5)
        expected = boundary_integral(a, b, v2, phi, normal)
        assert r @ r == pytest.approx(expected, rel=1e-9, abs=1e-22)
        compared += 1
    assert compared == 8


@pytest.mark.parametrize("phi", [0.0, 1e-16, 1e-12, 1e-8, math.pi - 1e-9])
def test_tiny_and_half_turn_arcs_stay_finite_with_finite_gradients(phi: float) -> None:
    a, b, v2 = arc(phi)
    v1 = torch.tensor(a, requires_grad=True)
    end = torch.tensor(v2, requires_grad=True)
    factor = sector.prepare(v1, end)
    assert torch.isfinite(factor).all()
    if phi < 1e-6:
        # phi -> 0: D = (2/3) a a', the second row is phi b / sqrt(6).
        assert torch.allclose(factor[0].detach(), torch.tensor(a) * math.sqrt(2 / 3), atol=1e-7)
        assert factor[1].norm().item() == pytest.approx(phi / math.sqrt(6), rel=1e-3, abs=1e-15)
    torch.cat([factor.flatten(), sector.residual(factor, torch.tensor(b + 0.3 * a))]).sum().backward()
    assert v1.grad is not None and torch.isfinite(v1.grad).all()
    assert end.grad is not None and torch.isfinite(end.grad).all()


def test_jacobian_by_normal_is_that_of_autograd() -> None:
    factor, normal = sector.prepare(unit(20, seed=1), unit(20, seed=2)), 4 * unit(20, seed=3)
    expected = torch.func.vmap(torch.func.jacrev(sector.residual, argnums=1))(factor, normal)
    torch.testing.assert_close(sector.jacobian(factor, normal), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shift_m", [0.0, 100.0])
def test_line_residual_jacobians_are_those_of_autograd_through_the_retractions(shift_m: float) -> None:
    generator = torch.Generator().manual_seed(5)
    n = 30
    poses = Pose.exp(torch.randn(n, 6, generator=generator, dtype=torch.float64))
    ends = torch.randn(n, 2, 3, generator=generator, dtype=torch.float64) + shift_m
    poses = Pose(
        poses.rotation, poses.translation - (poses.rotation @ torch.full((3, 1), shift_m, dtype=torch.float64)).squeeze(-1)
    )
    lines = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    chart = LineChart.from_lines(
        lines, ends[:, 0] + unit(n, seed=6), torch.rand(n, generator=generator, dtype=torch.float64) + 0.5
    )
    bearings = torch.stack([unit(n, seed=7), unit(n, seed=8)], 1)
    factor = sector.prepare(bearings[:, 0], bearings[:, 1])

    def cost(_, normal):
        return sector.residual(factor, normal), sector.jacobian(factor, normal)

    residual, by_pose, by_line = line_residual(cost, bearings, chart, poses)
    torch.testing.assert_close(residual, sector.residual(factor, lines.projection_normal(poses)), rtol=0, atol=1e-10)

    def perturbed(pose_step: torch.Tensor, line_step: torch.Tensor) -> torch.Tensor:
        # Rows are independent: the sum over them has the row Jacobians as its derivatives.
        return line_residual(cost, bearings, chart.retract(line_step), Pose.exp(pose_step) @ poses)[0].sum(0)

    zero = torch.zeros(n, 6, dtype=torch.float64)
    auto_pose, auto_line = torch.func.jacrev(perturbed, argnums=(0, 1))(zero, zero[:, :4])
    torch.testing.assert_close(by_pose, auto_pose.transpose(0, 1), rtol=0, atol=1e-9)
    torch.testing.assert_close(by_line, auto_line.transpose(0, 1), rtol=0, atol=1e-9)


def test_residual_is_zero_at_the_truth_on_arcs_beyond_90_degrees_off_axis() -> None:
    ends = torch.randn(40, 2, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64) * 3
    pose = Pose.exp(torch.randn(40, 6, generator=torch.Generator().manual_seed(10), dtype=torch.float64))
    in_camera = pose.transform(ends)
    assert (in_camera[..., 2] < 0).any()
    bearings = in_camera / in_camera.norm(dim=-1, keepdim=True)
    lines = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    r = sector.residual(sector.prepare(bearings[:, 0], bearings[:, 1]), lines.projection_normal(pose))
    assert r.abs().max() < 1e-12
