"""`scene.rrd`: lines, cameras and the truth as a recording for the viewer of rerun (https://rerun.io), which is an extra.

    /world/lines/<status>    the lines, labelled with their track and uncertainty, coloured as in lines.ply
    /world/cameras/<photo>   the pose, and the outline of what the camera sees, on a sphere about it
    /world/truth             true lines, where given

A rerun camera is a pinhole; an outline of bearings serves all cameras alike. Positions are kept in single precision there: to
1e-7 of their distance from the origin.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models import CameraModel
from camera_models.errors import InputError
from camera_models.formats.disk import write_atomically
from camera_models.wording import listed
from omnilines.files.ply import CAMERA_COLOUR, STATUS_COLOURS
from omnilines.records import ImagePoses, Lines

TRUTH_COLOUR = (150, 150, 150)
_SIDE = 24
"""Points of an outline on each side of the image."""
_HALVINGS = 30


def rerun_module() -> Any:
    """The module; raises InputError where the extra is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            f"A recording for the viewer needs rerun, found none ({error}); pip install 'omnilines[viewer]' brings it."
        ) from error
    return rerun


def write_recording(
    path: str | Path,
    lines: Lines,
    poses: ImagePoses,
    cameras: Mapping[str, CameraModel],
    *,
    truth: Float[np.ndarray, "n 2 3"] | None = None,
) -> None:
    """Write the lines that are known, the photos' cameras and, where given, the ends of the true lines (m), in one step.

    Photos whose camera is not named in `poses` have the first one. Raises InputError where rerun is not installed, a photo has
    no camera or the file cannot be written.
    """
    names = poses.cameras or (next(iter(cameras)),) * len(poses)
    for image, name in zip(poses.images, names, strict=True):
        if name not in cameras:
            raise InputError(f"The camera of {image} was expected to be one of {listed(cameras)}, found '{name}'; correct it.")
    rr = rerun_module()
    stream = rr.RecordingStream("omnilines", recording_id="scene", send_properties=False)
    kept = stream.memory_recording()
    for status, colour in STATUS_COLOURS.items():
        rows = [row for row, own in enumerate(lines.status) if own == status]
        if rows:
            _strips(rr, stream, ["lines", status], lines.ends_m[rows], colour, [_label(lines, row) for row in rows])
    if truth is not None and len(truth):
        _strips(rr, stream, ["truth"], truth, TRUTH_COLOUR, None)
    size = _camera_size_m(poses, lines.ends_m[lines.known].reshape(-1, 3))
    outlines = {name: _outline(cameras[name]) * size for name in dict.fromkeys(names)}
    centres, turns = poses.cam_from_world.centre.numpy(), poses.cam_from_world.rotation.mT.numpy()
    for image, name, centre, turn in zip(poses.images, names, centres, turns, strict=True):
        entity = ["world", "cameras", image]
        stream.log(entity, rr.Transform3D(translation=centre, mat3x3=turn), static=True, strict=True)
        shape = rr.LineStrips3D([*outlines[name]], colors=[CAMERA_COLOUR], labels=[image], show_labels=False)
        stream.log(entity, shape, static=True, strict=True)
    write_atomically(path, kept.drain_as_bytes())


def _strips(
    rr: Any, stream: Any, place: list[str], ends: Float[np.ndarray, "n 2 3"], colour: tuple[int, ...], labels: list[str] | None
) -> None:
    shape = rr.LineStrips3D([*ends], colors=[colour], radii=rr.Radius.ui_points(1.5), labels=labels, show_labels=False)
    stream.log(["world", *place], shape, static=True, strict=True)


def _label(lines: Lines, row: int) -> str:
    sigma = f"{1e3 * lines.sigma_m[row]:.3g} {lines.unit.thousandth}"
    return f"{lines.tracks[row]}: {lines.views[row]} views, largest sigma across {sigma}, {lines.rms_px[row]:.3g} px"


def _camera_size_m(poses: ImagePoses, points: Float[np.ndarray, "n 3"]) -> float:
    """A thirtieth of the scene, but for a few far ends."""
    everything = np.concatenate([points, poses.cam_from_world.centre.numpy().reshape(-1, 3)])
    if not len(everything):
        return 1.0
    return float(np.linalg.norm(np.ptp(np.quantile(everything, [0.02, 0.98], axis=0), axis=0))) / 30 or 1.0


def _outline(model: CameraModel) -> Float[np.ndarray, "strips k 3"]:
    """The rim of what a camera sees as closed strip of unit bearings, and a ray to each corner of the image as strips as long.

    The rim is that of the image, or of the model's domain where that ends within the image.
    """
    w, h = model.image_size
    corners = torch.tensor([[0.0, 0.0], [w - 1.0, 0.0], [w - 1.0, h - 1.0], [0.0, h - 1.0]], dtype=torch.float64)
    steps = torch.arange(_SIDE, dtype=torch.float64)[:, None] / _SIDE
    rim = torch.cat([a + (b - a) * steps for a, b in zip(corners, corners.roll(-1, 0), strict=True)])
    middle = model.centre_px.detach()
    with torch.no_grad():
        inside = model.unproject(rim)[1][:, None].double()
        outside = torch.ones_like(inside)
        for _ in range(_HALVINGS):
            share = 0.5 * (inside + outside)
            valid = model.unproject(middle + share * (rim - middle))[1][:, None]
            inside, outside = torch.where(valid, share, inside), torch.where(valid, outside, share)
        bearings = model.unproject(middle + inside * (rim - middle))[0]
    closed = torch.cat([bearings, bearings[:1]])
    rays = torch.linspace(0, 1, len(closed), dtype=torch.float64)[:, None] * bearings[::_SIDE, None]
    return torch.cat([closed[None], rays]).numpy()
