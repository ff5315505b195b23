"""Adjustments of a scene in parts against the same in one piece, which other tests compare with torch and Monte Carlo."""

import pickle
import shutil
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from engine_scenes import Row, row

from camera_models import InputError
from omnilines.adjustment import memory
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.datum import known_of_poses
from omnilines.adjustment.engine import LineEngine
from omnilines.adjustment.engine_layout import layout
from omnilines.adjustment.engine_solution import LineSolution, line_solution
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.parts import Division, divided
from omnilines.adjustment.parts_engine import PARTS, PartsEngine, PartsSolution, Workers, parts_solution
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Outcome
from omnilines.least_squares.dissection import covering, dissected
from omnilines.pipelines.part_workers import part_workers

PHOTOS, LINES, MOST, REACH = 44, 880, 11, 6


@cache
def scene() -> Row:
    """Photos along a path, of whose lines a few neighbours see each."""
    return row(PHOTOS, LINES, REACH)


def problem_of(given: Row, held: tuple[int, ...] = ()) -> tuple[LineProblem, LinesAndPoses]:
    """Lines and poses with the whitened cost."""
    centres = given.poses.centre[given.arcs.image]
    state = LinesAndPoses(given.poses, LineChart.about_cameras(given.lines, centres, given.arcs.track))
    fixed = torch.zeros(given.arcs.images, dtype=torch.bool)
    fixed[list(held)] = True
    return LineProblem(given.arcs, "whitened", Freedom(fixed), state), state


def test_the_fewest_rows_and_columns_cover_a_matrix() -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        entries = rng.random((5, 6)) < 0.6 * rng.random()
        rows, columns = covering(scipy.sparse.csr_array(entries.astype(np.int8)))
        assert (entries <= (rows[:, None] | columns)).all()
        tried = (np.array(chosen) for chosen in product((False, True), repeat=5))
        assert rows.sum() + columns.sum() == min(own.sum() + (entries & ~own[:, None]).any(0).sum() for own in tried)


def test_parts_are_small_alike_and_joined_by_separators_alone() -> None:
    side, reach = 24, 2
    number = np.arange(side * side).reshape(side, side)
    pairs = [(number[:, :-step], number[:, step:]) for step in range(1, reach + 1)]
    pairs += [(number[:-step], number[step:]) for step in range(1, reach + 1)]
    first, second = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in range(2))
    part = dissected(first, second, side * side, 100)
    inner, sizes = part >= 0, np.bincount(part[part >= 0])
    together = inner[first] & inner[second]
    assert together.any() and (part[first[together]] == part[second[together]]).all()
    assert len(sizes) >= 6 and sizes.max() <= 100 and sizes.min() >= 30
    # Two rows of the grid for the first cut, half as many for each that follows.
    assert (~inner).sum() <= reach * side * (1 + 0.5 * (len(sizes) - 2))


def test_every_line_is_of_one_part_with_all_its_photos() -> None:
    problem, _ = problem_of(scene())
    division, arcs = divided(problem, layout(problem), MOST), scene().arcs
    assert isinstance(division, Division) and len(division.parts) == 4
    assert torch.equal(torch.cat([part.rows for part in division.parts]).sort().values, torch.arange(len(arcs)))
    seen = torch.zeros(PHOTOS, dtype=torch.int64)
    for part in division.parts:
        assert torch.equal(torch.unique(arcs.image[part.rows]), part.frames) and len(part.frames) <= MOST + 2 * REACH
        assert bool(torch.isin(arcs.track, part.tracks)[part.rows].all()) and not part.tracks.diff().le(0).any()
        seen[part.frames] += 1
    assert torch.equal(torch.nonzero(seen > 1).flatten(), torch.from_numpy(np.sort(division.shared)))
    # A path is cut in three places, where as many photos separate as a line reaches over.
    assert len(division.shared) == 3 * (REACH - 1)


def both(given: Row, most: int, loss: Loss, held: tuple[int, ...]) -> tuple[LineSolution, PartsSolution]:
    """The solution in one piece and in parts, each from the same start."""
    problem, state = problem_of(given, held)
    whole = LineEngine(problem, loss)
    division = divided(problem, whole.layout, most)
    assert division is not None
    parts = PartsEngine(problem, state, loss, division)
    one, other = whole.minimise(state, 50), parts.minimise(state, 50)
    known = [known_of_poses(problem, found.state) for found in (one, other)]
    return line_solution(whole, one, known=known[0]), parts_solution(parts, other, known=known[1])


