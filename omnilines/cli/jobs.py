"""What a command does, as the list of compiled functions tells it apart (`omnilines/compiling/entries.yaml`)."""

from omnilines.cli.counts import Call, of_lines, of_table, of_target
from omnilines.compiling import EVERYTHING

ARCS = ("extract", "directions", "check")
EXPERIMENTS = ("wide", "short", "room", "house", "book")


def jobs(name: str, call: Call) -> tuple[str, ...]:
    """Of a command, by its name and how it was called.

    `boards`: targets are found in photos, and cameras calibrated; `arcs`: of lines in photos; `scene`: lines are rebuilt from
    photos; `adjust`: matched segments; `experiment`: the experiment of a board.
    """
    if name == "doctor":
        return (EVERYTHING,) if call.values["check"] else ()
    if name in ARCS:
        return ("arcs",)
    if name == "validate":
        return ("scene",) if call.values["scene"] else ("boards",)
    if name == "reconstruct":
        return ("scene",) if call.values["photos"] else ("adjust",)
    if name == "adjust" or name in EXPERIMENTS:
        return ("adjust",)
    if name == "board":
        return ("boards", "experiment")
    if name == "calibrate":
        boards = of_target(call) and not of_table(call)
        return tuple(job for job, needed in (("boards", boards), ("arcs", of_lines(call))) if needed)
    if name in ("detect", "guide") or (name == "frames" and call.has("pattern")):
        return ("boards",)
    return ()
