"""A target for a screen: one HTML file that shows it at true scale, once it has been told how large a pixel is."""

import numpy as np

from calib_patterns import Pattern
from omnilines.report.page import fragment


def screen_page(pattern: Pattern) -> str:
    """The page. Edges lie on whole pixels of the screen, and it says what the target then measures, as `pattern` takes it.

    It needs no network. The size of a pixel is found with a bank card (ISO/IEC 7810: 85.60 mm) or a ruler; the browser keeps it.
    """
    left, top = pattern.top_left_m
    rectangles_mm = 1000.0 * (pattern.black_rectangles_m - np.array([left, top, left, top]))
    return fragment(
        "screen",
        specification=pattern.specification,
        size_mm=[1000.0 * length for length in pattern.size_m],
        rectangles_mm=np.round(rectangles_mm, 6).tolist(),
    )
