"""What a calibration tells: figures for tables and `--json`, and the sections of its report."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models.pose import Pose
from omnilines import report
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.select import Selection
from omnilines.calibration.single import CameraCalibration
from omnilines.calibration.uncertainty import projection_covariance_px2, supported_grid, worst_sigma_px
from omnilines.pipelines.calibrate import CalibrationResult
from omnilines.records import Corners, ImagePoses, Polyline, Summary, ViewResult
from omnilines.report import Section
from omnilines.report.numbers import figure, with_sigma

STEPS_PER_LINE = 40
"""Points per reprojected board line: a fisheye bends it."""

MAP_STEPS = 64
"""Pixels along the longer side of the image at which the projection uncertainty is drawn."""


@dataclass(frozen=True)
class UncertaintyMap:
    """Standard deviation of the projection in its worst direction, over a grid of pixels; NaN where the camera sees nothing."""

    u_px: Float[np.ndarray, " w"]
    v_px: Float[np.ndarray, " h"]
    sigma_px: Float[np.ndarray, "h w"]
    supported: Bool[np.ndarray, "h w"]
    """Within the field of view that the data support."""

    @staticmethod
    def of(result: CameraCalibration) -> "UncertaintyMap":
        """The map of a calibration, at MAP_STEPS pixels along the longer side of its image."""
        width, height = result.model.image_size
        step = max(width, height) / MAP_STEPS
        u, v = (np.arange(0.5 * min(step, side), side, step) - 0.5 for side in (width, height))
        pixels = torch.as_tensor(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
        low, high = float(np.radians(result.min_angle_deg)), float(np.radians(result.max_angle_deg))
        reference = supported_grid(result.model, high, low)
        covariance, valid = projection_covariance_px2(result.model, torch.as_tensor(result.covariance), pixels, reference)
        angle = angles_off_axis(result.model, pixels)
        inside = valid & (angle >= low) & (angle <= high)
        shape = len(v), len(u)
        return UncertaintyMap(u, v, worst_sigma_px(covariance).numpy().reshape(shape), inside.numpy().reshape(shape))

    @property
    def figures(self) -> tuple[float, float]:
        """Median and largest standard deviation (px) over the supported field of view."""
        inside = self.sigma_px[self.supported]
        return float(np.median(inside)), float(inside.max())


def calibration_summaries(result: CameraCalibration, selection: Selection | None) -> tuple[Summary, ...]:
    """The figures, the parameters, what was estimated of the board, and how the models compare."""
    used = [view for view in result.views if view.used]
    median, largest = UncertaintyMap.of(result).figures
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
    summaries = [Summary("Calibration", rows, notes), Summary("Parameters ± one standard deviation", parameters)]
    if result.board_terms:
        terms = tuple((name, with_sigma(value, result.board_sigma[name], ".3g")) for name, value in result.board_terms.items())
        summaries.append(Summary("Board ± one standard deviation", terms))
    if selection is not None:
        summaries.append(Summary("Camera models: RMS px per point in sample, held out", _trial_rows(selection)))
    return tuple(summaries)


def _parameter_text(result: CameraCalibration, name: str, value: float) -> str:
    sigma, (low, high) = result.sigma[name], result.intervals[name]
    return with_sigma(value, sigma) + (f", 95 %: {low:.6g} to {high:.6g}" if result.curved and low < high else "")


def _trial_rows(selection: Selection) -> tuple[tuple[str, str], ...]:
    rows = []
    for trial in selection.trials:
        if trial.failure is not None:
            text = f"not fitted: {trial.failure}"
        else:
            held_out = figure(trial.held_out_px, ".4f") if math.isfinite(trial.held_out_px) else "open without one of the views"
            text = f"{figure(trial.in_sample_px, '.4f')}, {held_out}, {trial.parameters} parameters"
            text += "" if trial.monotone else ", folds back just beyond the data"
        rows.append((trial.candidate.label + (" (taken)" if trial is selection.chosen else ""), text))
    return tuple(rows)


def calibration_data(result: CameraCalibration, selection: Selection | None) -> dict[str, Any]:
    """What `--json` prints; see docs/formats.md."""
    median, largest = UncertaintyMap.of(result).figures
    data: dict[str, Any] = {
        "model": result.model.NAME,
        "image_size": list(result.model.image_size),
        "parameters": result.model.named_parameters(),
        "sigma": result.sigma,
        "interval_95": {name: [_or_none(end) for end in ends] for name, ends in result.intervals.items()},
        "curved": result.curved,
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


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def write_calibration_page(result: CalibrationResult, path: str | Path) -> Path:
    """Write the page of a calibration and return its path."""
    summaries = calibration_summaries(result.fit, result.selection)
    sections = calibration_sections(result.fit, result.found.corners, summaries, result.found.photo_folder)
    return report.write_report(path, f"Calibration of one {result.camera.NAME} camera", sections)


def calibration_sections(
    result: CameraCalibration, corners: Corners, summaries: tuple[Summary, ...], photo_folder: Path | None
) -> list[Section]:
    """All sections, in reading order; photos only where the folder is known."""
    model, kept = result.model, result.kept
    pixels = corners.pixels[kept]
    # The report shows observed minus predicted.
    residual = -result.residual_px[kept]
    theta = np.degrees(angles_off_axis(model, torch.as_tensor(pixels)).numpy())
    circle = supported_circle_px(result)
    curve_theta, curve_rho = projection_curve(result)
    values = model.parameters.numpy()
    sigmas = np.array(list(result.sigma.values()))
    uncertainty = UncertaintyMap.of(result)
    sections = [
        report.summary_section(summaries[0], *summaries[2:]),
        report.parameters_section(
            model.NAME, model.PARAMETER_NAMES, values, sigmas, intervals=result.interval_95 if result.curved else None
        ),
        report.residual_section(pixels, residual, model.image_size, corners.view[kept], list(corners.images), theta_deg=theta),
        report.coverage_section(pixels, model.image_size, circle, supported_angle_deg=result.max_angle_deg),
        report.uncertainty_section(
            uncertainty.sigma_px,
            uncertainty.u_px,
            uncertainty.v_px,
            model.image_size,
            circle,
            corners_px=pixels,
            supported_angle_deg=result.max_angle_deg,
        ),
        report.radial_section(curve_theta, curve_rho, supported_angle_deg=result.max_angle_deg),
        report.views_section(result.views),
    ]
    used = [view for view in result.views if view.used]
    if photo_folder is not None:
        sections.append(report.photos_section(photo_folder, board_curves(result, corners)))
    boards = [(view.image, board_outline(corners, view)) for view in used]
    camera = ImagePoses(("camera",), Pose.identity(1))
    sections.append(report.scene_section(boards=boards, cameras=camera, up=(0.0, -1.0, 0.0), title="Boards in the camera frame"))
    return sections


def supported_circle_px(result: CameraCalibration) -> Float[np.ndarray, "k 2"]:
    """The image of the cone at the largest angle that the data support."""
    phi = np.linspace(0, 2 * np.pi, 181)
    theta = np.radians(result.max_angle_deg)
    axis = np.sign(result.model.unproject(result.model.centre_px.numpy())[0][2])
    cone = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.full_like(phi, axis * np.cos(theta))], -1)
    pixels, valid = result.model.project(cone)
    return np.where(valid[:, None], pixels, np.nan)


def projection_curve(result: CameraCalibration) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
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
        ends = grid_lines(corners.board_m[rows])
        steps = np.linspace(0, 1, STEPS_PER_LINE)[:, None]
        points = ends[:, None, 0] * (1 - steps) + ends[:, None, 1] * steps
        seen = view.cam_from_board.transform(torch.as_tensor(points.reshape(-1, 3))).numpy()
        pixels, valid = result.model.project(seen)
        pixels = np.where(valid[:, None], pixels, np.nan).reshape(len(ends), -1, 2)
        curves += [Polyline(view.image, line, "board line as the calibration predicts it", "model") for line in pixels]
        curves.append(Polyline(view.image, corners.pixels[rows], "observed corners", "observed"))
    return curves


def grid_lines(board_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 2 3"]:
    """End points of the straight lines through corners with the same y, and with the same x, at least two corners each."""
    lines = []
    for across, along in ((1, 0), (0, 1)):
        for value in np.unique(np.round(board_m[:, across], 9)):
            row = board_m[np.abs(board_m[:, across] - value) < 1e-8]
            if len(row) > 1:
                lines.append([row[np.argmin(row[:, along])], row[np.argmax(row[:, along])]])
    return np.array(lines).reshape(-1, 2, 3)
