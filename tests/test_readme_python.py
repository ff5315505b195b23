"""The ten lines of Python in docs/api.md, as they stand there, on rendered photos of one camera."""

from pathlib import Path

import numpy as np
import pytest

import omnilines as ol

PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"
SIZE = (560, 560)


def lines_of_python() -> list[str]:
    """The code above the first heading of the second level."""
    above = PAGE.read_text(encoding="utf-8").partition("\n## ")[0]
    code = [line[4:] for line in above.splitlines() if line.startswith("    ")]
    assert code[0] == "import omnilines as ol" and len([line for line in code if line]) <= 12
    return code


@pytest.mark.slow
def test_the_lines_of_the_page_lead_from_photos_to_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
