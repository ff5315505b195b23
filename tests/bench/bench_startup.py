"""How long `omnilines --help` takes, as a whole process."""

import pathlib
import subprocess
import sys

from timing import SMALL, best_of, print_table

TARGET_S = 0.5
RUNS = 1 if SMALL else 7


def bench_help() -> None:
    command = pathlib.Path(sys.executable).with_name("omnilines")
    rows = []
    for arguments in (["--help"], ["--version"], ["calibrate", "--help"]):
        seconds = best_of(RUNS, lambda given=arguments: subprocess.run([command, *given], check=True, capture_output=True))
        rows.append([" ".join(["omnilines", *arguments]), f"{seconds:.3f} s", f"{TARGET_S} s"])
    assert rows
    print_table("Start of the command line", ["command", f"best of {RUNS}", "target below"], rows)
