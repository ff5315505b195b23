"""`lines.obj`: 3D lines as Wavefront objects of one `l` element each, for Blender, MeshLab, Rhino and what else draws.

Names hold letters, digits and `_ . - ~` only; other bytes stand as in the addresses of the web (%20 for a blank), so that every
track keeps a name of its own, from which it can be told.
"""

from pathlib import Path
from urllib.parse import quote

from camera_models.formats.disk import write_atomically
from omnilines.files.tables import number_cells
from omnilines.records import Lines


def safe_name(name: str) -> str:
    """The name without blanks and marks that mean something to readers of text files; `urllib.parse.unquote` undoes it."""
    return quote(name, safe="")


def write_obj(path: str | Path, lines: Lines) -> None:
    """Write the lines that are known (`ok`, `weak`), each an object called like its track, in their unit and the world frame.

    Raises InputError where a coordinate is NaN or infinite or the file cannot be written.
    """
    known = lines.known
    names = [safe_name(track) for track, there in zip(lines.tracks, known.tolist(), strict=True) if there]
    columns = [number_cells(column, path, name) for column, name in zip(lines.ends_m[known].reshape(-1, 3).T, "xyz", strict=True)]
    points = [f"v {x} {y} {z}" for x, y, z in zip(*columns, strict=True)]
    rows = [f"# omnilines: 3D lines, {lines.unit.words}, world frame"]
    for k, name in enumerate(names):
        rows += [f"o {name}", points[2 * k], points[2 * k + 1], f"l {2 * k + 1} {2 * k + 2}"]
    write_atomically(path, "\n".join(rows) + "\n")
