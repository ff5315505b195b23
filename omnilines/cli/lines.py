"""Commands on lines: reconstruct, adjust, export."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from camera_models.errors import InputError
from omnilines.cli._shared import Body, Cluster, Json, LossName, MaskOf, Out, Plots, Seed, Settings, SplitInto, app, run
from omnilines.cli.counts import PARTS
from omnilines.cli.values import parse_three
from omnilines.triangulation import method_options

if TYPE_CHECKING:
    from omnilines.commands.result import CommandResult
    from omnilines.extraction import ExtractionOptions
    from omnilines.pipelines.options import SceneOptions
    from omnilines.progress import ProgressCallback

Calibration = Annotated[
    Path, typer.Option("--calibration", help="calibration.yaml; of panoramas equirectangular.", show_default=False)
]
Poses = Annotated[
    Path,
    typer.Option(
        "--poses",
        help="poses.csv (cam_from_world), a COLMAP model's folder, a file of Metashape, Pix4D, Nerfstudio, OpenMVG or OpenSfM, "
        "or a trajectory (TUM, EuRoC, KITTI).",
        show_default=False,
    ),
]
PoseSource = Annotated[
    str,
    typer.Option(
        "--poses",
        help="poses.csv, a COLMAP model's folder, a file of Metashape, Pix4D, Nerfstudio, OpenMVG or OpenSfM, or a trajectory "
        "(TUM, EuRoC, KITTI); with photos also sfm, rig, boards or rectangle:279x216mm (a sheet of paper).",
        show_default=False,
    ),
]
ScenePhotos = Annotated[
    list[Path] | None, typer.Argument(help="Photos, folders of photos, a video, or a bag (BAG:/topic).", show_default=False)
]
SegmentTable = Annotated[Path, typer.Option("--segments", help="segments.csv (matched segments)", show_default=False)]
MaybeSegments = Annotated[
    Path | None,
    typer.Option("--segments", help="segments.csv: matched segments without photos, or unmatched ones of the photos."),
]
Triangulation = Annotated[str, typer.Option("--triangulation", help="dual, averaging, svd or ml.")]
Cost = Annotated[str, typer.Option("--cost", help="sector, whitened, taylor-kriegman or bartoli-sturm.")]
Subset = Annotated[
    int | None,
    typer.Option("--subset", help="With averaging: planes in each subset whose lines are averaged (3).", show_default=False),
]
Bandwidth = Annotated[
    float | None,
    typer.Option(
        "--bandwidth",
        help="With averaging: width of its kernel, radians (the median distance of a track's samples).",
        show_default=False,
    ),
]
Weights = Annotated[
    str | None,
    typer.Option(
        "--weights",
        help="With dual: weights of its rows, unit (default), published (in the file's frame) or most-likely.",
        show_default=False,
    ),
]
MaybeCost = Annotated[
    str | None,
    typer.Option("--cost", help="sector, whitened (default), taylor-kriegman or bartoli-sturm."),
]
MaybeLoss = Annotated[str | None, typer.Option("--loss", help="none, huber or cauchy (of photos: cauchy, of segments: none).")]
Robust = Annotated[bool, typer.Option("--robust", help="Find segments that belong to other lines, and leave them out.")]
PoseSigmaDeg = Annotated[
    float | None,
    typer.Option("--pose-sigma-deg", help="How well given poses that are refined are known: rotation, degrees (a prior)."),
]
PoseSigmaM = Annotated[
    float | None,
    typer.Option("--pose-sigma-m", help="How well given poses that are refined are known: position, metres (a prior)."),
]
Device = Annotated[str, typer.Option("--device", help="cpu or cuda: where lines are triangulated and adjusted.")]
Refine = Annotated[str, typer.Option("--refine", help="lines, with any of poses, intrinsics, rig.")]
MaybeRefine = Annotated[
    str | None,
    typer.Option("--refine", help="lines, with any of poses, intrinsics, rig (with --poses sfm: lines,poses; else: lines)."),
]
MaybePattern = Annotated[str | None, typer.Option("--pattern", help="Target of --poses boards.")]
ScaleFrom = Annotated[
    str | None,
    typer.Option(
        "--scale-from", help="PHOTO,PHOTO:METRES, a known distance, where poses leave the scale open (sfm, COLMAP, SLAM)."
    ),
]
Partition = Annotated[
    int,
    typer.Option("--partition", help="Adjust in parts of so many photos (0: in one piece, or in parts where memory is short)."),
]
MinViews = Annotated[
    int, typer.Option("--min-views", help="Photos that have to see a line (3 or more); one fewer where all of its arcs agree.")
]
TolerancePx = Annotated[
    float | None,
    typer.Option("--tolerance-px", help="Slack: error of poses and calibration, pixels; found from the arcs if not given."),
]


@app.command()
def reconstruct(
    calibration: Calibration,
    poses: PoseSource,
    out: Out,
    photos: ScenePhotos = None,
    segments: MaybeSegments = None,
    triangulation: Triangulation = "ml",
    subset: Subset = None,
    bandwidth: Bandwidth = None,
    weights: Weights = None,
    cost: MaybeCost = None,
    refine: MaybeRefine = None,
    loss: MaybeLoss = None,
    robust: Robust = False,
    pose_sigma_deg: PoseSigmaDeg = None,
    pose_sigma_m: PoseSigmaM = None,
    pattern: MaybePattern = None,
    body: Body = None,
    scale_from: ScaleFrom = None,
    mask: MaskOf = None,
    min_views: MinViews = 4,
    tolerance_px: TolerancePx = None,
    colmap: Annotated[bool, typer.Option("--colmap", help="Write a COLMAP model too.")] = False,
    device: Device = "cpu",
    recording: Annotated[bool, typer.Option("--recording", help="Write a recording for the rerun viewer too.")] = False,
    seed: Seed = 0,
    split: SplitInto = None,
    cluster: Cluster = None,
    partition: Partition = 0,
    plots: Plots = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Photos, calibration and poses (or matched segments in place of photos) -> 3D lines, report.html."""
    if not photos and segments is None:
        raise InputError(
            "Photos, or `segments` with a table of matched segments, were expected, found neither; give one of them."
        )
    from omnilines.commands.cluster import workers
    from omnilines.commands.frames import with_frames
    from omnilines.commands.reconstruct import check_videos, reconstruct_photos

    of_photos = bool(photos)
    extraction, options = _options(
        settings,
        {"subset": subset, "bandwidth": bandwidth, "weights": weights},
        refine=refine or ("lines,poses" if of_photos and poses == "sfm" else "lines"),
        triangulation=triangulation,
        cost=cost or "whitened",
        loss=loss or ("cauchy" if of_photos else "none"),
        device=device,
        min_views=min_views,
        tolerance_px=tolerance_px,
        seed=seed,
        partition=partition,
    )
    if not photos:
        assert segments is not None
        _from_segments(
            calibration, Path(poses), segments, out, options, body, robust, pose_sigma_deg, pose_sigma_m, as_json, plots
        )
        return

    def reconstructed(progress: "ProgressCallback") -> "CommandResult":
        """What these options ask for."""
        with workers(cluster, progress=progress) as executor:
            return with_frames(
                lambda paths: reconstruct_photos(
                    paths, calibration, poses, out, options, extraction=extraction, segments=segments, pattern=pattern, body=body,
                    scale_from=scale_from, pose_sigma_deg=pose_sigma_deg, pose_sigma_m=pose_sigma_m, mask=mask, colmap=colmap,
                    recording=recording, executor=executor, progress=progress,
                ),
                photos or [], out, split=split, progress=progress,
                check=lambda sizes: check_videos(
                    sizes, calibration, poses, options, segments=segments, pattern=pattern, body=body,
                    pose_sigma_deg=pose_sigma_deg, pose_sigma_m=pose_sigma_m, mask=mask,
                ),
            )  # fmt: skip

    run(reconstructed, as_json, kept=out / "work", plots=plots, photos=photos or [])


