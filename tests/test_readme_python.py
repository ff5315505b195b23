"""The ten lines of Python in the README, as they stand there, on rendered photos of one camera."""

import re
from pathlib import Path

import numpy as np
import pytest

import omnilines as ol

README = Path(__file__).resolve().parents[1] / "README.md"
SIZE = (560, 560)


def lines_of_python() -> list[str]:
    """The code of the section."""
    section = re.search(r"^## From Python\n(.*?)^## ", README.read_text(), re.M | re.S)
    assert section is not None
    code = [line[4:] for line in section[1].splitlines() if line.startswith("    ")]
    assert code[0] == "import omnilines as ol" and len([line for line in code if line]) <= 12
    return code


@pytest.mark.slow
def test_the_lines_of_the_readme_lead_from_photos_to_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board = ol.render("checkerboard:8x6:32.5mm", "opencv-fisheye", fov_deg=180.0, views=8, size_px=SIZE)
    assert isinstance(board, ol.RenderedTargets)
    board.save(tmp_path / "board")
    room = ol.render("plain-room", board.camera, views=8, size_px=SIZE, seed=2)
    room.save(tmp_path / "scene")
    (tmp_path / "scene" / "poses.csv").rename(tmp_path / "poses.csv")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec("\n".join(lines_of_python()), names)
    scene = names["scene"]
    assert isinstance(scene, ol.Scene)
    assert len(scene.lines) > 30 and np.isfinite(scene.lines.ends_m).all() and scene.lines.covariance is not None
    assert (tmp_path / "scene_lines" / "lines.csv").is_file() and (tmp_path / "report.html").is_file()
