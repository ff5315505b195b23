"""The sections of a calibration's report: figures, residuals, coverage, photos with reprojected board lines, boards in 3D."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from camera_models.pose import Pose
from omnilines import report
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.single import CameraCalibration
from omnilines.records import Corners, ImagePoses, Polyline, Summary, ViewResult
from omnilines.report import Section

STEPS_PER_LINE = 40
"""Points per reprojected board line: a fisheye bends it."""


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
    sections = [
        report.summary_section(summaries[0]),
        report.parameters_section(model.NAME, model.PARAMETER_NAMES, values, sigmas),
        report.residual_section(pixels, residual, model.image_size, corners.view[kept], list(corners.images), theta_deg=theta),
        report.coverage_section(pixels, model.image_size, circle, supported_angle_deg=result.max_angle_deg),
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