def assert_equal(whole: LineSolution, parts: PartsSolution) -> None:
    """Cost to 1e-9, lines and poses to 1e-3 standard deviations, covariances, those between lines and photos of different parts
    among them, as far as rounding goes."""
    assert whole.end.outcome is parts.end.outcome is Outcome.CONVERGED
    assert abs(parts.cost / whole.cost - 1) < 1e-9 and whole.end.iterations == parts.end.iterations
    expected, found = whole.covariances(), parts.covariances()
    sigma = [values.diagonal(dim1=1, dim2=2).sqrt() for values in expected]
    for one, other, deviations in zip(expected, found, sigma, strict=True):
        bound = deviations[:, :, None] * deviations[:, None, :]
        assert bool(((one - other).abs() <= 1e-5 * bound).all())
    chart, other_chart = whole.state.chart, parts.state.chart
    assert bool(((chart.phi - other_chart.phi).abs() <= 1e-3 * sigma[1][:, 3]).all())
    assert bool(((chart.S - other_chart.S).flatten(1).norm(dim=1) <= 1e-3 * sigma[1][:, :3].norm(dim=1)).all())
    free = whole.engine.problem.free
    moved = (whole.state.rig_from_world @ parts.state.rig_from_world.inverse()).log()[free]
    assert bool((moved.abs() <= 1e-3 * sigma[0]).all())
    lines = len(expected[1])
    some = torch.tensor([lines - 1, 0, 5, lines // 2, lines // 3])
    joint, other_joint = (solution.joint_eliminated_covariance(some) for solution in (whole, parts))
    torch.testing.assert_close(other_joint, joint, rtol=0.0, atol=1e-6 * float(joint.abs().max()))
    assert whole.reduction is not None and whole.reduction.system is not None
    # Of the photos that parts share: columns of the inverse of the whole.
    place = np.argsort(whole.engine.layout.frames[: len(free)].numpy())
    of_problem = np.searchsorted(free.numpy(), parts.engine.division.shared)
    assert (free.numpy()[of_problem] == parts.engine.division.shared).all()
    at = place[of_problem]
    columns = (6 * at[:, None] + np.arange(6)).ravel()
    right = np.zeros((6 * len(free), len(columns)))
    right[columns, np.arange(len(columns))] = 1.0
    inverse = whole.reduction.system.solve(right)[columns]
    np.testing.assert_allclose(parts.shared_covariance(), inverse, rtol=0.0, atol=1e-7 * np.abs(inverse).max())


@pytest.mark.parametrize(("loss", "held"), [(Loss(), ()), (Loss("cauchy", 2.0), ()), (Loss(), (0, PHOTOS - 1))])
def test_parts_end_where_the_whole_does(loss: Loss, held: tuple[int, ...]) -> None:
    assert_equal(*both(scene(), MOST, loss, held))


@pytest.mark.full
def test_hundreds_of_photos_in_parts_end_where_the_whole_does() -> None:
    assert_equal(*both(row(240, 9600, reach=8), 60, Loss(), ()))


def by_parts(given: Row, workers: Workers = Workers(), **options: Any) -> Adjusted:
    """An adjustment in parts."""
    found = adjust_lines(given.arcs, given.lines, given.poses, cost="whitened", partition=MOST, workers=workers, **options)
    assert isinstance(found.whitened, PartsSolution)
    return found


class Pickled(Executor):
    """Does at once what it is given, as it comes out of a pickle; raises what `errors` has for the number of the task, and
    removes the folders of parts below `gone` before."""

    def __init__(self, errors: dict[int, Exception] | None = None, gone: Path | None = None) -> None:
        self.errors, self.gone, self.count = errors or {}, gone, 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        self.count += 1
        try:
            if self.count in self.errors:
                raise self.errors[self.count]
            for folder in () if self.gone is None else self.gone.glob(f"{PARTS}*"):
                shutil.rmtree(folder)
            work, given, named = pickle.loads(pickle.dumps((fn, args, kwargs)))
            done.set_result(pickle.loads(pickle.dumps(work(*given, **named))))
        except Exception as error:
            done.set_exception(error)
        return done


@pytest.mark.slow
def test_workers_find_what_one_process_does_and_leave_nothing_behind(tmp_path: Path) -> None:
    whole = adjust_lines(scene().arcs, scene().lines, scene().poses, cost="whitened")
    here = by_parts(scene())
    pickled = Pickled({3: OSError(28, "No space left on device"), 9: MemoryError()})
    there = by_parts(scene(), part_workers(pickled, tmp_path / "work"))
    with ThreadPoolExecutor(2) as threads:
        threaded = by_parts(scene(), part_workers(threads, None))
    assert pickled.count > 40 and len(list((tmp_path / "work").glob(f"{PARTS}*"))) == 1
    for found in (here, there, threaded):
        assert abs(found.cost / whole.cost - 1) < 1e-9 and abs(found.noise_factor / whole.noise_factor - 1) < 1e-9
        for name in ("line_covariance", "pose_covariance"):
            one = getattr(whole, name)
            torch.testing.assert_close(getattr(found, name), one, rtol=1e-4, atol=1e-7 * float(one.abs().max()))
        joint = whole.joint_line_covariance(torch.tensor([0, LINES - 1]))
        again = found.joint_line_covariance(torch.tensor([0, LINES - 1]))
        torch.testing.assert_close(again, joint, rtol=0.0, atol=1e-6 * float(joint.abs().max()))
    assert isinstance(there.whitened, PartsSolution)
    there.whitened.engine.close()
    assert not list((tmp_path / "work").glob(f"{PARTS}*"))


def test_what_an_executor_cannot_do_is_said(tmp_path: Path) -> None:
    lost = Pickled({2: BrokenExecutor("a process was terminated abruptly")})
    with pytest.raises(InputError, match=r"The parts 2 to 2 could not be worked on: BrokenExecutor\. Workers that last"):
        by_parts(scene(), part_workers(lost, tmp_path))
    full = Pickled({count: OSError(28, "No space left on device") for count in range(1, 99)})
    with pytest.raises(InputError, match=r"OSError, tried 3 times.*No space left.*make `partition` smaller"):
        by_parts(scene(), part_workers(full, None))
    elsewhere = Pickled(gone=tmp_path)
    with pytest.raises(InputError, match=r"^The worker on \S+ cannot see the part \S+part0.pickle: expected a folder that all"):
        by_parts(scene(), part_workers(elsewhere, tmp_path))
    left = tmp_path / f"{PARTS}of-a-killed-run"
    left.mkdir()
    part_workers(None, tmp_path)
    assert not left.exists()


def test_a_partition_of_what_is_adjusted_in_one_piece_is_refused() -> None:
    given, prior = scene(), PosePrior(scene().poses, *(torch.full((PHOTOS,), 0.1, dtype=torch.float64) for _ in range(2)))
    for options, named in (
        ({"cost": "sector"}, "the cost sector"),
        ({"refine_poses": False}, "held poses"),
        ({"prior": prior}, "a prior"),
        ({"partition": -1}, "found -1"),
    ):
        with pytest.raises(InputError, match=f"`partition` of 0 or more photos was expected, .*{named}"):
            adjust_lines(given.arcs, given.lines, given.poses, **{"cost": "whitened", "partition": 20, **options})  # type: ignore[arg-type]


def test_a_small_scene_is_adjusted_in_one_piece_and_one_that_does_not_fit_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene()
    alone = adjust_lines(given.arcs, given.lines, given.poses, cost="whitened", partition=PHOTOS)
    assert isinstance(alone.whitened, LineSolution)
    problem, _ = problem_of(given)
    _, division = memory.laid_out_to_fit(problem, MOST, True)
    assert division is not None
    largest = max(memory.part_bytes(len(p.rows), len(p.tracks), len(p.frames), len(p.shared)) for p in division.parts)
    monkeypatch.setattr(memory, "AUTOMATIC", MOST)
    monkeypatch.setattr(memory, "available_bytes", lambda: (largest + memory.LINE * LINES) / memory.MOST_SHARE + 1)
    found = adjust_lines(given.arcs, given.lines, given.poses, cost="whitened")
    assert isinstance(found.whitened, PartsSolution) and abs(found.cost / alone.cost - 1) < 1e-9
    with pytest.raises(InputError, match=f"observations of {LINES} lines in {PHOTOS} photos was expected"):
        adjust_lines(given.arcs, given.lines, given.poses, cost="sector")
