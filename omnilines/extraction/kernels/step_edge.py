"""Profiles fitted with several blurred steps at once, one for each edge that crosses them; compiled.

A profile y_c(x) of channel c is level_c + sum_j h_jc Phi((x - x_j) / blur), with the places x_j common to all channels. The
heights are linear: they are solved for at every step of Gauss and Newton in the places (variable projection, Golub and Pereyra
1973). Many profiles of as many steps each are fitted at once, each in its lane; one that is done makes room for the next.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.step_algebra import (
    LEAST_BLUR_PX,
    MOST_STEPS,
    Fit,
    Move,
    backward,
    factorise,
    forward,
    heights,
    newton,
)
from omnilines.extraction.kernels.tables import Stepped, Window

MOST_LANES, LEAST_LANES = 64, 16
"""Profiles fitted at once where there are as many, and where not."""
ROUNDS = 5
SETTLED_PX = 0.01
_MOST_MOVE_PX = 0.5


class State(NamedTuple):
    """How far the fit of each lane is."""

    profile: Int[np.ndarray, " l"]
    """Its number; -1 where there is none."""
    number: Int[np.ndarray, " l"]
    """Of the round, from 0 on."""
    least: Float[np.ndarray, " l"]
    left: Float[np.ndarray, " l"]
    """Sum of squares at the places kept."""
    cost: Float[np.ndarray, " l"]
    refused: Bool[np.ndarray, " l"]
    """Where the last places tried were worse than those kept."""
    done: Bool[np.ndarray, " l"]


class Room(NamedTuple):
    """Room for some profiles, used again for the next ones."""

    fit: Fit
    move: Move
    state: State


class Found(NamedTuple):
    """What `fit_steps` returns."""

    place: Float[np.ndarray, "m s"]
    variance: Float[np.ndarray, " m"]
    heights: Float[np.ndarray, "m s c"]
    rest: Float[np.ndarray, " m"]


class Given(NamedTuple):
    """What it is given."""

    stepped: Stepped
    sigma: Float[np.ndarray, " m"]
    window: Window
    stiff: Float[np.ndarray, "2"]
    rounds: int
    blur: float


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _judge(steps: int, rounds: int, room: Room) -> None:
    """Keep the places tried where they are better than those kept; else go half the way back, after the last round all of it: the
    heights there are then asked for once more."""
    fit, move, state = room
    start, hold, here, kept = move.start, move.hold, move.here, move.kept
    lanes = len(state.cost)
    for n in range(lanes):
        state.cost[n] = fit.squares[n]
    for j in range(steps):
        for n in range(lanes):
            state.cost[n] += hold[j, n] * (here[j, n] - start[j, n]) ** 2
    for n in range(lanes):
        if state.number[n] == rounds:
            state.left[n], state.done[n] = fit.squares[n], True
            continue
        last = state.number[n] == rounds - 1 and rounds > 1
        state.refused[n] = state.cost[n] > state.least[n]
        if state.refused[n]:
            for j in range(steps):
                here[j, n] = kept[j, n] if last else 0.5 * (here[j, n] + kept[j, n])
        else:
            state.least[n], state.left[n], state.done[n] = state.cost[n], fit.squares[n], last
            for j in range(steps):
                kept[j, n] = here[j, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _take_step(steps: int, single: bool, room: Room) -> None:
    """The step of Gauss and Newton where the places tried are kept. A lane is done after a small step, or a `single` one: its
    heights and all else stay those of before it."""
    _, move, state = room
    start, hold, here, kept, hessian, newest, pull, _, _ = move
    lanes = len(state.cost)
    for j in range(steps):
        for n in range(lanes):
            newest[j, j, n] += hold[j, n] + 1e-9
            pull[0, j, n] += hold[j, n] * (start[j, n] - here[j, n])
    factorise(newest, steps)
    forward(newest, steps, pull, 0)
    backward(newest, steps, pull, 0)
    for n in range(lanes):
        state.number[n] += 1
        if state.done[n] or state.refused[n]:
            continue
        farthest = 0.0
        for j in range(steps):
            farthest = max(farthest, abs(pull[0, j, n]))
            for i in range(j + 1):
                hessian[j, i, n] = newest[j, i, n]
        # What is left of the steps and heights after so small a move is of second order.
        state.done[n] = single or farthest < SETTLED_PX
        for j in range(steps):
            place = here[j, n] + min(max(pull[0, j, n], -_MOST_MOVE_PX), _MOST_MOVE_PX)
            if state.done[n]:
                kept[j, n] = place
            else:
                here[j, n] = place


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _begin(given: Given, m: int, n: int, room: Room) -> None:
    """Put a profile in a lane."""
    profile, start, count = given.stepped
    begin, weight = given.window.begin, given.window.weight
    fit, move, state = room
    energy = 0.0
    for c in range(profile.shape[1]):
        for k in range(len(weight)):
            scaled = profile[m, c, begin + k] * weight[k]
            fit.scaled[c, k, n] = scaled
            energy += scaled * scaled
    fit.energy[n] = energy
    for j in range(count[m]):
        move.start[j, n], move.here[j, n] = start[m, j], start[m, j]
        move.hold[j, n] = (given.sigma[m] / given.stiff[min(j, 1)]) ** 2
    state.profile[n], state.number[n] = m, 0
    state.least[n], state.left[n], state.refused[n], state.done[n] = np.inf, 0.0, False, False


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _fit_rows(given: Given, rows: np.ndarray, room: Room, found: Found) -> None:
    """Fill in what is found of profiles of equally many steps."""
    count, sigma = given.stepped.steps, given.sigma
    fit, move, state = room
    lanes, channels, steps, following, left = len(state.cost), len(fit.scaled), count[rows[0]], 0, len(rows)
    for n in range(lanes):
        # Lanes without a profile repeat one, in vain.
        _begin(given, rows[min(n, len(rows) - 1)], n, room)
        if n >= len(rows):
            state.profile[n] = -1
    following = min(lanes, len(rows))
    while left > 0:
        heights(given.window, move.here, steps, given.blur, fit)
        _judge(steps, given.rounds, room)
        moving = False
        for n in range(lanes):
            moving = moving or not state.done[n]
        # Of lanes that are done nothing more is asked for.
        if moving:
            newton(steps, fit, move)
            _take_step(steps, given.rounds == 1, room)
        ended = False
        for n in range(lanes):
            ended = ended or (state.done[n] and state.profile[n] >= 0)
        if not ended:
            continue
        for j in range(steps):
            for n in range(lanes):
                move.pull[0, j, n] = 1.0 if j == 0 else 0.0
        forward(move.hessian, steps, move.pull, 0)
        backward(move.hessian, steps, move.pull, 0)
        for n in range(lanes):
            m = state.profile[n]
            if m < 0 or not state.done[n]:
                continue
            found.rest[m], found.variance[m] = state.left[n], sigma[m] * sigma[m] * move.pull[0, 0, n]
            for j in range(steps):
                found.place[m, j] = move.kept[j, n]
                for c in range(channels):
                    found.heights[m, j, c] = fit.height[c, 1 + j, n]
            left -= 1
            if following < len(rows):
                _begin(given, rows[following], n, room)
                following += 1
            else:
                state.profile[n] = -1


@njit(cache=True, nogil=True)
@no_type_check
def _room(channels: int, weight: np.ndarray, lanes: int) -> Room:
    """For so many lanes."""
    size, numbers = len(weight), np.empty((11, lanes))
    fit = Fit(
        np.zeros((channels, size, lanes)),
        numbers[10],
        np.empty((MOST_STEPS + 1, size, lanes)),
        np.empty((MOST_STEPS, size, lanes)),
        np.empty((MOST_STEPS + 1, MOST_STEPS + 1, lanes)),
        np.empty((MOST_STEPS + 1, lanes)),
        np.empty((channels, MOST_STEPS + 1, lanes)),
        numbers[0],
        numbers[1],
        numbers[2],
        numbers[3],
        numbers[7],
        numbers[8],
        numbers[9],
    )
    for k in range(size):
        fit.design[0, k] = weight[k]
    places, matrices = np.empty((4, MOST_STEPS, lanes)), np.ones((2, MOST_STEPS, MOST_STEPS, lanes))
    columns, pull = np.empty((2, MOST_STEPS, MOST_STEPS + 1, lanes)), np.empty((1, MOST_STEPS, lanes))
    move = Move(places[0], places[1], places[2], places[3], matrices[0], matrices[1], pull, columns[0], columns[1])
    profile, number = np.empty(lanes, dtype=np.int64), np.empty(lanes, dtype=np.int64)
    refused, done = np.empty(lanes, dtype=np.bool_), np.empty(lanes, dtype=np.bool_)
    return Room(fit, move, State(profile, number, numbers[4], numbers[5], numbers[6], refused, done))


@njit(cache=True, nogil=True)
@no_type_check
def fit_steps(
    stepped: Stepped, sigma: np.ndarray, window: Window, stiff: np.ndarray, blur: float, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places (m, s) of the steps of m profiles, begun at theirs; the variance of the first place (m), the heights (m, s, c) and
    the sum of squares that is left of the weighted profiles (m).

    Profile m has noise of `sigma` in each value. `stiff` (2) are the standard deviations in px of the first place about its start
    and of the others: a faint step stays where its own arc says. There are at most so many rounds; after a single one, places are
    good to first order, and all else is that of their start.
    """
    profile, start, count = stepped
    m, channels = len(profile), profile.shape[1]
    found = Found(start.copy(), np.full(m, np.inf), np.zeros((m, MOST_STEPS, channels)), np.zeros(m))
    given = Given(stepped, sigma, window, stiff, rounds, max(blur, LEAST_BLUR_PX))
    most, least = _room(channels, window.weight, MOST_LANES), _room(channels, window.weight, LEAST_LANES)
    order = np.argsort(count, kind="mergesort")
    first = 0
    while first < m:
        after = first
        while after < m and count[order[after]] == count[order[first]]:
            after += 1
        if after - first >= MOST_LANES:
            _fit_rows(given, order[first:after], most, found)
        else:
            _fit_rows(given, order[first:after], least, found)
        first = after
    return found.place, found.variance, found.heights, found.rest
