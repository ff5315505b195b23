"""The same photos under two names of cameras: two mounted cameras never see a board at the same pixels."""

import numpy as np

from camera_models import InputError
from omnilines.calibration.duplicates import duplicate_views
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.thresholds import DuplicateThresholds


def require_own_photos(views: RigViews, thresholds: DuplicateThresholds) -> None:
    """Raises InputError where views of two cameras show a board at the same pixels, to within `least_tolerance_px`: a copy ties
    the cameras together as no measurement does, and the rig would be stated as certain."""
    if len(views.cameras) < 2:
        return
    pairs = np.array(duplicate_views(views.corners, 0.0, thresholds), dtype=np.int64).reshape(-1, 2)
    cameras = views.camera[pairs]
    across = cameras[:, 0] != cameras[:, 1]
    if not across.any():
        return
    first, second = cameras[across][0]
    same = (np.sort(cameras, 1) == np.sort([first, second])).all(1)
    one, other = (views.corners.images[v] for v in pairs[across][0])
    names = f"{views.cameras[first]} and {views.cameras[second]}"
    raise InputError(
        f"The cameras {names} were expected to have photos of their own, found the board at the same pixels in {int(same.sum())} "
        f"photos of both, first in {one} and {other}; give each camera its own photos, or leave one of the two out."
    )
