"""Every benchmark runs: once, with little data. Nothing is measured.

A file `tests/bench/bench_*.py` is found by its name, and is one of two kinds:

- functions `bench_*`, which `make bench` runs with pytest: they take little data where `timing.SMALL` is true (set by
  OMNILINES_BENCH_SMALL), assert no ratio of times then, and call pytest.skip with a reason where data or peers are absent;
- a script with `if __name__ == "__main__":`, which has the option `--small`, needs no other argument with it, and ends by
  `timing.skip(reason)` where something is absent, if possible after what runs without it.

A file of neither kind fails, and so does one that does not know of its small size.
"""

import ast
import os
import pathlib
import re
import subprocess
import sys

import pytest
from bench.timing import SKIPPED

BENCH = pathlib.Path(__file__).resolve().parent / "bench"
ROOT = BENCH.parents[1]
FILES = sorted(BENCH.glob("bench_*.py"))
MOST_SECONDS = 600
"""Of a busy machine."""
COLLECTED = ("-o", "python_files=bench_*.py", "-o", "python_functions=bench_*")
AS_BENCH = ("-m", "pytest", "--noconftest", "-p", "no:cacheprovider", "-q", "-rs", "-o", f"pythonpath={BENCH} {BENCH.parent}")


def small_run(file: pathlib.Path) -> list[str]:
    """The arguments of Python that run a benchmark with little data."""
    text = file.read_text()
    functions = [part.name for part in ast.parse(text).body if isinstance(part, ast.FunctionDef)]
    if any(name.startswith("bench_") for name in functions):
        assert "SMALL" in text, f"{file.name} has no small size: see the head of this test"
        return [*AS_BENCH, *COLLECTED, "--rootdir", str(ROOT), str(file)]
    assert "__main__" in text, f"{file.name} has neither functions bench_* nor a main part"
    assert "--small" in text, f"{file.name} has no small size: see the head of this test"
    return [str(file), "--small"]


def test_every_benchmark_has_a_small_size() -> None:
    assert len([small_run(file) for file in FILES]) == len(FILES) > 10


@pytest.mark.full
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_benchmark_runs(file: pathlib.Path, tmp_path: pathlib.Path) -> None:
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "OMNILINES_BENCH_SMALL": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    environment.pop("OMNILINES_BENCH", None)
    done = subprocess.run(
        [sys.executable, *small_run(file)],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=MOST_SECONDS,
    )
    if done.returncode == SKIPPED:
        pytest.skip(done.stdout.splitlines()[-1])
    assert done.returncode == 0, done.stdout[-5000:]
    skipped = re.findall(r"^SKIPPED .*?: (.*)$", done.stdout, re.M)
    if skipped and not re.search(r"\d+ passed", done.stdout):
        pytest.skip("; ".join(skipped))
