"""Whether right angles tell the scale of a camera: directions of walls at known angles, seen by a camera that is off."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from omnilines.structure.meeting import Meeting
from omnilines.structure.options import RightAngleOptions
from omnilines.structure.told_scale import ToldScale, told_scale

SIGMA_RAD = 1e-3
QUICK = RightAngleOptions(told_factors=400, angles=100)


def photo(directions: np.ndarray, factor: float, rng: np.random.Generator) -> Meeting:
    """Directions, with noise, as a camera sees them whose bearings have z times `factor` in the place of their own."""
    seen = (directions + SIGMA_RAD * rng.normal(size=directions.shape)) * [1.0, 1.0, factor]
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    across = np.eye(3) - seen[:, :, None] * seen[:, None]
    return Meeting(seen, SIGMA_RAD**2 * across, np.full(0, -1), 0.0)


def told(headings_deg: Sequence[float], walls_deg: float, factor: float, tilt_deg: float = 0.0) -> ToldScale:
    """Of the verticals and both walls, y down, seen level or looking down, at headings from between the walls."""
    rng, half, tilt = np.random.default_rng(0), math.radians(walls_deg) / 2, math.radians(tilt_deg)
    look = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    photos = []
    for heading in np.radians(headings_deg):
        ways = np.array([[math.sin(a), 0.0, math.cos(a)] for a in (heading - half, heading + half)])
        photos.append(photo(np.concatenate([ways, [[0.0, 1.0, 0.0]]]) @ look.T, factor, rng))
    return told_scale(photos, np.ones(len(photos)))


@pytest.mark.slow
def test_right_angles_seen_from_several_sides_tell_the_scale_wherever_it_is() -> None:
    for factor in (1.0, 1.15, 0.6):
        found = told([5.0, 40.0, 95.0, -30.0], 90.0, factor)
        assert found.decisive and found.here is (factor == 1.0)
        assert abs(math.log(found.factor * factor)) < 3.0 * found.sigma < found.reach < 0.03


@pytest.mark.slow
def test_walls_at_85_degrees_seen_from_several_sides_explain_themselves() -> None:
    found = told([5.0, 40.0, 95.0, -30.0], 85.0, 1.1)
    assert not found.decisive and found.odds < 1.0
    assert abs(found.rival_factor * 1.1 - 1.0) < 0.01
    assert found.rival_angle_rad is not None and abs(math.degrees(found.rival_angle_rad) - 85.0) < 0.3


@pytest.mark.slow
def test_walls_nearly_at_right_angles_tell_the_scale_as_well_as_both_explanations_agree() -> None:
    """Walls at 88 degrees are right ones at a focal length a little off, and themselves at their own: it lies between."""
    for walls_deg in (88.0, 88.5):
        found = told([5.0, 40.0, 95.0, -30.0, 60.0], walls_deg, 1.1, 5.0)
        assert found.told and not found.decisive
        assert abs(math.log(found.either * 1.1)) < 3.0 * found.either_sigma < 0.1


@pytest.mark.slow
def test_one_pair_and_walls_seen_from_one_side_tell_nothing() -> None:
    """Any one angle is a right one at some scale, and photos from the same side repeat it."""
    for walls_deg in (85.0, 90.0):
        for headings in ([0.0], [5.0] * 6):
            found = told(headings, walls_deg, 1.0)
            assert not found.decisive and not found.told
    nothing = told_scale([], np.zeros(0))
    assert not nothing.decisive and not nothing.told


@pytest.mark.slow
def test_walls_at_85_degrees_are_not_right_ones_in_tilted_photos_either() -> None:
    """Verticals tell the scale there, and that walls are not at right angles at it."""
    found = told([20.0, 75.0, -50.0, 120.0], 85.0, 1.1, 15.0)
    assert not found.decisive and abs(found.rival_factor * 1.1 - 1.0) < 0.01
    assert told([20.0, 75.0, -50.0, 120.0], 90.0, 1.1, 15.0).decisive


@pytest.mark.slow
@pytest.mark.parametrize(("draws", "most"), [(10, 5), pytest.param(40, 11, marks=pytest.mark.full)])
def test_directions_at_random_tell_a_scale_no_more_often_than_odds_say(draws: int, most: int) -> None:
    """Where odds of ten decide, at most one in eleven of what is told may be wrong; here all of it would be."""
    rng, wrong, either = np.random.default_rng(1), 0, 0
    for _ in range(draws):
        directions = rng.normal(size=(4, 3, 3))
        photos = [photo(one / np.linalg.norm(one, axis=-1, keepdims=True), 1.0, rng) for one in directions]
        found = told_scale(photos, np.ones(4), QUICK)
        wrong, either = wrong + found.decisive, either + found.told
    # Of 10 and of 40, with a probability of 1/11 each, once in 1e4 more or less often.
    assert wrong <= most and either <= most
