"""No result goes over an input, or over a file that is not a result itself."""

import json
from pathlib import Path

import pytest

from camera_models.errors import InputError
from omnilines.files.folders import MANIFEST, claim, claimed, written_names


def test_a_new_folder_is_made_and_lists_what_will_be_written(tmp_path: Path) -> None:
    folder = claim(tmp_path / "a" / "b", ["lines.csv", "pictures/0.png"])
    assert folder.is_dir() and written_names(folder) == ["lines.csv", "pictures/0.png"]
    (folder / "lines.csv").write_text("1")
    claim(folder, ["lines.csv", "report.html"])
    assert written_names(folder) == ["lines.csv", "pictures/0.png", "report.html"]


def test_a_file_of_the_user_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(InputError, match=r"found .*report\.html, which is not in"):
        claim(tmp_path, ["lines.csv", "report.html"])
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_an_input_is_not_written_over_even_if_it_is_a_result_of_before(tmp_path: Path) -> None:
    claim(tmp_path, ["calibration.yaml"])
    (tmp_path / "calibration.yaml").write_text("1")
    claim(tmp_path, ["calibration.yaml"])
    (tmp_path / "link.yaml").symlink_to("calibration.yaml")
    for given in ("calibration.yaml", "link.yaml"):
        with pytest.raises(InputError, match="without the inputs"):
            claim(tmp_path, ["calibration.yaml"], [tmp_path / given])


def test_nothing_goes_through_links_or_out_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out/pictures").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="is a link out of it"):
        claim(tmp_path / "out", ["pictures/0.png"])
    for name in ("../x.csv", "/tmp/x.csv", "a/../../x.csv"):
        with pytest.raises(InputError, match="leads out of it"):
            claim(tmp_path / "out", [name])
    (tmp_path / "out/lines.csv").symlink_to("nowhere")
    with pytest.raises(InputError, match="which is not in"):
        claim(tmp_path / "out", ["lines.csv"])
    assert not list((tmp_path / "elsewhere").iterdir())


def test_pictures_are_not_written_among_the_photos(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for out in (tmp_path / "photos", tmp_path / "photos/views"):
        with pytest.raises(InputError, match="taken for photos"):
            claim(out, ["0.png"], [tmp_path / "photos"])
    claim(tmp_path / "photos/tables", ["segments.csv"], [tmp_path / "photos"])


@pytest.mark.parametrize("content", ["", "[]", '{"written": 3}', '{"written": [1, null]}', "[" * 100000, "\x00"])
def test_a_damaged_list_names_nothing(content: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(content)
    (tmp_path / "a.csv").write_text("mine")
    assert written_names(tmp_path) == []
    with pytest.raises(InputError):
        claim(tmp_path, ["a.csv"])
    claim(tmp_path, ["b.csv"])
    assert json.loads((tmp_path / MANIFEST).read_text()) == {"written": ["b.csv"]}


def test_a_claim_that_fails_leaves_no_trace_and_keeps_what_was_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="torn"), claimed(out, ["a.png", "b.png"]):
        raise InputError("torn")
    assert not out.exists()
    with pytest.raises(InputError, match="torn"), claimed(out, ["a.png", "b.png"]) as folder:
        (folder / "a.png").write_text("")
        raise InputError("torn")
    assert written_names(out) == ["a.png"]
    with claimed(out, ["a.png", "b.png"]) as folder:
        (folder / "b.png").write_text("")
    assert written_names(out) == ["a.png", "b.png"]
