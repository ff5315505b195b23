"""The application, its options and how a command is run and its result printed."""

import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from camera_models.errors import InputError
from omnilines.cli._stopping import say_when_stopped
from omnilines.cli.notes import rows_shown, shortened, told
from omnilines.cli.spelling import Application, flag_of, running_jobs, with_flags
from omnilines.compiled_cache import note_on_cache
from omnilines.machine import agree_on_threads
from omnilines.spelling import spelled_as

if TYPE_CHECKING:
    from rich.progress import Progress

    from omnilines.commands.result import CommandResult
    from omnilines.progress import ProgressCallback

app = Application(
    name="omnilines",
    help="Calibrate fisheye and omnidirectional cameras, and rebuild the straight lines they see as metric 3D lines.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
render_app = Application(help="Synthetic photos of targets through any camera model.", no_args_is_help=True)
experiment_app = Application(help="The dissertation's experiments.", no_args_is_help=True)
app.add_typer(render_app, name="render")
app.add_typer(experiment_app, name="experiment")

Photos = Annotated[
    list[Path], typer.Argument(help="Photos, folders of them, a video, a bag (BAG:/topic), or corners.csv.", show_default=False)
]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to.", show_default=False)]
LENS_MODELS = "pinhole, opencv-fisheye, scaramuzza, unified, extended-unified or double-sphere"
"""Those with parameters."""
PatternSpec = Annotated[str, typer.Option("--pattern", help="Target, such as checkerboard:8x6:32.5mm (inner corners, square).")]
Model = Annotated[
    str,
    typer.Option("--model", help=f"Camera model: {LENS_MODELS}."),
]
Size = Annotated[str, typer.Option("--size", help="Image size, WIDTHxHEIGHT.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Mirror = Annotated[bool, typer.Option("--mirror", help="The camera looks into a mirror (a0 < 0).")]
LossName = Annotated[str, typer.Option("--loss", help="none, huber or cauchy.")]
FovDeg = Annotated[float, typer.Option("--fov-deg", help="Field of view across the shorter side, degrees.")]
Views = Annotated[int, typer.Option("--views", help="Number of photos.")]
NoiseGrey = Annotated[float, typer.Option("--noise", help="Standard deviation of the image noise, grey levels of 255.")]
BlurPx = Annotated[float, typer.Option("--blur", help="Standard deviation of the blur, pixels.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="An option by its name, such as scene.min_views=3; may be given again.", show_default=False),
]
MaskOf = Annotated[
    Path | None,
    typer.Option("--mask", help="Image, white where to look, or a folder of them: PHOTO.png or CAMERA.png.", show_default=False),
]
SplitInto = Annotated[
    str | None,
    typer.Option("--split", help="Lenses side by side in every image, as left,right; one above the other, as top/bottom."),
]
Cluster = Annotated[
    str | None,
    typer.Option("--cluster", help="Who works on the photos: local (processes), slurm (jobs), or HOST:PORT of a Dask scheduler."),
]
Plots = Annotated[
    Path | None, typer.Option("--plots", help="Folder for every figure of the report, as PNG and SVG.", show_default=False)
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of everything random.")]


def _print_version(wanted: bool | None) -> None:
    if wanted:
        typer.echo(f"omnilines {version('omnilines')}")
        raise typer.Exit


@app.callback()
def _root(
    show: Annotated[
        bool | None, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option("--threads", help="Cores to use, before the command; all that the process may.", min=1)
    ] = None,
) -> None:
    """Options of the command as a whole."""
    agree_on_threads(threads)


LONGEST_WORD = 300
"""Letters; of a longer one the beginning and the end are told."""


def printable(text: str) -> str:
    """A text in one line, without what a terminal would obey and words without end: names and cells may hold anything."""
    text = re.sub(
        rf"\S{{{LONGEST_WORD},}}", lambda word: f"{word[0][: LONGEST_WORD // 2]}...{word[0][-LONGEST_WORD // 4 :]}", text
    )
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


LONGEST_SENTENCE = 1400


def bounded(sentence: str) -> str:
    """A sentence without its middle where it is endless: values may have any length."""
    half = LONGEST_SENTENCE // 2
    return sentence if len(sentence) <= LONGEST_SENTENCE else f"{sentence[:half]} ... {sentence[-half:]}"


@contextmanager
def progress() -> "Iterator[ProgressCallback]":
    """A progress line on standard error of a terminal; meanwhile, functions are compiled together where one has to be."""
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
    with line as bar, _compiling_together(bar, console.is_terminal):
        tasks: dict[str, Any] = {}
        now = ""

        def tell(stage: str, done: int, total: int) -> None:
            """Show how far a stage is."""
            nonlocal now
            if stage != now:
                # The stage before is over, whether it knew how long it would be or not; it may come again in another round.
                if now:
                    bar.update(tasks[now], total=1, completed=1, visible=False)
                if stage in tasks:
                    bar.reset(tasks[stage], total=total or None, visible=True)
                else:
                    tasks[stage] = bar.add_task(stage, total=total or None)
                now = stage
            bar.update(tasks[stage], completed=done, total=total or None)

        yield tell


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


def run(
    command: "Callable[[ProgressCallback], CommandResult]",
    as_json: bool,
    kept: Path | None = None,
    plots: Path | None = None,
) -> None:
    """Run a command, print its result, and exit with 1 where a check does not hold.

    `kept` is the folder from which the same command goes on where it was stopped; `plots` is one for the figures of its report.
    """
    if plots is not None:
        from omnilines.commands.plots import with_plots
        from omnilines.files.folders import check_results

        check_results(plots, ())
    goes_on = f"; what was found is kept in {kept}, the same command goes on from there"
    if kept is None:
        goes_on = " before its results were whole; the same command begins anew"
    say_when_stopped(printable(f"stopped{goes_on}."))
    if (note := note_on_cache()) is not None:
        typer.echo(f"note: {note}", err=True)
    with progress() as tell, spelled_as(flag_of):
        result = command(tell)
        if plots is not None:
            result = with_plots(result, plots, tell)
    whole = "--json" if result.report is None else result.report.name
    with said_in_full():
        for note in (*result.warnings, *told(result.details, result.photos, whole)):
            typer.echo(f"note: {printable(with_flags(note))}", err=True)
        if as_json:
            typer.echo(with_flags(json.dumps(_data(result), indent=2, allow_nan=False)))
        else:
            _print_tables(result)
    if not result.holds:
        raise typer.Exit(1)


def _data(result: "CommandResult") -> dict[str, Any]:
    """What --json prints."""
    from omnilines.commands.result import known_numbers

    checks = known_numbers([vars(check) for check in result.checks])
    files = [str(path) for path in result.files]
    report = str(result.report) if result.report else None
    verdict = " ".join(summary.verdict for summary in result.summaries if summary.verdict) or None
    advice = [{"limit": one.limit, "do": one.do} for summary in result.summaries for one in summary.advice]
    return {
        "verdict": verdict,
        "advice": advice,
        "notes": result.notes,
        **result.data,
        "checks": checks,
        "holds": result.holds,
        "files": files,
        "report": report,
    }


@contextmanager
def said_in_full() -> "Iterator[None]":
    """What is printed within it leaves the process at once. A reader who goes, as `head` does, is no error: results are files.

    Raises InputError where standard output cannot be written.
    """
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        # What is left in the buffer would be tried again at the end.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in filter(None, (sys.stdout, sys.stderr) if isinstance(error, BrokenPipeError) else (sys.stdout,)):
            os.dup2(nowhere, stream.fileno())
        if not isinstance(error, BrokenPipeError):
            raise InputError(f"Standard output cannot be written ({error.strerror}); all files of the result are.") from None


def _print_tables(result: "CommandResult") -> None:
    from omnilines.report.numbers import figure

    for summary in result.summaries:
        typer.echo(printable(summary.title))
        rows = rows_shown(summary.rows) if summary.of_photos else summary.rows
        rows = [(shortened(name), text) for name, text in rows]
        width = max((len(name) for name, _ in rows), default=0)
        for name, text in rows:
            typer.echo(printable(f"  {name:<{width}}  {text}"))
    if result.checks:
        typer.echo("Checks")
        width = max(len(check.name) for check in result.checks)
        for check in result.checks:
            verdict = "holds" if check.holds else "DOES NOT HOLD"
            typer.echo(f"  {check.name:<{width}}  {figure(check.value, '.4g', check.unit)} (limit {check.limit:.4g})  {verdict}")
    for summary in result.summaries:
        if summary.verdict:
            typer.echo(printable(summary.verdict))
        for one in summary.advice:
            typer.echo(printable(with_flags(f"- {one.limit} {one.do}")))
    said = any(name.startswith("written") for summary in result.summaries for name, _ in summary.rows)
    if result.report:
        typer.echo(printable(f"Report: {result.report}"))
    elif result.files and not said:
        more = f", and {len(result.files) - 1} more" if len(result.files) > 1 else ""
        typer.echo(printable(f"Written: {result.files[0]}{more}"))
    if result.then and result.holds:
        typer.echo(printable(f"Next: {shlex.join(['omnilines', *result.then])}"))
