"""omnilines render scene: photos of rooms, a street or a table with known edges, to test how lines are found and rebuilt."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from camera_models import Calibration, CameraEstimate, CameraModel, save
from camera_models.formats.disk import write_atomically
from omnilines.commands.result import CommandResult
from omnilines.files import find_photos, read_photo, write_poses
from omnilines.files.folders import output_folder
from omnilines.files.true_edges import Stretches, TrueEdges, write_stretches, write_true_edges
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import ImagePoses, Summary
from omnilines.scenes import (
    PHOTO_WIDTH_M,
    PLACES,
    LineScene,
    build_scene,
    eye,
    largest_angle,
    render_photo,
    scene_camera,
    scene_edges,
    scene_poses,
    stretches_of_photos,
    visible_stretches,
    with_photographs,
)

VIGNETTING = 0.3
"""Share of the light lost at the farthest image corner."""
TRUTH, VISIBILITY = "truth.csv", "visibility.csv"


@dataclass(frozen=True)
class RenderedScene:
    """A set of photos, the truth behind them, and where they were written."""

    scene: LineScene
    model: CameraModel
    circle_rad: float
    """Half the angle across the image circle; pi where there is none."""
    poses: ImagePoses
    edges: TrueEdges
    stretches: Stretches
    files: tuple[Path, ...]


def render_scene(
    out: str | Path,
    *,
    scene: str = "room",
    model: str = "opencv-fisheye",
    fov_deg: float | None = None,
    views: int = 20,
    size: tuple[int, int] = (1280, 960),
    noise: float = 2.0,
    blur: float = 0.5,
    seed: int = 0,
    mirror: bool = False,
    textures: str | Path | None = None,
    texture_m: float = PHOTO_WIDTH_M,
    textured: Sequence[str] = PLACES,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write colour photos (PNG), calibration.yaml, poses.csv, truth.csv and visibility.csv of a scene into `out`.

    `fov_deg` is the angle across the largest image circle (190, or 80 of a pinhole camera). `noise` is in grey levels of 255,
    `blur` in pixels (standard deviations). Scene, camera, poses and noise follow from `seed`. Photographs of the folder
    `textures`, `texture_m` wide on a face, cover the surfaces that `textured` names (`PLACES`). The tables are described in
    docs/scenes.md.

    Raises InputError for options out of range.
    """
    rendered = write_scene(
        out,
        scene=scene,
        model=model,
        fov_deg=fov_deg,
        views=views,
        size=size,
        noise=noise,
        blur=blur,
        seed=seed,
        mirror=mirror,
        textures=textures,
        texture_m=texture_m,
        textured=textured,
        progress=progress,
    )
    camera, stretches = rendered.model, rendered.stretches
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
    return CommandResult((Summary("Rendered scene", rows),), data, files=rendered.files)


def write_scene(
    out: str | Path,
    *,
    scene: str,
    model: str,
    fov_deg: float | None,
    views: int,
    size: tuple[int, int],
    noise: float,
    blur: float,
    seed: int,
    mirror: bool = False,
    textures: str | Path | None = None,
    texture_m: float = PHOTO_WIDTH_M,
    textured: Sequence[str] = PLACES,
    progress: ProgressCallback = silent,
) -> RenderedScene:
    """Do what `render_scene` says and hand back the truth."""
    world = build_scene(scene, seed)
    if textures is not None:
        photographs = [read_photo(photo.path) for photo in find_photos([textures])]
        world = with_photographs(world, photographs, seed, texture_m, textured)
    camera, circle = scene_camera(model, size, seed, fov_deg, mirror)
    poses = scene_poses(world, views, seed, camera)
    folder = output_folder(out)
    edges = scene_edges(world)
    truth = TrueEdges(tuple(f"e{k:0{len(str(len(edges)))}d}" for k in range(len(edges))), edges)
    look = eye(camera, circle)
    images = tuple(f"view{k:0{max(2, len(str(views - 1)))}d}.png" for k in range(views))
    found = []
    progress("rendering photos", 0, views)
    for k, name in enumerate(images):
        options = {"blur_px": blur, "noise_grey": noise, "vignetting": VIGNETTING}
        write_png(folder / name, render_photo(world, look, poses[k], seed=[seed, k], **options))
        found.append(visible_stretches(world, look, poses[k], edges, VIGNETTING))
        progress("rendering photos", k + 1, views)
    stretches = stretches_of_photos(images, found)
    table = ImagePoses(images, poses, ("cam0",) * views)
    inputs = {"scene": scene, "model": model, "fov_deg": fov_deg, "noise": noise, "blur": blur, "mirror": mirror}
    if textures is not None:
        inputs |= {"textures": str(textures), "texture_m": texture_m, "textured": ",".join(textured)}
    tables = tuple(folder / name for name in ("calibration.yaml", "poses.csv", TRUTH, VISIBILITY))
    estimate = CameraEstimate(max_angle_deg=math.degrees(largest_angle(camera, circle)))
    save(tables[0], Calibration({"cam0": camera}, {"cam0": estimate}, provenance=provenance(inputs, seed)))
    write_poses(tables[1], table)
    write_true_edges(tables[2], truth)
    write_stretches(tables[3], stretches, truth)
    files = (*(folder / name for name in images), *tables)
    return RenderedScene(world, camera, circle, table, truth, stretches, files)


def write_png(path: Path, photo: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Write a photo; encoded in memory, since cv2.imwrite only says false where a disk is full or a name is not ASCII."""
    encoded = cv2.imencode(".png", photo)[1]
    write_atomically(path, encoded.tobytes())
