"""What the calibration of a rig tells: figures for tables and `--json`, and the sections of its report."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from omnilines import report
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.next_pose import NextViews
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.one_camera import one_camera
from omnilines.calibration.rig.result import RigCalibration, RigMember
from omnilines.pages.calibration import board_curves, projection_curve, supported_circle_px
from omnilines.pages.next_views import next_views_section
from omnilines.pages.rig_figures import PARAMETERS_OF, link_row, rig_summaries
from omnilines.pages.uncertainty_map import UncertaintyMap, sigma_at_px
from omnilines.pipelines.calibrate_rig import RigResult
from omnilines.records import Corners
from omnilines.report import Section
from omnilines.report.rig import RigCameraDrawing, RigLinkDrawing, rig_section

PHOTOS_A_CAMERA = 4
"""Photos of each camera that are shown: those with the largest residuals."""


def write_rig_page(result: RigResult, path: str | Path) -> Path:
    """Write the page of a rig and return its path."""
    count = len(result.fit.members)
    title = f"Calibration of a rig of {count} cameras" if count > 1 else "Calibration of a camera by several boards"
    return report.write_report(path, title, rig_sections(result))


def rig_sections(calibrated: RigResult) -> list[Section]:
    """All sections, in reading order; photos only where the folder is known."""
    result, summaries, photo_folder = calibrated.fit, rig_summaries(calibrated), calibrated.found.photo_folder
    cameras = [RigCameraDrawing(m.name, m.cam_from_rig.centre.numpy(), field_of_view(m)) for m in result.members]
    drawn = [
        RigLinkDrawing(link.first, link.second, ": ".join(link_row(result, link)), link.corners, link is result.weakest)
        for link in result.links
    ]
    count = next(k for k, summary in enumerate(summaries) if summary.title.startswith(PARAMETERS_OF))
    sections = [
        report.verdict_section(summaries[0]),
        rig_section(cameras, drawn, _boards_in_rig(result)),
        report.summary_section(*summaries[:count]),
    ]
    for member in result.members:
        sections += _camera_sections(*one_camera(result, member), member.name, calibrated.next_views.get(member.name))
    sections.append(report.views_section(result.views))
    if photo_folder is not None:
        curves, shown = [], []
        for member in result.members:
            single, corners = one_camera(result, member)
            worst = sorted(single.views, key=lambda view: -(view.rms_px_per_point or 0.0))[:PHOTOS_A_CAMERA]
            curves += board_curves(single, corners)
            shown += [view.image for view in worst]
        title = "Photos with the largest residuals"
        sections.append(report.photos_section(photo_folder, curves, images=list(dict.fromkeys(shown)), title=title))
    return sections


def _camera_sections(single: CameraCalibration, corners: Corners, name: str, advice: NextViews | None) -> list[Section]:
    model, kept = single.model, single.kept
    pixels = corners.pixels[kept]
    theta = np.degrees(angles_off_axis(model, torch.as_tensor(pixels)).numpy())
    circle = supported_circle_px(single)
    sigmas = np.array(list(single.sigma.values()))
    angle = single.max_angle_deg
    sections = [
        report.parameters_section(
            model.NAME, model.PARAMETER_NAMES, model.parameters.numpy(), sigmas, title=f"{name}: parameters"
        ),
        report.residual_section(
            pixels,
            -single.residual_px[kept],
            model.image_size,
            corners.view[kept],
            list(corners.images),
            theta_deg=theta,
            title=f"{name}: residuals",
        ),
        report.coverage_section(pixels, model.image_size, circle, supported_angle_deg=angle, title=f"{name}: coverage"),
        report.radial_section(*projection_curve(single), supported_angle_deg=angle, title=f"{name}: projection"),
    ]
    if single.covariance.any():
        found = UncertaintyMap.of(single, None if advice is None else advice.known.field)
        sections.insert(
            3,
            report.uncertainty_section(
                found.stated_px,
                found.u_px,
                found.v_px,
                model.image_size,
                circle,
                corners_px=pixels,
                corners_sigma_px=sigma_at_px(single, pixels),
                supported_angle_deg=angle,
                title=f"{name}: projection uncertainty",
                largest=None if advice is None else (advice.image, advice.stated_worst_px, advice.worst_at_px),
            ),
        )
        if advice is not None:
            sections.append(next_views_section(advice, model, found, pixels, title=f"{name}: what to shoot next"))
    return sections


def field_of_view(member: RigMember) -> Float[np.ndarray, "n k 3"]:
    """Curves on the unit sphere of the rig: the rim of what the data support, its inner rim where there is one, and meridians."""
    axis = member.model.unproject(member.model.centre_px)[0].numpy()
    sign = 1.0 if axis[2] >= 0 else -1.0
    phi, low, high = np.linspace(0, 2 * np.pi, 49), math.radians(member.min_angle_deg), math.radians(member.max_angle_deg)
    rims = [(np.full(49, angle), phi) for angle in ((low, high) if low > 0 else (high,))]
    meridians = [(np.linspace(low, high, 49), np.full(49, azimuth)) for azimuth in phi[:48:6]]
    curves = []
    for theta, azimuth in [*rims, *meridians]:
        sine = np.sin(theta)
        curves.append(np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), sign * np.cos(theta)], -1))
    return np.stack(curves) @ member.cam_from_rig.rotation.numpy()


def _boards_in_rig(result: RigCalibration) -> list[tuple[str, Float[np.ndarray, "4 3"]]]:
    """The rectangle round every board in every frame."""
    boards = result.corners.boards or (result.boards[0],) * len(result.corners.view_names)
    of_row = np.array(boards)[result.corners.view]
    quads = {}
    for k, name in enumerate(result.boards):
        rows = of_row == name if (of_row == name).any() else np.ones(len(of_row), dtype=bool)
        (x0, y0), (x1, y1) = result.corners.board_m[rows, :2].min(0), result.corners.board_m[rows, :2].max(0)
        corner = torch.tensor([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]], dtype=torch.float64)
        quads[k] = result.target_from_board[k].transform(corner)
    found = []
    for f, frame in enumerate(result.frames):
        for k, quad in quads.items():
            found.append((f"frame {frame}, {result.boards[k]}", result.rig_from_target[f].transform(quad).numpy()))
    return found
