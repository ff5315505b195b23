"""Tables, JSON and report of `omnilines validate --scene`."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from camera_models.wording import rounded
from omnilines import report
from omnilines.evaluation.arcs import MIN_PX
from omnilines.evaluation.scene import MIN_CONTRAST, MIN_VIEWS, scene_scores
from omnilines.geometry.line import end_radius_sigmas
from omnilines.pages.validation import checks_advice, checks_words
from omnilines.records import Summary
from omnilines.report import Section
from omnilines.report.line_scene import line_photos_section, stage_section
from omnilines.report.numbers import figure
from omnilines.studies.scene_validation import TOLERANCE_PX, SceneValidation

CURVE_PX = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Distances, in pixels at the median distance, at which recall and precision are drawn."""
_ON, _OFF = "on a true edge", "on none"


def scene_validation_summaries(validation: SceneValidation) -> tuple[Summary, ...]:
    """The setting, the arcs, the lines and their uncertainty."""
    truth, rebuilt, scores, arcs = validation.truth, validation.rebuilt, validation.scores, validation.arcs
    width, height = truth.camera.image_size
    setting = (
        ("scene", f"{truth.name}, seed {truth.seed}, {len(truth.edges)} edges"),
        ("camera", f"{truth.camera.NAME}, {width}x{height} px, {len(truth.poses)} photos"),
        ("median distance of the edges", f"{validation.distance_m:.2f} m, where a pixel is {1e3 * validation.pixel_m:.3g} mm"),
    )
    extracted = (
        ("arcs", f"{arcs.arcs}, {arcs.mean_arc_px:.0f} px long on average"),
        ("on true edges", f"{_percent(arcs.on_line_share)} (worst photo {_percent(float(validation.on_edge_of_photo.min()))})"),
        ("edge length under arcs", _percent(arcs.covered_share)),
        ("arcs per stretch of edge", figure(arcs.arcs_per_stretch)),
        ("direction of arcs, median and 95th percentile", _pair(arcs.direction_deg(50), arcs.direction_deg(95), "degrees")),
        ("slack that was found", f"{rebuilt.slack_px:g} px"),
    )
    within = [
        (f"within {1e3 * tau:.3g} mm", f"{_percent(right)} of the lines, {_percent(found)} of the length")
        for tau, right, found in zip(scores.thresholds_m, scores.precision.tolist(), scores.recall.tolist(), strict=True)
    ]
    lines = (
        ("lines", f"{scores.lines}, {scores.total_m:.1f} m"),
        ("true edges that count", f"{scores.visible_m:.1f} m"),
        *within,
        ("farther end from the nearest edge", f"{1e3 * scores.median_error_m:.3g} mm (median)"),
        ("direction of lines, median and 95th percentile", _pair(scores.direction_deg(50), scores.direction_deg(95), "degrees")),
        ("length that repeats other lines", _percent(scores.repeated_share)),
    )
    stated = (
        ("lines on an edge", f"{int(validation.own.sum())} of {scores.lines}"),
        (f"their ends within {end_radius_sigmas():.3g} sigma_m, 95 percent where that holds", _percent(validation.inside_share)),
        ("inside the 95 percent ellipsoid of their covariance", _percent(validation.covariance_share)),
        (f"lines within {1e3 * validation.tolerance_m:.3g} mm, as sigma_m predicts", _percent(validation.expected_precision)),
    )
    note = (
        f"Edges count where at least {MIN_VIEWS} photos see them, with {MIN_CONTRAST:g} grey levels or more and {MIN_PX:g} px "
        f"or more. A line is within a distance when nine tenths of its length are. The last distance is {TOLERANCE_PX:g} pixels."
    )
    return (
        Summary("Rendered scene", setting, verdict=_verdict(validation), advice=checks_advice(validation.checks)),
        Summary("Arcs", extracted),
        Summary("Lines", lines, (note,)),
        Summary("What the lines state of their accuracy", stated),
    )


def _verdict(validation: SceneValidation) -> str:
    """How much of the lines is right and how much of the edges is found, in one sentence."""
    scores = validation.scores
    return (
        f"{checks_words(validation.checks)}: of {scores.lines} lines {_percent(scores.precision[-1])} lie within "
        f"{rounded(1e3 * scores.thresholds_m[-1])} mm of a true edge, and {_percent(scores.recall[-1])} of the length "
        f"of edges that {MIN_VIEWS} photos see well is found."
    )


