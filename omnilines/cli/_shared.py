"""The application, its options and how a command is run and its result printed."""

import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from camera_models.errors import InputError
from camera_models.wording import listed
from omnilines.cli._stopping import say_when_stopped
from omnilines.cli.notes import printable, rows_shown, shortened, told
from omnilines.cli.progress import progress
from omnilines.cli.spelling import Application, flag_of, with_flags
from omnilines.compiled_cache import note_on_cache
from omnilines.machine import agree_on_threads
from omnilines.spelling import spelled_as

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.progress import ProgressCallback

app = Application(
    name="omnilines",
    help="Calibrate fisheye and omnidirectional cameras, and rebuild the straight lines they see as metric 3D lines.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
render_app = Application(help="Synthetic photos of targets or scenes, with the truth.", no_args_is_help=True)
experiment_app = Application(
    help="Studies of triangulations and costs against known truth, as in the dissertation.", no_args_is_help=True
)
app.add_typer(render_app, name="render")
app.add_typer(experiment_app, name="experiment")

Photos = Annotated[
    list[Path], typer.Argument(help="Photos, folders of them, a video, a bag (BAG:/topic), or corners.csv.", show_default=False)
]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to.", show_default=False)]
LENS_MODELS = "pinhole, opencv-fisheye, fisheye624, scaramuzza, unified, extended-unified or double-sphere"
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
Body = Annotated[
    Path | None,
    typer.Option(
        "--body",
        help="Where cameras sit on the body of a trajectory: Kalibr's camchain (T_cam_imu), EuRoC's sensor.yaml, VINS-Fusion's "
        "settings (body_T_cam0), KITTI-360's calib_cam_to_pose.txt.",
    ),
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
        int | None, typer.Option("--threads", help="Cores to use (goes before the command); all if not given.", min=1)
    ] = None,
) -> None:
    """Options of the command as a whole."""
    agree_on_threads(threads)


def run(
    command: "Callable[[ProgressCallback], CommandResult]",
    as_json: bool,
    kept: Path | None = None,
    plots: Path | None = None,
    photos: Sequence[Path] = (),
) -> None:
    """Run a command, print its result, and exit with 1 where a check does not hold.

    `kept` is the folder from which the same command goes on where it was stopped; `plots` is one for the figures of its report,
    which may not lie among the `photos`.
    """
    if plots is not None:
        from omnilines.commands.plots import check_plots, with_plots

        check_plots(plots, photos)
    goes_on = f"stopped; what was found is kept in {kept}, the same command goes on from there."
    anew = "stopped before its results were whole; the same command begins anew."
    say_when_stopped(lambda: anew if kept is None or not kept.is_dir() else printable(goes_on))
    if (note := note_on_cache()) is not None:
        typer.echo(f"note: {note}", err=True)
    from omnilines.files.passed_over import passed_over
    from omnilines.files.sets import removals

    with progress() as tell, spelled_as(flag_of), removals() as removed, passed_over() as beside:
        result = command(tell)
        if plots is not None:
            result = with_plots(result, plots, tell)
    result = replace(result, warnings=(*result.warnings, *beside.notes, *_of_removed(removed)))
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


def _of_removed(files: Sequence[Path]) -> tuple[str, ...]:
    """A sentence where the run before wrote files that this one does not, and they are gone."""
    if not files:
        return ()
    gone = "is" if len(files) == 1 else "are"
    return (f"{listed(files)} of an earlier run, which this one does not write, {gone} removed.",)


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
