"""Arguments, progress and messages of the `omnilines` command; no arithmetic.

torch and cv2 are imported by the commands themselves, so that `--help` answers at once.
"""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from camera_models.errors import InputError, OmnilinesError

if TYPE_CHECKING:
    from omnilines.commands._common import CommandResult, ProgressCallback

app = typer.Typer(
    name="omnilines",
    help="Calibrate fisheye and omnidirectional cameras, and rebuild the straight lines they see as metric 3D lines.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
render_app = typer.Typer(help="Synthetic photos of targets through any camera model.", no_args_is_help=True)
experiment_app = typer.Typer(help="The dissertation's experiments.", no_args_is_help=True)
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


def parse_size(text: str, option: str) -> tuple[int, int]:
    """(width, height) of a text such as 1280x960; raises InputError otherwise."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"{option} was expected as WIDTHxHEIGHT in pixels, such as 1280x960, found '{text}'.")
    return int(parts[0]), int(parts[1])


@contextmanager
def _progress() -> "Iterator[ProgressCallback]":
    """A progress line on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total or None)
            bar.update(tasks[stage], completed=done)

        yield tell


def _run(command: "Callable[[ProgressCallback], CommandResult]", as_json: bool) -> None:
    """Run a command, print its result, and exit with 1 where a check does not hold."""
    with _progress() as progress:
        result = command(progress)
    for warning in result.warnings:
        typer.echo(f"note: {warning}", err=True)
    if as_json:
        checks = [vars(check) for check in result.checks]
        report = str(result.report) if result.report else None
        files = [str(path) for path in result.files]
        data = {**result.data, "checks": checks, "holds": result.holds, "files": files, "report": report}
        typer.echo(json.dumps(data, indent=2, allow_nan=False))
    else:
        _print_tables(result)
    if not result.holds:
        raise typer.Exit(1)


def _print_tables(result: "CommandResult") -> None:
    for summary in result.summaries:
        typer.echo(summary.title)
        width = max((len(name) for name, _ in summary.rows), default=0)
        for name, text in summary.rows:
            typer.echo(f"  {name:<{width}}  {text}")
    if result.checks:
        typer.echo("Checks")
        width = max(len(check.name) for check in result.checks)
        for check in result.checks:
            verdict = "holds" if check.holds else "DOES NOT HOLD"
            typer.echo(f"  {check.name:<{width}}  {check.value:.4g} {check.unit} (limit {check.limit:.4g})  {verdict}")
    if result.report:
        typer.echo(f"Report: {result.report}")


@app.command()
def pattern(
    specification: Annotated[str, typer.Argument(help="Target: checkerboard:8x6:32.5mm, charuco:..., aprilgrid:...")],
    out: Annotated[Path, typer.Option("--out", help="File ending in .pdf or .svg, or a folder.", show_default=False)],
    as_json: Json = False,
) -> None:
    """Print a calibration target at true scale -> PDF, SVG."""
    from omnilines.commands.pattern import pattern as command

    _run(lambda progress: command(specification, out), as_json)


@app.command()
def detect(photos: Photos, pattern: PatternSpec, out: Out, mirror: Mirror = False, as_json: Json = False) -> None:
    """Find target corners in photos -> corners.csv."""
    from omnilines.commands.detect import detect as command

    _run(lambda progress: command(photos, pattern, out, mirror=mirror, progress=progress), as_json)


@app.command()
def calibrate(
    photos: Photos,
    out: Out,
    pattern: Annotated[str | None, typer.Option("--pattern", help="Target, such as checkerboard:8x6:32.5mm.")] = None,
    image_size: Annotated[str | None, typer.Option("--image-size", help="WIDTHxHEIGHT, with corners.csv.")] = None,
    model: Annotated[str, typer.Option("--model", help="A camera model, or auto: fit all, take the best.")] = "scaramuzza",
    degree: Annotated[int | None, typer.Option("--degree", help="Degree of the scaramuzza polynomial (4).")] = None,
    coefficients: Annotated[int | None, typer.Option("--coefficients", help="Distortion of the pinhole: 0, 5 or 8 (5).")] = None,
    refine_board: Annotated[str, typer.Option("--refine-board", help="aspect, flatness or both, with a comma.")] = "",
    loss: LossName = "cauchy",
    mirror: Mirror = False,
    as_json: Json = False,
) -> None:
    """Photos or corners.csv of one camera -> calibration.yaml, report.html."""
    from omnilines.commands.calibrate import calibrate_corners, calibrate_photos

    tables = [path for path in photos if path.suffix.lower() == ".csv"]
    if tables and (len(photos) > 1 or image_size is None):
        wanted = "one corners.csv alone" if len(photos) > 1 else "--image-size WIDTHxHEIGHT beside corners.csv"
        raise InputError(
            f"{wanted} was expected, found {' '.join(map(str, photos))}; a table does not hold the size of the photos."
        )
    if not tables and pattern is None:
        raise InputError("--pattern was expected with photos, found none; give the target, such as checkerboard:8x6:32.5mm.")
    size = parse_size(image_size, "--image-size") if image_size else None
    board = tuple(name.strip() for name in refine_board.split(",") if name.strip())

    def command(progress: "ProgressCallback") -> "CommandResult":
        if size is not None and tables:
            return calibrate_corners(
                tables[0], size, out, model=model, degree=degree, coefficients=coefficients, loss=loss, mirror=mirror,
                refine_board=board, progress=progress,
            )  # fmt: skip
        return calibrate_photos(
            photos, pattern or "", out, model=model, degree=degree, coefficients=coefficients, loss=loss, mirror=mirror,
            refine_board=board, progress=progress,
        )  # fmt: skip

    _run(command, as_json)


