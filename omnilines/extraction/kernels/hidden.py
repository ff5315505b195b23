"""Edges that profiles show beside those already known, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.step_algebra import MOST_STEPS
from omnilines.extraction.kernels.step_table import Table, blurred_steps, row_of, step_at
from omnilines.extraction.kernels.tables import Stepped, Window


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _orthonormal(basis: np.ndarray, columns: int, size: int) -> int:
    """Gram and Schmidt on the rows of `basis` in place; rows that the others explain are dropped. Returns how many are left."""
    kept = 0
    for p in range(columns):
        before = 0.0
        for k in range(size):
            before += basis[p, k] ** 2
        for q in range(kept):
            inner = 0.0
            for k in range(size):
                inner += basis[p, k] * basis[q, k]
            for k in range(size):
                basis[p, k] -= inner * basis[q, k]
        square = 0.0
        for k in range(size):
            square += basis[p, k] ** 2
        if square <= 1e-4 * before or square == 0.0:
            continue
        for k in range(size):
            basis[kept, k] = basis[p, k] / math.sqrt(square)
        kept += 1
    return kept


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _explained(window: Window, place: np.ndarray, table: Table, basis: np.ndarray) -> int:
    """Fill the first rows of `basis`, orthonormal, with what a level, steps at places and their shifts explain; how many."""
    offsets, weight = window.offsets_px, window.weight
    size, steps = len(offsets), len(place)
    for k in range(size):
        basis[0, k] = weight[k]
    between = offsets[1] - offsets[0]
    for j in range(steps):
        at, shift, first = row_of(offsets[0], between, place[j], table)
        for k in range(size):
            half, bell = step_at(table, at + k, shift, first + k * between / table.blur)
            basis[1 + 2 * j, k], basis[2 + 2 * j, k] = weight[k] * half, weight[k] * bell
    return _orthonormal(basis, 1 + 2 * steps, size)


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _rest(profile: np.ndarray, weight: np.ndarray, basis: np.ndarray, kept: int, rest: np.ndarray) -> float:
    """Fill `rest` with what the basis leaves of a weighted profile (c, k); its sum of squares."""
    channels, size = profile.shape
    left = 0.0
    for c in range(channels):
        for k in range(size):
            rest[c, k] = profile[c, k] * weight[k]
        for q in range(kept):
            inner = 0.0
            for k in range(size):
                inner += rest[c, k] * basis[q, k]
            for k in range(size):
                rest[c, k] -= inner * basis[q, k]
        for k in range(size):
            left += rest[c, k] ** 2
    return left


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def one_more_step(
    stepped: Stepped,
    starts: np.ndarray,
    whole: np.ndarray,
    window: Window,
    blur: float,
    candidates: np.ndarray,
    min_apart_px: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each arc (n) with profiles (m, c, k) from starts[n] on, of which those `whole` (m) count, and each candidate place: how
    much less one more step there leaves of the sum of squares (n, d), and the mean square of its height over channels (n, d); and
    what is left without (n).

    The steps known may move to first order: what a small shift of theirs explains is no new step.
    """
    profile, place, count = stepped
    offsets, weight = window.offsets_px, window.weight
    arcs, size, channels = len(starts) - 1, profile.shape[2], profile.shape[1]
    gain, height, left = np.zeros((arcs, len(candidates))), np.zeros((arcs, len(candidates))), np.zeros(arcs)
    basis, rest = np.empty((2 * MOST_STEPS + 1, size)), np.empty((channels, size))
    known = np.empty((len(candidates), size))
    for d in range(len(candidates)):
        for k in range(size):
            known[d, k] = 0.5 * weight[k] * math.erf((offsets[k] - candidates[d]) / blur * 0.7071067811865476)
    table = blurred_steps(blur, offsets[1] - offsets[0])
    for arc in range(arcs):
        used = 0
        taken = np.zeros(len(candidates), dtype=np.int64)
        for n in range(starts[arc], starts[arc + 1]):
            if not whole[n]:
                continue
            used += 1
            kept = _explained(window, place[n, : count[n]], table, basis)
            left[arc] += _rest(profile[n], weight, basis, kept, rest)
            for d in range(len(candidates)):
                near = False
                for j in range(count[n]):
                    near = near or abs(place[n, j] - candidates[d]) < min_apart_px
                if near:
                    continue
                # The step less what the basis explains of it; what is left of the profile has nothing of the basis.
                square = 0.0
                for k in range(size):
                    square += known[d, k] ** 2
                for q in range(kept):
                    inner = 0.0
                    for k in range(size):
                        inner += known[d, k] * basis[q, k]
                    square -= inner * inner
                taken[d] += 1
                for c in range(channels):
                    inner = 0.0
                    for k in range(size):
                        inner += known[d, k] * rest[c, k]
                    gain[arc, d] += inner * inner / max(square, 1e-9)
                    height[arc, d] += (inner / max(square, 1e-9)) ** 2
        for d in range(len(candidates)):
            if 2 * taken[d] < used or used == 0:
                gain[arc, d], height[arc, d] = 0.0, 0.0
            else:
                height[arc, d] /= taken[d]
    return gain, height, left
