"""Tracks, poses and cameras that do not belong together are told from those that do, however rough, by the tracks themselves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from camera_models import InputError, OpenCVFisheye
from camera_models.pose import Pose, rotation_from_quaternion
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.pages.limits_of_lines import scene_advice
from omnilines.pipelines.adjust import adjust
from omnilines.pipelines.judged_tracks import judge_tracks
from omnilines.pipelines.options import OF_TABLES, JudgeOptions
from omnilines.posing.readings import other_readings
from omnilines.records import ImagePoses, Segments

LENS = OpenCVFisheye([170.25, 171.5, 325.0, 236.0, -0.01, 0.003, -0.001, 0.0001], (646, 482))
ALWAYS = JudgeOptions(fitting_px=0.0)
"""Also tracks that fit within a pixel are asked."""


def scene(
    lines: int, photos: int, *, seed: int, noise_px: float = 0.3, far: float = 1.0, around: Pose | None = None
) -> tuple[Segments, ImagePoses]:
    """Lines in front of cameras, all of which see all of them; or lines that cameras look at from around them."""
    rng = np.random.default_rng(seed)
    ends = far * rng.uniform([-1, -1, 1.5], [1, 1, 3], (2 * lines, 3))
    twists = torch.from_numpy(rng.uniform(-1, 1, (photos, 6)) * np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5]))
    poses = Pose.exp(twists)
    if around is not None:
        poses, ends = around, ends - [0.0, 0.0, 2.25]
    pixels = torch.cat([LENS.project(pose.transform(torch.from_numpy(ends)))[0] for pose in (poses[k] for k in range(photos))])
    noisy = pixels.numpy() + noise_px * rng.standard_normal((photos * 2 * lines, 2))
    images, tracks = tuple(f"{k}.png" for k in range(photos)), tuple(f"line{k}" for k in range(lines))
    image, track = np.repeat(np.arange(photos), lines), np.tile(np.arange(lines), photos)
    return Segments(image, images, track, tracks, noisy.reshape(-1, 2, 2)), ImagePoses(images, poses)


def judged(segments: Segments, poses: ImagePoses, lens: OpenCVFisheye = LENS, options: JudgeOptions = ALWAYS) -> tuple[str, ...]:
    arcs = arcs_from_segments(segments, poses, {"cam0": lens}).arcs
    misfit = judge_tracks(arcs, poses.cam_from_world, [lens], options=options)
    return () if misfit is None else misfit.notes


SEEDS = (0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2)))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", [{}, {"lines": 5, "photos": 3}, {"far": 300.0}, {"noise_px": 3.0}], ids=str)
@pytest.mark.slow
def test_tracks_that_belong_to_their_poses_are_taken(seed: int, kind: dict[str, float]) -> None:
    segments, poses = scene(**{"lines": 12, "photos": 5, "seed": seed, **kind})
    judged(segments, poses)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
def test_rough_poses_are_taken_and_spoken_of(seed: int) -> None:
    segments, poses = scene(12, 5, seed=seed)
    twists = torch.from_numpy(np.random.default_rng(seed).standard_normal((5, 6)) * 0.035)
    (note,) = judged(segments, replace(poses, cam_from_world=Pose.exp(twists) @ poses.cam_from_world), options=JudgeOptions())
    assert "rough" in note


@pytest.mark.full
def test_every_other_reading_is_named_when_the_table_was_written_so() -> None:
    segments, poses = scene(12, 5, seed=0)
    true = poses.cam_from_world
    q, t, axes = true.quaternion, true.translation, torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    blender = Pose(axes[:, None] * true.rotation, axes * t)
    written = {
        "inverted": true.inverse(),
        "order x, y, z, w": _of_quaternions(q[:, [1, 2, 3, 0]], t),
        "centre for t": Pose(true.rotation, true.centre),
        "transposed": Pose(true.rotation.mT, t),
        "OpenGL": blender,
        "inverted .* and .*OpenGL": blender.inverse(),
    }
    for says, poses_of_table in written.items():
        with pytest.raises(InputError, match=f"The poses look .*{says}.*explain [01] of 12 tracks, read so 12"):
            judged(segments, replace(poses, cam_from_world=poses_of_table))
    assert len(list(other_readings(true))) == 15


def _of_quaternions(quaternions: torch.Tensor, translation: torch.Tensor) -> Pose:
    return Pose(rotation_from_quaternion(quaternions), translation)


@pytest.mark.parametrize("scale", [0.5, 1.3, 2.0])
@pytest.mark.slow
def test_the_calibration_of_another_camera_is_named(scale: float) -> None:
    segments, poses = scene(12, 5, seed=0)
    other = OpenCVFisheye([scale * 170.25, scale * 171.5, *LENS.parameters.tolist()[2:]], LENS.image_size)
    with pytest.raises(InputError, match="looks like that of another camera"):
        judged(segments, poses, other)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
def test_tracks_that_were_shuffled_are_refused(seed: int) -> None:
    segments, poses = scene(20, 6, seed=seed)
    rng = np.random.default_rng(seed)
    mixed = np.concatenate([rng.permutation(20) for _ in range(6)])
    with pytest.raises(InputError, match="no better than segments put together at random"):
        judged(replace(segments, track=mixed), poses)


@pytest.mark.slow
def test_poses_of_other_axes_and_hands_are_named() -> None:
    segments, poses = scene(12, 5, seed=0)
    true = poses.cam_from_world
    robot = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    unreal = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    written = {
        "cameras whose right, down and forward are -y, -z, x": Pose(robot @ true.rotation, true.translation @ robot.T),
        "left-handed and of cameras whose right, down and forward are y, -z, x": Pose(
            unreal @ true.rotation @ mirror, true.translation @ unreal.T
        ),
    }
    for says, poses_of_table in written.items():
        with pytest.raises(InputError, match=f"The poses look to be .*{says}: .* read so 12"):
            judged(segments, replace(poses, cam_from_world=poses_of_table))


@pytest.mark.slow
def test_segments_that_are_written_otherwise_are_named() -> None:
    segments, poses = scene(12, 5, seed=0)
    ends, (width, height) = segments.endpoints_px, LENS.image_size
    last = np.array([width - 1.0, height - 1.0])
    written = {
        "v from the bottom": np.stack([ends[..., 0], last[1] - ends[..., 1]], -1),
        "mirrored": np.stack([last[0] - ends[..., 0], ends[..., 1]], -1),
        "turned by 180": last - ends,
        "order u1, u2, v1, v2": ends.transpose(0, 2, 1),
        "width and height": np.stack([ends[:, 0], ends[:, 1] - ends[:, 0]], 1),
        "shares of the image": (ends + 0.5) / (last + 1.0),
        "of 323x241 px, not of 646x482": (ends + 0.5) / 2 - 0.5,
    }
    for says, table in written.items():
        with pytest.raises(InputError, match=f"The segments look .*{says}.* read so 1[12]"):
            judged(replace(segments, endpoints_px=table), poses)


@pytest.mark.slow
@pytest.mark.parametrize("refine", [("lines", "poses"), pytest.param(("lines",), marks=pytest.mark.full)])
def test_photos_whose_names_were_exchanged_are_named_and_not_the_calibration(refine: tuple[str, ...]) -> None:
    """Least squares spread their errors over all photos, which look at lines from around them; rough poses are no such thing."""
    twists = torch.zeros(8, 6, dtype=torch.float64)
    twists[:, 1], twists[:, 0] = torch.linspace(0, 5.5, 8, dtype=torch.float64), 0.4 * (torch.arange(8) % 3)
    around = Pose(Pose.exp(twists).rotation, torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64).expand(8, 3))
    segments, poses = scene(40, 8, seed=0, around=around)
    stated, options = replace(segments, sigma_px=np.full(len(segments), 0.3)), replace(OF_TABLES, refine=refine)
    assert adjust(stated, poses, LENS, options).advice == ()
    order = np.array([0, 1, 5, 3, 4, 2, 6, 7])
    told = scene_advice(adjust(replace(stated, image=order[stated.image]), poses, LENS, options))
    assert any(one.limit.startswith("Few segments of 2.png (") and ", 5.png (" in one.limit for one in told)
    assert not any("calibration is off" in one.limit or "omnilines check" in one.do for one in told)
    off = Pose.exp(0.02 * torch.from_numpy(np.random.default_rng(0).standard_normal((8, 6)))) @ around
    rough = adjust(stated, replace(poses, cam_from_world=off), LENS, options)
    assert not any("of another photo" in one.limit for one in rough.advice)


@pytest.mark.slow
def test_observations_of_other_lines_are_told_with_the_option_that_leaves_them_out() -> None:
    segments, poses = scene(40, 8, seed=0)
    track = segments.track.copy()
    swapped = np.arange(0, len(track), 41)
    track[swapped] = (track[swapped] + 1) % 40
    keep = np.setdiff1d(np.arange(len(track)), swapped + 1)
    mixed = replace(segments.rows(keep), track=track[keep])
    plain, robust = (adjust(mixed, poses, LENS, OF_TABLES, robust=asked) for asked in (False, True))
    count = len(plain.adjusted.suspect)
    # They pull so much that the tracks as a whole may be said to be far from their lines before.
    told = [one for one in scene_advice(plain) if one.limit.startswith(f"{count} of {len(keep)} observations lie farther")]
    assert len(told) == 1 and "`robust`" in told[0].do
    every = [*scene_advice(robust), *scene_advice(adjust(segments, poses, LENS, OF_TABLES))]
    assert every and not any("`robust`" in one.do for one in every)


@pytest.mark.slow
def test_a_photo_whose_pose_is_rough_is_named_with_how_far_its_segments_lie() -> None:
    segments, poses = scene(40, 8, seed=0)
    twists = torch.zeros(8, 6, dtype=torch.float64)
    twists[3, 1] = 0.05
    off = replace(poses, cam_from_world=Pose.exp(twists) @ poses.cam_from_world)
    (held,) = adjust(segments, off, LENS, replace(OF_TABLES, refine=("lines",), loss="cauchy")).advice
    assert "3.png (" in held.limit and held.do == "Check the poses of these photos, and their names, or refine poses."
    (moved,) = adjust(segments, off, LENS).advice
    assert "3.png" in moved.limit and ".png" not in moved.limit.replace("3.png", ""), "no other photo was turned"
    assert adjust(segments, poses, LENS).advice == ()
