"""What a calibration tells: figures for tables and `--json`, and the sections of its report."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines import report
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.lines.select import LineSelection
from omnilines.calibration.model_misfit import ModelMisfit
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.select import Selection
from omnilines.calibration.unmodelled import Unmodelled
from omnilines.pages.board_curves import grid_curves_px
from omnilines.pages.limits import board_advice
from omnilines.pages.next_views import SHOOT_NEXT, next_views_data, next_views_section, next_views_summary
from omnilines.pages.uncertainty_map import CertainCamera, UncertaintyMap, sigma_at_px
from omnilines.pipelines.calibrate import CalibrationResult
from omnilines.records import Corners, ImagePoses, Polyline, Summary, ViewResult
from omnilines.report import Section
from omnilines.report.numbers import figure, with_sigma
from omnilines.spelling import spelled_in


def calibration_summaries(calibrated: CalibrationResult) -> tuple[Summary, ...]:
    """The figures, the parameters, what was estimated of the board, how the models compare, and what to shoot next."""
    result, selection = calibrated.fit, calibrated.selection
    used = [view for view in result.views if view.used]
    median, largest = UncertaintyMap.of(result).stated_figures
    model = result.model
    rows = (
        ("model", model.label),
        ("views used", f"{len(used)} of {len(result.views)}"),
        ("corners used", f"{int(result.kept.sum())} of {len(result.kept)}"),
        ("rms_px_per_axis", figure(result.rms_px_per_axis, ".4f")),
        ("rms_px_per_point", figure(result.rms_px_per_point, ".4f")),
        ("field of view supported by the data", f"{result.min_angle_deg:.1f} to {result.max_angle_deg:.1f} degrees off axis"),
        ("projection uncertainty in it", f"{figure(median, unit='px')} (median), {figure(largest, unit='px')} (worst)"),
    )
    notes = result.notes if selection is None else (selection.reason, *result.notes)
    parameters = tuple((name, _parameter_text(result, name, value)) for name, value in model.named_parameters().items())
    verdict = calibration_verdict(median, largest, (result.min_angle_deg, result.max_angle_deg))
    if result.misfit is not None:
        verdict = misfit_verdict(model.NAME, result.misfit, verdict)
    advice = board_advice(result, calibrated.next_views, calibrated.found.corners, compared=selection is not None)
    summaries = [
        Summary("Calibration", rows, notes, verdict=verdict, advice=advice),
        Summary("Parameters ± one standard deviation", parameters),
    ]
    if result.board_terms:
        terms = tuple((name, with_sigma(value, result.board_sigma[name])) for name, value in result.board_terms.items())
        summaries.append(Summary("Board ± one standard deviation", terms))
    if result.line_delay is not None and result.line_delay.modelled:
        row = ("line delay", f"{result.line_delay.text}, {result.line_delay.order}")
        summaries.append(Summary("Rolling shutter ± one standard deviation", (row,)))
    if selection is not None:
        summaries.append(Summary("Camera models: RMS px per point in sample, held out", trial_rows(selection, "views")))
    if result.misfit is None and calibrated.next_views is not None:
        summaries.append(next_views_summary(calibrated.next_views))
    return tuple(summaries)


def calibration_verdict(median_px: float, worst_px: float, reach_deg: tuple[float, float]) -> str:
    """How well the camera is known where there are data."""
    if not math.isfinite(worst_px):
        return "How well the camera is known cannot be said from these photos."
    return (
        f"The camera is known to {figure(median_px, '.2g', 'px')} in the median and {figure(worst_px, '.2g', 'px')} at worst, "
        f"from {reach_deg[0]:.0f} to {reach_deg[1]:.0f} degrees off axis."
    )


def misfit_verdict(model: str, misfit: ModelMisfit, verdict: str) -> str:
    """What `calibration_verdict` says is then not of the lens."""
    return (
        f"The {model} model does not follow this lens: all photos agree that corners lie off by up to "
        f"{rounded(misfit.largest_px)} px. Only if it did would hold: {verdict[0].lower()}{verdict[1:]}"
    )


def _parameter_text(result: CameraCalibration, name: str, value: float) -> str:
    sigma, (low, high) = result.sigma[name], result.intervals[name]
    return with_sigma(value, sigma) + (f", 95 %: {low:.6g} to {high:.6g}" if result.curved and low < high else "")


def trial_rows(selection: Selection | LineSelection, left_out: str) -> tuple[tuple[str, str], ...]:
    """How the candidates compare by what was left out of each fit in turn."""
    rows = []
    for trial in selection.trials:
        if trial.failure is not None:
            text = f"not fitted: {spelled_in(trial.failure)}"
        else:
            held_out = (
                figure(trial.held_out_px, ".4f") if math.isfinite(trial.held_out_px) else f"open without one of the {left_out}"
            )
            text = f"{figure(trial.in_sample_px, '.4f')}, {held_out}, {trial.parameters} parameters"
            text += "" if trial.monotone else ", folds back just beyond the data"
        rows.append((trial.candidate.label + (" (taken)" if trial is selection.chosen else ""), text))
    return tuple(rows)


def misfit_data(misfit: ModelMisfit) -> dict[str, Any]:
    """Of `calibration_data`."""
    return {"radii_px": misfit.radii_px.tolist(), "outward_px": misfit.outward_px.tolist(), "p": misfit.chance}


def unmodelled_data(found: Unmodelled) -> dict[str, Any]:
    """Of `calibration_data`."""
    of_camera = {"moved_px": found.moved_px, "stated_px": found.stated_px, "p": found.chance}
    of_rig = {"camera": found.camera} if found.camera else {}
    return {"kind": found.kind, "size": found.size, "reach_deg": found.reach_deg, **of_camera, **of_rig}


def calibration_data(calibrated: CalibrationResult) -> dict[str, Any]:
    """What `--json` prints; see docs/formats.md."""
    result, selection = calibrated.fit, calibrated.selection
    median, largest = UncertaintyMap.of(result).figures
    data: dict[str, Any] = {
        "model": result.model.NAME,
        "image_size": list(result.model.image_size),
        "parameters": result.model.named_parameters(),
        "sigma": result.sigma,
        "interval_95": {name: [_or_none(end) for end in ends] for name, ends in result.intervals.items()},
        "curved": result.curved,
        "misfit": None if result.misfit is None else misfit_data(result.misfit),
        "unmodelled": None if result.unmodelled is None else unmodelled_data(result.unmodelled),
        "change": None if result.change is None else asdict(result.change),
        "rms_px_per_axis": result.rms_px_per_axis,
        "rms_px_per_point": result.rms_px_per_point,
        "min_angle_deg": result.min_angle_deg,
        "max_angle_deg": result.max_angle_deg,
        "projection_sigma_px": {"median": median, "worst": largest},
        "views": [
            {
                "image": view.image,
                "used": view.used,
                "reason": view.reason,
                "rms_px_per_point": view.rms_px_per_point,
                "leverage": view.leverage,
                "remarks": list(view.remarks),
            }
            for view in result.views
        ],
        "notes": list(result.notes),
        "next_views": None if calibrated.next_views is None else next_views_data(calibrated.next_views),
        "line_delay": line_delay_data(result.line_delay),
    }
    if result.board_terms:
        data["board"] = {name: {"value": v, "sigma": result.board_sigma[name]} for name, v in result.board_terms.items()}
    if selection is not None:
        data["selection"] = {
            "reason": selection.reason,
            "models": [
                {
                    "model": trial.candidate.model,
                    "options": dict(trial.candidate.options),
                    "taken": trial is selection.chosen,
                    "failure": trial.failure,
                    "monotone": trial.monotone,
                    "parameters": trial.parameters,
                    "in_sample_px": _or_none(trial.in_sample_px),
                    "held_out_px": _or_none(trial.held_out_px),
                }
                for trial in selection.trials
            ],
        }
    return data


def line_delay_data(delay: LineDelay | None) -> dict[str, Any] | None:
    """Of a rolling shutter; None where none was recognised."""
    if delay is None:
        return None
    return {"value_s": delay.delay_s, "sigma_s": delay.sigma_s, "order": delay.order, "modelled": delay.modelled}


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def write_calibration_page(result: CalibrationResult, path: str | Path) -> Path:
    """Write the page of a calibration and return its path."""
    sections = calibration_sections(result, calibration_summaries(result))
    return report.write_report(path, f"Calibration of one {result.camera.NAME} camera", sections)


def calibration_sections(calibrated: CalibrationResult, summaries: tuple[Summary, ...]) -> list[Section]:
    """All sections, in reading order; photos only where the folder is known."""
    result, corners, photo_folder = calibrated.fit, calibrated.found.corners, calibrated.found.photo_folder
    model, kept = result.model, result.kept
    pixels = corners.pixels[kept]
    # The report shows observed minus predicted.
    residual = -result.residual_px[kept]
    theta = np.degrees(angles_off_axis(model, torch.as_tensor(pixels)).numpy())
    circle = supported_circle_px(result)
    curve_theta, curve_rho = projection_curve(result)
    values = model.parameters.numpy()
    sigmas = np.array(list(result.sigma.values()))
    advice = calibrated.next_views if result.misfit is None else None
    uncertainty = UncertaintyMap.of(result, None if advice is None else advice.known.field)
    sections = [
        report.verdict_section(summaries[0]),
        report.uncertainty_section(
            uncertainty.stated_px,
            uncertainty.u_px,
            uncertainty.v_px,
            model.image_size,
            circle,
            corners_px=pixels,
            corners_sigma_px=sigma_at_px(result, pixels),
            supported_angle_deg=result.max_angle_deg,
            largest=None if advice is None else (advice.image, advice.stated_worst_px, advice.worst_at_px),
        ),
        report.summary_section(summaries[0], *(other for other in summaries[2:] if other.title != SHOOT_NEXT)),
        report.parameters_section(
            model.NAME, model.PARAMETER_NAMES, values, sigmas, intervals=result.interval_95 if result.curved else None
        ),
        report.residual_section(pixels, residual, model.image_size, corners.view[kept], list(corners.images), theta_deg=theta),
        report.coverage_section(pixels, model.image_size, circle, supported_angle_deg=result.max_angle_deg),
        report.radial_section(curve_theta, curve_rho, supported_angle_deg=result.max_angle_deg),
        report.views_section(result.views),
    ]
    if advice is not None:
        sections.insert(1, next_views_section(advice, result.model, uncertainty, pixels))
    used = [view for view in result.views if view.used]
    if photo_folder is not None:
        sections.append(report.photos_section(photo_folder, board_curves(result, corners)))
    boards = [(view.image, board_outline(corners, view)) for view in used]
    camera = ImagePoses(("camera",), Pose.identity(1))
    sections.append(report.scene_section(boards=boards, cameras=camera, up=(0.0, -1.0, 0.0), title="Boards in the camera frame"))
    return sections


def supported_circle_px(result: CertainCamera) -> Float[np.ndarray, "k 2"]:
    """The image of the cone at the largest angle that the data support."""
    phi = np.linspace(0, 2 * np.pi, 181)
    theta = np.radians(result.max_angle_deg)
    axis = np.sign(result.model.unproject(result.model.centre_px.numpy())[0][2])
    cone = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.full_like(phi, axis * np.cos(theta))], -1)
    pixels, valid = result.model.project(cone)
    return np.where(valid[:, None], pixels, np.nan)


def projection_curve(result: CertainCamera) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Radius (px) along +x of the image against the angle off axis (degrees), over what the image shows."""
    theta = np.linspace(0, min(np.degrees(result.model.max_angle) * 0.999, 1.15 * result.max_angle_deg), 200)
    axis = np.sign(result.model.unproject(result.model.centre_px.numpy())[0][2])
    angle = np.radians(theta)
    pixels, valid = result.model.project(np.stack([np.sin(angle), np.zeros_like(angle), axis * np.cos(angle)], -1))
    radius = np.linalg.norm(pixels - result.model.centre_px.numpy(), axis=-1)
    return theta[valid], radius[valid]


def board_outline(corners: Corners, view: ViewResult) -> Float[np.ndarray, "4 3"]:
    """The rectangle round all board corners of the table, in the camera frame."""
    assert view.cam_from_board is not None
    (x0, y0), (x1, y1) = corners.board_m[:, :2].min(0), corners.board_m[:, :2].max(0)
    quad = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
    return view.cam_from_board.transform(torch.as_tensor(quad)).numpy()


def board_curves(result: CameraCalibration, corners: Corners) -> list[Polyline]:
    """Rows and columns of every used board reprojected as curves, and the corners that were observed."""
    curves = []
    for v, view in enumerate(result.views):
        if not view.used or view.cam_from_board is None:
            continue
        rows = corners.view == v
        pixels = grid_curves_px(result.model, view.cam_from_board, corners.board_m[rows])
        curves += [Polyline(view.image, line, "board line as the calibration predicts it", "model") for line in pixels]
        curves.append(Polyline(view.image, corners.pixels[rows], "observed corners", "observed"))
    return curves
