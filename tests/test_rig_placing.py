"""Instants of a rig placed by the lines of the others: a pair of fisheyes in a room of known lines."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matching_scenes import SIZE, MatchingScene, camera_named, from_views, looking

from camera_models import Calibration, InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.rig import rig_of_photos
from omnilines.files import PhotoRef
from omnilines.matching.match import match_arcs
from omnilines.matching.placing import lines_of_tracks, placed_anywhere
from omnilines.pipelines.better_poses import poses_by_lines
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs, viewed_arcs
from omnilines.pipelines.poses import estimate_poses
from omnilines.pipelines.reconstruct import reconstruct
from omnilines.posing.from_rig import poses_from_rig
from omnilines.posing.photo_poses import image_poses
from omnilines.records import ImagePoses
from omnilines.synthetic.lines import room_world

INSTANTS, CAMERAS = 9, ("left", "right")
IN_RIG = Pose.exp(torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.1, 2.0, 0.0, 0.2, 0.0, 0.1]], dtype=torch.float64))
FEW = 13
"""Arcs that each camera has at a poor instant: too few to place one photo alone."""


@pytest.fixture(scope="module")
def rig() -> tuple[MatchingScene, Calibration]:
    """All photos, those of one instant after each other, and the calibration of both cameras."""
    camera, half_rad = camera_named("fisheye")
    rng = np.random.default_rng(7)
    rig_from_world = looking(rng.uniform(0.25, 0.75, (INSTANTS, 3)) * SIZE, rng.standard_normal((INSTANTS, 3)) * [1, 1, 0.4])
    poses = Pose.stack([IN_RIG[k] @ rig_from_world[instant] for instant in range(INSTANTS) for k in range(2)])
    cameras = dict.fromkeys(CAMERAS, camera)
    placed = {name: RigCamera(IN_RIG[k]) for k, name in enumerate(CAMERAS)}
    return from_views(camera, half_rad, poses, room_world(1).ends_m), Calibration(cameras, rig=placed)


def found_in(scene: MatchingScene, few: int | None = None) -> list[FoundArcs]:
    """The arcs of all photos; of the instant `few` FEW arcs a photo."""
    arcs = scene.arcs(0.3, 3, True)
    pixels, _ = scene.camera.project(torch.as_tensor(arcs.bearings))
    found = []
    for k in range(arcs.images):
        rows = np.flatnonzero(arcs.image == k)
        rows = rows[:: max(len(rows) // FEW, 1)][:FEW] if k // 2 == few else rows
        photo = PhotoRef(Path(f"{CAMERAS[k % 2]}/{k // 2:03d}.png"), f"{CAMERAS[k % 2]}/{k // 2:03d}.png")
        ends = pixels[rows].numpy()
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        found.append(FoundArcs(photo, CAMERAS[k % 2], ends, arcs.covariance_px2[rows], length, arcs.colours[rows]))
    return found


def known_poses(found: list[FoundArcs], poses: Pose, instants: list[int]) -> ImagePoses:
    rows = [2 * instant + k for instant in instants for k in range(2)]
    names = [found[k].photo.name for k in rows]
    return image_poses(names, [poses[k] for k in rows], [found[k].camera for k in rows], [Path(name).stem for name in names])


def errors(placed: ImagePoses, found: list[FoundArcs], truth: Pose, instant: int) -> tuple[float, float]:
    """Degrees and metres of the worse photo of an instant."""
    apart = []
    for k in (2 * instant, 2 * instant + 1):
        pose = placed.cam_from_world[placed.images.index(found[k].photo.name)]
        turn = (pose @ truth[k].inverse()).log()[:3].norm()
        apart.append((math.degrees(float(turn)), float((pose.centre - truth[k].centre).norm())))
    return max(turn for turn, _ in apart), max(metres for _, metres in apart)


@pytest.mark.slow
@pytest.mark.parametrize("few", [None, pytest.param(INSTANTS - 1, marks=pytest.mark.full)])
def test_an_instant_without_a_pose_is_placed_by_both_cameras_as_one(rig, few) -> None:
    scene, calibration = rig
    found, last = found_in(scene, few), INSTANTS - 1
    poses = known_poses(found, scene.poses, list(range(last)))
    matched = match_arcs(viewed_arcs(found, poses, calibration))
    placed = poses_by_lines(found, poses, matched, calibration, SceneOptions(), lambda *told: None)
    assert placed is not None and placed.frames is not None
    assert placed.images[:-2] == poses.images and placed.frames[-2:] == (f"{last:03d}",) * 2
    degrees, metres = errors(placed, found, scene.poses, last)
    assert degrees < 0.2 and metres < 0.01
    if few is not None:
        known = lines_of_tracks(matched.arcs, matched.tracks.track, len(matched.tracks))
        for photo in found[-2:]:
            alone = viewed_arcs([photo], image_poses([photo.photo.name], [Pose.identity()], [photo.camera]), calibration)
            assert placed_anywhere(alone.widened(matched.tolerance_px), known, 0) is None
    between = placed.cam_from_world[-1] @ placed.cam_from_world[-2].inverse()
    expected = IN_RIG[1] @ IN_RIG[0].inverse()
    torch.testing.assert_close(between.rotation, expected.rotation, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(between.translation, expected.translation, rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_an_instant_whose_pose_is_off_is_mended_and_the_others_stay(rig) -> None:
    scene, calibration = rig
    found = found_in(scene)
    step = Pose.exp(torch.tensor([[0.02, -0.02, 0.015, 0.05, -0.04, 0.03]], dtype=torch.float64))
    off = Pose(scene.poses.rotation.clone(), scene.poses.translation.clone())
    for k in range(2):
        moved = IN_RIG[k] @ (step[0] @ (IN_RIG[0].inverse() @ scene.poses[4]))
        off.rotation[4 + k], off.translation[4 + k] = moved.rotation, moved.translation
    poses = known_poses(found, off, list(range(INSTANTS)))
    matched = match_arcs(viewed_arcs(found, poses, calibration))
    assert errors(poses, found, scene.poses, 2)[1] > 0.05
    mended = poses_by_lines(found, poses, matched, calibration, SceneOptions(), lambda *told: None)
    assert mended is not None
    degrees, metres = errors(mended, found, scene.poses, 2)
    assert degrees < 0.2 and metres < 0.01
    assert mended.frames == poses.frames


def test_arcs_of_a_rig_ask_for_its_whole_calibration(rig) -> None:
    scene, calibration = rig
    arcs = PhotoArcs(tuple(found_in(scene)), calibration)
    poses = known_poses(list(arcs.photos), scene.poses, list(range(INSTANTS)))
    for call in (reconstruct, lambda arcs, _, camera: estimate_poses(arcs, camera, "rig")):
        with pytest.raises(InputError, match=r"the arcs are of \(left, right\) was expected, found one of cam0; give the whole"):
            call(arcs, poses, calibration["left"])
    names = [one.photo.name for one in arcs.photos]
    camera_of, instant = {one.photo.name: one.camera for one in arcs.photos}, {name: name[-7:-4] for name in names}
    with pytest.raises(InputError, match=r"found 3 instants \(000, 001, 002\), and"):
        poses_from_rig(calibration, names[:6], camera_of, instant)


def test_a_prior_is_on_instants_of_which_every_photo_is_known(rig) -> None:
    scene, calibration = rig
    found = found_in(scene)
    every, some = (known_poses(found, scene.poses, list(range(count))) for count in (INSTANTS, INSTANTS - 1))
    known = KnownPoses(some.rows(range(1, len(some))), 1e-3, 1e-2)
    prior = known.prior(every, lambda photos: rig_of_photos(photos, list(CAMERAS), calibration.rig, False, 5.0)[1])
    assert torch.isinf(prior.sigma_m).tolist() == [True, *(INSTANTS - 2) * [False], True]
    assert torch.isinf(prior.sigma_rad).equal(torch.isinf(prior.sigma_m)) and float(prior.sigma_rad[1]) == 1e-3
    torch.testing.assert_close(prior.mean.translation, scene.poses.translation[::2])
    # Where the calibration has no rig, each photo is by itself.
    alone = known.prior(every, lambda photos: photos.cam_from_world)
    assert len(alone.mean) == 2 * INSTANTS and int(torch.isinf(alone.sigma_m).sum()) == 4
