"""What a calibration from straight lines tells: figures for tables and `--json`, and the sections of its report."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from omnilines import report
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.pages.calibration import calibration_verdict, projection_curve, supported_circle_px, trial_rows
from omnilines.pages.limits import line_advice
from omnilines.pages.uncertainty_map import UncertaintyMap, sigma_at_px
from omnilines.pipelines.calibrate_lines import LineResult
from omnilines.records import Summary
from omnilines.report import Section
from omnilines.report.numbers import figure, with_sigma


def line_calibration_summaries(result: LineResult) -> tuple[Summary, ...]:
    """The figures, the parameters, what each photo gave, and how models compare."""
    fit, model = result.fit, result.camera
    median, largest = UncertaintyMap.of(fit).stated_figures
    used = [photo for photo in fit.photos if photo.straight]
    rows = (
        ("model", model.label),
        ("photos used", f"{len(used)} of {len(fit.photos) + len(result.skipped)}"),
        ("photos with lines at right angles", f"{sum(photo.frame for photo in fit.photos)}"),
        ("edges used", f"{sum(p.straight for p in used)} of {sum(p.chains for p in fit.photos)}"),
        ("edges along a direction", f"{sum(photo.members for photo in used)}"),
        *_of_boards(result),
        ("rms_px of edges from their lines", figure(fit.rms_px, ".4f")),
        ("field of view supported by the data", f"{fit.min_angle_deg:.1f} to {fit.max_angle_deg:.1f} degrees off axis"),
        ("projection uncertainty in it", f"{figure(median, unit='px')} (median), {figure(largest, unit='px')} (worst)"),
    )
    verdict = calibration_verdict(median, largest, (fit.min_angle_deg, fit.max_angle_deg))
    parameters = tuple((name, with_sigma(value, fit.sigma[name])) for name, value in model.named_parameters().items())
    photos = tuple(
        (p.image, f"{p.straight} edges, {p.members} along {p.directions} directions, {figure(p.rms_px, '.3f', unit='px')}")
        for p in used
    )
    summaries = [
        Summary("Calibration from straight lines", rows, result.notes, verdict=verdict, advice=line_advice(fit, result.rim_px)),
        Summary("Parameters ± one standard deviation", parameters),
        Summary("Photos", photos, of_photos=True),
    ]
    if len(result.selection.trials) > 1:
        summaries.append(
            Summary(
                "Camera models: RMS px in sample, held out (edges by their weight, and strays from directions)",
                trial_rows(result.selection, "photos"),
            )
        )
    return tuple(summaries)


def _of_boards(result: LineResult) -> tuple[tuple[str, str], ...]:
    """What corners of boards count beside, where they do."""
    if result.boards is None:
        return ()
    views = [view for view in result.boards.views if view.used]
    corners = sum(view.corners_used for view in views)
    return (
        ("views of a board", str(len(views))),
        ("corners used", f"{corners}, {result.boards.rms_px_per_axis:.4f} px per axis"),
    )


def line_calibration_data(result: LineResult) -> dict[str, Any]:
    """What `--json` prints; see docs/formats.md."""
    fit, selection = result.fit, result.selection
    median, largest = UncertaintyMap.of(fit).figures
    return {
        "model": fit.model.NAME,
        "image_size": list(fit.model.image_size),
        "parameters": fit.model.named_parameters(),
        "sigma": fit.sigma,
        "interval_95": {name: ends for name, ends in zip(fit.model.PARAMETER_NAMES, fit.interval_95.tolist(), strict=True)},
        "rms_px": fit.rms_px,
        "min_angle_deg": fit.min_angle_deg,
        "max_angle_deg": fit.max_angle_deg,
        "projection_sigma_px": {"median": median, "worst": largest},
        "open": list(fit.open_terms),
        "corners": 0 if result.boards is None else sum(view.corners_used for view in result.boards.views),
        "photos": [
            {
                "image": photo.image,
                "edges": photo.chains,
                "used": photo.straight,
                "along_directions": photo.members,
                "directions": photo.directions,
                "right_angles": photo.frame,
                "rms_px": photo.rms_px,
                "leverage": photo.leverage,
            }
            for photo in fit.photos
        ],
        "skipped": {one.photo: one.text for one in result.skipped},
        "notes": list(result.notes),
        "selection": {
            "reason": selection.reason,
            "models": [
                {
                    "model": trial.candidate.model,
                    "options": dict(trial.candidate.options),
                    "taken": trial is selection.chosen,
                    "failure": trial.failure,
                    "monotone": trial.monotone,
                    "parameters": trial.parameters,
                    "in_sample_px": trial.in_sample_px,
                    "held_out_px": trial.held_out_px,
                }
                for trial in selection.trials
            ],
        },
    }


def write_line_calibration_page(result: LineResult, path: str | Path) -> Path:
    """Write the page and return its path."""
    fit = result.fit
    summaries = line_calibration_summaries(result)
    theta = np.degrees(angles_off_axis(fit.model, torch.as_tensor(fit.pixels)).numpy())
    circle, uncertainty = supported_circle_px(fit), UncertaintyMap.of(fit)
    if result.rim_px is not None:
        uncertainty = uncertainty.within(result.rim_px, fit.model.centre_px.detach().numpy())
    curve_theta, curve_rho = projection_curve(fit)
    images = [photo.image for photo in fit.photos]
    unused = Summary("Photos that were not used", tuple((one.photo, one.text) for one in result.details))
    sections: list[Section] = [
        report.verdict_section(summaries[0]),
        report.uncertainty_section(
            uncertainty.stated_px,
            uncertainty.u_px,
            uncertainty.v_px,
            fit.model.image_size,
            circle,
            corners_px=fit.pixels,
            corners_sigma_px=sigma_at_px(fit, fit.pixels),
            seen="points of edges",
            supported_angle_deg=fit.max_angle_deg,
            largest=("the image", *uncertainty.stated_largest),
        ),
        report.summary_section(summaries[0], *summaries[2:], *([unused] if unused.rows else [])),
        report.parameters_section(
            fit.model.NAME, fit.model.PARAMETER_NAMES, fit.model.parameters.numpy(), np.array(list(fit.sigma.values()))
        ),
        report.residual_section(fit.pixels, -fit.residual_px, fit.model.image_size, fit.photo, images, theta_deg=theta),
        report.coverage_section(fit.pixels, fit.model.image_size, circle, supported_angle_deg=fit.max_angle_deg),
        report.radial_section(curve_theta, curve_rho, supported_angle_deg=fit.max_angle_deg),
    ]
    return report.write_report(path, f"Calibration of one {fit.model.NAME} camera from straight lines", sections)
