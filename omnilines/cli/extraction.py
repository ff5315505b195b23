"""The command on arcs: extract."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnilines.cli._shared import Json, Out, Settings, SplitInto, app, run

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.progress import ProgressCallback

ScenePhotos = Annotated[list[Path], typer.Argument(help="Photos, folders of photos, or a video.", show_default=False)]


@app.command()
def extract(
    photos: ScenePhotos,
    calibration: Annotated[Path, typer.Option("--calibration", help="calibration.yaml of the camera.", show_default=False)],
    out: Out,
    mask: Annotated[Path | None, typer.Option("--mask", help="Image whose white pixels are looked at.")] = None,
    split: SplitInto = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Find arcs of straight lines in photos -> segments.csv and pictures."""
    from omnilines.commands.extract import extract as command
    from omnilines.commands.frames import with_frames
    from omnilines.extraction import ExtractionOptions
    from omnilines.options import with_settings

    options = with_settings(ExtractionOptions(), settings or (), "extraction.")

    def extracted(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        return with_frames(
            lambda paths: command(paths, calibration, out, mask=mask, options=options, progress=progress),
            photos, out, split=split, progress=progress,
        )  # fmt: skip

    run(extracted, as_json)
