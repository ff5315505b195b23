"""Pairs of photos that contradict the rotations of the others, and a mapping that is interrupted."""

import itertools
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sfm_scenes import described, places, world

from camera_models.pose import Pose
from omnilines.posing import colmap_mapper
from omnilines.posing.colmap_mapper import MapperInput, map_photos
from omnilines.posing.feature_matches import matched
from omnilines.posing.options import MapperOptions, PosingOptions
from omnilines.posing.rotations import agreeing_pairs, averaged_rotations, fits_rotation
from omnilines.posing.settled import Rays, least_joined, settled
from omnilines.progress import one_torch_thread
from omnilines.scenes import scene_camera


def of_pairs(turned: Rotation, pairs: list[tuple[int, int]], rng: np.random.Generator, noise_deg: float = 0.5):
    """Relative rotations with noise, and many matches."""
    found = {}
    for i, j in pairs:
        noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3))
        found[i, j] = ((noise * turned[j] * turned[i].inv()).as_matrix(), int(rng.integers(30, 200)))
    return found


@pytest.mark.parametrize("seed", range(5))
def test_pairs_that_contradict_the_others_are_dropped(seed):
    rng = np.random.default_rng(seed)
    turned = Rotation.random(12, random_state=seed)
    # A chain with neighbours two apart, closed to a ring; eight chance pairs of few matches, each with a turn of its own.
    ring = [(min(k, other), max(k, other)) for k in range(12) for other in ((k + 1) % 12, (k + 2) % 12)]
    pairs = of_pairs(turned, sorted(set(ring)), rng)
    others = [pair for pair in itertools.combinations(range(12), 2) if pair not in pairs]
    wrong = [others[k] for k in rng.choice(len(others), 8, replace=False)]
    for i, j in wrong:
        turn = Rotation.from_rotvec(np.radians(rng.uniform(20, 180)) * np.array([0.0, 1.0, 0.0]))
        pairs[i, j] = ((turn * turned[j] * turned[i].inv()).as_matrix(), int(rng.integers(15, 25)))
    kept = agreeing_pairs(pairs, averaged_rotations(pairs, 12))
    assert set(kept) == set(ring)


def test_parts_without_a_pair_between_them_and_no_pairs_at_all():
    rng = np.random.default_rng(0)
    turned = Rotation.random(7, random_state=1)
    pairs = of_pairs(turned, [(0, 1), (1, 2), (0, 2), (4, 5), (5, 6), (4, 6)], rng)
    assert set(agreeing_pairs(pairs, averaged_rotations(pairs, 7))) == set(pairs)
    assert agreeing_pairs({}, averaged_rotations({}, 3)) == []


def six_panoramas() -> tuple[MapperInput, Pose]:
    """Six panoramas of one room and their matches, and the true poses."""
    camera, _ = scene_camera("equirectangular", (800, 400), 0)
    points, words = world(500, 1)
    truth = places(6, 2)
    features = [described(camera, truth[k], points, words, np.random.default_rng([k, 5])) for k in range(6)]
    matches = {(i, j): matched(features[i], features[j])[0] for i, j in itertools.combinations(range(6), 2)}
    return MapperInput(features, matches, [0] * 6, list(range(6)), {}), truth


def test_photos_that_are_settled_are_mapped_once(tmp_path):
    """Each explains its matches, and has its true rotation to the first: no other way of adding photos is tried."""
    given, truth = six_panoramas()
    (part,) = map_photos(given, tmp_path, 0)
    assert sorted(part) == list(range(6))
    assert (tmp_path / "models0").is_dir() and not (tmp_path / "models1").exists()
    for k in range(1, 6):
        turn = part[k].rotation @ part[0].rotation.mT @ truth[0].rotation @ truth[k].rotation.mT
        assert Rotation.from_matrix(turn.numpy()).magnitude() < 5e-3


