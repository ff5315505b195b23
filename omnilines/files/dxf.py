"""DXF (release 12, which every CAD program reads): the known lines as LINE entities, on a layer for each status.

Coordinates are the scene's, in its unit. Group codes: 8 layer, 10 20 30 first point, 11 21 31 second. The name of a track has no
place in release 12.
"""

from pathlib import Path

from camera_models.formats.disk import write_atomically
from omnilines.files.scene_folder import SceneTables
from omnilines.files.tables import number_cells

_COLOURS = {"ok": 5, "weak": 30}
"""AutoCAD's numbers of blue and orange."""
_CODES = ("10", "20", "30", "11", "21", "31")


def write_dxf(path: Path, scene: SceneTables) -> tuple[str, ...]:
    """Write the lines that are known; what the file has no place for."""
    lines = scene.lines
    known = lines.known
    numbers = [
        number_cells(column, path, name) for column, name in zip(lines.ends_m[known].reshape(-1, 6).T, _CODES, strict=True)
    ]
    status = [name for name, there in zip(lines.status, known.tolist(), strict=True) if there]
    rows = ["999", f"omnilines: 3D lines, {lines.unit.words}, world frame", "0", "SECTION", "2", "TABLES"]
    rows += ["0", "TABLE", "2", "LAYER", "70", str(len(_COLOURS))]
    for name, colour in _COLOURS.items():
        rows += ["0", "LAYER", "2", name, "70", "0", "62", str(colour), "6", "CONTINUOUS"]
    rows += ["0", "ENDTAB", "0", "ENDSEC", "0", "SECTION", "2", "ENTITIES"]
    for layer, *ends in zip(status, *numbers, strict=True):
        rows += ["0", "LINE", "8", layer]
        for code, value in zip(_CODES, ends, strict=True):
            rows += [code, value]
    rows += ["0", "ENDSEC", "0", "EOF", ""]
    write_atomically(path, "\n".join(rows))
    return ("cameras and poses", "the names of tracks", "uncertainties")