Calibration = Annotated[Path, typer.Option("--calibration", help="calibration.yaml", show_default=False)]
Poses = Annotated[Path, typer.Option("--poses", help="poses.csv (cam_from_world)", show_default=False)]
SegmentTable = Annotated[Path, typer.Option("--segments", help="segments.csv (matched segments)", show_default=False)]
Triangulation = Annotated[str, typer.Option("--triangulation", help="dual, averaging, svd or ml.")]
Cost = Annotated[str, typer.Option("--cost", help="sector, whitened, taylor-kriegman or bartoli-sturm.")]
Robust = Annotated[bool, typer.Option("--robust", help="Find and leave out observations of other lines.")]
PoseSigmaDeg = Annotated[float | None, typer.Option("--pose-sigma-deg", help="Prior on the given poses: rotation, degrees.")]
PoseSigmaM = Annotated[float | None, typer.Option("--pose-sigma-m", help="Prior on the given poses: position, metres.")]
Refine = Annotated[str, typer.Option("--refine", help="lines, with any of poses, intrinsics, rig.")]


@app.command()
def reconstruct(
    calibration: Calibration,
    poses: Poses,
    segments: SegmentTable,
    out: Out,
    triangulation: Triangulation = "dual",
    cost: Cost = "sector",
    refine: Refine = "lines",
    loss: LossName = "none",
    robust: Robust = False,
    pose_sigma_deg: PoseSigmaDeg = None,
    pose_sigma_m: PoseSigmaM = None,
    as_json: Json = False,
) -> None:
    """Calibration, poses and matched segments -> 3D lines, report.html."""
    from omnilines.commands.reconstruct import reconstruct_segments

    _run(
        lambda progress: reconstruct_segments(
            calibration, poses, segments, out, triangulation=triangulation, cost=cost, refine=refine, loss=loss,
            robust=robust, pose_sigma_deg=pose_sigma_deg, pose_sigma_m=pose_sigma_m, progress=progress,
        ),
        as_json,
    )  # fmt: skip


@app.command()
def adjust(
    calibration: Calibration,
    poses: Poses,
    segments: SegmentTable,
    out: Out,
    triangulation: Triangulation = "dual",
    cost: Cost = "sector",
    refine: Refine = "lines,poses",
    loss: LossName = "none",
    robust: Robust = False,
    pose_sigma_deg: PoseSigmaDeg = None,
    pose_sigma_m: PoseSigmaM = None,
    as_json: Json = False,
) -> None:
    """Refine the lines and the poses of a scene."""
    reconstruct(
        calibration, poses, segments, out, triangulation, cost, refine, loss, robust, pose_sigma_deg, pose_sigma_m, as_json
    )