def scene_validation_data(validation: SceneValidation) -> dict[str, Any]:
    """For `--json`."""
    truth, rebuilt, scores, arcs = validation.truth, validation.rebuilt, validation.scores, validation.arcs
    return {
        "scene": truth.name,
        "model": truth.camera.NAME,
        "image_size": list(truth.camera.image_size),
        "seed": truth.seed,
        "photos": len(truth.poses),
        "distance_m": validation.distance_m,
        "pixel_m": validation.pixel_m,
        "tolerance_m": validation.tolerance_m,
        "arcs": {
            "count": arcs.arcs,
            "on_edge_share": _known(arcs.on_edge_share),
            "on_line_share": _known(arcs.on_line_share),
            "covered_share": _known(arcs.covered_share),
            "per_stretch": _known(arcs.arcs_per_stretch),
            "mean_px": _known(arcs.mean_arc_px),
            "direction_median_deg": _known(arcs.direction_deg(50)),
            "direction_p95_deg": _known(arcs.direction_deg(95)),
        },
        "views": [
            {"image": image, "on_edge_share": on, "in_lines_share": lines}
            for image, on, lines in zip(
                truth.poses.images, validation.on_edge_of_photo.tolist(), validation.in_line_of_photo.tolist(), strict=True
            )
        ],
        "stages": [asdict(stage) for stage in rebuilt.stages],
        "slack_px": rebuilt.slack_px,
        "rms_px": rebuilt.rms_px,
        "lines": scores.lines,
        "length_m": scores.total_m,
        "visible_m": scores.visible_m,
        "within": [
            {"distance_m": tau, "precision": right, "recall": found, "inlier_share": touch, "length_recall_m": length}
            for tau, right, found, touch, length in zip(
                scores.thresholds_m,
                scores.precision.tolist(),
                scores.recall.tolist(),
                scores.inlier_share.tolist(),
                scores.length_recall_m.tolist(),
                strict=True,
            )
        ],
        "median_error_m": scores.median_error_m,
        "direction_median_deg": scores.direction_deg(50),
        "direction_p95_deg": scores.direction_deg(95),
        "repeated_share": scores.repeated_share,
        "median_sigma_m": float(np.median(rebuilt.lines.sigma_m)),
        "on_edge": int(validation.own.sum()),
        "inside_sigma_share": validation.inside_share,
        "inside_covariance_share": validation.covariance_share,
        "expected_precision": validation.expected_precision,
    }


def write_scene_validation_page(validation: SceneValidation, path: str | Path, photo_folder: str | Path | None = None) -> Path:
    """Write the page of a validation on a scene and return its path."""
    title = f"Validation on a rendered {validation.truth.name}"
    return report.write_report(path, title, scene_validation_sections(validation, photo_folder))


def scene_validation_sections(validation: SceneValidation, photo_folder: str | Path | None) -> list[Section]:
    """All sections, in reading order; photos only where their folder is known."""
    truth, rebuilt = validation.truth, validation.rebuilt
    photos = []
    if photo_folder is not None:
        photos = [line_photos_section(photo_folder, rebuilt.lines, rebuilt.segments, rebuilt.poses, rebuilt.cameras)]
    in_sigmas = validation.across_m / rebuilt.lines.sigma_m[:, None]
    seen = np.unique(truth.stretches.edge)
    summaries = scene_validation_summaries(validation)
    return [
        report.verdict_section(summaries[0]),
        report.scene_section(
            lines=rebuilt.lines,
            groups=[_ON if own else _OFF for own in validation.own.tolist()],
            cameras=rebuilt.poses,
            truth_m=truth.edges.ends_m[seen],
            caption="The true lines are the edges that any photo sees.",
        ),
        report.checks_section(validation.checks),
        report.summary_section(*summaries),
        stage_section(rebuilt.stages),
        _by_distance(validation),
        report.histogram_section(
            "Distance of the lines' ends from their edges",
            {"both ends of every line": in_sigmas},
            "distance across (sigma_m)",
            f"Of honest lines 95 percent are below {end_radius_sigmas():.3g}.",
            logarithmic=True,
        ),
        report.summary_section(_photos(validation), title="Photos"),
        *photos,
    ]


def _by_distance(validation: SceneValidation) -> Section:
    """Strict precision and recall against the distance."""
    truth = validation.truth
    thresholds = [share * validation.pixel_m for share in CURVE_PX]
    scores = scene_scores(validation.rebuilt.lines.ends_m, truth.edges, truth.stretches, thresholds, min_px=MIN_PX)
    x = 1e3 * np.array(thresholds)
    return report.curve_section(
        "Precision and recall",
        {"lines that are right": (x, 100 * scores.precision), "length that is found": (x, 100 * scores.recall)},
        "distance from the edge (mm)",
        "share (percent)",
        f"A pixel is {1e3 * validation.pixel_m:.3g} mm at the median distance of the edges.",
    )


def _photos(validation: SceneValidation) -> Summary:
    rows = tuple(
        (image, f"{_percent(on)} of the arcs on true edges, {_percent(lines)} in lines")
        for image, on, lines in zip(
            validation.truth.poses.images,
            validation.on_edge_of_photo.tolist(),
            validation.in_line_of_photo.tolist(),
            strict=True,
        )
    )
    return Summary("Arcs of every photo", rows)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if math.isfinite(share) else "not known"


def _pair(first: float, second: float, unit: str) -> str:
    return f"{first:.3g} and {second:.3g} {unit}" if math.isfinite(first) else "not known"


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
