"""Small compiled pieces of triangulation: singular vectors by one-sided Jacobi rotations, Householder's QR, medians.

One-sided Jacobi (M. Hestenes 1958) turns the columns of A until they are orthogonal, A V = U S: it is as accurate as LAPACK's
method and, for the few columns here, much faster than a call of that for every track.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

SWEEPS = 40
ORTHOGONAL = 1e-15
"""Cosine between two columns at which they count as orthogonal."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def orthogonalise(a, rows, columns, v, length):
    """Turn the columns of a (rows x columns) until orthogonal: a becomes U S, v is V, `length` the singular values, falling."""
    for x in range(columns):
        for y in range(columns):
            v[x, y] = 1.0 if x == y else 0.0
    for _ in range(SWEEPS):
        turned = False
        for p in range(columns - 1):
            for q in range(p + 1, columns):
                alpha = beta = gamma = 0.0
                for r in range(rows):
                    alpha += a[r, p] * a[r, p]
                    beta += a[r, q] * a[r, q]
                    gamma += a[r, p] * a[r, q]
                if not abs(gamma) > ORTHOGONAL * math.sqrt(alpha * beta):
                    continue
                turned = True
                zeta = (beta - alpha) / (2.0 * gamma)
                t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = c * t
                for r in range(rows):
                    a[r, p], a[r, q] = c * a[r, p] - s * a[r, q], s * a[r, p] + c * a[r, q]
                for r in range(columns):
                    v[r, p], v[r, q] = c * v[r, p] - s * v[r, q], s * v[r, p] + c * v[r, q]
        if not turned:
            break
    for x in range(columns):
        square = 0.0
        for r in range(rows):
            square += a[r, x] * a[r, x]
        length[x] = math.sqrt(square)
    for x in range(columns - 1):
        best = x
        for y in range(x + 1, columns):
            if length[y] > length[best]:
                best = y
        if best != x:
            length[x], length[best] = length[best], length[x]
            for r in range(rows):
                a[r, x], a[r, best] = a[r, best], a[r, x]
            for r in range(columns):
                v[r, x], v[r, best] = v[r, best], v[r, x]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def triangle(a, rows, columns):
    """Householder's QR: the upper triangle of a (rows x columns) becomes R, what is below it zero."""
    for x in range(min(columns, rows - 1)):
        square = 0.0
        for r in range(x, rows):
            square += a[r, x] * a[r, x]
        if square == 0.0:
            continue
        alpha = -math.copysign(math.sqrt(square), a[x, x])
        first = a[x, x] - alpha
        # H = I - v v' / (v'v / 2) with v = (first, a[x + 1:, x]).
        half = square - alpha * a[x, x]
        for y in range(x + 1, columns):
            dot = first * a[x, y]
            for r in range(x + 1, rows):
                dot += a[r, x] * a[r, y]
            dot /= half
            a[x, y] -= dot * first
            for r in range(x + 1, rows):
                a[r, y] -= dot * a[r, x]
        a[x, x] = alpha
        for r in range(x + 1, rows):
            a[r, x] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def weighted_median(values, weights, count):
    """Of the first `count` values, which are sorted in place with their weights; as `weighted_median_by_group`. NaN for none."""
    total = 0.0
    for x in range(count):
        total += weights[x]
        value, weight = values[x], weights[x]
        y = x - 1
        while y >= 0 and values[y] > value:
            values[y + 1], weights[y + 1] = values[y], weights[y]
            y -= 1
        values[y + 1], weights[y + 1] = value, weight
    lower = upper = np.nan
    running = 0.0
    for x in range(count):
        running += weights[x] / total
        if lower != lower and running >= 0.5 - 1e-9:
            lower = values[x]
        if running > 0.5 + 1e-9:
            upper = values[x]
            break
    return 0.5 * (lower + upper)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def cross(a0, a1, a2, b0, b1, b2):
    """a x b."""
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def inverse_of_normal(matrix, count, factor, inverse):
    """Inverse of the leading (count x count) part of a normal matrix, scaled to a unit diagonal before, by Cholesky's factor
    (kept in `factor`, whose last column takes the scales); false where it is not positive definite."""
    for x in range(count):
        if not matrix[x, x] > 0.0:
            return False
        factor[x, count] = 1.0 / math.sqrt(matrix[x, x])
    for x in range(count):
        for y in range(x + 1):
            value = matrix[x, y] * factor[x, count] * factor[y, count]
            for z in range(y):
                value -= factor[x, z] * factor[y, z]
            if x > y:
                factor[x, y] = value / factor[y, y]
            elif value > 0.0:
                factor[x, x] = math.sqrt(value)
            else:
                return False
    for column in range(count):
        for x in range(count):
            value = 1.0 if x == column else 0.0
            for z in range(x):
                value -= factor[x, z] * inverse[z, column]
            inverse[x, column] = value / factor[x, x]
        for x in range(count - 1, -1, -1):
            value = inverse[x, column]
            for z in range(x + 1, count):
                value -= factor[z, x] * inverse[z, column]
            inverse[x, column] = value / factor[x, x]
    for x in range(count):
        for y in range(count):
            inverse[x, y] *= factor[x, count] * factor[y, count]
    return True