@pytest.mark.parametrize("seed", range(3))
def test_matches_of_one_small_plane_fit_several_rotations(seed):
    """They fit that of the photos, and one 4 degrees off, as may be told of them; matches of chance do not."""
    rng = np.random.default_rng(seed)
    limit_rad = 4e-3
    points = np.stack([*rng.uniform(-0.4, 0.4, (2, 60)), np.full(60, 4.0)], 1)
    true = Rotation.from_rotvec([0.05, 0.4, 0.02])

    def seen(at: np.ndarray) -> np.ndarray:
        noisy = at / np.linalg.norm(at, axis=1)[:, None] + rng.normal(0.0, 0.1 * limit_rad, at.shape)
        return noisy / np.linalg.norm(noisy, axis=1)[:, None]

    a, b = seen(points), seen(true.apply(points - [1.0, 0.2, 0.0]))
    near = Rotation.from_rotvec(np.radians(4.0) * np.array([0.0, 1.0, 0.0])) * true
    for turned in (true, near):
        assert fits_rotation(a, b, turned.as_matrix(), limit_rad)
    other = seen(true.apply(points[rng.permutation(60)] - [1.0, 0.2, 0.0]))
    assert not fits_rotation(a, other, true.as_matrix(), limit_rad)


def test_a_group_of_photos_has_to_explain_its_matches_with_the_others():
    """Of two groups of three photos nearly all is explained inside; what joins them counts by itself."""
    within, between = [(0, 1), (1, 2), (3, 4), (4, 5)], {(0, 5): 41, (1, 3): 0, (2, 3): 59}
    nothing = torch.zeros(100, 3).double()
    rays = {pair: Rays(nothing, nothing, 1e-3, True, True) for pair in (*within, *between)}
    rays[0, 4] = Rays(nothing, nothing, 1e-3, False, False)
    explained = dict.fromkeys(within, 98)
    assert least_joined(6, {**explained, **between}, rays) == pytest.approx(100 / 300)
    assert least_joined(6, {**explained, **dict.fromkeys(between, 95)}, rays) == pytest.approx(0.95)
    # Each photo alone explains most of its matches.
    of_first = (98 + 41) / 200
    assert not settled(6, {**explained, **between}, rays, of_first, 1.0)
    assert settled(6, {**explained, **dict.fromkeys(between, 95)}, rays, 0.8, 1.0)


@pytest.mark.slow
def test_a_photo_without_pairs_is_not_settled(tmp_path):
    """The same matches, but of other features of the last photo: no pair with it is verified."""
    given, _ = six_panoramas()
    bearings = given.features[5].bearings.flip(0)
    wrong = replace(given, features=[*given.features[:5], replace(given.features[5], bearings=bearings)])
    map_photos(wrong, tmp_path, 0)
    assert (tmp_path / "models2").is_dir()


def test_other_draws_are_tried_where_no_way_settles_all_photos(tmp_path, monkeypatch):
    """With the seed given no photo is placed: that with the next one is taken, and the others are left."""
    given, _ = six_panoramas()
    own, drawn = colmap_mapper._mapped, []

    def unlucky(module, database, models, options, *rest):
        drawn.append(options.random_seed)
        return [] if options.random_seed == 7 else own(module, database, models, options, *rest)

    monkeypatch.setattr(colmap_mapper, "_mapped", unlucky)
    (part,) = map_photos(given, tmp_path / "more", 7)
    assert sorted(part) == list(range(6)) and drawn == [7, 7, 7, 8]
    drawn.clear()
    options = replace(PosingOptions(), mapper=MapperOptions(more_draws=0))
    assert map_photos(given, tmp_path / "none", 7, options=options) == [] and drawn == [7, 7, 7]


def test_a_mapping_tells_how_far_it_is_and_an_interrupt_ends_it(tmp_path):
    given, _ = six_panoramas()
    told = []
    parts = map_photos(given, tmp_path / "whole", 0, lambda *step: told.append(step))
    assert len(parts[0]) == 6
    assert ("checking pairs of photos", 14, 15) in told
    assert [done for stage, done, _ in told if stage == "structure from motion"][:4] == [0, 3, 4, 5]

    def interrupt(stage: str, done: int, total: int) -> None:
        if stage == "structure from motion" and done == 3:
            os.kill(os.getpid(), signal.SIGINT)

    # A shell that starts the tests in the background has them ignore the signal.
    kept = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            map_photos(given, tmp_path / "cut", 0, interrupt)
    finally:
        signal.signal(signal.SIGINT, kept)


def test_torch_has_its_threads_back_after_small_products():
    before = torch.get_num_threads()
    with pytest.raises(ValueError), one_torch_thread():
        assert torch.get_num_threads() == 1
        raise ValueError
    assert torch.get_num_threads() == before
