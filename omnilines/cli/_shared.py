"""The application, its options and how a command is run and its result printed."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from camera_models.errors import InputError
from omnilines.cli._stopping import say_when_stopped
from omnilines.cli.spelling import Application, with_flags
from omnilines.compiled_cache import note_on_cache

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.progress import ProgressCallback

app = Application(
    name="omnilines",
    help="Calibrate fisheye and omnidirectional cameras, and rebuild the straight lines they see as metric 3D lines.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
render_app = Application(help="Synthetic photos of targets through any camera model.", no_args_is_help=True)
experiment_app = Application(help="The dissertation's experiments.", no_args_is_help=True)
app.add_typer(render_app, name="render")
app.add_typer(experiment_app, name="experiment")

Photos = Annotated[list[Path], typer.Argument(help="Photos, or folders of photos; or one corners.csv.", show_default=False)]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to.", show_default=False)]
PatternSpec = Annotated[str, typer.Option("--pattern", help="Target, such as checkerboard:8x6:32.5mm (inner corners, square).")]
Model = Annotated[
    str,
    typer.Option(
        "--model", help="Camera model: pinhole, opencv-fisheye, scaramuzza, unified, extended-unified or double-sphere."
    ),
]
Size = Annotated[str, typer.Option("--size", help="Image size, WIDTHxHEIGHT.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Mirror = Annotated[bool, typer.Option("--mirror", help="The camera looks into a mirror (a0 < 0).")]
LossName = Annotated[str, typer.Option("--loss", help="none, huber or cauchy.")]
FovDeg = Annotated[float, typer.Option("--fov-deg", help="Field of view of the camera, degrees.")]
Views = Annotated[int, typer.Option("--views", help="Number of photos.")]
NoiseGrey = Annotated[float, typer.Option("--noise", help="Standard deviation of the image noise, grey levels of 255.")]
BlurPx = Annotated[float, typer.Option("--blur", help="Standard deviation of the blur, pixels.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="An option by its name, such as scene.min_views=3; may be given again.", show_default=False),
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
) -> None:
    """Options of the command as a whole."""


def printable(text: str) -> str:
    """A text in one line, without what a terminal would obey: names of files and cells may hold anything."""
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


LARGEST_SIDE_PX = 100_000


def parse_size(text: str, option: str) -> tuple[int, int]:
    """(width, height) of a text such as 1280x960; raises InputError otherwise."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"{option} was expected as WIDTHxHEIGHT in pixels, such as 1280x960, found '{text}'.")
    width, height = (int(part) if len(part) < 10 else LARGEST_SIDE_PX + 1 for part in parts)
    if max(width, height) > LARGEST_SIDE_PX:
        raise InputError(f"{option} was expected to have sides of at most {LARGEST_SIDE_PX} px, found '{text[:40]}'.")
    return width, height


def parse_px(text: str, option: str) -> float:
    """Pixels of a text such as 0.1px; raises InputError otherwise."""
    try:
        value = float(text.strip().removesuffix("px"))
    except ValueError:
        value = 0.0
    if not 0 < value < LARGEST_SIDE_PX:
        raise InputError(f"{option} was expected as a positive number of pixels, such as 0.1px, found '{text[:40]}'.")
    return value


def parse_each(text: str, option: str) -> dict[str, str]:
    """Values by camera of a text such as cam0=pinhole,cam1=scaramuzza; one without a name stands under "" for all others."""
    found: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, mark, value = item.rpartition("=")
        if name.strip() in found or not value.strip() or (mark and not name.strip()):
            raise InputError(f"{option} was expected as a value, or as CAMERA=VALUE with a comma between, found '{text}'.")
        found[name.strip()] = value.strip()
    return found


@contextmanager
def progress() -> "Iterator[ProgressCallback]":
    """A progress line on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
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


def run(command: "Callable[[ProgressCallback], CommandResult]", as_json: bool, kept: Path | None = None) -> None:
    """Run a command, print its result, and exit with 1 where a check does not hold.

    `kept` is the folder from which the same command goes on where it was stopped.
    """
    goes_on = "" if kept is None else f"; what was found is kept in {kept}, the same command goes on from there"
    say_when_stopped(f"stopped{goes_on}.")
    if (note := note_on_cache()) is not None:
        typer.echo(f"note: {note}", err=True)
    with progress() as tell:
        result = command(tell)
    for warning in result.warnings:
        typer.echo(f"note: {printable(with_flags(warning))}", err=True)
    if as_json:
        checks = [vars(check) for check in result.checks]
        report = str(result.report) if result.report else None
        files = [str(path) for path in result.files]
        data = {**result.data, "checks": checks, "holds": result.holds, "files": files, "report": report}
        typer.echo(with_flags(json.dumps(data, indent=2, allow_nan=False)))
    else:
        _print_tables(result)
    if not result.holds:
        raise typer.Exit(1)


def _print_tables(result: "CommandResult") -> None:
    for summary in result.summaries:
        typer.echo(summary.title)
        width = max((len(name) for name, _ in summary.rows), default=0)
        for name, text in summary.rows:
            typer.echo(printable(f"  {name:<{width}}  {text}"))
    if result.checks:
        typer.echo("Checks")
        width = max(len(check.name) for check in result.checks)
        for check in result.checks:
            verdict = "holds" if check.holds else "DOES NOT HOLD"
            typer.echo(f"  {check.name:<{width}}  {check.value:.4g} {check.unit} (limit {check.limit:.4g})  {verdict}")
    if result.report:
        typer.echo(f"Report: {result.report}")
