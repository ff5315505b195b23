"""Commands on cameras: calibrate, convert, validate; view, doctor."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from calib_patterns import DetectionOptions
from camera_models.errors import InputError
from camera_models.formats import FORMATS
from omnilines.calibration.options import CalibrationOptions
from omnilines.cli._shared import (
    LENS_MODELS,
    BlurPx,
    Cluster,
    Json,
    LossName,
    MaskOf,
    Mirror,
    NoiseGrey,
    Out,
    PatternSpec,
    Photos,
    Plots,
    Seed,
    Settings,
    Size,
    SplitInto,
    Views,
    app,
    run,
)
from omnilines.cli.completion import format_names, model_names
from omnilines.cli.counts import IN_RIG
from omnilines.cli.values import parse_each, parse_px, parse_size
from omnilines.footage.options import FrameOptions
from omnilines.options import with_settings

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.guide.options import GuideOptions
    from omnilines.pipelines.line_options import LinesOptions
    from omnilines.progress import ProgressCallback

DEFAULT = CalibrationOptions
"""Its defaults."""
EACH = "; of a rig also by camera, as in cam0=...,cam1=..."
FILE_NAMES = ", ".join(f"{pattern} ({entry.name})" for entry in FORMATS for pattern in entry.files)
FORMAT_NAMES = ", ".join(sorted(entry.name for entry in FORMATS))


class Stages(NamedTuple):
    """The options of what `calibrate` does, as --set names them."""

    frames: FrameOptions
    detection: DetectionOptions
    calibration: CalibrationOptions
    lines: "LinesOptions"


class GuideStages(NamedTuple):
    """The options of what `guide` does, as --set names them."""

    detection: DetectionOptions
    calibration: CalibrationOptions
    guide: "GuideOptions"


@app.command()
def calibrate(
    photos: Photos,
    out: Out,
    pattern: Annotated[
        str | None,
        typer.Option("--pattern", help="Target, such as checkerboard:8x6:32.5mm; or lines, of buildings; or both: TARGET,lines."),
    ] = None,
    image_size: Annotated[str | None, typer.Option("--image-size", help=f"WIDTHxHEIGHT, with corners.csv{EACH}.")] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help=f"{LENS_MODELS}; or auto: fit all, take the best{EACH}.",
            show_default=DEFAULT.model,
            autocompletion=model_names,
        ),
    ] = None,
    degree: Annotated[
        int | None, typer.Option("--degree", help="Degree of the scaramuzza polynomial; chosen if not given.")
    ] = None,
    coefficients: Annotated[
        int | None,
        typer.Option(
            "--coefficients",
            help="Distortion coefficients to estimate: pinhole 0, 5 or 8 (5; with lines also 8 if photos need it), "
            "fisheye624 6, 8 or 12 (6).",
        ),
    ] = None,
    refine_board: Annotated[
        str, typer.Option("--refine-board", help="Estimate how the board differs from its drawing: aspect, flatness, surface.")
    ] = "",
    loss: LossName = DEFAULT.loss,
    mirror: Mirror = DEFAULT.mirror,
    boards: Annotated[
        str, typer.Option("--boards", help="Several boards: fixed to each other, known (tables), or moving.")
    ] = "fixed",
    calibration: Annotated[Path | None, typer.Option("--calibration", help="Of a rig: known cameras to begin from.")] = None,
    hold: Annotated[bool, typer.Option("--hold", help="Hold the intrinsics of --calibration.")] = False,
    time_offsets: Annotated[
        bool, typer.Option("--time-offsets", help="Of a rig of videos: estimate by how much each camera's clock is ahead.")
    ] = False,
    rolling_shutter: Annotated[
        bool, typer.Option("--rolling-shutter", help="Of videos: estimate how long after one row the next one is exposed.")
    ] = False,
    mask: MaskOf = None,
    split: SplitInto = None,
    cluster: Cluster = None,
    plots: Plots = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Photos or corners.csv of one camera or a rig -> calibration.yaml, report.html."""
    from omnilines.commands.calibrate_inputs import CalibrationInputs, calibrate_inputs
    from omnilines.commands.cluster import workers
    from omnilines.pipelines.line_options import LinesOptions

    sizes = {name: parse_size(size, "--image-size") for name, size in parse_each(image_size or "", "--image-size").items()}
    models = parse_each(model or "", "--model")
    given = CalibrationInputs(photos, pattern, sizes, models, boards, calibration, hold, time_offsets, split, mask)
    if given.named_cameras and not given.rig:
        raise InputError(f"`image_size` and `model` by camera count only {IN_RIG}; found one camera: name none.")
    terms = tuple(name.strip() for name in refine_board.split(",") if name.strip())
    options = CalibrationOptions(
        degree=degree, coefficients=coefficients, loss=loss, mirror=mirror, refine_board=terms, rolling_shutter=rolling_shutter
    )

    def command(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        stages = Stages(FrameOptions(), DetectionOptions(), options, LinesOptions())
        frames, detection, set_options, lines = with_settings(stages, settings or ())
        with workers(cluster, progress=progress) as executor:
            return calibrate_inputs(
                given, out, set_options, frames=frames, detection=detection, lines=lines, executor=executor, progress=progress
            )

    run(command, as_json, kept=None if given.table else out / "work", plots=plots, photos=photos)


@app.command()
def guide(
    source: Annotated[
        str, typer.Argument(help="A camera (0, 1, ...), a video, or a folder that photos come into.", metavar="SOURCE")
    ],
    pattern: PatternSpec,
    out: Out,
    until: Annotated[
        str | None, typer.Option("--until", help="End when the largest uncertainty in the image is below this, such as 0.1px.")
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help=f"{LENS_MODELS}; or auto: all are compared at the end.", autocompletion=model_names)
    ] = DEFAULT.model,
    mirror: Mirror = DEFAULT.mirror,
    port: Annotated[int, typer.Option("--port", help="Of the page on this machine; 0: one that is free.")] = 0,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """A page that says how to hold the board next -> frames, calibration.yaml."""
    from omnilines.guide.options import GuideOptions

    until_px = None if until is None else parse_px(until, "--until")

    def command(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        from omnilines.commands.guide import guide as command

        stages = GuideStages(DetectionOptions(), CalibrationOptions(model=model, mirror=mirror), GuideOptions(until_px))
        detection, calibration, options = with_settings(stages, settings or ())
        return command(
            source,
            pattern,
            out,
            options,
            calibration=calibration,
            detection=detection,
            port=port,
            announce=lambda address: typer.echo(f"Open {address}", err=True),
            progress=progress,
        )

    run(command, as_json, kept=out)


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Calibration file, or folder of them.", metavar="IN", show_default=False)],
    out: Annotated[Path, typer.Argument(help="File or folder to write, such as ros.yaml.", metavar="OUT")],
    from_format: Annotated[
        str | None,
        typer.Option("--from", help=f"Format of IN, else told by its contents: {FORMAT_NAMES}.", autocompletion=format_names),
    ] = None,
    to_format: Annotated[
        str | None,
        typer.Option(
            "--to",
            help=f"Format of OUT, one of these too; else told by its name: that of a format (ros.yaml), or {FILE_NAMES}.",
            autocompletion=format_names,
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option("--model", help=f"{LENS_MODELS}; else that of IN or the nearest OUT holds.", autocompletion=model_names),
    ] = None,
    fov_deg: Annotated[
        float | None, typer.Option("--fov", help="Field of view of a fit, degrees, else all that is known.")
    ] = None,
    image_size: Annotated[str | None, typer.Option("--image-size", help="WIDTHxHEIGHT, where IN does not hold it.")] = None,
    as_json: Json = False,
) -> None:
    """A calibration from one file format or camera model to another, with the conversion error."""
    from omnilines.commands.convert import convert as command

    size = parse_size(image_size, "--image-size") if image_size else None
    run(
        lambda progress: command(
            source, out, from_format=from_format, to_format=to_format, model=model, fov_deg=fov_deg, image_size=size
        ),
        as_json,
    )


@app.command()
def validate(
    out: Out,
    scene: Annotated[
        str | None, typer.Option("--scene", help="room, plain-room, flat or street: rebuild its lines, with no target.")
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="Camera model; with --scene any, else one that can be calibrated.")
    ] = "opencv-fisheye",
    fov_deg: Annotated[
        float | None,
        typer.Option("--fov-deg", help="Across the shorter side, degrees; default 190, with --scene of a pinhole camera 80."),
    ] = None,
    views: Views = 20,
    size: Size = "1280x960",
    noise: NoiseGrey = 2.0,
    blur: BlurPx = 0.5,
    seed: Seed = 0,
    mirror: Annotated[bool, typer.Option("--mirror", help="With --scene: the camera looks into a mirror (a0 < 0).")] = False,
    pattern: Annotated[
        str | None, typer.Option("--pattern", help="Target without --scene; default checkerboard:8x6:30mm.")
    ] = None,
    plots: Plots = None,
    as_json: Json = False,
) -> None:
    """Render photos with a known camera, calibrate and reconstruct from the files, compare with the truth."""
    image_size = parse_size(size, "--size")

    def command(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        from omnilines.pipelines.render import RenderOptions

        options = RenderOptions(fov_deg, views, image_size, noise, blur, mirror=mirror, seed=seed)
        if scene is not None:
            from omnilines.commands.validate_scene import validate_scene

            return validate_scene(out, scene, model, options, progress=progress)
        from omnilines.commands.validate import TARGET, validate

        options = replace(options, fov_deg=190.0 if fov_deg is None else fov_deg)
        return validate(out, pattern or TARGET, model, options, progress=progress)

    run(command, as_json, plots=plots)


@app.command()
def view(
    folder: Annotated[Path, typer.Argument(help="Folder of results, or a report.", metavar="DIR", show_default=False)],
    rerun: Annotated[bool, typer.Option("--rerun", help="The recording of a scene, in the viewer of rerun.")] = False,
    as_json: Json = False,
) -> None:
    """Open the report of a folder of results in the browser; its path where there is none."""

    def command(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        from omnilines.commands.view import view as command

        return command(folder, rerun=rerun)

    run(command, as_json)


@app.command()
def doctor(
    check: Annotated[
        bool, typer.Option("--check/--no-check", help="Calibrate a rendered camera and rebuild a rendered room.")
    ] = True,
    as_json: Json = False,
) -> None:
    """What is installed, cores, caches, and a self-check of half a minute."""

    def command(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        from omnilines.commands.doctor import doctor as command

        return command(check=check, progress=progress)

    run(command, as_json)
