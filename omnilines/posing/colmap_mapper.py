"""Structure from motion by COLMAP, with every camera replaced by one that it holds exactly.

COLMAP's own models end at 90 degrees off axis or differ from ours; bearings do not. So every keypoint is stored as the pixel that
an ideal panorama (COLMAP's EQUIRECTANGULAR, which sees all directions and has no parameters) has of its bearing. From COLMAP 4.2
on two-view geometry, resection, triangulation and adjustment of such cameras work on rays. A pixel of the panorama is as large as
one of the photo, so that COLMAP's limits in pixels mean what they always do; near its poles, straight above and below the camera,
they do not, and keypoints there are kept back.
"""

import itertools
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import InputError
from camera_models.pose import Pose
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.features import Features
from omnilines.posing.from_colmap import pose_of
from omnilines.posing.options import MapperOptions, PosingOptions
from omnilines.posing.rotations import agreeing_pairs, averaged_rotations, fits_rotation
from omnilines.posing.settled import Rays, explained_matches, settled
from omnilines.progress import ProgressCallback, interruptible, on_all_cores, silent


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


def map_photos(
    given: MapperInput,
    folder: Path,
    seed: int,
    progress: ProgressCallback = silent,
    options: PosingOptions = PosingOptions(),
) -> list[dict[int, Pose]]:
    """cam_from_world of photos by number, one mapping for each part that COLMAP could join, the largest first.

    `folder` holds COLMAP's database and models; what an earlier run left in it there is replaced. One thread and a fixed seed
    make the result repeatable. Photos are added in several ways (`resection_px`), with all pairs, without those that contradict
    the rotations of the others, without all that have another one (rotations.py), and then with other draws (`more_draws`), until
    one has settled all of them; else that is taken whose largest part explains most matches.
    """
    limits, inliers = options.mapper.resection_px, options.mapper.resection_inliers
    if not limits or len(limits) != len(inliers):
        raise InputError(
            f"As many `resection_inliers` as `resection_px` were expected, one or more, found {inliers} and {limits}; give both."
        )
    module = pycolmap()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = folder / "database.db"
    with module.Database.open(str(path)) as database:
        rays = _write(module, database, given, seed, progress, options)
    best: list[dict[int, Pose]] = []
    most = -1
    for number, one in enumerate(_ways(rays, seed, options.mapper)):
        with module.Database.open(str(path)) as database:
            for i, j in one.dropped:
                database.delete_two_view_geometry(i + 1, j + 1)
                database.delete_matches(i + 1, j + 1)
        models = folder / f"models{number}"
        models.mkdir()
        own = _options(module, one, options.mapper.min_first_pair_inliers)
        parts = _mapped(module, path, models, own, len(given.features), progress)
        explained = explained_matches(parts[0], rays) if parts else {}
        if sum(explained.values()) > most:
            best, most = parts, sum(explained.values())
        if settled(len(given.features), explained, rays, options.mapper.settled_share, one.least):
            break
    return best


@dataclass(frozen=True)
class _Way:
    """A way of adding photos."""

    dropped: Sequence[tuple[int, int]]
    """Pairs that are left out from here on."""
    seed: int
    error_px: float
    """Largest error of a photo that is added."""
    inliers: int
    """And its least inliers."""
    least: float
    """Matches that each photo has to explain: what agrees with nothing is placed by no draw, and none is made for it."""


def _ways(rays: Mapping[tuple[int, int], Rays], seed: int, its: MapperOptions) -> list[_Way]:
    """All, in the order in which they are tried."""
    contradicting = [pair for pair, one in rays.items() if not one.fits]
    turned = [pair for pair, one in rays.items() if one.fits and not one.agrees]
    limits = list(zip(its.resection_px, its.resection_inliers, strict=True))
    ways = []
    for left_out in ([], *(pairs for pairs in (contradicting, turned) if pairs)):
        first, *others = (_Way([], seed, *limit, 1.0) for limit in limits)
        ways += [replace(first, dropped=left_out), *others]
    ways[-1] = replace(ways[-1], least=0.0)
    return [*ways, *(_Way([], seed + 1 + draw, *limits[0], 0.0) for draw in range(its.more_draws))]


def _mapped(
    module: Any, database: Path, models: Path, options: Any, photos: int, progress: ProgressCallback
) -> list[dict[int, Pose]]:
    """The parts that COLMAP's mapper finds, the largest first."""
    placed = itertools.count(3)

    def tell() -> None:
        progress("structure from motion", min(next(placed), photos), photos)

    progress("structure from motion", 0, photos)
    token = module.CancellationToken()

    def work() -> Any:
        return module.incremental_mapping(
            str(database), str(models.parent), str(models), options, next_image_callback=tell, cancellation_token=token
        )

    found = interruptible(work, token.cancel)
    parts = [
        {image.image_id - 1: pose_of(image.cam_from_world()) for image in model.images.values() if image.has_pose}
        for model in found.values()
    ]
    return sorted(parts, key=len, reverse=True)


def _options(module: Any, way: _Way, first_pair: int) -> Any:
    options = module.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, way.seed
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.ba_refine_sensor_from_rig = options.extract_colors = options.ba_use_gpu = False
    options.min_model_size = 3
    options.mapper.init_min_num_inliers = first_pair
    options.mapper.abs_pose_max_error, options.mapper.abs_pose_min_num_inliers = way.error_px, way.inliers
    return options


