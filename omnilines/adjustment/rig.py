"""Photos of a rig: which frame and camera each belongs to, and the pose of every frame."""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from camera_models import InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.state import Rig
from omnilines.geometry.rig_readings import refuse_rig_reading
from omnilines.records import ImagePoses

ROUNDED_RAD, ROUNDED_M = 1e-4, 1e-4
"""Poses that a rig gave lie so near to it, as tables round them."""


def rig_of_photos(
    poses: ImagePoses,
    cameras: Sequence[str],
    rig: Mapping[str, RigCamera],
    needed: bool,
    most_turned_deg: float,
    *,
    held: bool = False,
) -> tuple[Rig | None, Pose]:
    """The rig with the frame and camera of every photo, and `rig_from_world` of every frame, from its first photo; None and
    `cam_from_world` of every photo where the poses name no frames or none of two photos, or the calibration has no rig, and where
    poses that are `held` are not as the rig has them.

    Raises InputError where a rig is `needed` and not known, or not from its frames, a photo names no camera, or its pose is
    turned against the rig by more than `most_turned_deg`, or the poses say that the rig is written in another way.
    """
    if not rig or poses.frames is None:
        if needed:
            missing = "a calibration without rig" if not rig else "no column frame in poses.csv"
            raise InputError(f"To refine a rig its cameras and the frame of every photo were expected, found {missing}; add it.")
        return None, poses.cam_from_world
    names = poses.cameras or ("",) * len(poses)
    unknown = [image for image, name in zip(poses.images, names, strict=True) if name not in rig]
    if unknown:
        raise InputError(f"The camera of every photo of a rig was expected, found none for {unknown[0]}; fill the column camera.")
    order = list(dict.fromkeys(poses.frames))
    frame = torch.tensor([order.index(name) for name in poses.frames])
    camera = torch.tensor([cameras.index(name) for name in names])
    if needed:
        _require_linked(frame, camera, cameras)
    elif len(order) == len(names):
        return None, poses.cam_from_world
    cam_from_rig = Pose.stack([rig[name].cam_from_rig for name in cameras])
    # The first camera of the calibration is the rig frame.
    cam_from_rig = cam_from_rig @ cam_from_rig[:1].inverse()[torch.zeros(len(cameras), dtype=torch.long)]
    from_photo = cam_from_rig[camera].inverse() @ poses.cam_from_world
    first = torch.tensor([poses.frames.index(name) for name in order])
    rig_from_world = from_photo[first]
    later = torch.tensor([k for k in range(len(names)) if k != int(first[frame[k]])], dtype=torch.long)
    if len(later):
        before = first[frame[later]]
        by_rig = cam_from_rig[camera[later]] @ cam_from_rig[camera[before]].inverse()
        refuse_rig_reading(poses.cam_from_world[later] @ poses.cam_from_world[before].inverse(), by_rig)
    apart = (from_photo @ rig_from_world[frame].inverse()).log()[:, :3].norm(dim=-1)
    if float(apart.max()) > math.radians(most_turned_deg):
        worst = int(apart.argmax())
        raise InputError(
            f"Photos of one frame were expected to be turned as the rig says, found {poses.images[worst]} "
            f"{math.degrees(float(apart[worst])):.0f} degrees off; check the columns frame and camera of poses.csv."
        )
    mounted = Rig(frame, camera, cam_from_rig)
    if held:
        off = (cam_from_rig[camera] @ rig_from_world[frame] @ poses.cam_from_world.inverse()).log()
        if float(off[:, :3].norm(dim=-1).max()) > ROUNDED_RAD or float(off[:, 3:].norm(dim=-1).max()) > ROUNDED_M:
            return None, poses.cam_from_world
    return mounted, rig_from_world


def _require_linked(frame: Int[Tensor, " n"], camera: Int[Tensor, " n"], cameras: Sequence[str]) -> None:
    """Raises InputError where a camera is in no chain of frames that leads to the first one."""
    linked, grown = {0}, True
    while grown:
        frames = frame[torch.isin(camera, torch.tensor(sorted(linked)))]
        found = linked | set(camera[torch.isin(frame, frames)].tolist())
        grown, linked = found != linked, found
    alone = next((name for k, name in enumerate(cameras) if k not in linked), None)
    if alone is not None:
        raise InputError(
            f"To refine a rig frames were expected that camera {alone} shares with {cameras[0]}, or with those that do, found "
            "none; check the columns frame and camera of poses.csv, or leave `rig` out of `refine`."
        )
