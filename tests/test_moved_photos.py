"""Photos that refined poses put far from those given are named, and rows of a table that slipped."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_calibration_errors import CAMERA, world

import omnilines as ol
from camera_models.pose import Pose
from omnilines.pipelines.moved_photos import photos_far_from_given
from omnilines.pipelines.options import OF_TABLES, MovedOptions
from omnilines.records import Advice, ImagePoses, LengthUnit, PhotoCount

COUNT = 12
NAMES = tuple(f"{k}.png" for k in range(COUNT))


def walk(seed: int, step_m: float = 0.6) -> Pose:
    """A camera that is carried along, and looks about."""
    rng = np.random.default_rng(seed)
    centre = torch.as_tensor(np.cumsum(rng.normal([step_m, 0.2, 0.0], 0.2, (COUNT, 3)), axis=0))
    turned = Pose.exp(torch.as_tensor(np.concatenate([rng.normal(0.0, 0.2, (COUNT, 3)), np.zeros((COUNT, 3))], -1))).rotation
    return Pose(turned, -(turned @ centre[..., None])[..., 0])


def shaken(poses: Pose, seed: int, sigma_rad: float = 0.002, sigma_m: float = 0.01) -> Pose:
    noise = np.random.default_rng(seed + 100).normal(size=(COUNT, 6)) * np.repeat([sigma_rad, sigma_m], 3)
    return Pose.exp(torch.as_tensor(noise)) @ poses


def told(
    given: Pose, rows: Sequence[int], seed: int, covariance: np.ndarray | None = None
) -> tuple[tuple[Advice, ...], frozenset]:
    """Of refined poses, where a table gives to each photo the pose of one of these rows, with errors."""
    stated = ImagePoses(NAMES, shaken(given, seed)[torch.tensor(rows)])
    return photos_far_from_given(stated, ImagePoses(NAMES, given), {}, LengthUnit.METRES, MovedOptions())


@pytest.mark.parametrize("seed", range(5))
def test_a_photo_with_the_pose_of_another_is_named_and_which(seed: int) -> None:
    """Nothing was said of it, or more photos were asked for."""
    poses, rows = walk(seed), list(range(COUNT))
    rows[4] = 9
    ((advice,), names) = told(poses, rows, seed)
    assert names == {"4.png"} and advice.limit.startswith("Refined poses lie far from those given: 4.png ")
    moved = float((poses.centre[4] - poses.centre[9]).norm())
    assert float(advice.limit.split("4.png ")[1].split()[0]) == pytest.approx(moved, rel=0.1)
    rows[9] = 4
    ((advice,), names) = told(poses, rows, seed)
    assert names == {"4.png", "9.png"}
    assert "(to where 9.png is said to be)" in advice.limit and "(to where 4.png is said to be)" in advice.limit


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("rows", "which"), [(1, "photo before"), (-1, "next photo")])
def test_rows_that_slipped_are_told_by_refined_poses(seed: int, rows: int, which: str) -> None:
    slipped = np.clip(np.arange(COUNT) + rows, 0, COUNT - 1).tolist()
    ((advice,), names) = told(walk(seed), slipped, seed)
    assert f"of 12 photos are those given for the {which} of the table" in advice.limit and not names


@pytest.mark.parametrize("seed", range(20))
def test_poses_that_are_rough_alike_name_no_photo(seed: int) -> None:
    """Nor where they are those of photos in any order: nothing says then which are right."""
    poses = walk(seed)
    assert told(poses, list(range(COUNT)), seed) == ((), frozenset())
    advice, _ = told(poses, np.random.default_rng(seed).permutation(COUNT).tolist(), seed)
    assert not any("slipped" in one.limit for one in advice)


def test_a_photo_that_is_hardly_known_is_not_named() -> None:
    """It moves as far as its own uncertainty lets it."""
    poses, rows = walk(0), list(range(COUNT))
    stated = shaken(poses, 0)
    away = Pose.exp(torch.tensor([[0.0, 0.0, 0.0, 0.5, 0.0, 0.0]], dtype=torch.float64)) @ stated[[4]]
    given = Pose.stack([away[0] if k == 4 else stated[k] for k in rows])
    covariance = np.tile(np.diag([1e-6] * 3 + [1e-4] * 3), (COUNT, 1, 1))
    final, options = ImagePoses(NAMES, poses, None, covariance), MovedOptions()
    assert photos_far_from_given(ImagePoses(NAMES, given), final, {}, LengthUnit.METRES, options)[1] == {"4.png"}
    covariance[4, 3:, 3:] *= 1e3
    assert photos_far_from_given(ImagePoses(NAMES, given), final, {}, LengthUnit.METRES, options) == ((), frozenset())


def test_a_photo_that_lines_hardly_explain_where_it_is_now_says_so() -> None:
    poses, rows = walk(0), list(range(COUNT))
    rows[4] = 9
    stated = ImagePoses(NAMES, shaken(poses, 0)[torch.tensor(rows)])
    count = PhotoCount("4.png", 62, *[5] * 5)
    ((advice,), _) = photos_far_from_given(stated, ImagePoses(NAMES, poses), {"4.png": count}, LengthUnit.OPEN, MovedOptions())
    assert "(even there lines explain 5 of its 62 arcs)" in advice.limit


def test_the_photos_of_an_instant_are_one() -> None:
    """A rig that stands elsewhere is one place, and its rows are not one after the other."""
    poses, rows = walk(0), list(range(COUNT))
    rows[4] = 9
    stated = shaken(poses, 0)[torch.tensor(rows)]
    beside = Pose.exp(torch.tensor([[0.0, 0.1, 0.0, 0.1, 0.0, 0.0]], dtype=torch.float64))
    names = tuple(f"{camera}/{k}.png" for k in range(COUNT) for camera in ("left", "right"))
    frames = tuple(str(k) for k in range(COUNT) for _ in range(2))

    def both(one: Pose) -> ImagePoses:
        each = [pose for k in range(COUNT) for pose in (one[k], (beside @ one[[k]])[0])]
        return ImagePoses(names, Pose.stack(each), None, None, frames)

    ((advice,), photos) = photos_far_from_given(both(stated), both(poses), {}, LengthUnit.METRES, MovedOptions())
    assert photos == {"left/4.png"} and "slipped" not in advice.limit
    assert not photos_far_from_given(replace(both(poses), frames=None), both(poses), {}, LengthUnit.METRES, MovedOptions())[0]


def test_an_adjustment_of_segments_names_photos_that_it_moved_far() -> None:
    """Only lines from photos did: `adjust` and `reconstruct --segments` said nothing of a pose that was 40 cm off."""
    segments, poses, _ = world()
    noise = np.random.default_rng(0).normal(0.0, 0.05, segments.endpoints_px.shape)
    segments = replace(segments, endpoints_px=segments.endpoints_px + noise)
    shifts = np.random.default_rng(1).normal(size=(len(poses), 6)) * np.repeat([0.001, 0.005], 3)
    options = replace(OF_TABLES, refine=("lines", "poses"))

    def said() -> list[str]:
        given = replace(poses, cam_from_world=Pose.exp(torch.as_tensor(shifts)) @ poses.cam_from_world)
        return [one.limit for one in ol.adjust(segments, given, CAMERA, options).advice]

    assert not said()
    shifts[4, 3] += 0.4
    (limit,) = said()
    assert limit.startswith("Refined poses lie far from those given: 4.png 0.4")
