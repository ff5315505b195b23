"""Structure from motion by COLMAP, with every camera replaced by one that it holds exactly.

COLMAP's own models end at 90 degrees off axis or differ from ours; bearings do not. So every keypoint is stored as the pixel that
an ideal panorama (COLMAP's EQUIRECTANGULAR, which sees all directions and has no parameters) has of its bearing. From COLMAP 4.2
on two-view geometry, resection, triangulation and adjustment of such cameras work on rays. A pixel of the panorama is as large as
one of the photo, so that COLMAP's limits in pixels mean what they always do; near its poles, straight above and below the camera,
they do not, and keypoints there are kept back.
"""

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.features import LEAST_SIGMA_PX, Features
from omnilines.posing.from_colmap import pose_of

LARGEST_LATITUDE_RAD = math.radians(80.0)
LEAST_TWO_VIEW, LEAST_FIRST_PAIR, LEAST_RESECTED = 15, 30, 15
"""Inliers of a verified pair, of the first pair, and of a photo that is added: rooms have few features."""
LEAST_INLIER_SHARE = 0.25
"""Of matches that a pair needs."""


@dataclass(frozen=True)
class MapperInput:
    """What structure from motion starts from; photos are numbered."""

    features: Sequence[Features]
    matches: Mapping[tuple[int, int], Int[Tensor, "_ 2"]]
    camera: Sequence[int]
    """Camera of each photo."""
    frame: Sequence[int]
    """Frame of each photo; a photo alone has its own."""
    cam_from_rig: Mapping[int, Pose]
    """Of each camera of a rig, the first being the rig frame; empty where there is none."""


def map_photos(given: MapperInput, folder: Path, seed: int) -> list[dict[int, Pose]]:
    """cam_from_world of photos by number, one mapping for each part that COLMAP could join, the largest first.

    `folder` holds COLMAP's database and models; what an earlier run left in it there is replaced. One thread and a fixed seed
    make the result repeatable. Raises InputError where pycolmap is not installed.
    """
    module = pycolmap()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = folder / "database.db"
    with module.Database.open(str(path)) as database:
        _write(module, database, given)
    verifier = module.GeometricVerifierOptions()
    verifier.num_threads = 1
    pairs = module.TwoViewGeometryOptions()
    pairs.ransac.random_seed = seed
    pairs.ransac.min_inlier_ratio = pairs.min_inlier_ratio = LEAST_INLIER_SHARE
    pairs.min_num_inliers = LEAST_TWO_VIEW
    module.geometric_verification(str(path), verifier, two_view_geometry_options=pairs)
    models = folder / "models"
    models.mkdir()
    found = module.incremental_mapping(str(path), str(folder), str(models), _options(module, seed))
    parts = [
        {image.image_id - 1: pose_of(image.cam_from_world()) for image in model.images.values() if image.has_pose}
        for model in found.values()
    ]
    return sorted(parts, key=len, reverse=True)


def _options(module: Any, seed: int) -> Any:
    options = module.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, seed
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.ba_refine_sensor_from_rig = options.extract_colors = options.ba_use_gpu = False
    options.min_model_size = 3
    options.mapper.init_min_num_inliers = LEAST_FIRST_PAIR
    options.mapper.abs_pose_min_num_inliers = LEAST_RESECTED
    return options


def _write(module: Any, database: Any, given: MapperInput) -> None:
    cameras = {}
    for number in sorted(set(given.camera)):
        own = [given.features[k] for k, camera in enumerate(given.camera) if camera == number]
        cameras[number] = _panorama(module, number + 1, own)
        database.write_camera(cameras[number], use_camera_id=True)
    rigs = _write_rigs(module, database, cameras, given.cam_from_rig)
    rows, images = [], []
    for k, (features, camera) in enumerate(zip(given.features, given.camera, strict=True)):
        pixels, kept = _panorama_pixels(features.bearings.numpy(), cameras[camera].width)
        rows.append(torch.as_tensor(np.where(kept, np.cumsum(kept) - 1, -1)))
        image = module.Image(name=f"{k}", camera_id=camera + 1, image_id=k + 1)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(k + 1, pixels[kept].astype(np.float32))
        images.append(image)
    for number, frame in enumerate(dict.fromkeys(given.frame)):
        members = [k for k, name in enumerate(given.frame) if name == frame]
        record = module.Frame()
        record.frame_id, record.rig_id = number + 1, rigs[given.camera[members[0]]]
        for k in members:
            record.add_data_id(images[k].data_id)
        database.write_frame(record, use_frame_id=True)
    for (i, j), pair in given.matches.items():
        there = torch.stack([rows[i][pair[:, 0]], rows[j][pair[:, 1]]], 1)
        there = there[(there >= 0).all(1)]
        if len(there) >= LEAST_TWO_VIEW:
            database.write_matches(i + 1, j + 1, there.numpy().astype(np.uint32))


def _write_rigs(module: Any, database: Any, cameras: Mapping[int, Any], cam_from_rig: Mapping[int, Pose]) -> dict[int, int]:
    """Number of the rig of each camera: one for all, or one for each."""
    members = [list(cameras)] if cam_from_rig else [[number] for number in cameras]
    for rig_id, numbers in enumerate(members, 1):
        rig = module.Rig()
        rig.rig_id = rig_id
        rig.add_ref_sensor(cameras[numbers[0]].sensor_id)
        for number in numbers[1:]:
            pose = cam_from_rig[number] @ cam_from_rig[numbers[0]].inverse()
            rotation = module.Rotation3d(pose.rotation.numpy())
            rig.add_sensor(cameras[number].sensor_id, module.Rigid3d(rotation, pose.translation.numpy()))
        database.write_rig(rig, use_rig_id=True)
    return {number: rig_id for rig_id, numbers in enumerate(members, 1) for number in numbers}


def _panorama(module: Any, number: int, features: Sequence[Features]) -> Any:
    """The panorama whose pixels are as large as those of a camera's photos where most keypoints are."""
    sigma = torch.cat([f.sigma_rad for f in features])
    pixel_rad = float(sigma.quantile(0.1)) / LEAST_SIGMA_PX if len(sigma) else 1e-3
    height = int(np.clip(round(math.pi / pixel_rad), 100, 100_000))
    size = [2 * height, height]
    camera = module.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size, camera_id=number)
    camera.has_prior_focal_length = True
    return camera


def _panorama_pixels(bearings: Float[np.ndarray, "n 3"], width: int) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """COLMAP's pixels of bearings, and which of them are clear of the poles."""
    longitude = np.arctan2(bearings[:, 0], bearings[:, 2])
    latitude = np.arctan2(bearings[:, 1], np.hypot(bearings[:, 0], bearings[:, 2]))
    scale = width / (2 * math.pi)
    pixels = np.stack([scale * (longitude + math.pi), scale * (latitude + 0.5 * math.pi)], -1)
    return pixels, np.abs(latitude) < LARGEST_LATITUDE_RAD
