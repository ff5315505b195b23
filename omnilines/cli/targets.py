"""Commands on calibration targets: pattern, detect, render targets."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnilines.cli._shared import (
    BlurPx,
    FovDeg,
    Json,
    Mirror,
    Model,
    NoiseGrey,
    Out,
    PatternSpec,
    Photos,
    Seed,
    Settings,
    Size,
    Views,
    app,
    parse_size,
    render_app,
    run,
)
from omnilines.options import with_settings

if TYPE_CHECKING:
    pass


@app.command()
def pattern(
    specification: Annotated[str, typer.Argument(help="Target: checkerboard:8x6:32.5mm, charuco:..., aprilgrid:...")],
    out: Annotated[Path, typer.Option("--out", help="File ending in .pdf or .svg, or a folder.", show_default=False)],
    as_json: Json = False,
) -> None:
    """Print a calibration target at true scale -> PDF, SVG."""
    from omnilines.commands.pattern import pattern as command

    run(lambda progress: command(specification, out), as_json)


@app.command()
def detect(
    photos: Photos,
    pattern: PatternSpec,
    out: Out,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.yaml of the camera, which leads to more corners.")
    ] = None,
    mirror: Mirror = False,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Find target corners in photos -> corners.csv."""
    from calib_patterns import DetectionOptions
    from omnilines.commands.detect import detect as command

    options = with_settings(DetectionOptions(), settings or (), "detection.")
    run(
        lambda progress: command(
            photos, pattern, out, calibration=calibration, mirror=mirror, options=options, progress=progress
        ),
        as_json,
    )


@render_app.command()
def targets(
    out: Out,
    pattern: PatternSpec = "checkerboard:8x6:30mm",
    model: Model = "opencv-fisheye",
    fov_deg: FovDeg = 190.0,
    views: Views = 20,
    size: Size = "1280x960",
    noise: NoiseGrey = 2.0,
    blur: BlurPx = 0.5,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Photos of a calibration target, with the true camera, poses and corners."""
    from omnilines.commands.render_targets import render_targets
    from omnilines.pipelines.render import RenderOptions

    options = RenderOptions(fov_deg, views, parse_size(size, "--size"), noise, blur, seed=seed)
    run(lambda progress: render_targets(out, pattern, model, options, progress=progress), as_json)
