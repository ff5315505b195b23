"""How far a command is, on standard error: a line that moves on a terminal, elsewhere a line now and then."""

import math
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any

import typer

from omnilines.cli.notes import printable
from omnilines.cli.spelling import running_jobs

if TYPE_CHECKING:
    from rich.progress import Progress

    from omnilines.progress import ProgressCallback

LOOK_S = 10.0
"""Between two looks at what goes on where standard error is no terminal: shorter commands say nothing."""
AGAIN_S = 30.0
"""After which a stage that goes on is named again."""


@contextmanager
def progress() -> "Iterator[ProgressCallback]":
    """A progress line on standard error of a terminal, elsewhere lines now and then; meanwhile, functions are compiled together
    where one has to be."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    console = Console(stderr=True, markup=False, emoji=False)
    # Where nobody looks, a line that is taken away again leaves an empty one.
    line = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    in_lines = nullcontext() if console.is_terminal else _told_in_lines(line)
    with line as bar, in_lines, _compiling_together(bar, console.is_terminal):
        tasks: dict[str, Any] = {}
        now = ""

        def tell(stage: str, done: int, total: int) -> None:
            """Show how far a stage is."""
            nonlocal now
            if stage != now:
                # The stage before is over. It may come again in another round, of another length or of one that is not known.
                if now:
                    bar.remove_task(tasks.pop(now))
                tasks[stage] = bar.add_task(stage, total=total or None)
                now = stage
            bar.update(tasks[stage], completed=done, total=total or None)

        yield tell


@contextmanager
def _told_in_lines(bar: "Progress") -> "Iterator[None]":
    """Minutes of silence in a log look like a program that hangs: meanwhile, a line names each stage that is met every LOOK_S,
    and again every AGAIN_S with how far it is."""
    over = threading.Event()

    def tell() -> None:
        """Say what goes on, until it is over."""
        begun = said = time.monotonic()
        named: set[str] = set()
        while not over.wait(LOOK_S):
            stage = next((task for task in reversed(bar.tasks) if task.visible), None)
            now = time.monotonic()
            if stage is None or (stage.description in named and now - said < AGAIN_S):
                continue
            named.add(stage.description)
            said = now
            minutes, seconds = divmod(round(now - begun), 60)
            count = f": {stage.completed:.0f}" if stage.completed or stage.total else ""
            far = f"{count} of {stage.total:.0f}" if stage.total else count
            # Whoever reads it may have gone.
            with suppress(OSError, ValueError):
                typer.echo(f"[{minutes}:{seconds:02}] {printable(stage.description)}{far}", err=True)

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join()


@contextmanager
def _compiling_together(bar: "Progress", on_a_terminal: bool) -> "Iterator[None]":
    """The first use of an installation, or of a command, compiles all that the command needs as soon as it needs one function."""
    from omnilines.compiling import EVERYTHING, before_first_compiled, compile_ahead, not_compiled, seconds_for

    wanted = not_compiled(*running_jobs())

    def compile_all() -> None:
        """Compile what the command needs, with a word and a line about it."""
        if not on_a_terminal:
            # A pipe or a CI has no line that moves: minutes of silence look like a program that hangs.
            about = math.ceil(seconds_for(wanted) / 10) * 10
            typer.echo(f"first use: {len(wanted)} functions are compiled, which takes about {about} s.", err=True)
        task = bar.add_task("compiling, for the first use", total=len(wanted))
        left = compile_ahead(wanted, lambda done, _: bar.update(task, completed=done))
        bar.update(task, visible=False)
        if left:
            typer.echo(
                f"note: {len(left)} functions could not be compiled beforehand: {left[0]}; they are when called.", err=True
            )

    until_needed: AbstractContextManager[None] = nullcontext()
    if wanted and EVERYTHING in running_jobs():
        compile_all()
    elif wanted:
        until_needed = before_first_compiled(compile_all)
    with until_needed:
        yield
