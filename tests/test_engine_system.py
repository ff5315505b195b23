"""The block-sparse reduced system against dense linear algebra, and problems that do not fit into memory."""

import numpy as np
import pytest
from engine_scenes import row

from camera_models import InputError
from omnilines.adjustment import memory
from omnilines.adjustment.lines import adjust_lines
from omnilines.least_squares import band, reduced_system
from omnilines.least_squares.band import BandFactor
from omnilines.least_squares.pattern import PairPattern, narrower_order, pair_pattern
from omnilines.least_squares.reduced_system import ReducedSystem, SparseFactor, sparse_matrix

DIM, KEPT = 3, 9


def system(null: int, seed: int = 0) -> tuple[PairPattern, np.ndarray, np.ndarray, np.ndarray]:
    """Pattern, blocks, dense matrix and null space of sums of squares over neighbours, with so many null directions."""
    rng = np.random.default_rng(seed)
    groups = [np.arange(k, min(k + 4, KEPT)) for k in range(KEPT - 2)]
    start = np.cumsum([0, *map(len, groups)])
    index = np.concatenate(groups).astype(np.int32)
    pattern = pair_pattern(start, index, KEPT)
    gauge = rng.standard_normal((DIM * KEPT, null))
    dense = np.zeros((DIM * KEPT, DIM * KEPT))
    for group in groups:
        columns = (DIM * group[:, None] + np.arange(DIM)).ravel()
        rows = rng.standard_normal((3 * len(columns), len(columns)))
        if null:
            basis = np.linalg.qr(gauge[columns])[0]
            rows -= rows @ basis @ basis.T
        dense[np.ix_(columns, columns)] += rows.T @ rows
    cells = dense.reshape(KEPT, DIM, KEPT, DIM).transpose(0, 2, 1, 3)
    return pattern, np.ascontiguousarray(cells[pattern.row, pattern.column]), dense, gauge


@pytest.mark.parametrize("narrow", [400, 0])
@pytest.mark.parametrize("null", [0, 1, 4])
@pytest.mark.parametrize("damping", [1e-3, 0.0])
def test_system_is_solved_on_its_constraint(monkeypatch: pytest.MonkeyPatch, narrow: int, null: int, damping: float) -> None:
    monkeypatch.setattr(band, "NARROW", narrow)
    pattern, blocks, dense, gauge = system(null)
    dense = dense + damping * np.diag(dense.diagonal())
    within = np.arange(DIM)
    blocks[pattern.diagonal[:, None], within, within] *= 1 + damping
    found = ReducedSystem.of(pattern, blocks, gauge, damping)
    assert found is not None
    complement = np.linalg.qr(gauge, mode="complete")[0][:, null:] if null else np.eye(len(dense))
    inverse = complement @ np.linalg.inv(complement.T @ dense @ complement) @ complement.T
    right = np.random.default_rng(1).standard_normal((len(dense), 2))
    np.testing.assert_allclose(found.solve(right), inverse @ right, rtol=1e-8, atol=1e-10 * np.abs(inverse).max())
    cells = inverse.reshape(KEPT, DIM, KEPT, DIM).transpose(0, 2, 1, 3)[pattern.row, pattern.column]
    np.testing.assert_allclose(found.covariance_blocks(), cells, rtol=1e-8, atol=1e-9 * np.abs(inverse).max())
    scale = 1 / np.sqrt(dense.diagonal())
    basis = np.linalg.qr(gauge * scale[:, None], mode="complete")[0][:, null:] if null else np.eye(len(dense))
    values = np.linalg.eigvalsh(basis.T @ (dense * scale * scale[:, None]) @ basis)
    assert abs(found.weakest()[0] / values[0] - 1) < 1e-6
    monkeypatch.setattr(reduced_system, "DENSE_SIZE", 0)
    assert abs(found.weakest()[0] / values[0] - 1) < 1e-4


