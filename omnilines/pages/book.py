"""The figures, checks and report of `omnilines experiment book`."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from camera_models import CameraModel
from omnilines import report
from omnilines.adjustment.scene import AdjustedScene
from omnilines.commands.render_scene import RenderedScene
from omnilines.pages.distances import NUMBERS, DistanceFigures
from omnilines.posing.rectangle import Rectangle
from omnilines.records import Check, ImagePoses, Polyline, Segments, Summary
from omnilines.scenes.books import SHEET_M
from omnilines.triangulation import TRIANGULATIONS

SHEET = Rectangle(*SHEET_M)
FOUND, BY_HAND = "found", "by hand"
TRIANGULATION, ADJUSTMENT = "triangulation", "adjustment"
SHOWN = "sector"
"""The cost whose lines and poses are written."""
COLUMNS = (*NUMBERS[:-1], "rms_3d_m")
POSE_LIMIT, LEAST_GAIN = 2.0, 1.0
"""Errors of poses may exceed what they state by so much in RMS; adjusted lines may not fit worse than those they start from."""


@dataclass(frozen=True)
class BookSetting:
    """One way of measuring, in the world of the sheet."""

    name: str
    poses: ImagePoses
    segments: Segments
    figures: tuple[DistanceFigures, ...]
    before: AdjustedScene
    after: AdjustedScene
    pose_errors: Float[np.ndarray, "n 3"]
    """Of each photo: turn (degrees), shift of the camera (m), and both over what is stated, RMS of six."""


def rms_of_each(values: Float[np.ndarray, "n k"]) -> list[float]:
    """Root mean square of every column."""
    rms: list[float] = np.sqrt((values**2).mean(0)).tolist()
    return rms


def book_checks(rendered: RenderedScene, settings: list[BookSetting]) -> tuple[Check, ...]:
    """Whether every sheet was found, poses err as they state, and the adjustment lowers the residuals."""
    posed, views = float(len(settings[0].poses)), float(len(rendered.poses))
    checks = [Check("photos whose sheet was found", posed, views, "photos", posed == views)]
    for setting in settings:
        stated = rms_of_each(setting.pose_errors)[2]
        checks.append(Check(f"error of poses over what they state, {setting.name}", stated, POSE_LIMIT, "", stated <= POSE_LIMIT))
        by_stage = {(f.stage.split(", ")[1], f.method): f.rms_px for f in setting.figures}
        gain = by_stage[ADJUSTMENT, SHOWN] / by_stage[TRIANGULATION, TRIANGULATIONS[0][0]]
        checks.append(Check(f"RMS after adjustment over before, {setting.name}", gain, LEAST_GAIN, "", gain <= LEAST_GAIN))
    return tuple(checks)


def book_summaries(rendered: RenderedScene, settings: list[BookSetting]) -> tuple[Summary, ...]:
    """Camera and poses, then the table of every setting before and after adjustment (table 5.2)."""
    found = settings[0]
    about = [
        ("camera", f"{rendered.model.NAME}, {rendered.model.image_size[0]} x {rendered.model.image_size[1]} px"),
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


def book_sections(
    folder: Path,
    rendered: RenderedScene,
    summaries: tuple[Summary, ...],
    checks: tuple[Check, ...],
    settings: list[BookSetting],
) -> list[report.Section]:
    """The page: summaries, checks, residuals, lines over the photos in `folder`, and the scene."""
    quantity = "orthogonal distance of an end point (px)"
    sections = [report.summary_section(*summaries), report.checks_section(checks)]
    for setting in settings:
        shown = [f for f in setting.figures if f.method in (TRIANGULATIONS[0][0], SHOWN)]
        distances = {f"{f.method}, {f.stage.split(', ')[1]}": f.distance_px for f in shown}
        sections.append(report.histogram_section(f"Residuals, lines {setting.name}", distances, quantity, logarithmic=True))
    curves = [curve for setting in settings[1:] for curve in _reprojections(rendered.model, setting)]
    sections.append(report.photos_section(folder / "photos", curves, title="Lines by hand over the photos"))
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
