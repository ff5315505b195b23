"""Functions are compiled by processes of their own before a command needs them, and not once more by the command."""

import os
import subprocess
import sys
import time
from collections import Counter
from importlib import import_module
from pathlib import Path

import numba
import numpy as np
import pytest

from omnilines.cli import progress
from omnilines.cli.counts import Call
from omnilines.cli.jobs import jobs
from omnilines.compiled_cache import VARIABLE
from omnilines.compiling import EVERYTHING, Entry, ahead, compile_ahead, entries, not_compiled, seconds_for
from omnilines.compiling.argument_types import read, written
from omnilines.progress import Cancelled

CHAINS = "omnilines.extraction.kernels.chain.chains"
SLOW = "omnilines.extraction.kernels.step_edge.fit_steps"
SCRIPT = Path(__file__).resolve().parents[1] / "docs" / "scripts" / "compiled.py"


def entry_named(function: str) -> Entry:
    return next(entry for entry in entries() if entry.function == function)


def silent(done: int, total: int) -> None:
    """Progress that nobody looks at."""


def test_the_list_names_functions_that_are_there_and_types_of_their_arguments() -> None:
    for entry in entries():
        compiled = getattr(import_module(entry.module), entry.function.rpartition(".")[2])
        assert isinstance(compiled, numba.core.dispatcher.Dispatcher)
        for arguments in entry.arguments:
            assert len(arguments) == compiled.py_func.__code__.co_argcount, entry.function
            assert [written(read(text), entry.module) for text in arguments] == list(arguments)
    assert {"boards", "arcs", "scene", "adjust", "experiment"} == {job for entry in entries() for job in entry.jobs}
    # numba's files of two functions would else be taken for one another's.
    named = Counter((entry.source.parent, entry.source.stem, entry.function.rpartition(".")[2]) for entry in entries())
    assert set(named.values()) == {1}


@pytest.mark.parametrize(
    "value",
    [np.zeros((2, 3))[:, ::2], np.zeros(2, dtype=np.float32), (1, 2.0), (True, 1), np.uint8(3), np.asfortranarray(np.eye(2))],
)
def test_types_are_written_and_read(value: object) -> None:
    kind = numba.typeof(value)
    assert read(written(kind, "omnilines")) == kind
    fixed = np.arange(3.0)
    fixed.flags.writeable = False
    assert read(written(numba.typeof(fixed), "omnilines")) == numba.typeof(fixed)
    with pytest.raises(TypeError, match="no way to write"):
        written(numba.typeof("text"), "omnilines")


@pytest.mark.slow
@pytest.mark.parametrize("outs", [("room", "from_photos"), pytest.param((), marks=pytest.mark.full)])
def test_the_list_holds_all_that_commands_call(outs: tuple[str, ...]) -> None:
    done = subprocess.run([sys.executable, SCRIPT, "--check", *outs], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"run `python docs/scripts/compiled.py`:\n{done.stderr[-3000:]}"


@pytest.mark.slow
def test_what_was_compiled_ahead_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    wanted = [entry_named(CHAINS), entry_named("omnilines.matching.kernels.chance.at_least")]
    assert len(not_compiled(EVERYTHING)) == len(entries())
    assert not_compiled("arcs", "adjust") == tuple(entry for entry in entries() if {"arcs", "adjust"} & set(entry.jobs))
    told: list[tuple[int, int]] = []
    assert compile_ahead(wanted, lambda done, total: told.append((done, total))) == ()
    assert told == [(0, 2), (1, 2), (2, 2)]
    assert [entry for entry in entries() if entry not in not_compiled(EVERYTHING)] == wanted
    call = (
        "import numpy as np\nfrom omnilines.extraction.kernels.chain import chains\n"
        "chains(np.full((3, 2), -1, dtype=np.int32))\nprint(sum(chains.stats.cache_hits.values()), chains.stats.cache_misses)"
    )
    assert subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, check=True).stdout == "1 Counter()\n"
    # A newer source has to be compiled anew.
    for path in tmp_path.rglob("chain.chains-*.nbi"):
        os.utime(path, (0, 0))
    assert [entry for entry in entries() if entry not in not_compiled(EVERYTHING)] == wanted[1:]


@pytest.mark.slow
def test_what_cannot_be_compiled_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    unknown = Entry("omnilines.extraction.kernels.chain.no_such_function", ("arcs",), 1.0, ())
    assert compile_ahead([unknown, entry_named("omnilines.matching.kernels.chance.at_least")], silent) == (unknown.function,)
    assert compile_ahead([], silent) == ()


