"""omnilines pattern: a calibration target at true scale, as PDF and SVG, or as a page for a screen."""

from pathlib import Path

from calib_patterns import pattern as parse_pattern
from calib_patterns.printing import FORMATS, print_pattern
from camera_models import InputError
from camera_models.formats.disk import write_atomically
from omnilines.commands.result import CommandResult
from omnilines.files.sets import claimed
from omnilines.records import Summary


def pattern(specification: str, out: Path) -> CommandResult:
    """Write the target of a specification to `out`: a file ending in .pdf or .svg, or a folder for both.

    Raises InputError when the specification is malformed, the ending is another or the target does not fit on a page.
    """
    target = parse_pattern(specification)
    paths = _files(out, target.specification, FORMATS)
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
    then = ("calibrate", "PHOTOS", "--pattern", target.specification, "--out", "result")
    return CommandResult((Summary(target.specification, rows),), data, files=paths, then=then)


def pattern_on_screen(specification: str, out: Path) -> CommandResult:
    """Write a page that shows the target on a screen at true scale to `out`: a file ending in .html, or a folder.

    Raises InputError when the specification is malformed or the ending is another.
    """
    from omnilines.pages.screen import screen_page

    target = parse_pattern(specification)
    (path,) = _files(out, target.specification, ("html",))
    with claimed(path.parent, [path.name], by=f"pattern {path.name}"):
        write_atomically(path, screen_page(target))
    across, down = (1000.0 * length for length in target.size_m)
    rows = (
        ("target with its white margin", f"{across:.6g} x {down:.6g} mm"),
        ("corners", str(len(target.points_m))),
        ("written", str(path)),
        ("next", "open it in a browser; it says how large the target is there"),
    )
    data = {"pattern": target.specification, "size_mm": [across, down], "corners": len(target.points_m)}
    return CommandResult((Summary(target.specification, rows),), data, files=(path,))


def _files(out: Path, specification: str, endings: tuple[str, ...]) -> tuple[Path, ...]:
    """The file `out` where it has one of the endings, else a file of each in the folder `out`."""
    ending = out.suffix.lower().lstrip(".")
    if ending in endings:
        return (out,)
    # A folder may be called board.v2 or board_32.5mm.
    if ending.isalpha() and not out.is_dir():
        known = " or ".join(f".{name}" for name in endings)
        instead = "; .html goes with `screen`" if ending == "html" else ""
        raise InputError(f"A file ending in {known}, or a folder, was expected, found '{out}'; give one of these{instead}.")
    return tuple(out / f"{specification.replace(':', '_')}.{name}" for name in endings)
