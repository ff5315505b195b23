"""Commands on calibration targets: pattern, frames, detect, render targets."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnilines.cli._shared import (
    BlurPx,
    Cluster,
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
    SplitInto,
    Views,
    app,
    render_app,
    run,
)
from omnilines.cli.values import parse_size
from omnilines.options import with_settings

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.progress import ProgressCallback


@app.command()
def pattern(
    specification: Annotated[str, typer.Argument(help="Target: checkerboard:8x6:32.5mm, charuco:..., aprilgrid:...")],
    out: Annotated[Path, typer.Option("--out", help="File ending in .pdf, .svg or .html, or a folder.", show_default=False)],
    screen: Annotated[bool, typer.Option("--screen", help="A page that shows it on a screen, at true scale.")] = False,
    as_json: Json = False,
) -> None:
    """A calibration target at true scale: printed -> PDF, SVG; on a screen -> HTML."""
    from omnilines.commands.pattern import pattern, pattern_on_screen

    run(lambda progress: (pattern_on_screen if screen else pattern)(specification, out), as_json)


@app.command()
def detect(
    photos: Photos,
    pattern: PatternSpec,
    out: Out,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.yaml of the camera, which leads to more corners.")
    ] = None,
    mirror: Mirror = False,
    cluster: Cluster = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Find target corners in photos -> corners.csv."""
    from calib_patterns import DetectionOptions
    from omnilines.commands.cluster import workers
    from omnilines.commands.detect import camera_of_video
    from omnilines.commands.detect import detect as command
    from omnilines.commands.frames import with_frames

    options = with_settings(DetectionOptions(), settings or (), "detection.")

    def detected(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        with workers(cluster, progress=progress) as executor:
            return with_frames(
                lambda paths: command(
                    paths, pattern, out, calibration=calibration, mirror=mirror, options=options, executor=executor,
                    progress=progress,
                ),
                photos, out, pattern, check=partial(camera_of_video, calibration), mirror=mirror, detection=options,
                progress=progress,
            )  # fmt: skip

    run(detected, as_json, kept=out / "work")


@app.command()
def frames(
    videos: Annotated[
        list[Path],
        typer.Argument(
            help="A video or a bag (BAG:/topic), of a rig one for each camera, or a folder of these.", show_default=False
        ),
    ],
    out: Out,
    split: SplitInto = None,
    pattern: Annotated[
        str | None, typer.Option("--pattern", help="Target: take what tells most of the camera; else of a scene.")
    ] = None,
    mirror: Mirror = False,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Choose the frames of a video: still, sharp and telling -> photos, frames.csv."""
    from typing import NamedTuple

    from calib_patterns import DetectionOptions
    from omnilines.commands.frames import frames as command
    from omnilines.footage.options import FrameOptions

    class Stages(NamedTuple):
        """As --set names them."""

        frames: FrameOptions
        detection: DetectionOptions

    options, detection = with_settings(Stages(FrameOptions(), DetectionOptions()), settings or ())
    run(
        lambda progress: command(
            videos, out, pattern, split=split, mirror=mirror, detection=detection, options=options, progress=progress
        ),
        as_json,
        kept=out / "work",
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
