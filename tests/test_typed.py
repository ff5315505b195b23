"""Arguments and fields are of the kinds that annotations state; tables are tables, cameras see what their pixels are."""

import math
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest
import torch
from hostile.good import LENS, store
from jaxtyping import Bool, Float, Int, jaxtyped

import camera_models
import omnilines as ol
from camera_models import InputError, Pose
from camera_models.typed import Typed, is_of, said, typed

ENDS = Float[np.ndarray, "n 2 2"]


@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (int, [3, np.int64(3)], [3.0, True, "3", None]),
        (float, [3, 3.5, np.float32(2), math.inf], [math.nan, np.float64(math.nan), "3", True, 1j]),
        (bool, [True, np.True_], [1, "yes", None]),
        (str | Path | None, ["a", Path("a"), None], [b"a", 3, ["a"]]),
        (tuple[int, int], [(640, 480), [640, 480]], [(640,), (640.5, 480), "64", np.array([640, 480])]),
        (tuple[str, ...], [(), ("lines",), ["lines"]], ["lines", (1,)]),
        (Sequence[str | Path], [["a", Path("b")], ()], ["a", [None], np.zeros(3), ["a", b"b"]]),
        (Mapping[str, Any], [{}, {"a": 1}], [[("a", 1)], {3: 1}]),
        (Literal["lines"], ["lines"], ["line", None]),
        (Callable[[str], None], [print], [3, "print"]),
        (ENDS, [np.zeros((0, 2, 2)), np.ones((3, 2, 2))], [np.ones((3, 4)), np.ones((3, 2, 2), np.float32), [[[1.0]]], None]),
        (Int[np.ndarray, " n"], [np.arange(3), np.arange(3, dtype=np.int32)], [np.arange(3.0), [0, 1]]),
        (Bool[np.ndarray, "h w"] | None, [np.ones((2, 2), bool), None], [np.ones((2, 2), np.uint8), np.ones(2, bool)]),
        (Float[torch.Tensor, "3 3"], [torch.eye(3, dtype=torch.float64)], [np.eye(3), torch.eye(3)]),
        (Any, [None, 3], []),
    ],
)
def test_a_value_is_of_a_kind_or_not(kind: Any, good: list[Any], bad: list[Any]) -> None:
    assert all(is_of(value, kind) for value in good) and not any(is_of(value, kind) for value in bad)


def test_a_kind_is_said_in_words() -> None:
    assert said(str | Path | None) == "str, Path or None" and said(tuple[int, int]) == "(int, int)"
    assert said(ENDS) == "an array of NumPy (n, 2, 2) of float64"
    assert said(Sequence[str | Path]) == "Sequence of str or Path" and said(Callable[[str], None]) == "a function"


@typed
def drawn(width: int, name: str | None = None, *, share: float = 0.5, **more: Any) -> tuple[Any, ...]:
    """As verbs are."""
    return width, name, share, more


def test_a_function_takes_what_it_states_and_says_what_else_it_found() -> None:
    assert drawn(3, share=1, other="x") == (3, None, 1, {"other": "x"})
    for call, said_so in {
        lambda: drawn(3.5): r"`width` of drawn was expected as int, found 3\.5; give one\.",
        lambda: drawn(3, 4): "`name` of drawn was expected as str or None, found 4",
        lambda: drawn(3, share=math.nan): "`share` of drawn was expected as float, found nan",
        lambda: drawn(np.zeros((2, 3))): r"found ndarray \(2, 3\) of float64",
    }.items():  # fmt: skip
        with pytest.raises(InputError, match=said_so):
            call()
    with pytest.raises(TypeError, match=r"drawn\(\) missing 1 required positional argument: 'width'"):
        drawn()  # type: ignore[call-arg]


class Group(NamedTuple):
    """Options of a concern."""

    most: int = 3


@dataclass(frozen=True)
class Options(Typed):
    """As those of stages."""

    group: Group = Group()
    share: float | None = None


def test_fields_and_those_of_groups_are_of_their_kinds() -> None:
    assert Options(Group(4), 1).share == 1
    with pytest.raises(InputError, match="`share` of Options was expected as float or None, found nan"):
        Options(share=math.nan)


