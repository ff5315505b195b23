"""omnilines pattern: a calibration target at true scale, as PDF and SVG."""

from pathlib import Path

from calib_patterns import pattern as parse_pattern
from calib_patterns.printing import FORMATS, print_pattern
from omnilines.commands.result import CommandResult
from omnilines.files.sets import claimed
from omnilines.records import Summary


def pattern(specification: str, out: Path) -> CommandResult:
    """Write the target of a specification to `out`: a file ending in .pdf or .svg, or a folder for both.

    Raises InputError when the specification is malformed, the ending is another or the target does not fit on a page.
    """
    target = parse_pattern(specification)
    paths: tuple[Path, ...] = (out,)
    if out.suffix.lower().lstrip(".") not in FORMATS:
        name = target.specification.replace(":", "_")
        paths = tuple(out / f"{name}.{kind}" for kind in FORMATS)
    names = [path.name for path in paths]
    with claimed(paths[0].parent, names, by=f"pattern {' '.join(names)}"):
        page = print_pattern(target, paths)
    across, down = (1000.0 * length for length in target.size_m)
    rows = (
        ("target with its white margin", f"{across:.6g} x {down:.6g} mm"),
        ("page", f"{page.width_mm:.6g} x {page.height_mm:.6g} mm, to be printed at 100 percent"),
        ("ruler", f"{page.ruler_mm} mm"),
        ("corners", str(len(target.points_m))),
        *(("written", str(path)) for path in paths),
    )
    data = {
        "pattern": target.specification,
        "size_mm": [across, down],
        "page_mm": [page.width_mm, page.height_mm],
        "ruler_mm": page.ruler_mm,
        "corners": len(target.points_m),
    }
    return CommandResult((Summary(target.specification, rows),), data, files=paths)
