"""How long `omnilines --help` takes, as a whole process."""

import pathlib
import subprocess
import sys

from timing import best_of, print_table

TARGET_S = 0.5


def bench_help() -> None:
    command = pathlib.Path(sys.executable).with_name("omnilines")
    rows = []
    for arguments in (["--help"], ["--version"], ["calibrate", "--help"]):
        seconds = best_of(7, lambda given=arguments: subprocess.run([command, *given], check=True, capture_output=True))
        rows.append([" ".join(["omnilines", *arguments]), f"{seconds:.3f} s", f"{TARGET_S} s"])
    assert rows
    print_table("Start of the command line", ["command", "best of 7", "target below"], rows)