SPOILT: dict[str, tuple[str, Callable[[Any], dict[str, Any]], str]] = {
    "single": ("segments", lambda s: {"endpoints_px": s.endpoints_px.astype(np.float32)}, "of float32"),
    "nan": ("segments", lambda s: {"endpoints_px": s.endpoints_px * math.nan}, "finite numbers, found .nan. in row .0"),
    "image": ("segments", lambda s: {"image": s.image + 100}, "`image` of Segments .*from 0 to 5.*found .100"),
    "track": ("segments", lambda s: {"track": s.track - 9}, "`track` of Segments .*from -1 to 9.*found .-9"),
    "tracks": ("segments", lambda s: {"tracks": s.tracks[:2]}, "from -1 to 1"),
    "cameras": ("segments", lambda s: {"cameras": ("cam0",)}, "`cameras` of Segments .*6 photos, found 1"),
    "sigma": ("segments", lambda s: {"sigma_px": -np.ones(60)}, "deviations above 0, found -1"),
    "covariance": ("segments", lambda s: {"covariance_px2": np.zeros((60, 2, 2, 2))}, "variances above 0"),
    "corner": ("corners", lambda c: {"pixels": c.pixels + math.inf}, "`pixels` of Corners .*finite"),
    "view": ("corners", lambda c: {"view": c.view - 100}, "`view` of Corners .*from 0 to 4"),
    "images": ("corners", lambda c: {"images": c.images[:2]}, "`images` of Corners .*5 views, found 2"),
    "times": ("corners", lambda c: {"times_s": np.zeros(2)}, "`times_s` of Corners .*5 views, found 2"),
    "time": ("corners", lambda c: {"times_s": np.full(5, math.nan)}, "`times_s` of Corners .*finite"),
    "poses": ("poses", lambda p: {"images": p.images[:3]}, r"poses of 3 photos, found \(6, 3\)"),
    "mirrored": ("poses", lambda p: {"cam_from_world": turned(p, -1.0)}, "right-handed, found"),
    "scaled": ("poses", lambda p: {"cam_from_world": turned(p, 2.0)}, "rows are orthonormal"),
    "lost": ("poses", lambda p: {"cam_from_world": turned(p, math.nan)}, "rows are orthonormal"),
}  # fmt: skip
"""What is wrong -> the table, the fields that are so, what is said."""


def turned(poses: ol.ImagePoses, factor: float) -> Pose:
    """Rotations that are none."""
    pose = poses.cam_from_world
    return Pose(factor * pose.rotation, pose.translation)


@pytest.mark.parametrize("what", SPOILT)
def test_a_table_that_is_none_is_not_made(what: str) -> None:
    kind, change, said_so = SPOILT[what]
    table = getattr(ol, f"read_{kind}")(store() / f"{kind}.csv")
    with pytest.raises(InputError, match=said_so):
        replace(table, **change(table))


def test_no_row_is_a_table() -> None:
    none = ol.segments_of_arrays(np.zeros((0, 2, 2)), [], [])
    assert len(none) == 0 and none.images == ()
    with pytest.raises(InputError, match="`image` of Segments was expected to be from 0 to 0"):
        ol.segments_of_arrays(np.ones((2, 2, 2)), [-1, 0], [0, 0])


def test_a_pose_of_arrays_is_rigid() -> None:
    Pose.of(np.eye(3).tolist(), [0, 0, 1])
    for rotation, translation in ((-np.eye(3), [0, 0, 0]), (np.zeros((3, 3)), [0, 0, 0]), (np.eye(3), [0, 0, math.nan])):
        with pytest.raises(InputError, match="was expected"):
            Pose.of(rotation, translation)
    with pytest.raises(InputError, match="as many translations"):
        Pose.of(np.stack([np.eye(3)] * 3), np.zeros((2, 3)))


@pytest.mark.parametrize("size", [(640,), (640, 480, 3), (-640, 480), (0, 0), (640.5, 480), (math.nan, 480)])
def test_an_image_has_a_size(size: Any) -> None:
    with pytest.raises(InputError, match=r"\(width, height\) in whole pixels above 0, found"):
        camera_models._model._size(size)


@pytest.mark.parametrize("model", sorted(dict(camera_models.MODELS)))
def test_what_is_no_number_is_nowhere_seen(model: str) -> None:
    lens = camera_models.model_class(model).examples()[0]
    for value in (math.nan, math.inf, 1e300):
        points = np.array([[value, value, value], [value, 0.0, 1.0], [0.0, 0.0, 1.0]])
        pixels, seen = lens.project(points)
        assert np.isfinite(pixels).all() and seen[2] and not (seen & np.isnan(points).any(-1)).any()
        bearings, _ = lens.unproject(np.array([[value, value]]))
        np.testing.assert_allclose(np.linalg.norm(bearings, axis=-1), 1.0)


