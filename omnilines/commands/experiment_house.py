"""omnilines experiment house: line triangulation and adjustment on the Oxford model house (Srestasathiern 2012, section 5.3)."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from omnilines import report
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.scene import LineScene, reconstruct_lines
from omnilines.commands._common import CommandResult, ProgressCallback, output_folder, silent
from omnilines.costs import COSTS
from omnilines.files import read_vgg_lines, write_lines, write_ply, write_poses
from omnilines.files.tables import number_cells, write_table
from omnilines.files.vgg_house import MatchedLines
from omnilines.records import Check, Summary
from omnilines.triangulation import TRIANGULATIONS, triangulate
from omnilines.triangulation.observations import PlaneObservations

PUBLISHED_PX = {"dual, published weights": 0.85, "averaging": 0.63, "svd": 0.62}
"""RMS of the triangulations in the dissertation, whose poses came from a factorisation and not from the matrices."""
SVD_LIMIT_PX, SECTOR_LIMIT_PX = 0.65, 0.435
SHOWN = "sector"
"""The cost whose lines and poses are written."""
NUMBERS = ("lines", "end_points", "rms_px", "min_px", "max_px", "std_px", "published_rms_px")


@dataclass(frozen=True)
class HouseFigures:
    """Orthogonal distances (px) of the end points from the lines of one method."""

    stage: str
    method: str
    lines: int
    distance_px: Float[np.ndarray, " k"]
    """Without sign, both ends of every segment whose line is known."""
    published_px: float = math.nan

    @property
    def rms_px(self) -> float:
        """Root mean square."""
        return float(np.sqrt(np.mean(self.distance_px**2)))

    def row(self) -> dict[str, Any]:
        """The figures by the names of the CSV columns; the standard deviation is that of the distances about their mean."""
        d = self.distance_px
        values = (float(self.lines), float(len(d)), self.rms_px, *map(float, (d.min(), d.max(), d.std())), self.published_px)
        return {"stage": self.stage, "method": self.method, **dict(zip(NUMBERS, values, strict=True))}


def experiment_house(data: str | Path, out: str | Path, *, progress: ProgressCallback = silent) -> CommandResult:
    """Triangulate the lines of the house with every method, adjust lines and poses with every cost, compare the distances.

    Writes figures.csv, report.html and, as the sector cost adjusts them, lines.csv, lines.ply and poses.csv. Raises InputError
    for a folder that does not hold the data.
    """
    house = read_vgg_lines(data)
    figures = list(_triangulations(house))
    scenes: dict[str, LineScene] = {}
    for done, (cost, _) in enumerate(COSTS):
        progress("adjusting lines and poses", done, len(COSTS))
        scenes[cost] = reconstruct_lines(house.segments, house.poses, house.cameras, cost=cost, refine_poses=True)
        distance = np.abs(scenes[cost].residual_px)
        figures.append(_figures("adjustment", cost, int(scenes[cost].lines.known.sum()), distance))
    checks = _checks(house, figures)
    folder = output_folder(out)
    files = tuple(folder / name for name in ("figures.csv", "lines.csv", "lines.ply", "poses.csv"))
    scene = scenes[SHOWN]
    _write_figures(files[0], figures)
    write_lines(files[1], scene.lines)
    write_ply(files[2], scene.lines, camera_centres_m=scene.poses.cam_from_world.centre.numpy())
    write_poses(files[3], scene.poses)
    summaries = _summaries(house, figures)
    page = report.write_report(folder / "report.html", "The model house", _sections(summaries, checks, figures, scene))
    rows = [
        {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in f.row().items()}
        for f in figures
    ]
    data_out = {"tracks": len(house.segments.tracks), "views": len(house.poses), "segments": len(house.segments), "rows": rows}
    return CommandResult(summaries, data_out, checks, (*files, page), page)


def _triangulations(house: MatchedLines) -> list[HouseFigures]:
    """Every method of the registry, and the dual space as published, from the given poses."""
    arcs = arcs_from_segments(house.segments, house.poses, house.cameras).arcs
    poses = house.poses.cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(arcs.bearings, poses, arcs.track, arcs.tracks)
    methods: list[tuple[str, str, dict[str, Any]]] = [(name, name, {}) for name, _ in TRIANGULATIONS]
    methods.append(("dual, published weights", "dual", {"weights": "published", "origin": "file"}))
    found = []
    for name, method, options in methods:
        result = triangulate(method, planes, **options)
        distance = arcs.orthogonal_px(result.lines[arcs.track].projection_normal(poses)).abs().numpy()
        found.append(_figures("triangulation", name, int(result.known.sum()), distance))
    return found


def _figures(stage: str, method: str, lines: int, distance_px: Float[np.ndarray, "n 2"]) -> HouseFigures:
    known = distance_px[np.isfinite(distance_px).all(1)].ravel()
    published = PUBLISHED_PX.get(method, math.nan) if stage == "triangulation" else math.nan
    return HouseFigures(stage, method, lines, known, published)


def _checks(house: MatchedLines, figures: list[HouseFigures]) -> tuple[Check, ...]:
    by_name = {(f.stage, f.method): f for f in figures}
    start, adjusted = by_name["triangulation", "svd"], by_name["adjustment", "sector"]
    tracks = float(len(house.segments.tracks))
    fewest = float(min(start.lines, adjusted.lines))
    return (
        Check("lines of the SVD start and of the sector adjustment", fewest, tracks, "lines", fewest == tracks),
        Check("RMS of the SVD start", start.rms_px, SVD_LIMIT_PX, "px", start.rms_px <= SVD_LIMIT_PX),
        Check(
            "RMS after adjustment with the sector cost",
            adjusted.rms_px,
            SECTOR_LIMIT_PX,
            "px",
            adjusted.rms_px <= SECTOR_LIMIT_PX,
        ),
    )


def _write_figures(path: Path, figures: list[HouseFigures]) -> None:
    rows = [f.row() for f in figures]
    columns = {name: ['"' + row[name] + '"' if "," in row[name] else row[name] for row in rows] for name in ("stage", "method")}
    for name in NUMBERS:
        columns[name] = number_cells(np.array([row[name] for row in rows], dtype=np.float64), path, name, may_be_nan=True)
    write_table(path, columns)


def _summaries(house: MatchedLines, figures: list[HouseFigures]) -> tuple[Summary, ...]:
    segments = house.segments
    setting = Summary(
        "The model house",
        (("lines, views, segments", f"{len(segments.tracks)}, {len(house.poses)}, {len(segments)}"),),
    )
    start = tuple((f.method, _described(f)) for f in figures if f.stage == "triangulation")
    adjusted = tuple((f.method, _described(f)) for f in figures if f.stage == "adjustment")
    note = "Orthogonal distance of both end points of every segment from the projected line, without sign."
    published = "The published figures rest on other poses, from a factorisation; here they are those of the given matrices."
    return (
        setting,
        Summary("Triangulation from the given poses", start, (note, published)),
        Summary("Lines and poses adjusted", adjusted),
    )


def _described(f: HouseFigures) -> str:
    row = f.row()
    published = "" if math.isnan(f.published_px) else f", published RMS {f.published_px:.2f}"
    return (
        f"RMS {row['rms_px']:.4f} px, min {row['min_px']:.1e}, max {row['max_px']:.2f}, std {row['std_px']:.4f}, "
        f"{f.lines} lines{published}"
    )


def _sections(
    summaries: tuple[Summary, ...], checks: tuple[Check, ...], figures: list[HouseFigures], scene: LineScene
) -> list[report.Section]:
    quantity = "orthogonal distance of an end point (px)"
    by_stage = {
        stage: {f.method: f.distance_px for f in figures if f.stage == stage} for stage in ("triangulation", "adjustment")
    }
    return [
        report.summary_section(*summaries),
        report.checks_section(checks),
        report.histogram_section("Residuals after triangulation", by_stage["triangulation"], quantity, logarithmic=True),
        report.histogram_section("Residuals after adjustment", by_stage["adjustment"], quantity, logarithmic=True),
        report.scene_section(lines=scene.lines, cameras=scene.poses, title=f"Lines and cameras, {SHOWN} cost"),
    ]
