"""What limits a calibration and what to shoot next: as a table, for `--json`, and drawn over the image."""

from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models import CameraModel
from omnilines import report
from omnilines.calibration.next_pose import NextViews
from omnilines.pages.board_curves import grid_curves_px
from omnilines.pages.uncertainty_map import UncertaintyMap
from omnilines.records import Summary
from omnilines.report import Section
from omnilines.report.next_views import photo_words

SHOOT_NEXT = "What to shoot next"


def next_views_summary(views: NextViews, title: str = SHOOT_NEXT) -> Summary:
    """What limits the calibration, where it is worst, and the poses that help most."""
    rows = [("limited by" if k == 0 else "and by", limit) for k, limit in enumerate(views.limits)]
    rows.append(
        (
            "largest uncertainty",
            f"{views.worst_words} {views.worst_where}; {views.median_words} in the median of {views.image}",
        )
    )
    rows += [(photo_words(k), f"{text[0].upper()}{text[1:]}.") for k, text in enumerate(views.sentences)]
    rows.append(("all in all", views.conclusion))
    return Summary(title, tuple(rows))


def next_views_data(views: NextViews) -> dict[str, Any]:
    """What `--json` prints; see docs/formats.md."""
    return {
        "limits": list(views.limits),
        "worst_px": views.worst_px,
        "median_px": views.median_px,
        "worst_at_px": list(views.worst_at_px),
        "worst_where": views.worst_where,
        "corner_sigma_px": views.corner_sigma_px,
        "conclusion": views.conclusion,
        "poses": [
            {
                "words": pose.words,
                "rotation_wxyz": pose.cam_from_board.quaternion.tolist(),
                "translation_m": pose.cam_from_board.translation.tolist(),
                "place_px": list(pose.place_px),
                "tilt_deg": pose.tilt_deg,
                "distance_m": pose.distance_m,
                "worst_px": pose.worst_px,
                "median_px": pose.median_px,
            }
            for pose in views.poses
        ],
    }


def next_views_section(
    views: NextViews,
    model: CameraModel,
    uncertainty: UncertaintyMap,
    corners_px: Float[np.ndarray, "n 2"],
    title: str = SHOOT_NEXT,
) -> Section:
    """The table, and the boards drawn over the map of the uncertainty."""
    boards = [grid_curves_px(model, pose.cam_from_board, views.board_m) for pose in views.poses]
    return report.next_views_section(
        next_views_summary(views, title),
        boards,
        uncertainty.stated_px,
        uncertainty.u_px,
        uncertainty.v_px,
        model.image_size,
        corners_px=corners_px,
        title=title,
    )
