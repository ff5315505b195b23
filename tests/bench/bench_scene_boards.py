"""Lines of printed boards in real fisheye and mirror photos, against the boards' own drawing: places, and what is stated of them.

    python tests/bench/bench_scene_boards.py [--work DIR] [--data DIR] [--sets fisheye190 ...] [--small]

The photos of a set (`calibration/*` of the shared data) calibrate their camera (scaramuzza, for `ov_plane` from its list of
corners), their corners give the poses (`--poses corners.csv`), and `omnilines reconstruct` rebuilds what the photos show, as it
would any scene. Edges between the squares lie on the lines of a grid in the plane z = 0. A line is one of these edges where both
of its ends are within NEAR of a square of a line of the grid, in the plane and out of it. *In the plane* and *out of it*: RMS of
its ends. *Within 2.45 sigma*: the worse end, for `sigma_m` as it is stated, and without what errors of the calibration leave.
Boards bend by 0.2 to 1.4 mm (`--refine-board surface`), and bright squares bloom into dark ones: that is in the figures.
"""

import argparse
import csv
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_scene_own import run
from timing import print_table, skip

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from ov_plane import read_split

from omnilines.files import read_lines
from omnilines.records import Lines

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "calibration"
NEAR = 0.2
WITHIN_95 = 2.45


@dataclass(frozen=True)
class Board:
    """Photos of a board of nx x ny inner corners, the first at the origin or `first` squares from it."""

    photos: str
    nx: int
    ny: int
    square_m: float
    first: float = 0.0


SETS = {
    "fisheye1": Board("fisheye1/images", 6, 8, 0.0325),
    "fisheye190": Board("fisheye190/images", 7, 6, 0.03),
    "fisheye_wide": Board("fisheye_wide", 7, 6, 0.01),
    "kaidan": Board("kaidan/images", 7, 11, 0.03),
    "ov_plane": Board("ov_plane", 22, 22, 0.0075, 1.0),
}
HEADER = ("set", "lines", "of the grid", "mm in the plane", "out of it", "sigma mm", "within 2.45 sigma", "without calibration")


def listed_corners(folder: Path, work: Path) -> tuple[Path, Path]:
    """The photos of `ov_plane` in one folder, and the table of their corners."""
    photos, table = work / "photos", work / "listed.csv"
    photos.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("view", "image", "board_x_m", "board_y_m", "u_px", "v_px"))
        for split in ("train", "test"):
            corners = read_split(folder, split)
            for view, board, pixel in zip(corners.view, corners.board_m, corners.pixels, strict=True):
                rows.writerow((corners.view_names[view], corners.images[view], *board[:2], *pixel))
            for photo in (folder / split).glob("*.png"):
                (photos / photo.name).write_bytes(photo.read_bytes())
    return photos, table


def rebuilt(board: Board, data: Path, work: Path) -> Lines:
    """From the photos to the lines."""
    work.mkdir(parents=True, exist_ok=True)
    photos, own = data / board.photos, work / "own"
    if board.first:
        photos, table = listed_corners(photos, work)
        run("calibrate", str(table), "--image-size", "1280x800", "--out", str(own))
    else:
        pattern = f"checkerboard:{board.nx}x{board.ny}:{1e3 * board.square_m:g}mm"
        run("calibrate", str(photos), "--pattern", pattern, "--out", str(own))
    known = ("--calibration", str(own / "calibration.yaml"), "--poses", str(own / "corners.csv"))
    run("reconstruct", str(photos), *known, "--out", str(work / "lines"))
    return read_lines(work / "lines" / "lines.csv")


def row(name: str, board: Board, lines: Lines) -> list[str]:
    """One set."""
    lines = lines.rows(np.flatnonzero(lines.known))
    ends, square = lines.ends_m, board.square_m
    way = np.abs(ends[:, 1] - ends[:, 0])
    upright = way[:, 1] > way[:, 0]
    place = np.where(upright[:, None], ends[..., 0], ends[..., 1]) / square - board.first
    nearest = np.rint(place)
    count = np.where(upright, board.nx, board.ny)[:, None]
    along = np.where(upright[:, None], ends[..., 1], ends[..., 0]) / square - board.first
    over = (along > -1.1) & (along < np.where(upright, board.ny, board.nx)[:, None] + 0.1)
    off, out = (place - nearest) * square, ends[..., 2]
    drawn = over & (nearest >= 0) & (nearest < count) & (np.abs(off) < NEAR * square) & (np.abs(out) < NEAR * square)
    mine = drawn.all(1) & (nearest[:, 0] == nearest[:, 1])
    found = {(bool(u), int(k)) for u, k in zip(upright[mine], nearest[mine, 0], strict=True)}
    away, sigma = np.hypot(off, out)[mine].max(1), lines.sigma_m[mine]
    assert lines.calibration_sigma_m is not None
    alone = np.sqrt((sigma**2 - lines.calibration_sigma_m[mine] ** 2).clip(0.0))
    rms = [1e3 * float(np.sqrt(np.mean(values[mine] ** 2))) for values in (off, out)]
    shares = [f"{100 * float((away < WITHIN_95 * each).mean()):.0f} %" for each in (sigma, alone)]
    grid = f"{len(found)} of {board.nx + board.ny}"
    return [name, str(len(lines)), grid, *(f"{one:.2f}" for one in rms), f"{1e3 * float(np.median(sigma)):.2f}", *shares]


def main(data: Path, work: Path, sets: list[str]) -> None:
    if not data.is_dir():
        skip(f"the folder {data} with photos of boards is absent")
    rows = [row(name, SETS[name], rebuilt(SETS[name], data, work / name)) for name in sets]
    print_table("Edges of printed boards in real photos", HEADER, rows)
    for one in rows:
        some, every = one[2].split(" of ")
        assert int(some) >= 0.8 * int(every), f"{one[0]}: {one[2]} lines of the grid"


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=Path)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--small", action="store_true", help="one set")
    given = parser.parse_args()
    chosen = ["fisheye190"] if given.small else given.sets
    if given.work is not None:
        main(given.data, given.work, chosen)
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(given.data, Path(folder), chosen)