def _options(settings: list[str] | None, method: Mapping[str, Any], **given: Any) -> "tuple[ExtractionOptions, SceneOptions]":
    """The options of arcs and of the scene, from their flags and from `settings`; `method` are those of the triangulation."""
    from omnilines.adjustment.scene import parse_refine
    from omnilines.options import with_settings
    from omnilines.pipelines.arcs import SHORT_ARCS
    from omnilines.pipelines.options import SceneOptions

    named = [f"scene.{setting}" if setting.startswith(PARTS) else setting for setting in settings or []]
    of_arcs = [setting for setting in named if setting.startswith("extraction.")]
    others = [setting for setting in named if setting not in of_arcs]
    scene = with_settings(SceneOptions(**{**given, "refine": parse_refine(given["refine"])}), others, "scene.")
    scene = replace(scene, triangulation_options=method_options(scene.triangulation, **method))
    return with_settings(SHORT_ARCS, of_arcs, "extraction."), scene


def _from_segments(
    calibration: Path, poses: Path, segments: Path, out: Path, options: "SceneOptions", body: Path | None, robust: bool,
    pose_sigma_deg: float | None, pose_sigma_m: float | None, as_json: bool, plots: Path | None,
) -> None:  # fmt: skip
    from omnilines.commands.reconstruct import reconstruct_segments

    run(
        lambda progress: reconstruct_segments(
            calibration, poses, segments, out, options, body=body, robust=robust, pose_sigma_deg=pose_sigma_deg,
            pose_sigma_m=pose_sigma_m, progress=progress,
        ),
        as_json,
        plots=plots,
    )  # fmt: skip


