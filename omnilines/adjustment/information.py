"""What arcs say of the poses of their photos while the lines stay."""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import adjoint
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.state import AT_ONCE, LinesAndPoses
from omnilines.costs import WHITENED, cost_function
from omnilines.costs._cost import line_residual


def pose_information(arcs: MatchedArcs, state: LinesAndPoses) -> tuple[Float[Tensor, "frames 6 6"], Float[Tensor, "cameras 6 6"]]:
    """J'J of the left perturbation of every frame (photo, without a rig), and of every camera of a rig, for the noise of the
    arcs; zero where there is none."""
    rig, poses = state.rig, state.cam_from_world
    frames = torch.zeros(len(state.rig_from_world), 6, 6, dtype=torch.float64)
    cameras = torch.zeros(0 if rig is None else len(rig.cam_from_rig), 6, 6, dtype=torch.float64)
    for rows in torch.arange(len(arcs)).split(AT_ONCE):
        some = arcs.rows(rows)
        cost = cost_function(WHITENED, some)
        by_photo = line_residual(cost, some.bearings, state.chart[some.track], poses[some.image])[1]
        # A line that is none, or that lies in the camera, says nothing.
        by_photo = torch.nan_to_num(by_photo, 0.0, 0.0, 0.0)
        if rig is None:
            frames.index_add_(0, some.image, by_photo.mT @ by_photo)
            continue
        camera = rig.camera[some.image]
        by_frame = by_photo @ adjoint(rig.cam_from_rig[camera])
        frames.index_add_(0, rig.frame[some.image], by_frame.mT @ by_frame)
        cameras.index_add_(0, camera, by_photo.mT @ by_photo)
    return frames, cameras
