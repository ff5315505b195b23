"""A camera and a board that hang together with the rest of a rig by its motion alone: cameras that look apart.

The camera sees no board that another camera sees at the same time. Over frames f whose rig_from_target(f) is known,

    cam_from_board(f) = cam_from_rig rig_from_target(f) target_from_board

has an unknown pose on both sides: robot-world and hand-eye calibration (M. Shah, Solving the robot-world/hand-eye calibration
problem using the Kronecker product, J. Mechanisms and Robotics 2013). It takes turns about two axes that are not parallel.
"""

import math

import torch

from camera_models.pose import Pose, vector_from_rotation
from camera_models.rotations import nearest_rotation
from omnilines.calibration.thresholds import RigThresholds


def camera_and_board(rig_from_target: Pose, cam_from_board: Pose, thresholds: RigThresholds) -> tuple[Pose, Pose] | None:
    """`cam_from_rig` and `target_from_board` from the poses of some frames; None where they are few or turn about one axis."""
    frames, given, seen = len(rig_from_target), rig_from_target, cam_from_board
    if frames < thresholds.apart_views or second_turn_deg(given) < thresholds.apart_turn_deg:
        return None
    # X^T B = A Z is linear in the rotations X^T and Z together; their common scale and sign are open.
    one = torch.eye(3, dtype=torch.float64)
    left = torch.einsum("ij,flk->fikjl", one, seen.rotation).reshape(-1, 9)
    right = torch.einsum("fij,kl->fikjl", given.rotation, one).reshape(-1, 9)
    both = torch.linalg.svd(torch.cat([left, -right], 1)).Vh[-1].view(2, 3, 3)
    both = both * torch.sign(torch.linalg.det(both[1]))
    rig_from_cam, board = nearest_rotation(both)
    camera = rig_from_cam.mT
    # X (A z + a) + x = b, linear in the translations z and x.
    factors = torch.cat([camera @ given.rotation, one.expand(frames, 3, 3)], -1).reshape(-1, 6)
    wanted = seen.translation - given.translation @ camera.mT
    moved = torch.linalg.lstsq(factors, wanted.reshape(-1, 1), driver="gelsd").solution[:, 0]
    return Pose(camera, moved[3:]), Pose(board, moved[:3])


def second_turn_deg(poses: Pose) -> float:
    """Root mean square of the turns between poses about the second of their principal axes."""
    turns = vector_from_rotation(poses.rotation.mT @ poses.rotation[len(poses) // 2])
    return math.degrees(float(torch.linalg.svdvals(turns - turns.mean(0))[1]) / math.sqrt(len(poses)))