@app.command()
def adjust(
    calibration: Calibration,
    poses: Poses,
    segments: SegmentTable,
    out: Out,
    triangulation: Triangulation = "ml",
    subset: Subset = None,
    bandwidth: Bandwidth = None,
    weights: Weights = None,
    cost: Cost = "whitened",
    refine: Refine = "lines,poses",
    loss: LossName = "none",
    body: Body = None,
    robust: Robust = False,
    pose_sigma_deg: PoseSigmaDeg = None,
    pose_sigma_m: PoseSigmaM = None,
    device: Device = "cpu",
    partition: Partition = 0,
    plots: Plots = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Refine the lines and the poses of a scene."""
    _, options = _options(
        settings,
        {"subset": subset, "bandwidth": bandwidth, "weights": weights},
        refine=refine,
        triangulation=triangulation,
        cost=cost,
        loss=loss,
        device=device,
        partition=partition,
    )
    _from_segments(calibration, poses, segments, out, options, body, robust, pose_sigma_deg, pose_sigma_m, as_json, plots)


@app.command()
def export(
    scene: Annotated[Path, typer.Argument(help="Folder that reconstruct or adjust wrote.", metavar="SCENE", show_default=False)],
    out: Annotated[Path, typer.Argument(help="File or folder to write; its name tells the format.", metavar="OUT")],
    to_format: Annotated[
        str | None, typer.Option("--to", help="dxf, glb, geojson, nerfstudio, limap or colmap, else told by the name of OUT.")
    ] = None,
    photos: Annotated[
        Path | None,
        typer.Option("--photos", help="Folder of the photos: nerfstudio names them, masks of colmap are found in them."),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option("--origin", help="LAT,LON,HEIGHT (WGS84, m) of the scene's origin, x east, y north, z up: for GeoJSON."),
    ] = None,
    as_json: Json = False,
) -> None:
    """A scene for other tools: DXF, GLB, GeoJSON, LIMAP, Nerfstudio, COLMAP with masks."""
    from omnilines.commands.export import export as command

    place = parse_three(origin, "--origin") if origin is not None else None
    run(lambda progress: command(scene, out, to_format=to_format, photos=photos, origin=place), as_json)
