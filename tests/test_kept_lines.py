"""Which photos lines join least."""

import numpy as np
from scipy import sparse

from omnilines.pipelines.kept_lines import nearest_apart, shared_lines, shown_lines, weakest_link


def shared(*lines_of: tuple[int, ...]) -> sparse.csr_array:
    """Of photos that show lines of these numbers."""
    image = np.repeat(np.arange(len(lines_of)), [len(lines) for lines in lines_of])
    return shared_lines(shown_lines(image, np.array([line for lines in lines_of for line in lines]), len(lines_of), 12))


def test_the_weakest_link_is_that_of_the_tree_of_most_shared_lines() -> None:
    # 0-1 share four lines, 1-2 two and 0-2 one, 2-3 three.
    photos = shared((0, 1, 2, 3, 4), (0, 1, 2, 3, 5, 6), (4, 5, 6, 7, 8, 9), (7, 8, 9))
    assert weakest_link(photos) == (1, 2, 2)
    assert nearest_apart(photos, np.eye(4, 3)) is None


def test_photos_that_no_lines_join_are_asked_for_between_the_nearest() -> None:
    """Three groups in a row: 0 with 3, 1 with 2, and 4, which shows nothing; 3 and 1 are at 2 and 5."""
    photos = shared((0, 1), (2,), (2, 3), (1,), ())
    at = np.array([0.0, 5.0, 6.0, 2.0, 10.0])[:, None] * [1.0, 0.0, 0.0]
    assert weakest_link(photos)[2] == 0
    assert set(nearest_apart(photos, at) or ()) == {3, 1}
