"""`lines.ply`: 3D lines as vertices and edges, for MeshLab, Open3D, Blender, trimesh and CloudCompare.

Own writer, because trimesh writes edges in single precision and without colours. The names and types are those that the readers
ask for: `edge` with int `vertex1`, `vertex2` (VCGlib takes no other integer), uchar `red green blue` on vertices (VCGlib,
CloudCompare) and on edges (Open3D). ASCII, because trimesh takes the colours of binary edges for indices. CloudCompare shows
the vertices only.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from camera_models.formats.disk import write_atomically
from camera_models.typed import typed
from omnilines.files.tables import number_cells
from omnilines.records import Lines

STATUS_COLOURS = {"ok": (33, 102, 172), "weak": (244, 165, 30)}
"""Blue and orange, told apart by colour-blind readers too."""
FAMILY_COLOURS = ((33, 102, 172), (217, 72, 1), (35, 139, 69), (122, 1, 119), (166, 118, 29), (102, 102, 102))
CAMERA_COLOUR = (203, 24, 29)

_HEADER = """ply
format ascii 1.0
comment omnilines: 3D lines, {unit}, world frame
element vertex {vertices}
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
element edge {edges}
property int vertex1
property int vertex2
property uchar red
property uchar green
property uchar blue
end_header
"""


@typed
def write_ply(
    path: str | Path,
    lines: Lines,
    family: Int[np.ndarray, " n"] | None = None,
    camera_centres_m: Float[np.ndarray, "k 3"] | None = None,
) -> None:
    """Write the lines that are known (`ok`, `weak`) as edges in their unit, and camera centres as single vertices after them.

    Colours tell the status, or the `family` of each line (any whole numbers, one colour per number, repeating after six).
    Raises InputError where a coordinate is NaN or infinite or the file cannot be written.
    """
    known = lines.known
    ends = lines.ends_m[known]
    if family is None:
        weak = np.array([status == "weak" for status in lines.status], dtype=bool)[known]
        colours = np.where(weak[:, None], STATUS_COLOURS["weak"], STATUS_COLOURS["ok"])
    else:
        colours = np.array(FAMILY_COLOURS)[family[known] % len(FAMILY_COLOURS)]
    centres = np.empty((0, 3)) if camera_centres_m is None else camera_centres_m
    points = np.concatenate([ends.reshape(-1, 3), centres])
    point_colours = np.concatenate([np.repeat(colours, 2, 0), np.tile(CAMERA_COLOUR, (len(centres), 1))])
    numbers = [number_cells(column, path, name) for column, name in zip(points.T, "xyz", strict=True)]
    vertices = zip(*numbers, *_whole_cells(point_colours), strict=True)
    edges = zip(*_whole_cells(np.arange(2 * len(ends)).reshape(-1, 2)), *_whole_cells(colours), strict=True)
    rows = [*map(" ".join, vertices), *map(" ".join, edges)]
    write_atomically(
        path, _HEADER.format(unit=lines.unit.words, vertices=len(points), edges=len(ends)) + "".join(f"{row}\n" for row in rows)
    )


def _whole_cells(values: Int[np.ndarray, "n k"]) -> list[list[str]]:
    return [list(map(str, column)) for column in values.T.tolist()]