def test_processes_end_with_whoever_started_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    started: list[subprocess.Popen[str]] = []
    start = ahead._started
    monkeypatch.setattr(ahead, "_started", lambda share: started.append(start(share)) or started[-1])

    def stop(done: int, total: int) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        compile_ahead([entry_named(SLOW)], stop)
    assert started[0].wait(10) != 0
    # As by kill -9: nobody is left who could end them.
    orphan = start([entry_named(SLOW)])
    assert orphan.stdin is not None
    time.sleep(0.2)
    orphan.stdin.close()
    assert orphan.wait(60) != 0
    assert orphan.stdout is not None
    orphan.stdout.close()


def test_processes_share_the_work_and_keep_modules_whole() -> None:
    def entry(name: str, seconds: float) -> Entry:
        return Entry(name, (), seconds, ())

    wanted = [entry("a.f", 5.0), entry("b.f", 3.0), entry("a.g", 1.0), entry("c.f", 3.0)]
    shares = ahead.shared_out(wanted, 2)
    assert [[one.function for one in share] for share in shares] == [["a.f", "a.g"], ["b.f", "c.f"]]
    assert len(ahead.shared_out(wanted, 8)) == 3
    assert [one.function for one in ahead.shared_out(wanted, 1)[0]] == ["a.f", "a.g", "b.f", "c.f"]
    assert 6.0 <= seconds_for(wanted) <= 12.0 and seconds_for([]) == 0.0


@pytest.mark.parametrize(
    ("name", "values", "given", "its"),
    [
        ("doctor", {"check": True}, (), ("everything",)),
        ("doctor", {"check": False}, (), ()),
        ("extract", {}, (), ("arcs",)),
        ("calibrate", {"pattern": "checkerboard:8x6:30mm", "photos": [Path("a")]}, (), ("boards",)),
        ("calibrate", {"pattern": "lines", "photos": [Path("a")]}, (), ("arcs",)),
        ("calibrate", {"pattern": "checkerboard:8x6:30mm, lines", "photos": [Path("a")]}, (), ("boards", "arcs")),
        ("calibrate", {"pattern": None, "photos": [Path("corners.csv")]}, (), ()),
        ("reconstruct", {"photos": [Path("a")]}, (), ("scene",)),
        ("reconstruct", {"photos": []}, (), ("adjust",)),
        ("validate", {"scene": None}, (), ("boards",)),
        ("validate", {"scene": "room"}, (), ("scene",)),
        ("frames", {"pattern": None}, (), ()),
        ("frames", {"pattern": "checkerboard:8x6:30mm"}, ("pattern",), ("boards",)),
        ("board", {}, (), ("boards", "experiment")),
        ("house", {}, (), ("adjust",)),
        ("convert", {}, (), ()),
    ],
)
def test_jobs_of_commands(name: str, values: dict[str, object], given: tuple[str, ...], its: tuple[str, ...]) -> None:
    assert jobs(name, Call(values, given)) == its
    assert set(its) <= {job for entry in entries() for job in entry.jobs} | {EVERYTHING}


@pytest.mark.parametrize(("wanted", "left"), [(2, ()), (2, ("a.f",)), (0, ())])
def test_all_that_a_command_needs_is_compiled_where_it_needs_one_function(
    wanted: int, left: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    its = tuple(Entry(f"a.{number}", (), 12.0, ()) for number in range(wanted))
    monkeypatch.setattr("omnilines.compiling.not_compiled", lambda *jobs: its)
    monkeypatch.setattr("omnilines.compiling.compile_ahead", lambda entries, progress: progress(2, 2) or left)
    first, second = (numba.njit(lambda x: x + 1) for _ in range(2))
    with progress.progress() as tell:
        tell("finding arcs", 0, 2)
        assert capsys.readouterr().err == ""
        assert first(1) == second(1) == 2
    said = capsys.readouterr().err
    assert said.count("first use: 2 functions are compiled, which takes about 30 s.") == (wanted > 0)
    assert ("1 functions could not be compiled beforehand: a.f; they are when called." in said) == bool(left)
    assert (said == "") == (wanted == 0)
    numba.njit(lambda x: x + 2)(1)
    assert capsys.readouterr().err == ""


def test_doctor_compiles_all_functions_at_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("omnilines.compiling.not_compiled", lambda *jobs: tuple(jobs))
    monkeypatch.setattr("omnilines.compiling.seconds_for", lambda wanted: 31.0)
    monkeypatch.setattr("omnilines.compiling.compile_ahead", lambda wanted, progress: ())
    monkeypatch.setattr(progress, "running_jobs", lambda: (EVERYTHING,))
    with progress.progress():
        assert capsys.readouterr().err == "first use: 1 functions are compiled, which takes about 40 s.\n"
