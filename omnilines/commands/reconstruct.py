"""omnilines reconstruct and adjust: calibration.yaml, poses.csv and segments.csv -> 3D lines with their uncertainty."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, CameraEstimate, InputError, load, save
from camera_models.formats.calibration_data import RigCamera
from omnilines import report
from omnilines.adjustment.scene import LineScene, parse_refine, reconstruct_lines
from omnilines.adjustment.suspects import Suspect
from omnilines.commands.result import CommandResult
from omnilines.files import (
    is_corners_table,
    read_corners,
    read_poses,
    read_segments,
    write_covariance,
    write_lines,
    write_ply,
    write_poses,
    write_segments,
)
from omnilines.files.folders import output_folder
from omnilines.least_squares import Outcome, Progress
from omnilines.pages.noise_notes import noise_data, noise_notes, noise_row
from omnilines.pipelines.scene_frame import UNIT_KEY, unit_of_table
from omnilines.posing.from_corners import poses_from_corners
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import ImagePoses, Segments, Summary

SHOWN_SUSPECTS = 5
"""Observations named in a note; all of them are in `--json` and the report."""


def reconstruct_segments(
    calibration: Path,
    poses: Path,
    segments: Path,
    out: Path,
    *,
    triangulation: str = "dual",
    triangulation_options: Mapping[str, Any] | None = None,
    cost: str = "whitened",
    refine: str = "lines",
    loss: str = "none",
    robust: bool = False,
    pose_sigma_deg: float | None = None,
    pose_sigma_m: float | None = None,
    device: str = "cpu",
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Triangulate and adjust the lines of a user's own tables; `refine` is `lines` with any of `poses`, `intrinsics` and `rig`.

    With `robust`, observations of other lines are found by consensus and left out. `pose_sigma_deg` and `pose_sigma_m`, both or
    neither, make the poses of the table a prior with these standard deviations of each component. `device` is `cpu` or `cuda`.

    Writes a scene folder: calibration.yaml, poses.csv, segments.csv, lines.csv, covariance.npz, lines.ply, report.html. Raises
    InputError naming file, line and column where a table is malformed, and GeometryError when no track determines a line.
    """
    parts = parse_refine(refine)
    prior = _pose_sigma(pose_sigma_deg, pose_sigma_m, "poses" in parts)
    cameras = load(calibration)
    table = read_segments(segments)
    pose_table = _poses(poses, table, cameras)

    def tell(step: Progress) -> None:
        progress("adjusting the scene", step.iteration, 0)

    progress("triangulating", 0, 0)
    scene = reconstruct_lines(
        table,
        pose_table,
        cameras,
        triangulation=triangulation,
        triangulation_options=triangulation_options,
        cost=cost,
        refine_poses="poses" in parts,
        refine_cameras="intrinsics" in parts,
        refine_rig="rig" in parts,
        rig=cameras.rig,
        pose_sigma=prior,
        robust=robust,
        loss=loss,
        device=device,
        callback=tell,
    )
    scene = replace(scene, lines=replace(scene.lines, unit=unit_of_table(poses)))
    folder = output_folder(out)
    files = write_scene(folder, scene, table, cameras, {"calibration": calibration, "poses": poses, "segments": segments})
    progress("writing the report", 0, 0)
    summary = _summary(scene, triangulation, cost, parts)
    page = report.write_report(folder / "report.html", "Line scene", _sections(scene, summary))
    return CommandResult(
        (summary,), _data(scene, tuple(cameras)), files=(*files, page), report=page, warnings=scene.table.left_out + summary.notes
    )


def _poses(path: Path, segments: Segments, cameras: Calibration) -> ImagePoses:
    """The poses of a table, or those that see its points of known place."""
    if not is_corners_table(path):
        return read_poses(path)
    names = segments.cameras or (next(iter(cameras)),) * len(segments.images)
    if segments.cameras is None and len(cameras.cameras) > 1:
        raise InputError(
            f"{path}: the camera of every photo was expected in the column camera of segments.csv, found none; add it."
        )
    found = poses_from_corners(read_corners(path), cameras, dict(zip(segments.images, names, strict=True)))
    if found.left_out:
        raise InputError(f"{path}: {next(iter(found.left_out.values()))}")
    return found.poses


def _pose_sigma(sigma_deg: float | None, sigma_m: float | None, refined: bool) -> tuple[float, float] | None:
    """Standard deviations (rad, m) of the prior on poses, or None."""
    if sigma_deg is None and sigma_m is None:
        return None
    if sigma_deg is None or sigma_m is None or not (sigma_deg > 0 and sigma_m > 0) or not refined:
        raise InputError(
            "A prior on poses takes --pose-sigma-deg and --pose-sigma-m above 0 and --refine with poses, found "
            f"{sigma_deg}, {sigma_m} and poses {'refined' if refined else 'held'}; give both or neither."
        )
    return math.radians(sigma_deg), sigma_m


