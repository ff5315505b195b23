"""Commands on scenes and views: render scene, rectify."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnilines.cli._shared import Body, Json, Mirror, Out, Seed, Settings, Size, SplitInto, app, render_app, run
from omnilines.cli.extraction import arcs_and_directions
from omnilines.cli.values import parse_size

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.progress import ProgressCallback


@render_app.command()
def scene(
    out: Out,
    scene: Annotated[
        str,
        typer.Option(
            "--scene",
            help="room (furnished), plain-room (large pieces), flat (five rooms), street, books (a sheet and books on a table).",
        ),
    ] = "room",
    model: Annotated[
        str, typer.Option("--model", help="Any camera model, equirectangular and cylindrical too.")
    ] = "opencv-fisheye",
    fov_deg: Annotated[
        float | None,
        typer.Option("--fov-deg", help="Across the shorter side, degrees; default 190, pinhole 80, cylindrical 360."),
    ] = None,
    views: Annotated[int, typer.Option("--views", help="Number of photos.")] = 20,
    size: Size = "1280x960",
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of the image noise, grey levels of 255.")] = 2.0,
    blur: Annotated[float, typer.Option("--blur", help="Standard deviation of the blur, pixels.")] = 0.5,
    seed: Seed = 0,
    mirror: Mirror = False,
    textures: Annotated[
        Path | None,
        typer.Option("--textures", help="Folder of photographs that cover the surfaces; truth.csv has no edges of theirs."),
    ] = None,
    texture_m: Annotated[
        float, typer.Option("--texture-m", help="Width of a photograph on a surface, metres; it is repeated.")
    ] = 1.5,
    textured: Annotated[str, typer.Option("--textured", help="What they cover.")] = "walls,floors,ceilings,furniture",
    as_json: Json = False,
) -> None:
    """Photos of a room, a flat, a street or a table, with the true camera, poses, edges and what each photo sees of them."""
    from omnilines.commands.render_scene import render_scene

    image_size = parse_size(size, "--size")
    run(
        lambda progress: render_scene(
            out, scene=scene, model=model, fov_deg=fov_deg, views=views, size=image_size, noise=noise, blur=blur,
            seed=seed, mirror=mirror, textures=textures, texture_m=texture_m, textured=textured.split(","), progress=progress,
        ),
        as_json,
    )  # fmt: skip


@app.command()
def rectify(
    photos: Annotated[
        list[Path], typer.Argument(help="Photos, folders of photos, a video, or a bag (BAG:/topic).", show_default=False)
    ],
    calibration: Annotated[
        Path, typer.Option("--calibration", help="calibration.yaml; of panoramas equirectangular.", show_default=False)
    ],
    out: Out,
    view: Annotated[str, typer.Option("--view", help="perspective, cylindrical, panorama or cube.")] = "perspective",
    poses: Annotated[
        Path | None,
        typer.Option(
            "--poses",
            help="poses.csv, a COLMAP model's folder, a file of Metashape, Pix4D, Nerfstudio, OpenMVG or OpenSfM, or a "
            "trajectory (TUM, EuRoC, KITTI): the poses of the views are written too.",
        ),
    ] = None,
    body: Body = None,
    fov_deg: Annotated[
        float | None, typer.Option("--fov-deg", help="Angle across a perspective (90) or cylindrical (360) view, degrees.")
    ] = None,
    size: Annotated[str | None, typer.Option("--size", help="Size of a view, WIDTHxHEIGHT.")] = None,
    yaw_deg: Annotated[float, typer.Option("--yaw-deg", help="Turn to the right from the optical axis, degrees.")] = 0.0,
    pitch_deg: Annotated[float, typer.Option("--pitch-deg", help="Turn upwards, degrees.")] = 0.0,
    distance_m: Annotated[
        float | None,
        typer.Option("--distance-m", help="Of a rig: distance at which things are seen once, not doubled, metres (far)."),
    ] = None,
    upright: Annotated[
        bool, typer.Option("--upright", help="Turn photos level by the vertical that their lines show; --yaw-deg is from there.")
    ] = False,
    split: SplitInto = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Perspective, cylindrical, panoramic or cube views of photos, with their calibration and poses; a rig is one camera."""
    from omnilines.commands.frames import with_frames
    from omnilines.commands.rectify import check_videos
    from omnilines.commands.rectify import rectify as command

    extraction, options = arcs_and_directions(settings)
    image_size = None if size is None else parse_size(size, "--size")

    def views_of(paths: Sequence[Path], progress: "ProgressCallback") -> "CommandResult":
        return command(
            paths, calibration, out, view=view, poses=poses, body=body, fov_deg=fov_deg, size=image_size, yaw_deg=yaw_deg,
            pitch_deg=pitch_deg, distance_m=distance_m, upright=upright, extraction=extraction, options=options,
            progress=progress,
        )  # fmt: skip

    run(
        lambda progress: with_frames(
            lambda paths: views_of(paths, progress),
            photos,
            out,
            check=lambda sizes: check_videos(
                sizes,
                calibration,
                view,
                poses=poses,
                body=body,
                size=image_size,
                fov_deg=fov_deg,
                yaw_deg=yaw_deg,
                pitch_deg=pitch_deg,
            ),
            split=split,
            progress=progress,
        ),
        as_json,
        kept=out / "work",
    )
