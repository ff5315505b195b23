"""The page of a result as a file, and its figures as files beside it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from camera_models.formats.disk import write_atomically
from omnilines.files.folders import check_results
from omnilines.files.sets import claimed, claimed_page
from omnilines.progress import ProgressCallback, silent


@contextmanager
def claimed_report(path: str | Path, plots: str | Path | None) -> Iterator[None]:
    """`claimed_page`, and once the page is there, every figure of it as PNG and SVG in the folder `plots`, where one is given.

    Raises InputError as `claimed` does; for the folder, before anything is written.
    """
    if plots is not None:
        check_results(plots, ())
    with claimed_page(path):
        yield
    if plots is not None:
        write_figures(path, plots)


def write_figures(page: str | Path, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
    """Every figure of a page as PNG and SVG in a folder, which is made; the files written.

    Raises InputError as `claimed` does.
    """
    from omnilines.report.paper import KINDS, paper_figures  # and matplotlib

    figures = paper_figures(Path(page))
    names = [f"{figure.name}.{kind}" for figure in figures for kind in KINDS]
    with claimed(folder, names, [page], by="plots") as out:
        for done, figure in enumerate(figures, 1):
            for kind in KINDS:
                write_atomically(out / f"{figure.name}.{kind}", figure.file(kind))
            progress("drawing figures", done, len(figures))
    return tuple(Path(folder) / name for name in names)