@render_app.command()
def targets(
    out: Out,
    pattern: PatternSpec = "checkerboard:8x6:30mm",
    model: Model = "opencv-fisheye",
    fov_deg: Annotated[float, typer.Option("--fov-deg", help="Field of view of the camera, degrees.")] = 190.0,
    views: Annotated[int, typer.Option("--views", help="Number of photos.")] = 20,
    size: Size = "1280x960",
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of the image noise, grey levels of 255.")] = 2.0,
    blur: Annotated[float, typer.Option("--blur", help="Standard deviation of the blur, pixels.")] = 0.5,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Photos of a calibration target, with the true camera, poses and corners."""
    from omnilines.commands.render import render_targets

    image_size = parse_size(size, "--size")
    _run(
        lambda progress: render_targets(
            out, pattern_spec=pattern, model=model, fov_deg=fov_deg, views=views, size=image_size, noise=noise, blur=blur,
            seed=seed, progress=progress,
        ),
        as_json,
    )  # fmt: skip


@app.command()
def validate(
    out: Out,
    model: Model = "opencv-fisheye",
    fov_deg: Annotated[float, typer.Option("--fov-deg", help="Field of view of the camera, degrees.")] = 190.0,
    views: Annotated[int, typer.Option("--views", help="Number of photos.")] = 20,
    size: Size = "1280x960",
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of the image noise, grey levels of 255.")] = 2.0,
    blur: Annotated[float, typer.Option("--blur", help="Standard deviation of the blur, pixels.")] = 0.5,
    seed: Seed = 0,
    pattern: PatternSpec = "checkerboard:8x6:30mm",
    as_json: Json = False,
) -> None:
    """Render photos with a known camera, calibrate and reconstruct from the files, compare with the truth."""
    from omnilines.commands.validate import validate as command

    image_size = parse_size(size, "--size")
    _run(
        lambda progress: command(
            out, model=model, fov_deg=fov_deg, views=views, size=image_size, noise=noise, blur=blur, seed=seed,
            pattern_spec=pattern, progress=progress,
        ),
        as_json,
    )  # fmt: skip


@experiment_app.command()
def board(
    data: Annotated[Path, typer.Option("--data", help="Folder of board photos, or of corners.csv.", show_default=False)],
    out: Out,
    pattern: PatternSpec = "checkerboard:8x6:32.5mm",
    model: Model = "scaramuzza",
    perturb_deg: Annotated[float, typer.Option("--perturb-deg", help="Turn of every pose before the adjustment.")] = 1.0,
    perturb_m: Annotated[float, typer.Option("--perturb-m", help="Shift of every pose before the adjustment.")] = 0.01,
    seed: Seed = 0,
    triangulation: Triangulation = "dual",
    cost: Cost = "sector",
    as_json: Json = False,
) -> None:
    """Calibrate from photos of a board, rebuild its rows and columns as 3D lines from disturbed poses, before and after."""
    from omnilines.commands.experiment import experiment_board

    _run(
        lambda progress: experiment_board(
            data, out, pattern_spec=pattern, model=model, perturb_deg=perturb_deg, perturb_m=perturb_m, seed=seed,
            triangulation=triangulation, cost=cost, progress=progress,
        ),
        as_json,
    )  # fmt: skip


Noise = Annotated[str, typer.Option("--noise", help="Standard deviations of the end points, pixels, with commas.")]
Trials = Annotated[int, typer.Option("--trials", help="Trials at each noise.")]
PerturbDeg = Annotated[float, typer.Option("--perturb-deg", help="Turn of every pose before it is estimated.")]
PerturbM = Annotated[float, typer.Option("--perturb-m", help="Shift of every pose before it is estimated.")]


STUDIES = {
    "wide": "Lines in a cube, cameras 45 degrees apart: every triangulation and cost against noise, with the Cramer-Rao bound.",
    "short": "The same with cameras 9 degrees apart.",
    "room": "The same in a room of lines through a fisheye of 190 degrees.",
}


def _add_study(name: str) -> None:
    @experiment_app.command(name, help=STUDIES[name])
    def study(
        out: Out,
        trials: Trials = 50,
        noise: Noise = "0.2,0.5,1,1.5,2,2.5,3",
        perturb_deg: PerturbDeg = 1.0,
        perturb_m: PerturbM = 0.05,
        seed: Seed = 0,
        as_json: Json = False,
    ) -> None:
        from omnilines.commands.experiment_lines import experiment_lines, parse_noise

        levels = parse_noise(noise)
        _run(
            lambda progress: experiment_lines(
                name, out, noise_px=levels, trials=trials, perturb_deg=perturb_deg, perturb_m=perturb_m, seed=seed,
                progress=progress,
            ),
            as_json,
        )  # fmt: skip


for _name in STUDIES:
    _add_study(_name)


@experiment_app.command()
def house(
    data: Annotated[Path, typer.Option("--data", help="Folder of the model house, with 2D and 3D in it.", show_default=False)],
    out: Out,
    as_json: Json = False,
) -> None:
    """Lines of the Oxford model house: every triangulation and every cost, residuals in pixels."""
    from omnilines.commands.experiment_house import experiment_house

    _run(lambda progress: experiment_house(data, out, progress=progress), as_json)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: an error that the user can mend is one sentence on standard error and exit status 2."""
    try:
        app(arguments, standalone_mode=True)
    except OmnilinesError as error:
        typer.echo(f"omnilines: {error}", err=True)
        sys.exit(2)
    except OSError as error:
        typer.echo(f"omnilines: {error.filename or 'a file'} cannot be read or written ({error.strerror}).", err=True)
        sys.exit(2)
