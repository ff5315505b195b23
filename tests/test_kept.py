"""What a run keeps for the next one."""

import gc
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

import omnilines as ol
from calib_patterns import Detection
from calib_patterns.checkerboard import Checkerboard
from camera_models import Pinhole
from omnilines.files.kept import read_kept, write_kept
from omnilines.pipelines import detect
from omnilines.pipelines.photo_corners import PhotoCorners

ARRAYS = {f"array{k}": np.full((3, 4), float(k)) for k in range(6)}


@pytest.fixture
def threads_meet() -> Iterator[None]:
    """Threads give way at every chance, and Python code runs while objects are made: CPython's parser was not ready for it."""

    def give_way(phase: str, found: dict[str, int]) -> None:
        for _ in range(300):
            pass

    interval, threshold = sys.getswitchinterval(), gc.get_threshold()
    gc.callbacks.append(give_way)
    sys.setswitchinterval(1e-6)
    gc.set_threshold(3)
    try:
        yield
    finally:
        gc.set_threshold(*threshold)
        sys.setswitchinterval(interval)
        gc.callbacks.remove(give_way)


def test_threads_read_at_once(tmp_path: Path, threads_meet: None) -> None:
    """3000 reads by four threads of Python 3.11.7 raised SystemError 20 times (github.com/python/cpython/issues/106905)."""
    path = tmp_path / "kept.npz"
    write_kept(path, "inputs", ARRAYS)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: read_kept(path, "inputs"), range(1000)))
    assert all(one is not None and one.keys() == ARRAYS.keys() for one in found)
    assert all(np.array_equal(one[name], array) for one in found if one is not None for name, array in ARRAYS.items())


def test_what_is_cut_changed_or_of_other_inputs_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    assert read_kept(path, "inputs") is None
    write_kept(path, "inputs", ARRAYS)
    content = path.read_bytes()
    assert read_kept(path, "others") is None
    for damaged in (b"", content[:20], content[:-1], content[:100] + b"x" + content[101:]):
        path.write_bytes(damaged)
        assert read_kept(path, "inputs") is None


def board(shift: int) -> np.ndarray:
    """A photo of a board of 5 x 4 corners."""
    rows, columns = np.indices((240, 320))
    squares = (rows - 40) // 32 + (columns - 50 - shift) // 32
    dark = (squares % 2 == 0) & (rows >= 40) & (rows < 200) & (columns >= 50 + shift) & (columns < 242 + shift)
    noise = np.random.default_rng(shift).normal(0, 2, dark.shape)
    return np.clip(cv2.GaussianBlur(np.where(dark, 30.0, 220.0), (0, 0), 1.0) + noise, 0, 255).astype(np.uint8)


def test_corners_that_photos_show_or_not_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, pixels in (("a", board(0)), ("b", board(9)), ("none", np.full((240, 320), 128, dtype=np.uint8))):
        cv2.imwrite(str(photos / f"{name}.png"), pixels)
    (photos / "cut.png").write_bytes(b"cut")
    looked: list[int] = []
    real = Checkerboard.detect

    def counted(self: Checkerboard, *given: object, **named: object) -> object:
        looked.append(1)
        return real(self, *given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Checkerboard, "detect", counted)

    def found(pattern: str = "checkerboard:5x4:30mm") -> tuple[PhotoCorners, int]:
        looked.clear()
        return ol.detect(photos, pattern, work=tmp_path / "work"), len(looked)

    (first, every), (again, none) = found(), found()
    assert every == 3 and none == 0 and len(first.corners.images) == 2
    assert again.skipped == first.skipped and {view.name for view in first.skipped} == {"none.png", "cut.png"}
    for name in ("view", "board_m", "pixels", "sigma_px", "ids"):
        np.testing.assert_array_equal(getattr(again.corners, name), getattr(first.corners, name))
    np.testing.assert_array_equal(again.blur_px, first.blur_px)
    cv2.imwrite(str(photos / "b.png"), board(20))
    assert found()[1] == 1
    # Another target is looked for in all of them.
    assert found("checkerboard:5x4:31mm")[1] == 3


def test_what_a_camera_leads_to_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, shift in (("a", 0), ("b", 9)):
        cv2.imwrite(str(photos / f"{name}.png"), board(shift))
    first = ol.detect(photos, "checkerboard:5x4:30mm", work=tmp_path / "work")
    searched: list[int] = []

    def moved(*given: object, **named: object) -> Detection:
        searched.append(1)
        return Detection(np.arange(20), np.arange(40.0).reshape(20, 2), np.ones(20))

    monkeypatch.setattr(detect, "searched", moved)

    def again(focal_px: float) -> tuple[PhotoCorners, int]:
        searched.clear()
        camera = Pinhole([focal_px, focal_px, 159.5, 119.5, *[0.0] * 9], (320, 240))
        return detect.search_again(first, camera, {}, first=True), len(searched)

    (fresh, every), (kept, none), (_, others) = again(300.0), again(300.0), again(301.0)
    assert (every, none, others) == (2, 0, 2)
    np.testing.assert_array_equal(kept.corners.pixels, fresh.corners.pixels)
    assert kept.corners.pixels[0].tolist() == [0.0, 1.0]
