"""Tables and report of `omnilines validate`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models.wording import rounded
from omnilines import report
from omnilines.records import Advice, Check, Polyline, Summary
from omnilines.report import Section
from omnilines.report.numbers import figure, with_sigma
from omnilines.studies.validation import Validation

RINGS = 40
"""Of angle, over which bearing errors are grouped for the plot."""
STEPS_PER_LINE = 40
"""Points per reprojected line: a wide lens bends it."""


def validation_summaries(validation: Validation) -> tuple[Summary, ...]:
    """The setting, the errors of camera and lines, and the parameters beside the true ones."""
    truth, bearings, lines = validation.truth, validation.bearings, validation.lines
    estimate = validation.calibration.estimates["cam0"]
    width, height = truth.camera.image_size
    setting = (
        ("camera model", f"{truth.camera.NAME}, {truth.fov_deg:g} degrees, {width}x{height} px, seed {truth.seed}"),
        ("photos used", f"{len(truth.poses) - validation.photos_lost} of {len(truth.poses)}"),
        ("corners reach", f"{estimate.max_angle_deg or 0.0:.1f} degrees off axis"),
        ("rms_px_per_axis", f"{estimate.rms_px_per_axis or 0.0:.4f}"),
        ("rms_px_per_point", f"{estimate.rms_px_per_point or 0.0:.4f}"),
    )
    found = (
        ("bearings, RMS", f"{bearings.rms_deg:.5f} degrees up to {math.degrees(truth.max_angle_rad):.1f} degrees off axis"),
        ("bearings, largest", f"{bearings.max_deg:.5f} degrees"),
        ("line directions, RMS", f"{math.degrees(float(lines.angle_rad.square().mean().sqrt())):.5f} degrees"),
        ("line directions, largest", f"{math.degrees(float(lines.angle_rad.max())):.5f} degrees"),
        ("distance of the lines' ends, RMS", f"{1e3 * lines.aligned.rms_m:.4g} mm (predicted {1e3 * lines.predicted_rms_m:.4g})"),
        ("distance of the lines' ends, largest", f"{1e3 * float(lines.distance_m.max()):.4g} mm"),
    )
    note = (
        "Bearings are compared after the best common rotation, lines after the best similarity. What is predicted for the lines "
        "follows from the accuracy that the detector states for the corners, not from the residuals of a fit."
    )
    return (
        Summary("Validation", setting, verdict=_verdict(validation), advice=checks_advice(validation.checks)),
        Summary("Errors against the truth", found, (note,)),
        Summary("Parameters: estimated ± one standard deviation, true", parameter_rows(validation)),
    )


def _verdict(validation: Validation) -> str:
    """What is recovered, in one sentence."""
    bearings, lines = validation.bearings.rms_deg, 1e3 * validation.lines.aligned.rms_m
    said = checks_words(validation.checks)
    return f"{said}: bearings are recovered to {rounded(bearings)} degrees and lines to {rounded(lines)} mm (RMS)."


def checks_words(checks: Sequence[Check]) -> str:
    """How many hold."""
    failed = sum(not check.holds for check in checks)
    return f"{failed} of {len(checks)} checks do not hold" if failed else f"All {len(checks)} checks hold"


def checks_advice(checks: Sequence[Check]) -> tuple[Advice, ...]:
    """Of those that do not hold."""
    do = "Try another `seed`: where that fails too it is a fault of ours, or of this setting; the pictures show where."
    failed = [check for check in checks if not check.holds]
    found = [figure(check.value, ".3g", check.unit) for check in failed]
    named = [f"{check.name[0].upper()}{check.name[1:]}" for check in failed]
    return tuple(
        Advice(f"{name}: {value}, where {check.limit:.3g} is the limit.", do)
        for name, value, check in zip(named, found, failed, strict=True)
    )


def parameter_rows(validation: Validation) -> tuple[tuple[str, str], ...]:
    """Each parameter with its standard deviation and its true value; all in the form that calibration holds."""
    true = validation.truth.camera.calibrated_form().named_parameters()  # a higher degree than the truth's is zero there
    sigma = validation.calibration.estimates["cam0"].sigma or {}
    z = dict(zip(validation.parameters.names, validation.parameters.z.tolist(), strict=True))
    return tuple(
        (
            name,
            f"{with_sigma(value, sigma.get(name, 0.0))}, true {true.get(name, 0.0):.7g}"
            + (f", {z[name]:+.2f} sigma" if name in z else ""),
        )
        for name, value in validation.model.named_parameters().items()
    )


def validation_data(validation: Validation) -> dict[str, Any]:
    """For `--json`."""
    truth, parameters, lines = validation.truth, validation.parameters, validation.lines
    return {
        "model": truth.camera.NAME,
        "image_size": list(truth.camera.image_size),
        "fov_deg": truth.fov_deg,
        "seed": truth.seed,
        "photos": len(truth.poses),
        "photos_used": len(truth.poses) - validation.photos_lost,
        "max_angle_deg": math.degrees(truth.max_angle_rad),
        "rms_px_per_axis": validation.calibration.estimates["cam0"].rms_px_per_axis,
        "rms_px_per_point": validation.calibration.estimates["cam0"].rms_px_per_point,
        "bearing_rms_deg": validation.bearings.rms_deg,
        "bearing_max_deg": validation.bearings.max_deg,
        "parameters": validation.model.named_parameters(),
        "true_parameters": truth.camera.named_parameters(),
        "z_scores": dict(zip(parameters.names, parameters.z.tolist(), strict=True)),
        "parameters_mahalanobis2": parameters.statistic,
        "lines": len(validation.scene.lines),
        "corners_aside": validation.corners_aside,
        "line_angle_max_deg": math.degrees(float(lines.angle_rad.max())),
        "line_distance_rms_mm": 1e3 * lines.aligned.rms_m,
        "line_distance_predicted_mm": 1e3 * lines.predicted_rms_m,
        "lines_mahalanobis2": lines.statistic,
    }


def write_validation_page(validation: Validation, path: str | Path, photo_folder: str | Path | None = None) -> Path:
    """Write the page of a validation and return its path."""
    title = f"Validation: {validation.truth.camera.NAME}"
    return report.write_report(path, title, validation_sections(validation, photo_folder))


def validation_sections(validation: Validation, photo_folder: str | Path | None) -> list[Section]:
    """All sections, in reading order; photos only where their folder is known."""
    photos = []
    if photo_folder is not None:
        photos = [report.photos_section(photo_folder, reprojections(validation), images=validation.truth.poses.images)]
    distances = {"both ends of every line": 1e3 * validation.lines.distance_m.numpy()}
    summaries = validation_summaries(validation)
    return [
        report.verdict_section(summaries[0]),
        report.curve_section(
            "Bearing error",
            _error_by_angle(validation),
            "angle off axis (degrees)",
            "error (degrees)",
            "Angle between estimated and true bearings over a uniform grid of pixels, after the best common rotation.",
        ),
        report.histogram_section("Distance of the lines from the truth", distances, "distance (mm)"),
        report.checks_section(validation.checks),
        report.summary_section(*summaries),
        *photos,
        _scene(validation),
    ]


def _error_by_angle(validation: Validation) -> dict[str, tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]]:
    """RMS and largest error in rings of equal width."""
    theta, error = np.degrees(validation.bearings.theta_rad.numpy()), np.degrees(validation.bearings.error_rad.numpy())
    edges = np.linspace(0.0, math.degrees(validation.truth.max_angle_rad), RINGS + 1)
    ring = np.clip(np.digitize(theta, edges) - 1, 0, RINGS - 1)
    count = np.bincount(ring, minlength=RINGS)
    largest = np.zeros(RINGS)
    np.maximum.at(largest, ring, error)
    seen = count > 0
    middle = 0.5 * (edges[1:] + edges[:-1])[seen]
    rms = np.sqrt(np.bincount(ring, error**2, minlength=RINGS)[seen] / count[seen])
    return {"RMS": (middle, rms), "largest": (middle, largest[seen])}


def reprojections(validation: Validation) -> list[Polyline]:
    """The rebuilt lines projected into every photo by the calibrated camera, and the corners that were observed."""
    ends, poses = torch.as_tensor(validation.scene.lines.ends_m), validation.scene.poses
    steps = torch.linspace(0, 1, STEPS_PER_LINE, dtype=torch.float64)[:, None]
    points = (ends[:, :1] * (1 - steps) + ends[:, 1:] * steps).reshape(-1, 3)
    curves = []
    for k, image in enumerate(poses.images):
        pixels, valid = validation.model.project(poses.cam_from_world[k].transform(points))
        drawn = torch.where(valid[:, None], pixels, torch.nan).reshape(len(ends), -1, 2)
        # NaN lifts the pen between lines.
        broken = torch.cat([drawn, drawn.new_full((len(ends), 1, 2), torch.nan)], 1).reshape(-1, 2)
        rows = validation.corners.view == validation.corners.images.index(image)
        curves.append(Polyline(image, broken.numpy(), "rebuilt lines, reprojected", "model"))
        curves.append(Polyline(image, validation.corners.pixels[rows], "corners found", "observed"))
    return curves


def _scene(validation: Validation) -> Section:
    points = validation.truth.pattern.points_m
    low, high = points.min(0), points.max(0)
    outline = np.array([low, [high[0], low[1], 0.0], high, [low[0], high[1], 0.0]])
    return report.scene_section(
        boards=[("board", outline)],
        lines=validation.scene.lines,
        cameras=validation.scene.poses,
        truth_m=validation.board.ends_m,
        up=(0.0, -1.0, 0.0),
        title="Board, lines and cameras",
        caption="The world is the board; each pyramid is the camera of one photo.",
    )
