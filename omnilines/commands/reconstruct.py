"""omnilines reconstruct and adjust: calibration.yaml, poses.csv and segments.csv -> 3D lines with their uncertainty."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, load, save
from omnilines import report
from omnilines.adjustment.scene import LineScene, parse_refine, reconstruct_lines
from omnilines.commands._common import CommandResult, ProgressCallback, output_folder, provenance, silent
from omnilines.files import read_poses, read_segments, write_covariance, write_lines, write_ply, write_poses, write_segments
from omnilines.least_squares import Outcome, Progress
from omnilines.records import Segments, Summary


def reconstruct_segments(
    calibration: Path,
    poses: Path,
    segments: Path,
    out: Path,
    *,
    triangulation: str = "dual",
    cost: str = "sector",
    refine: str = "lines",
    loss: str = "none",
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Triangulate and adjust the lines of a user's own tables; `refine` is `lines` or `lines,poses`.

    Writes a scene folder: calibration.yaml, poses.csv, segments.csv, lines.csv, covariance.npz, lines.ply, report.html. Raises
    InputError naming file, line and column where a table is malformed, and GeometryError when no track determines a line.
    """
    refine_poses = parse_refine(refine)
    cameras = load(calibration)
    table, pose_table = read_segments(segments), read_poses(poses)

    def tell(step: Progress) -> None:
        progress("adjusting the scene", step.iteration, 0)

    progress("triangulating", 0, 0)
    scene = reconstruct_lines(
        table,
        pose_table,
        cameras,
        triangulation=triangulation,
        cost=cost,
        refine_poses=refine_poses,
        loss=loss,
        callback=tell,
    )
    folder = output_folder(out)
    files = write_scene(folder, scene, table, cameras, {"calibration": calibration, "poses": poses, "segments": segments})
    progress("writing the report", 0, 0)
    summary = _summary(scene, triangulation, cost, refine_poses)
    page = report.write_report(folder / "report.html", "Line scene", _sections(scene, summary))
    return CommandResult(
        (summary,), _data(scene), files=(*files, page), report=page, warnings=scene.table.left_out + summary.notes
    )


def write_scene(
    folder: Path, scene: LineScene, segments: Segments, cameras: Calibration, inputs: dict[str, Any]
) -> tuple[Path, ...]:
    """The files of a scene folder but for the report."""
    paths = tuple(
        folder / name for name in ("calibration.yaml", "poses.csv", "segments.csv", "lines.csv", "covariance.npz", "lines.ply")
    )
    save(paths[0], Calibration(cameras.cameras, cameras.estimates, cameras.rig, cameras.views, provenance(inputs)))
    write_poses(paths[1], scene.poses)
    write_segments(paths[2], segments)
    write_lines(paths[3], scene.lines)
    write_covariance(paths[4], scene.poses, scene.lines)
    write_ply(paths[5], scene.lines, camera_centres_m=scene.poses.cam_from_world.centre.numpy())
    return paths


def _summary(scene: LineScene, triangulation: str, cost: str, refine_poses: bool) -> Summary:
    counts = Counter(scene.lines.status)
    lines = scene.lines
    rows = (
        ("tracks", str(len(lines))),
        ("lines", ", ".join(f"{count} {status}" for status, count in counts.most_common())),
        ("photos", str(len(scene.poses))),
        ("triangulation and cost", f"{triangulation}, {cost}"),
        ("refined", "lines and poses" if refine_poses else "lines"),
        ("rms_px before", f"{scene.rms_px(before=True):.4f}"),
        ("rms_px after", f"{scene.rms_px():.4f}"),
        ("median sigma of a line's ends across it", f"{_median_sigma_m(scene):.3g} m"),
    )
    notes: tuple[str, ...] = ()
    if refine_poses:
        notes += (
            "The scale, position and orientation of the scene are free with bearings alone: the poses as a whole keep those of "
            "poses.csv, and the uncertainties are stated in that frame.",
        )
    if scene.adjusted.outcome is not Outcome.CONVERGED:
        notes += (scene.adjusted.outcome.value,)
    return Summary("Line scene", rows, notes)


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


def _data(scene: LineScene) -> dict[str, Any]:
    sigma = _median_sigma_m(scene)
    return {
        "tracks": len(scene.lines),
        "status": dict(Counter(scene.lines.status)),
        "rms_px_before": scene.rms_px(before=True),
        "rms_px": scene.rms_px(),
        "median_sigma_m": sigma if np.isfinite(sigma) else None,
        "outcome": scene.adjusted.outcome.name.lower(),
        "iterations": scene.adjusted.iterations,
        "left_out": list(scene.table.left_out),
    }