@pytest.mark.parametrize("null", [1, 4])
def test_covariances_are_on_the_constraint_of_a_datum(null: int) -> None:
    pattern, blocks, dense, gauge = system(null)
    rng = np.random.default_rng(2)
    roots = rng.standard_normal((KEPT, DIM, DIM))
    known = roots.transpose(0, 2, 1) @ roots
    found = ReducedSystem.of(pattern, blocks, gauge, 0.0)
    assert found is not None
    found = found.in_datum(known)
    constraint = np.einsum("bij,bjg->big", known, gauge.reshape(KEPT, DIM, null)).reshape(-1, null)
    complement = np.linalg.qr(constraint, mode="complete")[0][:, null:]
    inverse = complement @ np.linalg.inv(complement.T @ dense @ complement) @ complement.T
    right = rng.standard_normal((len(dense), 2))
    np.testing.assert_allclose(found.solve(right), inverse @ right, rtol=1e-8, atol=1e-10 * np.abs(inverse).max())
    cells = inverse.reshape(KEPT, DIM, KEPT, DIM).transpose(0, 2, 1, 3)[pattern.row, pattern.column]
    np.testing.assert_allclose(found.covariance_blocks(), cells, rtol=1e-8, atol=1e-9 * np.abs(inverse).max())
    inner = rng.standard_normal(dense.shape)
    inner = inner @ inner.T
    own = np.ascontiguousarray(inner.reshape(KEPT, DIM, KEPT, DIM).transpose(0, 2, 1, 3)[pattern.row, pattern.column])
    both = inverse @ sparse_matrix(pattern, own).toarray() @ inverse
    cells = both.reshape(KEPT, DIM, KEPT, DIM).transpose(0, 2, 1, 3)[pattern.row, pattern.column]
    np.testing.assert_allclose(found.conjugated_blocks(own), cells, rtol=1e-8, atol=1e-9 * np.abs(both).max())


def test_superlu_gives_what_the_band_gives() -> None:
    pattern, blocks, dense, _ = system(0)
    np.testing.assert_allclose(sparse_matrix(pattern, blocks).toarray(), dense, rtol=1e-14, atol=1e-14)
    sparse, banded = SparseFactor.of(pattern, blocks), BandFactor.of(pattern, blocks)
    assert sparse is not None and banded is not None
    np.testing.assert_allclose(sparse.inverse_blocks(pattern, DIM), banded.inverse_blocks(pattern, DIM), rtol=1e-8, atol=1e-10)
    blocks[pattern.diagonal[4]] *= -1
    assert SparseFactor.of(pattern, blocks) is None and BandFactor.of(pattern, blocks) is None


@pytest.mark.parametrize("zeros", [False, True])
def test_the_inverse_of_a_grid_follows_from_its_factor(zeros: bool) -> None:
    """A net of loops, whose band is wide; with zeros inside its blocks, of which the factor keeps none."""
    side = 7
    rng = np.random.default_rng(5)
    at = np.arange(side * side).reshape(side, side)
    ties = np.concatenate([np.stack([at[:, :-1].ravel(), at[:, 1:].ravel()], 1), np.stack([at[:-1].ravel(), at[1:].ravel()], 1)])
    pattern = pair_pattern(np.arange(0, 2 * len(ties) + 1, 2), ties.ravel().astype(np.int32), side * side)
    blocks = rng.standard_normal((len(pattern.row), DIM, DIM))
    if zeros:
        blocks[:, [0, 0, 1, 2], [1, 2, 0, 0]] = 0.0
    blocks[pattern.diagonal] = 12.0 * np.eye(DIM)
    dense = sparse_matrix(pattern, blocks).toarray()
    cells = np.linalg.inv(dense).reshape(side * side, DIM, side * side, DIM).transpose(0, 2, 1, 3)
    factor = SparseFactor.of(pattern, blocks)
    assert factor is not None and pattern.reach >= side
    np.testing.assert_allclose(factor.inverse_blocks(pattern, DIM), cells[pattern.row, pattern.column], rtol=1e-10, atol=1e-12)


def test_a_shuffled_path_is_put_in_order() -> None:
    path = np.random.default_rng(0).permutation(50)
    pairs = np.sort(np.stack([path[:-1], path[1:]], 1), 1)
    pattern = pair_pattern(np.arange(0, 2 * len(pairs) + 1, 2), pairs.ravel().astype(np.int32), 50)
    order = narrower_order(pattern)
    assert order is not None and pattern.reach > 20
    place = np.argsort(order)
    assert int(np.abs(place[path[:-1]] - place[path[1:]]).max()) == 1


def test_a_problem_that_does_not_fit_is_refused_before_it_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = row()
    monkeypatch.setattr(memory, "available_bytes", lambda: 50_000)
    with pytest.raises(InputError, match=r"observations of 60 lines in 10 photos was expected, about .* found 0\.0 GB available"):
        adjust_lines(scene.arcs, scene.lines, scene.poses)
    with pytest.raises(InputError, match=r"about 0\.5 GB"):
        memory.require_for_arcs(1_000_000, 100_000, 1_000)
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    memory.require_for_arcs(1_000_000, 100_000, 1_000)
