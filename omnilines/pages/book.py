"""The figures, checks and report of `omnilines experiment book`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from camera_models import CameraModel
from omnilines import report
from omnilines.pipelines.rendered import RenderedScene
from omnilines.records import Polyline, Summary
from omnilines.studies.book import (
    ADJUSTMENT,
    COLUMNS,
    SHEET,
    SHOWN,
    TRIANGULATION,
    BookSetting,
    book_checks,
    rms_of_each,
)
from omnilines.studies.distances import json_rows
from omnilines.triangulation import TRIANGULATIONS

POSE_ERRORS = ("rms_deg", "rms_m", "rms_over_stated")


def book_summaries(rendered: RenderedScene, settings: Sequence[BookSetting]) -> tuple[Summary, ...]:
    """Camera and poses, then the table of every setting before and after adjustment (table 5.2)."""
    found = settings[0]
    about = [
        ("camera", f"{rendered.camera.NAME}, {rendered.camera.image_size[0]} x {rendered.camera.image_size[1]} px"),
        ("photos with a pose", f"{len(found.poses)} of {len(rendered.poses)}"),
        ("lines that all of them show", str(len(found.segments.tracks))),
    ]
    for setting in settings:
        turn, shift, stated = rms_of_each(setting.pose_errors)
        about.append((f"poses, {setting.name}", f"RMS {turn:.4f} degrees, {1e3 * shift:.3f} mm, {stated:.2f} of what they state"))
    tables = [Summary("A sheet of paper and books", tuple(about))]
    for setting in settings:
        for stage in (TRIANGULATION, ADJUSTMENT):
            rows = tuple((f.method, f.described()) for f in setting.figures if f.stage.endswith(stage))
            tables.append(Summary(f"Lines {setting.name}, {stage}", rows))
    note = "3D: distance of the true ends of the edges from the lines after the best turn and shift; the sheet gives the scale."
    tables[-1] = replace(tables[-1], notes=(note,))
    return tuple(tables)


def book_data(rendered: RenderedScene, settings: Sequence[BookSetting]) -> dict[str, Any]:
    """For `--json`."""
    return {
        "views": len(rendered.poses),
        "posed": len(settings[0].poses),
        "tracks": len(settings[0].segments.tracks),
        "rows": json_rows([f for setting in settings for f in setting.figures], COLUMNS),
        "poses": {s.name: dict(zip(POSE_ERRORS, rms_of_each(s.pose_errors), strict=True)) for s in settings},
    }


def book_sections(rendered: RenderedScene, settings: Sequence[BookSetting], photo_folder: Path) -> list[report.Section]:
    """The page: summaries, checks, residuals, lines over the photos in a folder, and the scene."""
    quantity = "orthogonal distance of an end point (px)"
    checks = book_checks(rendered, settings)
    sections = [report.summary_section(*book_summaries(rendered, settings)), report.checks_section(checks)]
    for setting in settings:
        shown = [f for f in setting.figures if f.method in (TRIANGULATIONS[0][0], SHOWN)]
        distances = {f"{f.method}, {f.stage.split(', ')[1]}": f.distance_px for f in shown}
        sections.append(report.histogram_section(f"Residuals, lines {setting.name}", distances, quantity, logarithmic=True))
    curves = [curve for setting in settings[1:] for curve in _reprojections(rendered.camera, setting)]
    sections.append(report.photos_section(photo_folder, curves, title="Lines by hand over the photos"))
    caption = "In the frame of the sheet, z down."
    sections.append(
        report.scene_section(
            boards=[("sheet", SHEET.corners_m)],
            lines=settings[0].after.lines,
            cameras=settings[0].after.poses,
            up=(0.0, 0.0, -1.0),
            title=f"Sheet, lines and cameras, {SHOWN} cost",
            caption=caption,
        )
    )
    return sections


def _reprojections(model: CameraModel, setting: BookSetting) -> list[Polyline]:
    """Lines before and after the adjustment projected into every photo, and the ends that were picked (figures 5.10, 5.11)."""
    share = torch.linspace(0.0, 1.0, 17, dtype=torch.float64)[:, None]
    curves = []
    for k, image in enumerate(setting.segments.images):
        for label, scene in (("triangulated", setting.before), ("adjusted", setting.after)):
            lines, at = (scene.before, setting.poses) if label == "triangulated" else (scene.lines, scene.poses)
            ends = torch.as_tensor(lines.ends_m[lines.known])
            points = ends[:, :1] * (1 - share) + ends[:, 1:] * share
            pixels, valid = model.project(at.cam_from_world[at.images.index(image)].transform(points))
            # NaN lifts the pen between lines.
            pen_up = pixels.new_full((len(pixels), 1, 2), torch.nan)
            lifted = torch.cat([torch.where(valid[..., None], pixels, torch.nan), pen_up], 1)
            curves.append(Polyline(image, lifted.reshape(-1, 2).numpy(), f"{label} lines, projected", "model"))
        own = setting.segments.endpoints_px[setting.segments.image == k].reshape(-1, 2)
        curves.append(Polyline(image, own, "picked ends", "observed"))
    return curves
