"""The corners of `calibration/ov_plane` (babelcalib's formats) as our table; its board's own unit is taken to be 1 cm."""

from pathlib import Path

import numpy as np

from omnilines.records import Corners

IMAGE_SIZE = (1280, 800)
UNIT_M = 0.01


def read_split(folder: Path, split: str) -> Corners:
    """All views of `train` or `test`, in the order of their names."""
    board = np.loadtxt((folder / "ov_plane.dsc").read_text().splitlines()[2:], delimiter=",")[:, 3:] * UNIT_M
    names, rows = [], []
    for view, path in enumerate(sorted((folder / split).glob("*.orpc"))):
        lines = path.read_text().splitlines()
        start = next(k for k, line in enumerate(lines) if line.startswith("encoding")) + 1
        found = np.array([[float(x) for x in line.split(",")] for line in lines[start:] if line.strip()])
        rows.append(np.column_stack([np.full(len(found), view), found]))
        names.append(path.with_suffix(".png").name)
    table = np.concatenate(rows)
    corner = table[:, 2].astype(int)
    return Corners(table[:, 0].astype(int), tuple(names), tuple(names), board[corner], table[:, 4:6])
