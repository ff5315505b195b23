"""One hostile input: how it is made, which command gets it, and what has to be said. `run` plays it and checks everything."""

import contextlib
import hashlib
import io
import os
import re
import resource
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from omnilines import cli

TIME_S = 240.0
"""Of one command; the first of a fresh clone compiles for a minute or two, on a busy machine."""
MEMORY_BYTES = 2 * 1024**3
"""By which the process may grow."""
PROGRESS = r"(?m)^\[\d+:\d\d\] .*\n"
"""How far a command is, that takes long on a busy machine."""
START = "import sys, torch, cv2\nfrom omnilines.cli import main\ntorch.set_num_threads(1)\nmain(sys.argv[1:])\n"


@dataclass(frozen=True)
class Case:
    """A command line in a folder of its own, of which `IN/` is what the user has and `OUT` is where results go."""

    name: str
    arguments: tuple[str, ...]
    prepare: Callable[[Path], None]
    """Makes the inputs, given the folder in which the command runs."""
    says: str
    """A regular expression that the one sentence holds: the file, the option or the name at fault."""
    status: tuple[int, ...] = (2,)
    alone: bool = False
    """In a process of its own: it could crash, hang in compiled code, or take all memory."""
    changes: tuple[str, ...] = field(default=())
    """Inputs that are results too, as shell patterns."""


class TooLong(BaseException):
    """The time is up; not an Exception, so that nothing takes it for an error of its own."""


def play(case: Case, folder: Path) -> None:
    """Make the inputs, run the command, and assert what holds of every case."""
    case.prepare(folder)
    before = contents(folder)
    status, out, err = _alone(case, folder) if case.alone else _here(case, folder)
    err = re.sub(PROGRESS, "", err)
    after = contents(folder)
    assert "Traceback" not in err, err[-2000:]
    assert status in case.status, f"exit status {status}: {out[-500:]} {err[-1500:]}"
    assert not re.search(r"\b(nan|inf)\b", out, re.I), out[-800:]
    for text in (out, err):
        assert not any(ord(letter) < 32 and letter not in "\n\t" for letter in text), f"a control character was printed: {text!r}"
    assert "Warning:" not in err, err
    said = [line for line in err.splitlines() if line.startswith("omnilines: ")]
    if status == 2:
        assert len(said) == 1 and len([line for line in err.splitlines() if line.strip()]) == 1, err
        assert re.search(case.says, said[0]), said[0]
        assert len(said[0]) < 1500, said[0]
        assert out == "", out
        # What is found is kept for the same command with other options.
        made = {name for name in after.keys() - before.keys() if not name.startswith("OUT/work/")}
        assert not made, f"left behind: {sorted(made)}"
    else:
        assert re.search(case.says, out + err), (out + err)[-1500:]
    results = {name for name in before if any(Path(name).match(pattern) for pattern in case.changes)}
    changed = [name for name, what in before.items() if after.get(name) != what and name not in results]
    assert not changed, f"changed inputs: {changed}"


def contents(folder: Path) -> dict[str, str]:
    """What every file of a folder holds; of links and of what is no file, that."""
    found = {}
    for parent, _, names in os.walk(folder):
        for name in names:
            path = Path(parent) / name
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                what = f"-> {os.readlink(path)}"
            elif stat.S_ISREG(mode) and path.lstat().st_size < 1 << 28:
                what = hashlib.sha256(path.read_bytes()).hexdigest()
            else:
                what = f"mode {mode}"
            found[path.relative_to(folder).as_posix()] = what
    return found


def _here(case: Case, folder: Path) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    status = 0
    with contextlib.chdir(folder), limited(TIME_S), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(list(case.arguments))
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak)
    assert grown < MEMORY_BYTES, f"{grown / 1e9:.1f} GB"
    return status, out.getvalue(), err.getvalue()


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Within it, TooLong is raised when the time is up."""

    def stop(number: int, frame: object) -> None:
        raise TooLong(f"more than {seconds:g} s")

    kept = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, kept)


def _alone(case: Case, folder: Path) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-c", START, *case.arguments],
        cwd=folder,
        capture_output=True,
        timeout=TIME_S,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (4 * MEMORY_BYTES,) * 2),
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(cli.__file__).parents[2]), os.environ.get("PYTHONPATH", "")])},
    )
    return done.returncode, done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace")