def test_a_camera_that_is_none_is_neither_used_nor_saved(tmp_path: Path) -> None:
    """As where it is read from a file; a fit may end at one."""
    for focal in (math.nan, -170.0, 0.0):
        lens = LENS.with_parameters(torch.tensor([focal, focal, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0]))
        with pytest.raises(InputError, match="fx of camera cam0"):
            ol.save(tmp_path / "calibration.yaml", {"cam0": lens})
        with pytest.raises(InputError, match="fx of camera cam0"):
            ol.extract(store() / "photos", lens)
    with pytest.raises(InputError, match="name of a camera"):
        ol.save(tmp_path / "calibration.yaml", {"": LENS})
    assert list(tmp_path.iterdir()) == []


AS_USERS_CALL = """
import io, math, numpy as np, torch, camera_models as cm, omnilines as ol
ends, rows = np.ones((2, 2, 2)), np.arange(2)
line, pose = np.array([[[1.0, 2.0], [3.0, 4.0]]]), ol.Pose.identity()

def segments(image=rows, endpoints_px=ends):
    return ol.Segments(image, ("0", "1"), rows, ("a", "b"), endpoints_px)

lens = cm.OpenCVFisheye([170.0] * 2 + [320.0, 240.0] + [0.0] * 4, (640, 480))
grey = np.zeros((480, 640), np.uint8)
for call in (
    lambda: lens.unproject(3.0), lambda: lens.unproject(np.zeros((2, 3))), lambda: lens.project(None),
    lambda: lens.unproject(np.zeros(2, complex)), lambda: lens.with_parameters("fx"),
    lambda: lens.project(np.array([["a", "b", "c"]])), lambda: lens.project([[1.0, 2.0], [3.0]]),
    lambda: cm.convert(lens, "scaramuzza", 90, degreee=3), lambda: cm.convert(lens, "pinhole", 90, {"zz": 0.0}),
    lambda: ol.extract([grey, "a.png"], lens), lambda: ol.extract({3: grey}, lens), lambda: ol.extract({"../a": grey}, lens),
    lambda: ol.extract({"a": grey}, lens, mask=grey), lambda: ol.extract({"a": grey}, lens, mask=grey > 0),
    lambda: ol.reconstruct(None, None, lens), lambda: ol.calibrate({"a": grey}, "lines", image_size="640x480"),
    lambda: ol.write_poses("x.csv", np.eye(4)), lambda: ol.export(np.zeros(3), "a.dxf"),
    lambda: segments(endpoints_px=ends.tolist()), lambda: segments(endpoints_px=ends.astype("f4")),
    lambda: segments(endpoints_px=ends.reshape(2, 4)), lambda: segments(image=rows[:1]), lambda: segments(image=rows * 1.0),
    lambda: ol.segments_of_arrays(ends, [0.5, 1.5], [0, 0]), lambda: ol.segments_of_arrays(None, [0], [0]),
    lambda: ol.SceneOptions(min_views=math.nan), lambda: ol.Pose.of("a", "b"),
    lambda: ol.segments_of_arrays(ends, [0, 1], [0, 0]), lambda: ol.segments_of_arrays(line[[0, 0]], [0, 0], [-1, -1]),
    lambda: ol.segments_of_arrays(np.concatenate([line, line[:, ::-1]]), [1, 1], [0, 0]),
    lambda: ol.Pose.exp(np.ones(5)), lambda: pose.transform(np.ones((4, 2))), lambda: pose.transform(None), lambda: pose[0],
    lambda: list(pose), lambda: ol.read_poses(None), lambda: ol.read_segments(io.StringIO()), lambda: ol.read_corners(b"x"),
    lambda: ol.read_lines(3), lambda: ol.read_rig_corners(None), lambda: ol.write_segments(None, segments()),
    lambda: ol.Scene.save(None, None), lambda: ol.Scene.save(None, b"x"), lambda: ol.Scene.report(None, None),
    lambda: ol.CalibrationResult.save(None, None), lambda: ol.PhotoArcs.save(None, 3),
):
    try:
        print(call())
    except ol.InputError as error:
        print(error)
"""
SAID = (
    "Pixels were expected as an array (..., 2), found float",
    "Pixels were expected as an array (..., 2), found an array (2, 3)",
    "Points were expected as an array (..., 3), found NoneType",
    "An array of real numbers was expected, found ndarray (2,) of complex128; correct it.",
    "An array of real numbers was expected, found 'fx'; correct it.",
    "An array of real numbers was expected, found ndarray (1, 3) of str; correct it.",
    "An array of real numbers was expected, found [[1.0, 2.0], [3.0]]; correct it.",
    "Camera model scaramuzza has degree, found 'degreee'",
    "Camera model pinhole has cx cy fx fy",
    "`photos` of extract was expected as str, Path",
    "`photos` of extract was expected as str, Path",
    "A photo was expected under a name, as tables have it, found that '../a' leads out of it",
    "`mask` of extract was expected as an array of NumPy (h, w) of true and false, str, Path, Mapping",
    "A mask was expected to be true where photos are looked at",
    "`arcs` of reconstruct was expected as PhotoArcs or Segments, found NoneType",
    "`image_size` of calibrate was expected as (int, int) or None, found '640x480'",
    "`poses` of write_poses was expected as ImagePoses, found ndarray (4, 4) of float64",
    "`scene` of export was expected as str, Path or Scene, found ndarray (3,) of float64",
    "`endpoints_px` of Segments was expected as an array of NumPy (n, 2, 2) of float64, found [[[1.0, 1.0], [1.0",
    "`endpoints_px` of Segments was expected as an array of NumPy (n, 2, 2) of float64, found ndarray (2, 2, 2) of float32",
    "`endpoints_px` of Segments was expected as an array of NumPy (n, 2, 2) of float64, found ndarray (2, 4) of float64",
    "`track` of Segments was expected as an array of NumPy (n) of whole numbers, found ndarray (2,) of int64",
    "`image` of Segments was expected as an array of NumPy (n) of whole numbers, found ndarray (2,) of float64",
    "`image` was expected as whole numbers in a row, found [0.5, 1.5]",
    "An array of real numbers was expected, found NoneType",
    "`min_views` of SceneOptions was expected as int, found nan",
    "An array of real numbers was expected, found 'a'; correct it.",
    "`endpoints_px` was expected with two ends for each segment, found [1.0, 1.0] as both of row 0; remove the row.",
    "`endpoints_px` was expected with each segment once, found that of row 0 in row 1 again; remove one of the two rows.",
    "`endpoints_px` was expected with each segment once, found that of row 0 in row 1 again; remove one of the two rows.",
    "Twists were expected as an array (..., 6), found an array (5,); give them so.",
    "Points were expected as an array (..., 3), found an array (4, 2); give them so.",
    "Points were expected as an array (..., 3), found NoneType; give them so.",
    "A batch of poses was expected where one is picked, found a single pose; use it as it is.",
    "A batch of poses was expected where one is picked, found a single pose; use it as it is.",
    "`path` of read_poses was expected as str or Path, found NoneType; give one.",
    "`path` of read_segments was expected as str or Path, found StringIO; give one.",
    "`path` of read_corners was expected as str or Path, found bytes; give one.",
    "`path` of read_lines was expected as str or Path, found 3; give one.",
    "`path` of read_rig_corners was expected as str or Path, found NoneType; give one.",
    "`path` of write_segments was expected as str or Path, found NoneType; give one.",
    "`folder` of save was expected as str or Path, found NoneType; give one.",
    "`folder` of save was expected as str or Path, found bytes; give one.",
    "`path` of report was expected as str or Path, found NoneType; give one.",
    "`folder` of save was expected as str or Path, found NoneType; give one.",
    "`folder` of save was expected as str or Path, found 3; give one.",
)


@pytest.mark.slow
def test_wrong_arguments_are_told_in_a_sentence() -> None:
    """In a process of its own, as users call: the hook of the tests would refuse wrong types before."""
    run = subprocess.run([sys.executable, "-W", "error", "-c", AS_USERS_CALL], capture_output=True, text=True, check=True)
    lines = run.stdout.splitlines()
    assert len(lines) == len(SAID)
    assert [line for line, wanted in zip(lines, SAID, strict=True) if not line.startswith(wanted)] == []


def test_axes_of_arguments_are_not_those_of_a_caller() -> None:
    """Whose signature is checked too, as all are while testing: not at every call (`enforced.py`)."""

    @typed
    def rows(table: Float[np.ndarray, "h w"]) -> int:
        return len(table)

    with jaxtyped("context"):
        assert isinstance(np.zeros((3, 4)), Float[np.ndarray, "h w"])
        assert [rows(np.zeros((5, 6))) for _ in range(400)] == [5] * 400
