"""`lines.ply` holds the known lines, read back by trimesh and by the letter of the format."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from camera_models.errors import InputError
from omnilines.files import write_ply
from omnilines.files.ply import CAMERA_COLOUR, FAMILY_COLOURS, STATUS_COLOURS
from omnilines.records import Lines

TYPES = {"double": float, "int": int, "uchar": int}


def some_lines(n: int, status: tuple[str, ...]) -> Lines:
    ends = np.random.default_rng(n).normal(size=(n, 2, 3)) * 1e5 / 3
    ends[[s not in ("ok", "weak") for s in status]] = np.nan
    return Lines(tuple(map(str, range(n))), ends, np.full(n, 3), np.ones(n), np.ones(n), status)


def elements(path: Path) -> dict[str, dict[str, list[float]]]:
    """The properties of the elements of an ASCII PLY file, by the format's own rules."""
    head, _, body = path.read_text("ascii").partition("end_header\n")
    words = [line.split() for line in head.splitlines()]
    assert words[:2] == [["ply"], ["format", "ascii", "1.0"]]
    rows = iter(body.splitlines())
    result: dict[str, dict[str, list[float]]] = {}
    for k, word in enumerate(words):
        if word[0] == "element":
            later = words[k + 1 :]
            properties = later[: next((i for i, w in enumerate(later) if w[0] == "element"), len(later))]
            cells = [next(rows).split() for _ in range(int(word[2]))]
            assert all(len(row) == len(properties) for row in cells)
            result[word[1]] = {name: [TYPES[kind](row[i]) for row in cells] for i, (_, kind, name) in enumerate(properties)}
    assert next(rows, None) is None
    return result


def columns(element: dict[str, list[float]], *names: str) -> np.ndarray:
    return np.column_stack([element[name] for name in names])


def test_trimesh_sees_the_lines(tmp_path: Path) -> None:
    lines = some_lines(5, ("ok", "weak", "behind", "ok", "two_views"))
    write_ply(tmp_path / "lines.ply", lines)
    with (tmp_path / "lines.ply").open("rb") as file:
        drawing = trimesh.load_path(file, file_type="ply")
    seen = np.array([drawing.vertices[entity.points] for entity in drawing.entities])
    truth = lines.ends_m[lines.known]
    order = [int(np.argmin(np.abs(truth - one).max((1, 2)))) for one in seen]
    assert sorted(order) == [0, 1, 2]
    # trimesh merges vertices closer than 1e-8, so it may round what it reads.
    np.testing.assert_allclose(seen, truth[order], atol=1e-7)


def test_vertices_edges_and_colours_to_the_letter(tmp_path: Path) -> None:
    lines = some_lines(4, ("weak", "ok", "at_infinity", "ok"))
    centres = np.random.default_rng(0).normal(size=(2, 3))
    write_ply(tmp_path / "lines.ply", lines, camera_centres_m=centres)
    read = elements(tmp_path / "lines.ply")
    assert list(read) == ["vertex", "edge"] and list(read["edge"])[:2] == ["vertex1", "vertex2"]
    points = columns(read["vertex"], "x", "y", "z")
    assert np.array_equal(points[:6], lines.ends_m[lines.known].reshape(-1, 3)) and np.array_equal(points[6:], centres)
    assert columns(read["edge"], "vertex1", "vertex2").tolist() == [[0, 1], [2, 3], [4, 5]]
    weak, ok = STATUS_COLOURS["weak"], STATUS_COLOURS["ok"]
    rgb = ("red", "green", "blue")
    assert list(map(tuple, columns(read["edge"], *rgb).tolist())) == [weak, ok, ok]
    assert list(map(tuple, columns(read["vertex"], *rgb).tolist())) == [weak] * 2 + [ok] * 4 + [CAMERA_COLOUR] * 2


def test_families_have_a_colour_each(tmp_path: Path) -> None:
    lines = some_lines(4, ("ok", "behind", "weak", "ok"))
    write_ply(tmp_path / "lines.ply", lines, family=np.array([0, 1, 1, len(FAMILY_COLOURS)]))
    colours = columns(elements(tmp_path / "lines.ply")["edge"], "red", "green", "blue")
    assert list(map(tuple, colours.tolist())) == [FAMILY_COLOURS[0], FAMILY_COLOURS[1], FAMILY_COLOURS[0]]


def test_no_line_at_all(tmp_path: Path) -> None:
    write_ply(tmp_path / "lines.ply", some_lines(2, ("behind", "epipolar")))
    read = elements(tmp_path / "lines.ply")
    assert read["vertex"]["x"] == read["edge"]["vertex1"] == []


def test_no_number_and_no_place_to_write_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="column y: row 3 would be nan"):
        write_ply(tmp_path / "lines.ply", some_lines(1, ("ok",)), camera_centres_m=np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(InputError, match=r"lines\.ply cannot be written"):
        write_ply(tmp_path / "absent" / "lines.ply", some_lines(1, ("ok",)))
