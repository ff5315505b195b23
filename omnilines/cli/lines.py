"""Commands on lines: reconstruct, adjust."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnilines.cli._shared import (
    Json,
    LossName,
    Out,
    app,
    run,
)

if TYPE_CHECKING:
    pass


Calibration = Annotated[Path, typer.Option("--calibration", help="calibration.yaml", show_default=False)]
Poses = Annotated[Path, typer.Option("--poses", help="poses.csv (cam_from_world)", show_default=False)]
SegmentTable = Annotated[Path, typer.Option("--segments", help="segments.csv (matched segments)", show_default=False)]
Triangulation = Annotated[str, typer.Option("--triangulation", help="dual, averaging, svd or ml.")]
Cost = Annotated[str, typer.Option("--cost", help="sector, whitened, taylor-kriegman or bartoli-sturm.")]
Robust = Annotated[bool, typer.Option("--robust", help="Find and leave out observations of other lines.")]
PoseSigmaDeg = Annotated[float | None, typer.Option("--pose-sigma-deg", help="Prior on the given poses: rotation, degrees.")]
PoseSigmaM = Annotated[float | None, typer.Option("--pose-sigma-m", help="Prior on the given poses: position, metres.")]
Refine = Annotated[str, typer.Option("--refine", help="lines, with any of poses, intrinsics, rig.")]


@app.command()
def reconstruct(
    calibration: Calibration,
    poses: Poses,
    segments: SegmentTable,
    out: Out,
    triangulation: Triangulation = "dual",
    cost: Cost = "sector",
    refine: Refine = "lines",
    loss: LossName = "none",
    robust: Robust = False,
    pose_sigma_deg: PoseSigmaDeg = None,
    pose_sigma_m: PoseSigmaM = None,
    as_json: Json = False,
) -> None:
    """Calibration, poses and matched segments -> 3D lines, report.html."""
    from omnilines.commands.reconstruct import reconstruct_segments

    run(
        lambda progress: reconstruct_segments(
            calibration, poses, segments, out, triangulation=triangulation, cost=cost, refine=refine, loss=loss,
            robust=robust, pose_sigma_deg=pose_sigma_deg, pose_sigma_m=pose_sigma_m, progress=progress,
        ),
        as_json,
    )  # fmt: skip


@app.command()
def adjust(
    calibration: Calibration,
    poses: Poses,
    segments: SegmentTable,
    out: Out,
    triangulation: Triangulation = "dual",
    cost: Cost = "sector",
    refine: Refine = "lines,poses",
    loss: LossName = "none",
    robust: Robust = False,
    pose_sigma_deg: PoseSigmaDeg = None,
    pose_sigma_m: PoseSigmaM = None,
    as_json: Json = False,
) -> None:
    """Refine the lines and the poses of a scene."""
    reconstruct(
        calibration, poses, segments, out, triangulation, cost, refine, loss, robust, pose_sigma_deg, pose_sigma_m, as_json
    )
