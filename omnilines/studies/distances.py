"""Orthogonal distances of the end points of one method, in rows for a table and in words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from omnilines.files.tables import number_cells, write_table

NUMBERS = ("lines", "end_points", "rms_px", "min_px", "max_px", "std_px", "published_rms_px")


@dataclass(frozen=True)
class DistanceFigures:
    """Orthogonal distances (px) of the end points from the lines of one method."""

    stage: str
    method: str
    lines: int
    distance_px: Float[np.ndarray, " k"]
    """Without sign, both ends of every segment whose line is known."""
    published_px: float = math.nan
    rms_3d_m: float = math.nan
    """Distance of the true end points from the lines, where there is a truth."""

    @property
    def rms_px(self) -> float:
        """Root mean square."""
        return float(np.sqrt(np.mean(self.distance_px**2)))

    def row(self) -> dict[str, Any]:
        """The figures by the names of the CSV columns; the standard deviation is that of the distances about their mean."""
        d = self.distance_px
        values = (float(self.lines), float(len(d)), self.rms_px, *map(float, (d.min(), d.max(), d.std())), self.published_px)
        return {"stage": self.stage, "method": self.method, **dict(zip(NUMBERS, values, strict=True)), "rms_3d_m": self.rms_3d_m}

    def described(self) -> str:
        """One line for a person."""
        row = self.row()
        published = "" if math.isnan(self.published_px) else f", published RMS {self.published_px:.2f}"
        in_space = "" if math.isnan(self.rms_3d_m) else f", 3D {1e3 * self.rms_3d_m:.3f} mm"
        return (
            f"RMS {row['rms_px']:.4f} px, min {row['min_px']:.1e}, max {row['max_px']:.2f}, std {row['std_px']:.4f}, "
            f"{self.lines} lines{in_space}{published}"
        )


def figures_of(stage: str, method: str, lines: int, distance_px: Float[np.ndarray, "n 2"], **more: float) -> DistanceFigures:
    """Of the segments whose line is known: distances are NaN without one."""
    return DistanceFigures(stage, method, lines, distance_px[np.isfinite(distance_px).all(1)].ravel(), **more)


def json_rows(figures: Sequence[DistanceFigures], numbers: Sequence[str] = NUMBERS) -> list[dict[str, Any]]:
    """The rows of the table, None for what is not known."""
    rows = [{name: f.row()[name] for name in ("stage", "method", *numbers)} for f in figures]
    return [{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()} for row in rows]


def write_distance_figures(path: Path, figures: Sequence[DistanceFigures], numbers: Sequence[str] = NUMBERS) -> None:
    """figures.csv."""
    rows = [f.row() for f in figures]
    columns = {name: ['"' + row[name] + '"' if "," in row[name] else row[name] for row in rows] for name in ("stage", "method")}
    for name in numbers:
        columns[name] = number_cells(np.array([row[name] for row in rows], dtype=np.float64), path, name, may_be_nan=True)
    write_table(path, columns)
