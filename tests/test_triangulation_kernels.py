"""The small compiled pieces of triangulation against NumPy and the charts in torch."""

import numpy as np
import pytest
import torch

from omnilines.geometry.line import PlueckerLines, weighted_median_by_group
from omnilines.geometry.line_chart import PHI_MAX_RAD, PHI_MIN_RAD, LineChart
from omnilines.triangulation.kernels.likelihood import PHI, SIZE, damped_step, moved
from omnilines.triangulation.kernels.small import cross, inverse_of_normal, orthogonalise, triangle, weighted_median
from omnilines.triangulation.kernels.sums import second_eigenvalue


@pytest.mark.parametrize(("rows", "columns"), [(2, 3), (3, 3), (6, 6), (40, 3), (18, 6)])
@pytest.mark.parametrize("weakest", [1.0, 1e-9])
def test_orthogonalised_columns_are_the_singular_vectors_of_lapack(rows: int, columns: int, weakest: float) -> None:
    """Also where the last columns nearly depend on the others: one-sided rotations keep small singular values as they are."""
    rng = np.random.default_rng([rows, columns])
    given = rng.standard_normal((rows, columns)) * np.where(np.arange(columns) < columns - 1, 1.0, weakest)
    a, v, length = given.copy(), np.empty((columns, columns)), np.empty(columns)
    orthogonalise(a, rows, columns, v, length)
    np.testing.assert_allclose(v.T @ v, np.eye(columns), atol=1e-12)
    np.testing.assert_allclose(a, given @ v, atol=1e-12)
    expected = np.zeros(columns)
    expected[: min(rows, columns)] = np.linalg.svd(given, compute_uv=False)
    np.testing.assert_allclose(length, expected, rtol=1e-9, atol=1e-13)
    assert bool((np.diff(length) <= 1e-15).all())


@pytest.mark.parametrize(("rows", "columns"), [(1, 6), (5, 6), (6, 6), (60, 6), (9, 3)])
def test_the_triangle_is_that_of_qr_up_to_signs(rows: int, columns: int) -> None:
    given = np.random.default_rng([rows, columns]).standard_normal((rows, columns))
    a = given.copy()
    triangle(a, rows, columns)
    expected = np.zeros_like(a)
    upper = np.linalg.qr(given, mode="r")
    expected[: len(upper)] = upper
    np.testing.assert_allclose(np.abs(a), np.abs(expected), atol=1e-12)
    np.testing.assert_allclose(a.T @ a, given.T @ given, atol=1e-11)


def test_weighted_medians_are_those_of_all_groups_at_once() -> None:
    rng = np.random.default_rng(1)
    group = np.sort(rng.integers(0, 60, 400))
    values = np.round(rng.standard_normal(400), 1)
    weights = np.where(group % 2 == 0, 1.0, rng.uniform(0.1, 3.0, 400))
    tensors = torch.as_tensor(values), torch.as_tensor(weights), torch.as_tensor(group)
    expected = weighted_median_by_group(*tensors, 60).numpy()
    for k in range(60):
        own = group == k
        assert weighted_median(values[own], weights[own], int(own.sum())) == pytest.approx(expected[k], nan_ok=True)


def normal_matrix(size: int, seed: int) -> np.ndarray:
    """Of badly scaled unknowns."""
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((12, size)) * 10.0 ** rng.uniform(-4.0, 4.0, size)
    return jacobian.T @ jacobian


@pytest.mark.parametrize("size", [1, 2, 4])
def test_inverses_of_normal_matrices_are_those_of_numpy(size: int) -> None:
    matrix = normal_matrix(size, size)
    factor, inverse = np.zeros((size, size + 1)), np.zeros((size, size))
    assert inverse_of_normal(matrix, size, factor, inverse)
    unit = np.sqrt(np.diagonal(matrix))
    np.testing.assert_allclose(
        inverse * unit * unit[:, None], np.linalg.inv(matrix / unit / unit[:, None]), rtol=1e-9, atol=1e-12
    )
    matrix[0, 0] = -1.0
    assert not inverse_of_normal(matrix, size, factor, inverse)


def test_crosses_and_second_eigenvalues_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        a, b = rng.standard_normal((2, 3))
        np.testing.assert_allclose(cross(*a, *b), np.cross(a, b), atol=1e-15)
        rows = rng.standard_normal((5, 2)) * np.array([1.0, rng.uniform(1e-4, 1.0)])
        along, mixed, off = rows[:, 0] @ rows[:, 0], rows[:, 0] @ rows[:, 1], rows[:, 1] @ rows[:, 1]
        expected = np.linalg.eigvalsh(np.array([[along, mixed], [mixed, off]]))[0]
        assert second_eigenvalue(along, mixed, off) == pytest.approx(expected, rel=1e-6)
    assert second_eigenvalue(0.0, 0.0, 0.0) == 0.0


@pytest.mark.parametrize("damping", [0.0, 1e-10, 0.1, 1e3])
def test_the_damped_step_is_that_of_the_dense_equations(damping: float) -> None:
    """(J'J + damping D) step = -J'h, D the diagonal, and the decrease that the linear model promises for it."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        rows = rng.standard_normal((9, 5)) * 10.0 ** rng.uniform(-3.0, 3.0, 5)
        total, factor, step = rows.T @ rows, np.empty((4, 5)), np.empty(4)
        promised = damped_step(total, damping, factor, step)
        unit = np.sqrt(np.diagonal(total)[:4])
        matrix = total[:4, :4] / unit / unit[:, None] + damping * np.eye(4)
        expected = np.linalg.solve(matrix, -total[:4, 4] / unit)
        np.testing.assert_allclose(step * unit, expected, rtol=1e-8, atol=1e-12)
        assert promised == pytest.approx(-(total[:4, 4] / unit) @ expected + damping * expected @ expected, rel=1e-9)
    singular = np.ones((5, 5))
    assert damped_step(singular, 0.0, factor, step) == np.inf and not step.any()


def test_moved_charts_are_those_of_torch() -> None:
    """Small steps and large ones, after which the centre is moved back: the same chart, not only the same line."""
    rng = np.random.default_rng(4)
    count = 60
    points = torch.as_tensor(rng.uniform(-2.0, 2.0, (2, count, 3)))
    lines = PlueckerLines.from_points(points[0], points[1])
    scale = torch.as_tensor(rng.uniform(0.5, 3.0, count))
    chart = LineChart.from_lines(lines, torch.as_tensor(rng.uniform(-3.0, 3.0, (count, 3))), scale).recentred()
    delta = torch.as_tensor(rng.standard_normal((count, 4)) * 10.0 ** rng.uniform(-3.0, 0.2, (count, 1)))
    stepped = chart.retract(delta)
    far = stepped.needs_recentring
    expected = stepped.recentred()
    assert 5 < int(far.sum()) < count - 5
    rows = torch.cat([chart.centre, chart.S.flatten(1), chart.phi[:, None]], 1).numpy()
    trial = np.empty((count, SIZE))
    for k in range(count):
        moved(rows[k], delta[k].numpy(), float(scale[k]), PHI_MIN_RAD, PHI_MAX_RAD, trial[k])
    np.testing.assert_allclose(trial[:, :3], expected.centre.numpy(), atol=1e-10)
    np.testing.assert_allclose(trial[:, 3:PHI].reshape(-1, 3, 3), expected.S.numpy(), atol=1e-9)
    np.testing.assert_allclose(trial[:, PHI], expected.phi.numpy(), atol=1e-10)
