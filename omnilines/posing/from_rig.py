"""Poses of the photos of a calibrated rig: all of one instant, or those that are missing beside known ones."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from camera_models import Calibration, InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from camera_models.wording import listed
from omnilines.geometry.rig_readings import refuse_rig_reading
from omnilines.posing.options import GivenOptions
from omnilines.posing.photo_poses import PhotoPoses, image_poses
from omnilines.records import ImagePoses


def poses_from_rig(
    calibration: Calibration, photos: Sequence[str], camera_of: Mapping[str, str], frame_of: Mapping[str, str]
) -> PhotoPoses:
    """`cam_from_world` of the photos of one instant of a rig: the rig frame is the world, metres are those of the calibration.

    `frame_of` names the instant of each photo. Raises InputError for a calibration without a rig, photos of several instants
    (where the rig stood at each is then not known), and two photos of one camera.
    """
    _require_rig(calibration)
    frames = list(dict.fromkeys(frame_of[photo] for photo in photos))
    if len(frames) != 1:
        raise InputError(
            f"Photos of one instant of the rig were expected, found {len(frames)} instants ({listed(frames)}), and "
            "where the rig was at each is not known; give poses.csv with the column frame, or --poses sfm."
        )
    _require_one_photo_each(photos, camera_of, frame_of)
    poses = [calibration.rig[camera_of[photo]].cam_from_rig for photo in photos]
    cameras = [camera_of[photo] for photo in photos]
    notes = ("The world is the rig frame.",)
    return PhotoPoses(image_poses(photos, poses, cameras, [frames[0]] * len(photos)), {}, notes)


def complete_from_rig(
    calibration: Calibration,
    poses: ImagePoses,
    photos: Sequence[str],
    camera_of: Mapping[str, str],
    frame_of: Mapping[str, str],
    *,
    options: GivenOptions = GivenOptions(),
) -> PhotoPoses:
    """Known poses, and those that follow from them for the other cameras of the rig at the same instants.

    Poses that are known stay as they are. Where several are known of an instant, the rig stands at the mean of what they say.
    Photos of instants without a known pose are left out. Raises InputError for a calibration without a rig, two photos of one
    camera and instant, and known poses that contradict the rig, or say that it is written in another way.
    """
    _require_rig(calibration)
    _require_one_photo_each(photos, camera_of, frame_of)
    known = {name: poses.cam_from_world[k] for k, name in enumerate(poses.images) if name in frame_of}
    in_frame: dict[str, list[str]] = {}
    for name in known:
        in_frame.setdefault(frame_of[name], []).append(name)
    pairs = [(first, name) for first, *others in in_frame.values() for name in others]
    if pairs:
        mounted = {name: calibration.rig[camera_of[name]].cam_from_rig for name in known}
        by_poses, by_rig = (
            Pose.stack([where[name] @ where[first].inverse() for first, name in pairs]) for where in (known, mounted)
        )
        refuse_rig_reading(by_poses, by_rig)
    most_rad = options.rig_contradicts_rad
    rig_from_world = {frame: _rig_at(calibration, names, known, camera_of, most_rad) for frame, names in in_frame.items()}
    kept, found = [], []
    lost = {}
    for photo in photos:
        frame = frame_of[photo]
        if photo in known:
            found.append(known[photo])
        elif frame in rig_from_world:
            found.append(calibration.rig[camera_of[photo]].cam_from_rig @ rig_from_world[frame])
        else:
            lost[photo] = f"{photo} has no pose: none is known of any photo of its instant {frame}."
            continue
        kept.append(photo)
    return PhotoPoses(image_poses(kept, found, [camera_of[p] for p in kept], [frame_of[p] for p in kept]), lost)


def with_rig(calibration: Calibration, rig: Mapping[str, Pose]) -> Calibration:
    """A calibration whose cameras sit where photos tell (`PhotoPoses.rig`), how well is not known; as it is where they tell
    none."""
    if not rig:
        return calibration
    return replace(calibration, rig={name: RigCamera(rig[name]) for name in calibration.rig})


def _rig_at(
    calibration: Calibration, names: Sequence[str], known: Mapping[str, Pose], camera_of: Mapping[str, str], most_rad: float
) -> Pose:
    """rig_from_world of one instant: the mean on SE(3) of what its photos say, who differ by `most_rad` at most."""
    said = Pose.stack([calibration.rig[camera_of[name]].cam_from_rig.inverse() @ known[name] for name in names])
    first = said[0]
    apart = (said @ Pose.stack([first.inverse()] * len(said))).log()
    turned = apart[:, :3].norm(dim=-1)
    if float(turned.max()) > most_rad:
        worst = int(turned.argmax())
        raise InputError(
            f"Photos of one instant were expected to be turned as the rig says, found {names[worst]} "
            f"{math.degrees(float(turned[worst])):.0f} degrees off {names[0]}; check the columns frame and camera of poses.csv."
        )
    return Pose.exp(apart.mean(0)) @ first


def _require_rig(calibration: Calibration) -> None:
    if not calibration.rig:
        raise InputError(
            "A calibration with a rig was expected to place photos by it, found one without; calibrate the cameras as a rig, or "
            "give --poses sfm."
        )


def _require_one_photo_each(photos: Sequence[str], camera_of: Mapping[str, str], frame_of: Mapping[str, str]) -> None:
    taken: dict[tuple[str, str], str] = {}
    for photo in photos:
        key = (frame_of[photo], camera_of[photo])
        if key in taken:
            raise InputError(
                f"One photo of each camera at each instant was expected, found {taken[key]} and {photo} of camera {key[1]} at "
                f"{key[0]}; name the instants apart."
            )
        taken[key] = photo


def cam_from_rig_of(calibration: Calibration, cameras: Sequence[str]) -> Pose:
    """cam_from_rig (n,) of cameras by name; the identity for each where the calibration has no rig."""
    if not calibration.rig:
        return Pose.identity(len(cameras))
    poses = [calibration.rig[name].cam_from_rig for name in cameras]
    return Pose.stack(poses) if poses else Pose(torch.zeros(0, 3, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64))
