"""Targets at true scale, as PDF and SVG: one figure with a ruler and the specification, written by matplotlib.

The page is as large as the target with its white margin plus a border; printed at 100 percent, a millimetre is a millimetre.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from calib_patterns._pattern import Pattern
from camera_models.errors import InputError
from camera_models.formats.disk import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("pdf", "svg")
BORDER_MM = 8.0
"""White around the target, which most printers cannot print on to the edge."""
FOOT_MM = 24.0
"""Below the target, for the ruler and the text."""
RULER_MM = 200
"""Length of the ruler where the page is wide enough; otherwise the tens of millimetres that fit."""
MAX_PAGE_MM = 5000.0
"""Readers of PDF take pages of up to 200 inches."""
_MM_PER_INCH = 25.4
_TICKS_MM = ((10, 4.0), (5, 3.0), (1, 2.0))
"""(every, length), the longest first."""


@dataclass(frozen=True)
class Page:
    """Where things lie on the page, millimetres from its top left corner, y down."""

    width_mm: float
    height_mm: float
    board_origin_mm: tuple[float, float]
    """The origin of the board frame."""
    ruler_start_mm: tuple[float, float]
    ruler_mm: int

    @staticmethod
    def of(pattern: Pattern) -> "Page":
        """Raises InputError when the target is too large for one page or too small for a ruler."""
        size = 1000.0 * np.array(pattern.size_m)
        width, height = float(size[0]) + 2 * BORDER_MM, float(size[1]) + 2 * BORDER_MM + FOOT_MM
        ruler = min(RULER_MM, int((width - 2 * BORDER_MM) // 10) * 10)
        if max(width, height) > MAX_PAGE_MM or ruler < 10:
            raise InputError(
                f"A target between 10 mm and {MAX_PAGE_MM / 1000:g} m wide was expected, found {pattern.specification} of "
                f"{size[0]:.3g} x {size[1]:.3g} mm with its margin; check the unit of its lengths."
            )
        left, top = (BORDER_MM - 1000.0 * edge for edge in pattern.top_left_m)
        return Page(width, height, (left, top), (BORDER_MM, BORDER_MM + float(size[1]) + 4.0), ruler)


def print_pattern(pattern: Pattern, paths: tuple[Path, ...]) -> Page:
    """Write a target at true scale to files ending in .pdf or .svg; the same target gives the same bytes.

    Raises InputError for another ending and for targets that do not fit on a page.
    """
    import matplotlib

    for path in paths:
        if path.suffix.lower().lstrip(".") not in FORMATS:
            raise InputError(f"A file ending in .pdf or .svg was expected, found '{path}'; give one of these endings.")
    page = Page.of(pattern)
    # Text stays text in SVG; ids of its elements do not change from run to run.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": pattern.specification, "pdf.fonttype": 42}):
        figure = _figure(pattern, page)
        for path in paths:
            kind = path.suffix.lower().lstrip(".")
            dates = {"Date": None} if kind == "svg" else {"CreationDate": None}
            content = io.BytesIO()
            figure.savefig(content, format=kind, metadata={"Title": pattern.specification, **dates})
            write_atomically(path, content.getvalue())
    return page


def _figure(pattern: Pattern, page: Page) -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(page.width_mm / _MM_PER_INCH, page.height_mm / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, page.width_mm)
    axes.set_ylim(page.height_mm, 0.0)
    _fill(axes, np.array(page.board_origin_mm * 2) + 1000.0 * pattern.black_rectangles_m, "target")
    _ruler(axes, page)
    left, top = page.ruler_start_mm
    axes.text(left, top + 13.0, pattern.specification, fontsize=9, va="center", gid="specification")
    # As wide as the narrowest page takes.
    axes.text(left, top + 17.5, "Print at 100 percent; check the ruler.", fontsize=5, va="center")
    return figure


def _fill(axes: "Axes", rectangles_mm: Float[np.ndarray, "n 4"], name: str) -> None:
    """Black rectangles as one path: filled at once, neighbours show no seam."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    ring = rectangles_mm[:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 2)
    codes = np.tile([Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY], len(rectangles_mm))
    axes.add_patch(PathPatch(Outline(ring, codes), facecolor="black", edgecolor="none", linewidth=0.0, clip_on=False, gid=name))


def _ruler(axes: "Axes", page: Page) -> None:
    """Ticks of a fifth of a millimetre, centred on their millimetre, over a line; numbers at the tens."""
    left, top = page.ruler_start_mm
    at = np.arange(page.ruler_mm + 1)
    length = np.select([at % every == 0 for every, _ in _TICKS_MM], [tall for _, tall in _TICKS_MM])
    ticks = np.stack([left + at - 0.1, np.full(len(at), top), left + at + 0.1, top + length], -1)
    line = np.array([[left - 0.1, top - 0.2, left + page.ruler_mm + 0.1, top]])
    _fill(axes, np.concatenate([line, ticks]), "ruler")
    for tens in at[::10]:
        label = f"{tens} mm" if tens == page.ruler_mm else str(tens)
        axes.text(left + tens, top + 6.5, label, fontsize=7, ha="center", va="center")
