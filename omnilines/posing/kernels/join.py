"""The compiled joining of features into tracks that have no two features of one photo."""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def share_photo(photo, following, i, j):
    """Whether two tracks, given by their first features, have features of one photo."""
    while i >= 0 and j >= 0:
        if photo[i] == photo[j]:
            return True
        if photo[i] < photo[j]:
            i = following[i]
        else:
            j = following[j]
    return False


@njit(cache=True, nogil=True)
@no_type_check
def merge(photo, following, i, j):
    """One list of the features of two tracks, in the order of their photos; returns its first."""
    head = last = -1
    while i >= 0 or j >= 0:
        if j < 0 or (i >= 0 and photo[i] < photo[j]):
            taken = i
            i = following[i]
        else:
            taken = j
            j = following[j]
        if last < 0:
            head = taken
        else:
            following[last] = taken
        last = taken
    return head


@njit(cache=True, nogil=True)
@no_type_check
def joined(links, photo):
    """The track of every feature, after each link (l x 2) in turn joined the tracks of its two features, unless both have a
    feature of the same photo. `photo` (n) is that of every feature. A track has the number of one of its features."""
    track, first, following = np.arange(len(photo)), np.arange(len(photo)), np.full(len(photo), -1)
    size = np.ones(len(photo), dtype=np.int64)
    for k in range(len(links)):
        a, b = track[links[k, 0]], track[links[k, 1]]
        if a == b or share_photo(photo, following, first[a], first[b]):
            continue
        if size[a] < size[b]:
            a, b = b, a
        i = first[b]
        while i >= 0:
            track[i] = a
            i = following[i]
        size[a] += size[b]
        first[a] = merge(photo, following, first[a], first[b])
    return track
