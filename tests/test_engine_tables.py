"""Segments in Parquet: the same as from CSV, row group by row group; a missing pyarrow and malformed tables are named."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from camera_models import InputError
from omnilines.files import read_lines, read_segments, write_lines, write_segments
from omnilines.records import Lines, Segments

ABSENT = "pyarrow, an optional extra, is not installed"


def segments() -> Segments:
    rng = np.random.default_rng(0)
    ends = rng.uniform(0, 900, (40, 2, 2))
    track = rng.integers(-1, 8, 40)
    track[:9] = np.arange(-1, 8)
    order = np.unique(track[track >= 0], return_index=True)[1]
    assert len(order) == 8
    image = np.arange(40) % 5
    return Segments(
        image, tuple(f"photo {k}.png" for k in range(5)), track, tuple(f"t{k}" for k in range(8)), ends, rng.uniform(0.2, 1, 40)
    )


def test_without_pyarrow_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pyarrow, which was not found; install it with pip install 'omnilines\[parquet\]'"):
        read_segments(tmp_path / "segments.parquet")


def test_parquet_gives_what_csv_gives(tmp_path: Path) -> None:
    pyarrow, parquet = (pytest.importorskip(name, reason=ABSENT) for name in ("pyarrow", "pyarrow.parquet"))
    given = segments()
    write_segments(tmp_path / "segments.csv", given)
    names = [given.images[k] for k in given.image]
    tracks = [given.tracks[k] if k >= 0 else None for k in given.track]
    ends = given.endpoints_px.reshape(-1, 4).T
    table = pyarrow.table(
        {
            "image": names,
            "track": tracks,
            "u1_px": ends[0],
            "v1_px": ends[1],
            "u2_px": ends[2],
            "v2_px": ends[3],
            "sigma_px": given.sigma_px,
        }
    )
    parquet.write_table(table, tmp_path / "segments.parquet", row_group_size=7)
    from_csv, from_parquet = read_segments(tmp_path / "segments.csv"), read_segments(tmp_path / "segments.parquet")
    assert from_csv.images == from_parquet.images and from_csv.tracks == from_parquet.tracks
    for name in ("image", "track", "endpoints_px", "sigma_px"):
        np.testing.assert_array_equal(getattr(from_csv, name), getattr(from_parquet, name))


def test_parquet_columns_of_other_tools_are_texts_and_empty_cells(tmp_path: Path) -> None:
    """Texts as views, and columns in which nothing stands, which have no type then: segments before they are matched."""
    pyarrow, parquet = (pytest.importorskip(name, reason=ABSENT) for name in ("pyarrow", "pyarrow.parquet"))
    given = segments()
    names = pyarrow.array([given.images[k] for k in given.image], pyarrow.string_view())
    ends = dict(zip(("u1_px", "v1_px", "u2_px", "v2_px"), given.endpoints_px.reshape(-1, 4).T, strict=True))
    nothing = pyarrow.nulls(len(given.image))
    table = pyarrow.table({"image": names, "track": nothing, **ends, "sigma_px": nothing})
    parquet.write_table(table, tmp_path / "segments.parquet")
    found = read_segments(tmp_path / "segments.parquet")
    assert found.images == given.images and found.tracks == () and found.sigma_px is None and (found.track == -1).all()
    parquet.write_table(table.set_column(2, "u1_px", nothing), tmp_path / "segments.parquet")
    with pytest.raises(InputError, match="row 1, column u1_px: expected a finite number, found"):
        read_segments(tmp_path / "segments.parquet")


def test_lines_in_parquet_are_those_in_csv(tmp_path: Path) -> None:
    pyarrow, parquet = (pytest.importorskip(name, reason=ABSENT) for name in ("pyarrow.csv", "pyarrow.parquet"))
    ends = np.random.default_rng(0).normal(size=(3, 2, 3))
    ends[1] = np.nan
    sigma = np.array([0.01, np.nan, 0.02])
    given = Lines(("a", "b", "c"), ends, np.array([3, 2, 4]), sigma * 10, sigma, ("ok", "parallel_planes", "weak"))
    write_lines(tmp_path / "lines.csv", given)
    parquet.write_table(pyarrow.read_csv(tmp_path / "lines.csv"), tmp_path / "lines.parquet")
    from_csv, from_parquet = read_lines(tmp_path / "lines.csv"), read_lines(tmp_path / "lines.parquet")
    assert from_csv.status == from_parquet.status == given.status and from_csv.tracks == from_parquet.tracks
    np.testing.assert_array_equal(from_csv.ends_m, from_parquet.ends_m)


def test_whole_numbers_are_names_as_in_csv(tmp_path: Path) -> None:
    """Also where a tool wrote them as floating point, as pandas does where one is missing."""
    pyarrow, parquet = (pytest.importorskip(name, reason=ABSENT) for name in ("pyarrow", "pyarrow.parquet"))
    ends = {"u1_px": [1.0, 2.0, 3.0], "v1_px": [2.0] * 3, "u2_px": [7.0] * 3, "v2_px": [5.0] * 3}
    path = tmp_path / "s.parquet"
    for track, names, index in (
        ([7, 3, 7], ("7", "3"), [0, 1, 0]),
        ([7.0, None, 3.0], ("7", "3"), [0, -1, 1]),
        ([None, None, None], (), [-1, -1, -1]),
    ):
        columns = {"image": [20, 10, 20], "track": pyarrow.array(track, pyarrow.float64() if None in track else pyarrow.int64())}
        parquet.write_table(pyarrow.table(columns | ends), path)
        found = read_segments(path)
        assert found.images == ("20", "10") and found.image.tolist() == [0, 1, 0]
        assert found.tracks == names and found.track.tolist() == index
    for wrong in ([1.5, 2.0, 3.0], [2**53, 2, 3], [2**60 + 1, 2, 3]):
        parquet.write_table(pyarrow.table({"image": ["a", "b", "c"], "track": wrong} | ends), path)
        with pytest.raises(InputError, match="row 1, column track: expected texts or whole numbers, found"):
            read_segments(path)


def test_tables_are_not_written_under_a_name_of_parquet(tmp_path: Path) -> None:
    for name in ("segments.parquet", "segments.PQ"):
        with pytest.raises(InputError, match=rf"{name}: tables are written as CSV, found a name of Parquet; give one"):
            write_segments(tmp_path / name, segments())
    assert list(tmp_path.iterdir()) == []


def test_a_malformed_cell_is_named_by_row(tmp_path: Path) -> None:
    pyarrow, parquet = (pytest.importorskip(name, reason=ABSENT) for name in ("pyarrow", "pyarrow.parquet"))
    columns = {"image": ["a", "b"], "track": ["t", "t"], "u1_px": [1.0, None], "v1_px": [2.0, 2.0], "u2_px": [3.0, 3.0]}
    parquet.write_table(pyarrow.table(columns), tmp_path / "s.parquet")
    with pytest.raises(InputError, match="the column v2_px is missing"):
        read_segments(tmp_path / "s.parquet")
    parquet.write_table(pyarrow.table(columns | {"v2_px": [4, 4]}), tmp_path / "s.parquet")
    with pytest.raises(InputError, match="row 2, column u1_px: expected a finite number"):
        read_segments(tmp_path / "s.parquet")
    (tmp_path / "no.parquet").write_text("image,track\n")
    with pytest.raises(InputError, match="Parquet file"):
        read_segments(tmp_path / "no.parquet")
