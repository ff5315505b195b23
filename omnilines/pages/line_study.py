"""Tables, checks, CSV and report of a study of lines with known truth."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from omnilines import report
from omnilines.files.tables import number_cells, write_table
from omnilines.records import Check, Summary
from omnilines.report import Section
from omnilines.studies.line_study import ADJUSTMENT, ESTIMATED, POSES, SETTING, TRIANGULATION, MethodFigures, Study
from omnilines.synthetic.lines import LineWorld

NUMBERS = (
    "noise_px",
    "trials",
    "complete",
    "lines_found",
    "rms_2d_px",
    "rms_3d_m",
    "rms_3d_euclidean_m",
    "bound_2d_px",
    "bound_3d_m",
    "over_bound",
    "over_bound_se",
)
COLUMNS = ("poses", "stage", "method", *NUMBERS)


def _rms(values: Tensor) -> float:
    return math.sqrt(float(values.square().nanmean()))


def study_rows(study: Study) -> list[dict[str, Any]]:
    """One row for each method, noise and setting, over all trials; NaN where there is no figure."""
    rows = []
    for f in study.figures:
        ratio, error = study.over_bound(f)
        bound = study.bounds[f.poses]
        values = (
            f.noise_px,
            float(study.trials),
            float(f.complete.sum()),
            float(f.found.mean()),
            _rms(f.rms_2d_px),
            _rms(f.rms_3d_m),
            _rms(f.rms_3d_euclidean_m),
            f.noise_px * bound.rms_px,
            f.noise_px * bound.rms_m,
            ratio,
            error,
        )
        rows.append({"poses": f.poses, "stage": f.stage, "method": f.method, **dict(zip(NUMBERS, values, strict=True))})
    return rows


def write_figures(path: Path, study: Study) -> None:
    """The rows as CSV; an empty cell where there is no figure."""
    rows = study_rows(study)
    columns: dict[str, list[str]] = {name: [row[name] for row in rows] for name in COLUMNS[:3]}
    for name in NUMBERS:
        columns[name] = number_cells(np.array([row[name] for row in rows], dtype=np.float64), path, name, may_be_nan=True)
    write_table(path, columns)


def beyond_share(world: LineWorld) -> float:
    """Share of the observed end points whose bearing is more than 90 degrees off the optical axis."""
    bearings, _ = world.camera.unproject(world.ends_px)
    return float((bearings[..., 2] < 0).to(torch.float64).mean())


def study_about(study: Study) -> tuple[tuple[str, str], ...]:
    """The scene and the trials, in rows."""
    world = study.world
    views = np.bincount(world.track.numpy(), minlength=world.lines)
    return (
        ("camera", f"{world.camera.NAME}, {world.camera.image_size[0]} x {world.camera.image_size[1]} px"),
        ("lines, views, segments", f"{world.lines}, {world.images}, {len(world.track)}"),
        ("views of a line", f"{views.min()} to {views.max()}"),
        ("end points beyond 90 degrees off axis", f"{100 * beyond_share(world):.1f} %"),
        ("trials", f"{study.trials} at each noise of {', '.join(f'{noise:g}' for noise in study.noise_px)} px"),
    )


def _nearest(study: Study) -> float:
    """The noise that the short table is for."""
    return min(study.noise_px, key=lambda noise: (abs(noise - 0.5), noise))


def study_summaries(study: Study, title: str, about: tuple[tuple[str, str], ...]) -> tuple[Summary, ...]:
    """What was done, and the figures of every method at one noise."""
    noise = _nearest(study)
    tables = [Summary(title, about)]
    for poses in POSES:
        for stage in (TRIANGULATION, ADJUSTMENT):
            rows = [(f.method, _described(study, f)) for f in study.of(poses, stage) if f.noise_px == noise]
            tables.append(Summary(f"{stage.capitalize()} at {noise:g} px, {SETTING[poses]}", tuple(rows)))
    note = (
        "2D: RMS orthogonal distance of the observed end points. 3D: RMS distance of the true end points from the lines after "
        "the best similarity, and over the Cramer-Rao bound of that figure, in trials that have every line. Euclidean: after the "
        "best turn and shift alone; bearings leave the scale free, so with estimated poses it shows the scale of the start."
    )
    return (*tables[:-1], Summary(tables[-1].title, tables[-1].rows, (note,)))


def _described(study: Study, f: MethodFigures) -> str:
    ratio, error = study.over_bound(f)
    over = f", {ratio:.3f} ± {error:.3f} of the bound" if math.isfinite(ratio) else ""
    lost = f", {100 * float(f.found.mean()):.1f} % of the lines" if float(f.found.mean()) < 1 else ""
    euclidean = f"Euclidean {_told(1e3 * _rms(f.rms_3d_euclidean_m), 'mm')}"
    return f"2D {_told(_rms(f.rms_2d_px), 'px', '.4f')}, 3D {_told(1e3 * _rms(f.rms_3d_m), 'mm')}{over}, {euclidean}{lost}"


def _told(value: float, unit: str, digits: str = ".4g") -> str:
    """NaN where no trial has every line."""
    return "not known" if math.isnan(value) else f"{value:{digits}} {unit}"


def study_data(study: Study, seed: int) -> dict[str, Any]:
    """For `--json`."""
    methods = dict.fromkeys(f.method for f in study.figures if f.stage == ADJUSTMENT)
    pooled = {poses: {m: study.over_bound(*study.of(poses, ADJUSTMENT, m)) for m in methods} for poses in POSES}
    return {
        "seed": seed,
        "trials": study.trials,
        "noise_px": list(study.noise_px),
        "lines": study.world.lines,
        "views": study.world.images,
        "segments": len(study.world.image),
        "bound_3d_m_per_px": {poses: bound.rms_m for poses, bound in study.bounds.items()},
        "over_bound": {
            poses: {method: {"ratio": _known(ratio), "standard_error": _known(error)} for method, (ratio, error) in each.items()}
            for poses, each in pooled.items()
        },
        "rows": [{name: _known(value) for name, value in row.items()} for row in study_rows(study)],
    }


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def study_sections(study: Study, summaries: tuple[Summary, ...], checks: tuple[Check, ...]) -> list[Section]:
    """All sections, in reading order."""
    plots = [section for poses in POSES for section in _plots(study, poses)]
    scene = report.scene_section(
        cameras=study.world.poses(),
        truth_m=study.world.ends_m.numpy(),
        title="Scene",
        caption="The true lines, between the ends that are observed, and the cameras.",
    )
    return [report.summary_section(*summaries), report.checks_section(checks), *plots, scene]


def _plots(study: Study, poses: str) -> list[Section]:
    """2D and 3D error against noise, and the 3D error over the bound, in one setting."""
    setting, bound = SETTING[poses], study.bounds[poses]
    noise = np.array(study.noise_px, dtype=np.float64)
    expected = {"expected of an efficient estimate": (noise, noise * bound.rms_px)}
    least = {"Cramer-Rao bound": (noise, 1e3 * noise * bound.rms_m)}
    x = "noise (px)"
    sections = []
    for stage in (TRIANGULATION, ADJUSTMENT):
        # Errors of poses span decades above those of noise.
        wide = stage == TRIANGULATION and poses == ESTIMATED and bool((noise > 0).all())
        two, three, flat = (_curves(study, poses, stage, name) for name in ("rms_2d_px", "rms_3d_m", "rms_3d_euclidean_m"))
        name = f"{stage}, {setting}"
        sections += [
            report.curve_section(f"2D error: {name}", two, x, "RMS (px)", reference=expected, logarithmic=wide),
            report.curve_section(f"3D error: {name}", three, x, "RMS (mm)", reference=least, logarithmic=wide),
            report.curve_section(
                f"3D error, Euclidean alignment: {name}",
                flat,
                x,
                "RMS (mm)",
                "The dissertation's figure: turn and shift alone are taken out, so the error of the scale remains.",
                reference=least,
                logarithmic=wide,
            ),
        ]
    ratio = {
        method: (noise, np.array([study.over_bound(f)[0] for f in study.of(poses, ADJUSTMENT, method)]))
        for method in dict.fromkeys(f.method for f in study.of(poses, ADJUSTMENT))
    }
    one = {"Cramer-Rao bound": (noise, np.ones(len(noise)))}
    title = f"3D error over the bound: {ADJUSTMENT}, {setting}"
    return [*sections, report.curve_section(title, ratio, x, "error over the bound", reference=one)]


def _curves(study: Study, poses: str, stage: str, figure: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """RMS over the trials against noise, of every method; metres become millimetres."""
    unit = 1e3 if figure.endswith("_m") else 1.0
    noise = np.array(study.noise_px, dtype=np.float64)
    methods = dict.fromkeys(f.method for f in study.of(poses, stage))
    return {m: (noise, unit * np.array([_rms(getattr(f, figure)) for f in study.of(poses, stage, m)])) for m in methods}
