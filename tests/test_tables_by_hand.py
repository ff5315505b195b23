"""The CSV tables people bring: harmless differences are taken, what is wrong is named to the cell."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from table_checks import assert_same

from camera_models.errors import InputError
from omnilines.files import read_corners, read_lines, read_poses, read_segments, write_lines

CORNERS = "view,image,board_x_m,board_y_m,u_px,v_px\n0,a.jpg,0,0,1.5,2\n0,a.jpg,0.1,0,3,4\n1,b.jpg,0,0,5,6\n"
SEGMENTS = "image,track,u1_px,v1_px,u2_px,v2_px\na.jpg,t1,1,2,3,4\na.jpg,,5,6,7,8\nb.jpg,t1,9,10,11,12\n"
POSES = "image,camera,qw,qx,qy,qz,tx,ty,tz\na.jpg,cam0,1,0,0,0,1,2,3\nb.jpg,cam0,0,2,0,0,4,5,6\n"
LINES = "track,x1_m,y1_m,z1_m,x2_m,y2_m,z2_m,views,rms_px,sigma_m,status\nt1,0,0,0,1,0,0,3,0.2,0.01,ok\nt2,,,,,,,2,,,two_views\n"
SHOWN = (
    LINES.replace("status\n", "status,shown_share,chance_share\n")
    .replace("ok\n", "ok,0.75,0.1\n")
    .replace("views\n", "views,,\n")
)


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "table.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_corners_of_a_stranger(tmp_path: Path) -> None:
    corners = read_corners(written(tmp_path, CORNERS))
    assert corners.view.tolist() == [0, 0, 1] and corners.view_names == ("0", "1") and corners.images == ("a.jpg", "b.jpg")
    assert corners.board_m.tolist() == [[0, 0, 0], [0.1, 0, 0], [0, 0, 0]]
    assert corners.pixels.tolist() == [[1.5, 2], [3, 4], [5, 6]] and corners.sigma_px is None and corners.ids is None


def test_segments_and_poses_of_a_stranger(tmp_path: Path) -> None:
    segments = read_segments(written(tmp_path, SEGMENTS))
    assert segments.track.tolist() == [0, -1, 0] and segments.tracks == ("t1",) and segments.images == ("a.jpg", "b.jpg")
    assert segments.endpoints_px[1].tolist() == [[5, 6], [7, 8]] and segments.cameras is None
    poses = read_poses(written(tmp_path, POSES))
    assert poses.images == ("a.jpg", "b.jpg") and poses.cameras == ("cam0", "cam0")
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    assert torch.equal(poses.cam_from_world.rotation[1], turned)
    assert poses.cam_from_world.translation.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read_poses(written(tmp_path, POSES.replace("cam0", ""))).cameras is None


def test_covariances_of_end_points_are_laid_out_by_end(tmp_path: Path) -> None:
    text = "image,track,u1_px,v1_px,u2_px,v2_px,suu1,suv1,svv1,suu2,suv2,svv2\na,t,1,2,3,4,1,0.5,2,3,-0.5,4\n"
    covariance = read_segments(written(tmp_path, text)).covariance_px2
    assert covariance is not None and covariance.tolist() == [[[[1, 0.5], [0.5, 2]], [[3, -0.5], [-0.5, 4]]]]


def test_lines_as_they_are_written(tmp_path: Path) -> None:
    lines = read_lines(written(tmp_path, LINES))
    assert lines.known.tolist() == [True, False] and np.isnan(lines.ends_m[1]).all() and np.isnan(lines.rms_px[1])
    write_lines(tmp_path / "out.csv", lines)
    rows = list(csv.DictReader((tmp_path / "out.csv").read_text().splitlines()))
    assert rows[0]["x2_m"] == "1.0" and rows[1]["x1_m"] == rows[1]["rms_px"] == "" and rows[1]["status"] == "two_views"
    assert ",".join(rows[0]) == LINES.splitlines()[0] and b"\r" not in (tmp_path / "out.csv").read_bytes()


def test_the_shares_of_a_line_that_photos_show_and_that_are_there_by_chance(tmp_path: Path) -> None:
    plain = read_lines(written(tmp_path, LINES))
    assert plain.shown_share is None and plain.chance_share is None
    lines = read_lines(written(tmp_path, SHOWN))
    assert lines.shown_share is not None and lines.shown_share[0] == 0.75 and np.isnan(lines.shown_share[1])
    assert lines.chance_share is not None and lines.chance_share[0] == 0.1 and np.isnan(lines.chance_share[1])
    write_lines(tmp_path / "out.csv", lines)
    rows = list(csv.DictReader((tmp_path / "out.csv").read_text().splitlines()))
    assert [(row["shown_share"], row["chance_share"]) for row in rows] == [("0.75", "0.1"), ("", "")]
    second = lines.rows(np.array([1, 0]))
    assert second.tracks == ("t2", "t1") and second.status == ("two_views", "ok") and second.views.tolist() == [2, 3]
    np.testing.assert_array_equal(second.chance_share, [np.nan, 0.1])


@pytest.mark.parametrize(
    "change",
    [
        lambda s: "\ufeff" + s,
        lambda s: s.replace("\n", "\r\n"),
        lambda s: s.replace("\n", "\r"),
        lambda s: s.replace("\n", "\n\n \n,,,,,\n"),
        lambda s: s.rstrip("\n"),
        lambda s: s.replace("a.jpg", '"a.jpg"'),
        lambda s: s.replace("view,image", " view , image"),
        lambda s: s.replace("1.5", " 15e-1 "),
        lambda s: s.replace("\n", ",note\n", 1).replace(",2\n", ",2,nice\n").replace(",4\n", ",4,\n").replace(",6\n", ",6,x\n"),
    ],
)
def test_harmless_differences_are_taken(change: Callable[[str], str], tmp_path: Path) -> None:
    changed = change(CORNERS)
    assert changed != CORNERS
    assert_same(read_corners(written(tmp_path, CORNERS)), read_corners(written(tmp_path, changed)))


def test_optional_columns_that_are_empty_throughout_are_absent(tmp_path: Path) -> None:
    rows = CORNERS.splitlines()
    text = "\n".join([rows[0] + ",camera,id,board_z_m,sigma_px", *(row + ",,,," for row in rows[1:])])
    assert_same(read_corners(written(tmp_path, CORNERS)), read_corners(written(tmp_path, text)))


def with_columns(text: str, header: str, *cells: str) -> str:
    rows = text.splitlines()
    return "\n".join([f"{rows[0]},{header}", *(f"{row},{cell}" for row, cell in zip(rows[1:], cells, strict=True))]) + "\n"


Reader = Callable[[Path], Any]
ERRORS: list[tuple[Reader, str, str]] = [
    (read_corners, CORNERS.replace("3,4", "3,nan"), r"line 3, column v_px: expected a finite number, found 'nan'; correct it"),
    (read_corners, CORNERS.replace("3,4", "inf,4"), "line 3, column u_px: expected a finite number, found 'inf'"),
    (read_corners, CORNERS.replace("3,4", "3,"), "line 3, column v_px: expected a finite number, found an empty cell"),
    (read_corners, CORNERS.replace("3,4", '3,"4,5"'), "line 3, column v_px: expected a finite number, found '4,5'"),
    (read_corners, CORNERS.replace("3,4", "3,1_0"), "line 3, column v_px: expected a finite number, found '1_0'"),
    (read_corners, CORNERS.replace("3,4", "3"), "line 3: expected 6 fields as in the header, found 5"),
    (read_corners, CORNERS.replace("3,4", "3,4,5"), "line 3: expected 6 fields as in the header, found 7"),
    (read_corners, CORNERS.replace("3,4", "\n\n3"), "line 3: expected 6 fields as in the header, found 5"),
    (read_corners, CORNERS.replace("u_px", "u"), "line 1: the column u_px is missing; expected .*, found view,image,.*,u,v_px"),
    (read_corners, CORNERS.replace("\n", ",u_px\n"), "line 1: the column u_px stands there twice"),
    (read_corners, CORNERS.replace(",", ";"), "line 1 is separated by semicolons; save the table with commas"),
    (read_corners, CORNERS.replace(",", "\t"), "line 1 is separated by tabs"),
    (read_corners, CORNERS.split("\n", 1)[1], "line 1: the column view is missing; expected a header line with the columns view"),
    (read_corners, CORNERS.split("\n", 1)[0], "has a header line and no rows"),
    (read_corners, "", "is empty; expected a header line"),
    (read_corners, "\n \n", "is empty; expected a header line"),
    (
        read_corners,
        CORNERS.replace("1,b.jpg", "0,b.jpg"),
        "line 4, column image: expected 'a.jpg' as in line 2 of the same view '0'",
    ),
    (read_corners, CORNERS.replace("1,b.jpg", "1,"), "line 4, column image: expected a name, found an empty cell; fill it in"),
    (read_corners, CORNERS.replace("1,b.jpg", ",b.jpg"), "line 4, column view: expected a name, found an empty cell"),
    (
        read_corners,
        CORNERS + "0,a.jpg,0.1,0,7,8\n",
        "line 5, columns view, .*: expected each .* once .*, found that of line 3 again",
    ),
    (read_corners, CORNERS.replace("0.1,0,3", "-0,0,3"), "line 3, .*found that of line 2 again"),
    (read_corners, CORNERS.replace("0.1,0,3", '"0.1,0,3'), "line 4 is not valid CSV"),
    (read_corners, with_columns(CORNERS, "camera", "c0", "c0", "c1"), r"expected the corners of one camera, .* 2 \('c0', 'c1'\)"),
    (
        read_corners,
        with_columns(CORNERS, "camera", "c0", "", "c0"),
        "line 3, column camera: expected a name, found an empty cell",
    ),
    (read_corners, with_columns(CORNERS, "id", "0", "1.0", "2"), "line 3, column id: expected a whole number, found '1.0'"),
    (read_corners, with_columns(CORNERS, "id", "0", "9" * 20, "2"), "line 3, column id: expected a whole number, found '999"),
    (read_corners, with_columns(CORNERS, "id", "0", "", "2"), "line 3, column id: expected a whole number, found an empty cell"),
    (
        read_corners,
        with_columns(CORNERS, "sigma_px", "1", "0", "1"),
        "line 3, column sigma_px: expected a standard deviation above 0",
    ),
    (
        read_corners,
        with_columns(CORNERS, "board_z_m", "1", "x", "1"),
        "line 3, column board_z_m: expected a finite number, found 'x'",
    ),
    (
        read_segments,
        SEGMENTS.replace("7,8", "5,6"),
        "line 3, column u2_px: expected an end point other than the first, found '5'",
    ),
    (read_segments, SEGMENTS.replace("b.jpg", " "), "line 4, column image: expected a name, found an empty cell"),
    (read_segments, SEGMENTS.replace(",track", ",trak"), "line 1: the column track is missing"),
    (read_segments, SEGMENTS.replace("7,8", "7,e"), "line 3, column v2_px: expected a finite number, found 'e'"),
    (
        read_segments,
        with_columns(SEGMENTS, "camera", "c0", "c1", "c0"),
        "line 3, column camera: expected 'c0' as in line 2 of the same image 'a.jpg', found 'c1'; give one camera to each image",
    ),
    (read_segments, with_columns(SEGMENTS, "sigma_px", "1", "1", "-1"), "line 4, column sigma_px: expected a standard deviation"),
    (read_segments, with_columns(SEGMENTS, "suu1", "1", "1", "1"), "the column suv1 is missing beside suu1; give all of suu1,"),
    (
        read_segments,
        with_columns(SEGMENTS, "suu1,suv1,svv1,suu2,suv2,svv2", "1,0,1,1,0,1", "1,0,1,1,1.01,1", "1,0,1,1,0,1"),
        r"line 3, column suv2: expected a covariance of at most sqrt\(suu2 svv2\), found '1.01'",
    ),
    (
        read_segments,
        with_columns(SEGMENTS, "suu1,suv1,svv1,suu2,suv2,svv2", "1,0,1,1,0,1", "1,0,0,1,0,1", "1,0,1,1,0,1"),
        "line 3, column svv1: expected a variance above 0, found '0'",
    ),
    (read_poses, POSES.replace("b.jpg", "a.jpg"), "line 3, column image: expected each image once, found 'a.jpg'"),
    (read_poses, POSES.replace("0,2,0,0", "0,0,0,0"), "line 3, column qw: expected a quaternion qw,qx,qy,qz of about length 1"),
    (read_poses, POSES.replace("4,5,6", "4,5,nan"), "line 3, column tz: expected a finite number, found 'nan'"),
    (read_poses, POSES.replace("b.jpg,cam0", "b.jpg,"), "line 3, column camera: expected a name, found an empty cell"),
    (read_poses, POSES.replace(",camera", "").replace(",cam0", ""), "line 1: the column camera is missing"),
    (read_lines, LINES.replace("t2", "t1"), "line 3, column track: expected each track once, found 't1'"),
    (read_lines, LINES.replace("t2", ""), "line 3, column track: expected a name, found an empty cell"),
    (read_lines, LINES.replace("two_views", "fine"), "line 3, column status: expected one of ok, weak, .*, found 'fine'"),
    (
        read_lines,
        LINES.replace("two_views", "weak"),
        "line 3, column x1_m: expected a finite number, as the status is ok or weak",
    ),
    (
        read_lines,
        LINES.replace(",ok", ",behind"),
        "line 2, column x1_m: expected nothing, as the status is neither .*, found '0'",
    ),
    (read_lines, LINES.replace("0.2", "nan"), "line 2, column rms_px: expected a finite number or nothing, found 'nan'"),
    (read_lines, LINES.replace("3,0.2", "-3,0.2"), "line 2, column views: expected a number of views, not negative, found '-3'"),
    (read_lines, SHOWN.replace("0.75", "1.5"), "line 2, column shown_share: expected a share between 0 and 1, found '1.5'"),
    (read_lines, SHOWN.replace("0.1\n", "-0.1\n"), "line 2, column chance_share: expected a share between 0 and 1, found '-0.1'"),
    (read_lines, LINES.replace("3,0.2", ",0.2"), "line 2, column views: expected a whole number, found an empty cell"),
]


@pytest.mark.parametrize(
    ("read", "text"), [(read_corners, CORNERS), (read_segments, SEGMENTS), (read_poses, POSES), (read_lines, LINES)]
)
def test_the_tables_that_the_errors_are_made_of_are_good(read: Reader, text: str, tmp_path: Path) -> None:
    assert len(read(written(tmp_path, text))) >= 2


@pytest.mark.parametrize(("read", "text", "message"), ERRORS)
def test_an_error_names_file_line_and_column(read: Reader, text: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    sentence = str(caught.value)
    assert sentence.startswith(str(path)) and sentence.endswith(".") and "\n" not in sentence


def test_files_that_are_no_tables_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv does not exist"):
        read_corners(tmp_path / "none.csv")
    with pytest.raises(InputError, match="is a folder where a file was expected"):
        read_corners(tmp_path)
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_corners(written(tmp_path, CORNERS.encode("utf-16")))


def test_real_corners_are_read_in_full(shared_data: Path) -> None:
    paths = sorted(shared_data.glob("calibration/*/corners.csv"))
    assert len(paths) >= 3
    for path in paths:
        truth = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(2, 3, 4, 5))
        corners = read_corners(path)
        assert np.array_equal(np.column_stack([corners.board_m[:, :2], corners.pixels]), truth)
        assert len(set(corners.view_names)) == len(set(corners.images)) == corners.view.max() + 1