def _write(
    module: Any, database: Any, given: MapperInput, seed: int, progress: ProgressCallback, options: PosingOptions
) -> dict[tuple[int, int], Rays]:
    """All that the mapper needs; returns the matches of the pairs that were verified."""
    cameras, its = {}, options.mapper
    for number in sorted(set(given.camera)):
        own = [given.features[k] for k, camera in enumerate(given.camera) if camera == number]
        cameras[number] = _panorama(module, number + 1, own, options.features.sigma_px)
        database.write_camera(cameras[number], use_camera_id=True)
    rigs = _write_rigs(module, database, cameras, given.cam_from_rig)
    seen, images = [], []
    for k, (features, camera) in enumerate(zip(given.features, given.camera, strict=True)):
        pixels, kept = _panorama_pixels(features.bearings.numpy(), cameras[camera].width, its.max_latitude_rad)
        row = np.where(kept, np.cumsum(kept) - 1, -1)
        seen.append(_Seen(cameras[camera], pixels[kept], features.bearings.numpy()[kept], row))
        image = module.Image(name=f"{k}", camera_id=camera + 1, image_id=k + 1)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(k + 1, seen[-1].pixels.astype(np.float32))
        images.append(image)
    for number, frame in enumerate(dict.fromkeys(given.frame)):
        members = [k for k, name in enumerate(given.frame) if name == frame]
        record = module.Frame()
        record.frame_id, record.rig_id = number + 1, rigs[given.camera[members[0]]]
        for k in members:
            record.add_data_id(images[k].data_id)
        database.write_frame(record, use_frame_id=True)

    def verify(pair: tuple[int, int]) -> tuple[Any, Any]:
        return _verified(module, seen[pair[0]], seen[pair[1]], given.matches[pair].numpy(), seed, its)

    every = on_all_cores(verify, list(given.matches), "checking pairs of photos", progress)
    verified = {pair: found for pair, found in zip(given.matches, every, strict=True) if found[1] is not None}
    relative = {pair: (one.cam2_from_cam1.rotation.matrix(), len(one.inlier_matches)) for pair, (_, one) in verified.items()}
    turned = averaged_rotations(relative, len(images), its)
    agreeing, rays = set(agreeing_pairs(relative, turned, its)), {}
    for (i, j), (matches, found) in verified.items():
        database.write_matches(i + 1, j + 1, matches)
        database.write_two_view_geometry(i + 1, j + 1, found)
        agree, agrees = np.asarray(found.inlier_matches), (i, j) in agreeing
        a, b = (torch.as_tensor(seen[k].bearings[agree[:, side]]) for side, k in enumerate((i, j)))
        rays[i, j] = Rays(a, b, its.epipolar_px * 2 * math.pi / seen[j].camera.width, agrees, agrees)

    def fits(pair: tuple[int, int]) -> bool:
        (i, j), one = pair, rays[pair]
        return fits_rotation(one.a.numpy(), one.b.numpy(), turned[j] @ turned[i].T, one.limit_rad, its)

    doubted = [pair for pair, one in rays.items() if not one.agrees]
    for pair, fit in zip(doubted, on_all_cores(fits, doubted, "checking rotations of photos", progress), strict=True):
        rays[pair] = replace(rays[pair], fits=fit)
    return rays


@dataclass(frozen=True)
class _Seen:
    """Keypoints of a photo as COLMAP has them."""

    camera: Any
    pixels: Float[np.ndarray, "k 2"]
    bearings: Float[np.ndarray, "k 3"]
    row: Int[np.ndarray, " n"]
    """Of every feature in `pixels`; -1 where it was kept back."""


def _verified(module: Any, a: _Seen, b: _Seen, pairs: Int[np.ndarray, "m 2"], seed: int, its: MapperOptions) -> tuple[Any, Any]:
    """Matches of two photos as COLMAP has them, and the geometry that enough of them agree with, or None."""
    matches = np.stack([a.row[pairs[:, 0]], b.row[pairs[:, 1]]], 1)
    matches = matches[(matches >= 0).all(1)].astype(np.uint32)
    if len(matches) < its.min_pair_inliers:
        return matches, None
    options = module.TwoViewGeometryOptions()
    options.ransac.random_seed, options.min_num_inliers, options.compute_relative_pose = seed, its.min_pair_inliers, True
    options.ransac.min_inlier_ratio = options.min_inlier_ratio = its.min_inlier_share
    options.ransac.max_error = its.epipolar_px
    found = module.estimate_calibrated_two_view_geometry(a.camera, a.pixels, b.camera, b.pixels, matches, options)
    enough = found.cam2_from_cam1 is not None and len(found.inlier_matches) >= its.min_pair_inliers
    return matches, found if enough else None


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


def _panorama(module: Any, number: int, features: Sequence[Features], sigma_px: float) -> Any:
    """The panorama whose pixels are as large as those of a camera's photos where most keypoints, of `sigma_px`, are."""
    sigma = torch.cat([f.sigma_rad for f in features])
    pixel_rad = float(sigma.quantile(0.1)) / sigma_px if len(sigma) else 1e-3
    height = int(np.clip(round(math.pi / pixel_rad), 100, 100_000))
    size = [2 * height, height]
    camera = module.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size, camera_id=number)
    camera.has_prior_focal_length = True
    return camera


def _panorama_pixels(
    bearings: Float[np.ndarray, "n 3"], width: int, max_latitude_rad: float
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """COLMAP's pixels of bearings, and which of them are clear of the poles."""
    longitude = np.arctan2(bearings[:, 0], bearings[:, 2])
    latitude = np.arctan2(bearings[:, 1], np.hypot(bearings[:, 0], bearings[:, 2]))
    scale = width / (2 * math.pi)
    pixels = np.stack([scale * (longitude + math.pi), scale * (latitude + 0.5 * math.pi)], -1)
    return pixels, np.abs(latitude) < max_latitude_rad
