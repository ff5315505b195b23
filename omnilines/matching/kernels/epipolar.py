"""Which arcs of other photos lie where an arc could be seen: by their angle about the line between both cameras, compiled.

A point seen from two cameras has one angle about the baseline in both, and along a line of the world that angle only grows or
only falls. So arcs show a common piece of one line only where their intervals of that angle overlap: nothing is lost by looking
no farther. `no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

BINS = 512
"""Of the angle; an arc stands in all that it reaches."""
NEARLY_HALF = math.pi - 0.2
"""An arc over so large an angle passes a pole of the baseline, and may be on either side of it: it stands in all bins."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def frame_about(x, y, z, frame):
    """Two orthonormal rows across a baseline of any length into `frame`; false where there is none."""
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        return False
    x, y, z = x / length, y / length, z / length
    # Duff et al., Building an Orthonormal Basis, Revisited, JCGT 2017.
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    frame[0, 0], frame[0, 1], frame[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    frame[1, 0], frame[1, 1], frame[1, 2] = b, sign + y * y * a, -y
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def bins_of(p, frame):
    """The first bin of an arc (row of `packed`) and how many it reaches."""
    angle = np.empty(2)
    for end in range(2):
        v0, v1, v2 = p[3 * end], p[3 * end + 1], p[3 * end + 2]
        along = frame[0, 0] * v0 + frame[0, 1] * v1 + frame[0, 2] * v2
        angle[end] = math.atan2(frame[1, 0] * v0 + frame[1, 1] * v1 + frame[1, 2] * v2, along)
    step = angle[1] - angle[0]
    step -= 2.0 * math.pi * round(step / (2.0 * math.pi))
    if abs(step) > NEARLY_HALF:
        return 0, BINS
    low = (min(angle[0], angle[0] + step) / (2.0 * math.pi) + 1.0) * BINS
    first = int(low)
    return first % BINS, int(low + abs(step) / (2.0 * math.pi) * BINS) - first + 1


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def arcs_by_angle(photo, photos, starts, packed):
    """Frames about the baselines from one photo to others, and the arcs of each in each bin: those of bin b of the k-th photo are
    members[begin[k, b]:begin[k, b + 1]]. A photo at the same place has none."""
    frames, begin = np.zeros((len(photos), 2, 3)), np.zeros((len(photos), BINS + 1), dtype=np.int64)
    reach = np.zeros((starts[-1], 2), dtype=np.int64)
    here, total = packed[starts[photo]], 0
    for k in range(len(photos)):
        low, high = starts[photos[k]], starts[photos[k] + 1]
        if low == high or not frame_about(
            packed[low, 9] - here[9], packed[low, 10] - here[10], packed[low, 11] - here[11], frames[k]
        ):
            begin[k] = total
            continue
        count = np.zeros(BINS, dtype=np.int64)
        for j in range(low, high):
            reach[j] = bins_of(packed[j], frames[k])
            for b in range(reach[j, 0], reach[j, 0] + reach[j, 1]):
                count[b % BINS] += 1
        begin[k, 0] = total
        for b in range(BINS):
            begin[k, b + 1] = begin[k, b] + count[b]
        total = begin[k, BINS]
    members = np.empty(total, dtype=np.int32)
    for k in range(len(photos)):
        if begin[k, 0] == begin[k, BINS]:
            continue
        at = begin[k, :BINS].copy()
        for j in range(starts[photos[k]], starts[photos[k] + 1]):
            for b in range(reach[j, 0], reach[j, 0] + reach[j, 1]):
                members[at[b % BINS]] = j
                at[b % BINS] += 1
    return frames, begin, members


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def arcs_across(p, frames, begin, members, mark, seen, found):
    """Arcs that share a bin with an arc (row of `packed`), each once and in order of photos, into `found`; how many.

    `seen` remembers by `mark` which were found.
    """
    count = 0
    for k in range(len(frames)):
        if begin[k, 0] == begin[k, BINS]:
            continue
        first, reach = bins_of(p, frames[k])
        for b in range(first, first + reach):
            for at in range(begin[k, b % BINS], begin[k, b % BINS + 1]):
                j = members[at]
                if seen[j] != mark:
                    seen[j] = mark
                    found[count] = j
                    count += 1
    return count
