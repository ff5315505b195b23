"""What a command says on a terminal: many notes of a kind in one line, and output that nobody reads or that cannot be written."""

import subprocess
import sys

import pytest

from omnilines.cli.notes import SHOWN_ROWS, rows_shown, told
from omnilines.records import Detail

COMMAND = [sys.executable, "-m", "omnilines", "pattern", "checkerboard:4x3:30mm", "--out"]


def test_many_photos_of_a_kind_are_one_sentence_with_the_worst_three():
    dark = [Detail.of(f"{k}.png", f"too dark: 99 percent below {k} percent") for k in range(1, 8)]
    size = [Detail.of("a.png", "its size is 4x4 px where most photos have 8x8 px")]
    plain = [Detail(f"{k}.jpg", f"{k}.jpg is skipped: no board") for k in range(5)]
    said = list(told([*size, *dark, *plain], 20, "report.html"))
    assert said == [
        "7 of 20 photos (1.png, 2.png, 3.png and 4 more; report.html lists all), the first: too dark: 99 percent below 1 percent",
        "5 of 20 photos (0.jpg, 1.jpg, 2.jpg and 2 more; report.html lists all): no board",
        "a.png: its size is 4x4 px where most photos have 8x8 px",
    ]
    rejected = [Detail.of(f"{k}.png", f"{k} of 40 corners rejected") for k in range(4)]
    assert "(3.png, 2.png, 1.png and 1 more; --json lists all), the first: 3 of 40" in next(told(rejected, None, "--json"))


def test_few_photos_of_a_kind_have_a_line_each_and_long_names_are_cut():
    name = "x" * 240 + ".png"
    assert list(told([Detail.of(name, "dark"), Detail.of("b.png", "dark")], 2, "")) == [
        f"{'x' * 30}...{'x' * 26}.png: dark",
        "b.png: dark",
    ]
    rows = [(str(k), "") for k in range(SHOWN_ROWS + 5)]
    assert rows_shown(rows)[-1] == ("...", "5 more; --json lists all") and rows_shown(rows[: SHOWN_ROWS + 1])[-1][0] == "20"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shell", "status", "said"),
    [('"$@" --json | head -c 0; exit ${PIPESTATUS[0]}', 0, ""), ('"$@" > /dev/full', 2, "omnilines: Standard output cannot be")],
)
def test_output_that_goes_nowhere_is_no_traceback(tmp_path, shell, status, said):
    done = subprocess.run(["bash", "-c", shell, "bash", *COMMAND, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == status and done.stderr.startswith(said) and len(done.stderr.splitlines()) == bool(said)
    assert list(tmp_path.glob("*.pdf"))
