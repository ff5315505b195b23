"""A rig without some of its members, as if they had not been of it."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import torch

from camera_models.pose import Pose
from omnilines.calibration.rig.joint import RigData, RigFit
from omnilines.calibration.rig.near import Scales
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.problem import RigState


def without_members(outcome: RigOutcome, members: Collection[int]) -> RigOutcome:
    """The outcome of the other members, where these were fitted with them; the first of them is the frame of the rig then."""
    data, fit = outcome.data, outcome.fit
    left = [k for k in range(len(data.cameras)) if k not in members]
    fewer = _data(data, left)
    views = fit.views[np.isin(data.views.camera[fit.views], fewer.cameras)]
    points, ordered, rows = fewer.points(views)
    kept = np.zeros(len(data.views.corners), dtype=bool)
    kept[fit.rows] = fit.kept.numpy()
    state = state_of(outcome.solution.state, left)
    scales = Scales(fit.scales.scale[left], fit.scales.beside_alone, fewer.noise)
    smaller = RigFit(points, fewer.problem(points), ordered, rows, state, torch.as_tensor(kept[rows]), scales)
    return replace(outcome, data=fewer, fit=smaller, solution=replace(outcome.solution, state=state))


def _data(data: RigData, left: list[int]) -> RigData:
    return replace(
        data,
        cameras=tuple(data.cameras[k] for k in left),
        bases=tuple(data.bases[k] for k in left),
        noise=tuple(data.noise[k] for k in left),
    )


def state_of(state: RigState, left: list[int]) -> RigState:
    """The state of some members, with the first of them as the frame of the rig."""
    first = state.cam_from_rig[left[0]]
    in_first = Pose.stack([state.cam_from_rig[k] @ first.inverse() for k in left])
    models = tuple(state.models[k] for k in left)
    path = state.path
    if path is not None:
        path = replace(path, offset_s=path.offset_s[left] - path.offset_s[left[0]], line_delay_s=path.line_delay_s[left])
    return replace(state, models=models, cam_from_rig=in_first, rig_from_target=first @ state.rig_from_target, path=path)
