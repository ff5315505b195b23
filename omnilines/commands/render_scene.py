"""omnilines render scene: photos of rooms, a street or a table with known edges, to test how lines are found and rebuilt."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from omnilines.commands.result import CommandResult
from omnilines.files.folders import OF_RENDER, check_output_folder
from omnilines.files.sets import claimed
from omnilines.pipelines.render import MODEL, RenderOptions
from omnilines.pipelines.render import render_scene as rendered_scene
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Summary
from omnilines.scenes import PHOTO_WIDTH_M, PLACES, largest_angle


def render_scene(
    out: str | Path,
    *,
    scene: str = "room",
    model: str = MODEL,
    fov_deg: float | None = None,
    views: int = RenderOptions.views,
    size: tuple[int, int] = RenderOptions.size_px,
    noise: float = RenderOptions.noise_grey,
    blur: float = RenderOptions.blur_px,
    seed: int = 0,
    mirror: bool = False,
    textures: str | Path | None = None,
    texture_m: float = PHOTO_WIDTH_M,
    textured: Sequence[str] = PLACES,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write colour photos (PNG), calibration.yaml, poses.csv, truth.csv and visibility.csv of a scene into `out`.

    docs/scenes.md describes the tables. Raises InputError for options out of range.
    """
    options = RenderOptions(fov_deg, views, size, noise, blur, mirror=mirror, seed=seed)
    check_output_folder(out)
    rendered = rendered_scene(
        scene, model, options, textures=textures, texture_m=texture_m, textured=textured, progress=progress
    )  # fmt: skip
    with claimed(out, rendered.file_names, [] if textures is None else [textures], by=OF_RENDER):
        files = rendered.save(out, progress)
    camera, stretches = rendered.camera, rendered.stretches
    field = 2.0 * math.degrees(largest_angle(camera, rendered.circle_rad))
    seen_px = float(stretches.length_px.sum()) / views
    rows = (
        ("scene", f"{scene}, {len(rendered.scene)} faces"),
        ("camera model", camera.NAME),
        ("image size", f"{size[0]}x{size[1]} px"),
        ("field of view", f"{field:.1f} degrees"),
        ("photos", str(views)),
        ("edges", f"{len(rendered.edges)}, {len(np.unique(stretches.edge))} of them seen"),
        ("edge length in a photo", f"{seen_px:.0f} px"),
        ("written to", str(Path(out))),
    )
    data = {
        "scene": scene,
        "model": camera.NAME,
        "image_size": list(camera.image_size),
        "parameters": camera.named_parameters(),
        "field_of_view_deg": field,
        "photos": list(rendered.poses.images),
        "edges": len(rendered.edges),
        "stretches": len(stretches),
        "edge_length_px": seen_px,
        "seed": seed,
    }
    given = ("--calibration", str(files[files.index(Path(out) / "calibration.yaml")]), "--poses", str(Path(out) / "poses.csv"))
    then = ("reconstruct", str(out), *given, "--out", "lines")
    return CommandResult((Summary("Rendered scene", rows),), data, files=files, then=then)