def write_scene(
    folder: Path, scene: LineScene, segments: Segments, cameras: Calibration, inputs: dict[str, Any]
) -> tuple[Path, ...]:
    """The files of a scene folder but for the report."""
    paths = tuple(
        folder / name for name in ("calibration.yaml", "poses.csv", "segments.csv", "lines.csv", "covariance.npz", "lines.ply")
    )
    save(paths[0], refined_calibration(scene, cameras, inputs))
    write_poses(paths[1], scene.poses)
    write_segments(paths[2], segments)
    write_lines(paths[3], scene.lines)
    write_covariance(paths[4], scene.poses, scene.lines)
    write_ply(paths[5], scene.lines, camera_centres_m=scene.poses.cam_from_world.centre.numpy())
    return paths


def refined_calibration(scene: LineScene, cameras: Calibration, inputs: dict[str, Any]) -> Calibration:
    """The calibration with the cameras and the rig as they were refined, and with their uncertainty."""
    models, estimates, rig = dict(cameras.cameras), dict(cameras.estimates), dict(cameras.rig)
    for name, model, covariance in zip(models, scene.cameras, scene.adjusted.camera_covariance, strict=False):
        models[name] = model
        sigma = covariance.diagonal().clamp_min(0).sqrt().tolist()
        named = dict(zip(model.PARAMETER_NAMES, sigma, strict=True))
        # The residuals of a calibration are those of its own corners.
        known = replace(estimates.get(name, CameraEstimate()), rms_px_per_axis=None, rms_px_per_point=None)
        estimates[name] = replace(known, sigma=named, covariance=covariance.numpy())
    if scene.cam_from_rig is not None and scene.adjusted.rig_covariance is not None:
        sigmas = scene.adjusted.rig_covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt().numpy()
        rig = {name: RigCamera(scene.cam_from_rig[k], sigmas[k]) for k, name in enumerate(rig)}
    return Calibration(models, estimates, rig, cameras.views, {**provenance(inputs), UNIT_KEY: scene.lines.unit.sign})


def _summary(scene: LineScene, triangulation: str, cost: str, parts: tuple[str, ...]) -> Summary:
    counts = Counter(scene.lines.status)
    lines = scene.lines
    rows = (
        ("tracks", str(len(lines))),
        ("lines", ", ".join(f"{count} {status}" for status, count in counts.most_common())),
        ("photos", str(len(scene.poses))),
        ("triangulation and cost", f"{triangulation}, {cost}"),
        ("refined", ", ".join(parts)),
        ("rms_px before", f"{scene.rms_px(before=True):.4f}"),
        ("rms_px after", f"{scene.rms_px():.4f}"),
        ("median of the largest sigma of a line's ends across it", f"{_median_sigma_m(scene):.3g} {lines.unit.sign}"),
        ("noise of the end points", noise_row(scene.adjusted.noise)),
    )
    notes = _named("do not belong to their track and were left out", scene.wrong)
    notes += _named("lie farther from their line than 99.9 percent should", scene.suspect)
    if "poses" in parts:
        notes += (
            "The scale, position and orientation of the scene are free with bearings alone: the poses as a whole keep those of "
            "poses.csv, and the uncertainties are stated in that frame.",
        )
    if scene.adjusted.outcome is not Outcome.CONVERGED:
        notes += (scene.adjusted.outcome.value,)
    notes += noise_notes(scene.adjusted.noise)
    return Summary("Line scene", rows, notes)


def _named(what: str, found: tuple[Suspect, ...]) -> tuple[str, ...]:
    """One sentence on observations, the first few by name."""
    if not found:
        return ()
    shown = ", ".join(f"{s.track} in {s.image} ({s.distance_px:.1f} px)" for s in found[:SHOWN_SUSPECTS])
    more = f" and {len(found) - SHOWN_SUSPECTS} more" if len(found) > SHOWN_SUSPECTS else ""
    return (f"{len(found)} observations {what}: {shown}{more}.",)


def _median_sigma_m(scene: LineScene) -> float:
    known = scene.lines.sigma_m[np.isfinite(scene.lines.sigma_m)]
    return float(np.median(known)) if len(known) else float("nan")


def _sections(scene: LineScene, summary: Summary) -> list[report.Section]:
    before, after = (values[np.isfinite(values)] for values in (scene.residual_before_px, scene.residual_px))
    distances = {"triangulated": np.abs(before), "adjusted": np.abs(after)}
    return [
        report.summary_section(summary),
        report.histogram_section("Residuals", distances, "orthogonal distance of an observed end (px)"),
        report.scene_section(lines=scene.lines, cameras=scene.poses),
    ]


def _data(scene: LineScene, names: tuple[str, ...]) -> dict[str, Any]:
    sigma = _median_sigma_m(scene)
    return {
        "tracks": len(scene.lines),
        UNIT_KEY: scene.lines.unit.sign,
        "status": dict(Counter(scene.lines.status)),
        "rms_px_before": scene.rms_px(before=True),
        "rms_px": scene.rms_px(),
        "median_sigma_m": sigma if np.isfinite(sigma) else None,
        "noise": noise_data(scene.adjusted.noise),
        "outcome": scene.adjusted.outcome.name.lower(),
        "iterations": scene.adjusted.iterations,
        "left_out": list(scene.table.left_out),
        "wrong": [asdict(suspect) for suspect in scene.wrong],
        "suspect": [asdict(suspect) for suspect in scene.suspect],
        "cameras": {name: model.named_parameters() for name, model in zip(names, scene.cameras, strict=False)},
    }
