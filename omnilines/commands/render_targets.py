"""omnilines render targets: photos of a calibration target through a camera that is known, to test any pipeline with."""

import math
from pathlib import Path

from omnilines.commands.result import CommandResult
from omnilines.pipelines.render import RenderOptions
from omnilines.pipelines.render import render_targets as rendered_targets
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Summary


def render_targets(
    out: str | Path,
    pattern_spec: str,
    model: str,
    options: RenderOptions,
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write photos (PNG), calibration.yaml (the true camera and cam_from_board), poses.csv and true_corners.csv into `out`.

    poses.csv holds cam_from_world with the board as the world. Raises InputError for options out of range and GeometryError when
    the camera cannot see the target.
    """
    rendered = rendered_targets(pattern_spec, model, options)
    files = rendered.save(out, progress)
    camera, width, height = rendered.camera, *rendered.camera.image_size
    rows = (
        ("camera model", camera.NAME),
        ("image size", f"{width}x{height} px"),
        ("field of view", f"{rendered.fov_deg:g} degrees"),
        ("photos", str(len(rendered.photos))),
        ("target", rendered.pattern.specification),
        ("boards reach", f"{math.degrees(rendered.max_angle_rad):.1f} degrees off axis"),
        ("written to", str(Path(out))),
    )
    data = {
        "model": camera.NAME,
        "image_size": [width, height],
        "parameters": camera.named_parameters(),
        "photos": list(rendered.photos),
        "pattern": rendered.pattern.specification,
        "max_angle_deg": math.degrees(rendered.max_angle_rad),
        "seed": options.seed,
    }
    seen = ("--pattern", rendered.pattern.specification, "--model", camera.NAME)
    return CommandResult(
        (Summary("Rendered photos", rows),), data, files=files, then=("calibrate", str(out), *seen, "--out", "result")
    )
