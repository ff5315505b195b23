"""The commands on the arcs of photos: extract, directions, check."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from camera_models.errors import InputError
from omnilines.cli._shared import Cluster, Json, MaskOf, Out, Plots, Settings, SplitInto, app, run

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.extraction import ExtractionOptions
    from omnilines.progress import ProgressCallback
    from omnilines.structure.options import DirectionsOptions

ScenePhotos = Annotated[
    list[Path], typer.Argument(help="Photos, folders of photos, a video, or a bag (BAG:/topic).", show_default=False)
]


@app.command()
def extract(
    photos: ScenePhotos,
    calibration: Annotated[
        Path,
        typer.Option("--calibration", help="calibration.yaml of the camera; of panoramas equirectangular.", show_default=False),
    ],
    out: Out,
    mask: MaskOf = None,
    split: SplitInto = None,
    cluster: Cluster = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Find arcs of straight lines, 25 px and longer, in photos -> segments.csv and pictures."""
    from omnilines.commands.camera_videos import cameras_of_videos
    from omnilines.commands.cluster import workers
    from omnilines.commands.extract import extract as command
    from omnilines.commands.frames import with_frames
    from omnilines.extraction import ExtractionOptions
    from omnilines.options import with_settings

    options = with_settings(ExtractionOptions(), settings or (), "extraction.")

    def extracted(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        with workers(cluster, progress=progress) as executor:
            return with_frames(
                lambda paths: command(
                    paths, calibration, out, mask=mask, options=options, executor=executor, progress=progress
                ),
                photos, out, check=partial(cameras_of_videos, calibration, mask=mask), split=split, progress=progress,
            )  # fmt: skip

    run(extracted, as_json, kept=out / "work")


@app.command()
def directions(
    photos: ScenePhotos,
    calibration: Annotated[
        Path,
        typer.Option("--calibration", help="calibration.yaml of the camera; of panoramas equirectangular.", show_default=False),
    ],
    out: Out,
    orthogonal: Annotated[
        bool, typer.Option("--orthogonal", help="Three directions at right angles, and the rotation of each photo.")
    ] = False,
    vertical: Annotated[
        bool, typer.Option("--vertical", help="Only the vertical, by photos held about upright, and how each is tilted.")
    ] = False,
    mask: MaskOf = None,
    split: SplitInto = None,
    plots: Plots = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Find the directions in which the lines of each photo meet -> directions.csv, rotations where asked for, pictures."""
    from omnilines.commands.camera_videos import cameras_of_videos
    from omnilines.commands.directions import directions as command
    from omnilines.commands.frames import with_frames

    extraction, options = arcs_and_directions(settings)

    def found(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        return with_frames(
            lambda paths: command(
                paths, calibration, out, orthogonal=orthogonal, vertical=vertical, mask=mask, extraction=extraction,
                options=options, progress=progress,
            ),
            photos, out, check=partial(cameras_of_videos, calibration, mask=mask), split=split, progress=progress,
        )  # fmt: skip

    run(found, as_json, kept=out / "work", plots=plots, photos=photos)


def arcs_and_directions(settings: list[str] | None) -> "tuple[ExtractionOptions, DirectionsOptions]":
    """How arcs are found, and the directions in which they meet, as `--set` says."""
    from omnilines.options import with_settings
    from omnilines.pipelines.arcs import SHORT_ARCS
    from omnilines.structure.options import DirectionsOptions

    of_arcs = [setting for setting in settings or () if setting.startswith("extraction.")]
    others = [setting for setting in settings or () if setting not in of_arcs]
    return with_settings(SHORT_ARCS, of_arcs, "extraction."), with_settings(DirectionsOptions(), others, "directions.")


@app.command()
def check(
    photos: ScenePhotos,
    calibration: Annotated[Path, typer.Option("--calibration", help="calibration.yaml of the camera.", show_default=False)],
    out: Annotated[Path | None, typer.Option("--out", help="Folder for check.csv; without it nothing is written.")] = None,
    mask: MaskOf = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Is a calibration still right? Straight lines in photos of anything tell; exit status 1 where they contradict it."""
    from omnilines.commands.camera_videos import cameras_of_videos
    from omnilines.commands.check import check as command
    from omnilines.commands.frames import with_frames
    from omnilines.files.videos import find_videos
    from omnilines.options import with_settings
    from omnilines.pipelines.check_options import CheckOptions

    options = with_settings(CheckOptions(), settings or (), "check.")

    def checked(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        if out is not None:
            return with_frames(
                lambda paths: command(paths, calibration, out, mask=mask, options=options, progress=progress),
                photos, out, check=partial(cameras_of_videos, calibration, mask=mask), progress=progress,
            )  # fmt: skip
        if find_videos(photos):
            raise InputError(f"`out` was expected beside {photos[0]}, for the frames of the video; give a folder.")
        return command(photos, calibration, mask=mask, options=options, progress=progress)

    run(
        checked,
        as_json,
        kept=None if out is None else out / "work",
    )
