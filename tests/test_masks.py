"""Masks of photos: which is whose, and that arcs, chains and features keep to them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import omnilines as ol
from camera_models import Calibration, GeometryError, InputError, Pinhole, save
from omnilines.cli import main
from omnilines.files import find_photos, photos_of
from omnilines.files.masks import check_masks, looked_at, mask_files, masks_note, with_masks
from omnilines.photo_file import opaque_pixels
from omnilines.pipelines.chains import chains_of

SIZE = (320, 240)
CAMERA = Pinhole([300.0, 300.0, 159.5, 119.5, *[0.0] * 9], SIZE)


def halves() -> np.ndarray:
    """A photo of a bright quadrangle in each half."""
    rng = np.random.default_rng(0)
    photo = np.full(SIZE[::-1], 60.0)
    for left in (30, 190):
        cv2.fillConvexPoly(photo, np.array([[left, 50], [left + 90, 62], [left + 84, 190], [left + 6, 176]]), 190.0)
    blurred = cv2.GaussianBlur(photo, (0, 0), 1.0) + rng.normal(0, 1, photo.shape)
    return np.clip(blurred, 0, 255).astype(np.uint8)


def side(left: bool) -> np.ndarray:
    keep = np.zeros(SIZE[::-1], dtype=bool)
    keep[:, slice(0, 160) if left else slice(160, None)] = True
    return keep


def write(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels.astype(np.uint8) * (255 if pixels.dtype == bool else 1))
    return path


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for name in ("a.png", "b.png", "c.png"):
        write(tmp_path / "photos" / name, halves())
    return tmp_path / "photos"


def test_a_mask_is_found_by_the_name_of_its_photo_or_camera(tmp_path: Path) -> None:
    names = ("cam0/a.jpg", "cam0/b.jpg", "cam1/a.jpg", "cam1/b.jpg", "cam2/a.jpg")
    for name in names:
        write(tmp_path / "photos" / name, halves())
    for name in ("cam0/a.jpg.png", "cam0/b.jpg", "cam1/a.png", "cam0.png", "cam1.png"):
        write(tmp_path / "masks" / name, side(True))
    found = with_masks(find_photos([tmp_path / "photos"]), tmp_path / "masks")
    own = [photo.mask.relative_to(tmp_path / "masks").as_posix() if isinstance(photo.mask, Path) else None for photo in found]
    assert own == ["cam0/a.jpg.png", "cam0/b.jpg", "cam1/a.png", "cam1.png", None]
    assert len(mask_files(found)) == 4 and masks_note(found)[0].startswith("1 of 5 photos have no mask")
    assert "such as cam2/a.jpg" in masks_note(found)[0]


def test_masks_beside_photos_are_no_photos(photos: Path) -> None:
    for name in ("a.png.png", "b.png.png"):
        write(photos / name, side(True))
    found = with_masks(find_photos([photos]), photos)
    assert [photo.name for photo in found] == ["a.png", "b.png", "c.png"]
    assert [photo.mask is not None for photo in found] == [True, True, False]


def test_arcs_and_chains_lie_where_each_mask_is_true(photos: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    write(masks / "a.png", side(True))
    write(masks / "b.png", side(False))
    arcs = ol.extract(photos, CAMERA, mask=masks)
    assert "1 of 3 photos have no mask" in arcs.notes[0]
    left, right, both = (one.endpoints_px[..., 0] for one in arcs.photos)
    assert left.max() < 160 < right.min() and both.min() < 100 and both.max() > 220
    assert len(left) >= 4 and len(right) >= 4 and len(both) >= len(left) + len(right) - 1
    # What is kept of a run is of its masks, too.
    for mask in (masks, side(True), side(False)):
        ends = ol.extract(photos, CAMERA, mask=mask, work=tmp_path / "work").photos[0].endpoints_px[..., 0]
        assert (ends.max() < 160) == (mask is masks or bool(mask[0, 0]))
    in_memory = {name: halves() for name in ("a.png", "b.png", "c.png")}
    same = ol.extract(in_memory, CAMERA, mask={"a.png": side(True), "b.png": side(False)})
    np.testing.assert_array_equal(same.segments.endpoints_px, arcs.segments.endpoints_px)
    chains = chains_of(photos, mask=masks).chains
    across = [chains.pixels[chains.image[chains.chain] == k, 0] for k in range(3)]
    assert across[0].max() < 160 < across[1].min() and across[2].min() < 100 and across[2].max() > 220


def test_masks_that_hide_most_of_photos_are_named(photos: Path, tmp_path: Path) -> None:
    """Also of arcs kept by a run before; half of a photo is no matter."""
    mask = np.zeros(SIZE[::-1], dtype=bool)
    mask[:, 20:132] = True
    for _ in range(2):
        notes = ol.extract(photos, CAMERA, mask={"a.png": mask, "b.png": side(True)}, work=tmp_path / "work").notes
        assert len(notes) == 2 and "hide more than half of 1 of 3 photos: of a.png they leave 35 percent" in notes[1]
    assert not ol.extract(photos, CAMERA, mask=side(True)).notes


def with_alpha(opaque: np.ndarray) -> np.ndarray:
    return np.dstack([*[halves()] * 3, opaque.astype(np.uint8) * 255])


def test_what_is_transparent_is_left_out_as_by_a_mask(photos: Path, tmp_path: Path) -> None:
    for name, opaque in (("a.png", side(True)), ("b.png", np.zeros(SIZE[::-1])), ("c.png", np.ones(SIZE[::-1]))):
        write(photos / name, with_alpha(opaque))
    arcs = ol.extract(photos, CAMERA, work=tmp_path / "work")
    assert list(arcs.skipped) == ["b.png"] and "found every pixel transparent" in arcs.skipped["b.png"]
    half, whole = (one.endpoints_px[..., 0] for one in arcs.used)
    assert len(half) >= 4 and half.max() < 160 and whole.max() > 220
    upper = np.zeros(SIZE[::-1], dtype=bool)
    upper[:120] = True
    first, _, last = with_masks(find_photos([photos]), upper)
    np.testing.assert_array_equal(looked_at(first, SIZE), side(True) & upper)
    assert looked_at(replace(last, mask=None), SIZE) is None
    with pytest.raises(InputError, match="Its transparency has 320x240 px, where the photo has 320x10"):
        looked_at(replace(first, mask=None), (320, 10))
    chains = chains_of(photos).chains
    assert chains.pixels[chains.image[chains.chain] == 0, 0].max() < 160


@pytest.mark.parametrize("ending", ["png", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_transparency_is_turned_as_the_photo_is(tmp_path: Path, orientation: int, ending: str) -> None:
    """A pixel is as transparent as it is dark, turned by OpenCV and by us."""
    grey = (np.arange(24).reshape(4, 6) % 3 == 0).astype(np.uint8) * 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    more = {"lossless": True, "exact": True} if ending == "webp" else {}
    Image.fromarray(np.dstack([grey] * 4), "RGBA").save(tmp_path / f"a.{ending}", exif=exif, **more)
    photo = find_photos([tmp_path])[0]
    pixels = photo.read()
    assert pixels.shape[:2] == (grey.shape if orientation < 5 else grey.T.shape)
    np.testing.assert_array_equal(looked_at(photo, pixels.shape[1::-1]), pixels[..., 0] > 0)


@pytest.mark.parametrize(
    ("name", "mode"), [("a.png", "LA"), ("a.png", "P"), ("a.webp", "RGBA"), ("lossy.webp", "RGBA"), ("a.tif", "RGBA")]
)
def test_transparency_of_all_kinds_of_files_is_found(tmp_path: Path, name: str, mode: str) -> None:
    picture = Image.fromarray(with_alpha(side(True)), "RGBA")
    more: dict[str, object] = {"lossless": name == "a.webp"} if name.endswith("webp") else {}
    if mode == "P":
        picture, more = Image.fromarray(side(True).astype(np.uint8), "P"), {"transparency": 0}
        picture.putpalette([40, 40, 40, 200, 200, 200])
    picture.convert(mode).save(tmp_path / name, **more)
    np.testing.assert_array_equal(opaque_pixels(tmp_path / name), side(True))
    cv2.imwrite(str(tmp_path / "plain.jpg"), halves())
    assert opaque_pixels(tmp_path / "plain.jpg") is None
    # Four channels of which nothing says that the last is opacity: it may be near infrared.
    cv2.imwrite(str(tmp_path / "four.tif"), with_alpha(side(True)))
    assert opaque_pixels(tmp_path / "four.tif") is None


def test_a_photo_whose_mask_cannot_be_used_is_skipped(photos: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    write(masks / "a.png", np.zeros(SIZE[::-1], dtype=bool))
    write(masks / "b.png", side(True)[:-1])
    arcs = ol.extract(photos, CAMERA, mask=masks)
    assert list(arcs.skipped) == ["a.png", "b.png"] and len(arcs.used) == 1
    assert "expected to be white" in arcs.skipped["a.png"] and "Its mask has 320x239 px" in arcs.skipped["b.png"]
    black, small = chains_of(photos, mask=masks).skipped
    assert "expected to be white" in black.text and "Its mask has 320x239 px, where the photo has 320x240" in small.text


def test_masks_that_are_none_are_refused(photos: Path, tmp_path: Path) -> None:
    refs = photos_of(photos)
    (tmp_path / "empty").mkdir()
    for mask, said in (
        (tmp_path / "empty", "such as a.png.png or a.png, found none for any of 3"),
        (tmp_path / "nowhere.png", "which does not exist"),
        (photos / "a.png", "apart from the photos"),
        (write(tmp_path / "black.png", np.zeros((4, 4), dtype=bool)), "nothing brighter than 0"),
        (np.zeros(SIZE[::-1], dtype=bool), "false everywhere"),
        ({"z.png": side(True)}, "found z.png"),
        ({"a.png": side(True).astype(np.uint8)}, "of truth values"),
    ):
        with pytest.raises(InputError, match=said):
            with_masks(refs, mask)
    small = write(tmp_path / "small.png", side(True)[:10])
    with pytest.raises(InputError, match="320x240 px was expected, as the camera has, found 320x10"):
        check_masks(with_masks(refs, small), dict.fromkeys(("a.png", "b.png", "c.png"), SIZE))
    assert looked_at(with_masks(refs, small)[0], (320, 10)).shape == (10, 320)


def test_the_command_takes_a_folder_of_masks(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "calibration.yaml", Calibration({"cam0": CAMERA}))
    write(tmp_path / "masks" / "a.png", side(True))
    call = ["extract", str(photos), "--calibration", str(tmp_path / "calibration.yaml"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        main([*call, "--mask", str(tmp_path / "masks"), "--json"])
    assert not ended.value.code and "2 of 3 photos have no mask" in json.loads(capsys.readouterr().out)["notes"][0]
    ends = ol.read_segments(tmp_path / "out" / "segments.csv").endpoints_px[..., 0]
    image = ol.read_segments(tmp_path / "out" / "segments.csv").image
    assert ends[image == 0].max() < 160 < ends[image == 1].max()
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", str(photos), "--pattern", "checkerboard:7x5:30mm", "--out", str(tmp_path / "c"), "--mask", "masks"])
    assert ended.value.code == 2 and "--mask counts only with --pattern lines" in capsys.readouterr().err


def test_structure_from_motion_looks_for_features_where_masks_are_true(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "masks" / "a.png", side(True))
    arcs, asked = ol.extract(photos, CAMERA, mask=tmp_path / "masks"), {}

    def looks(names: list[str], *_: object, mask_of: Callable[[str], np.ndarray | None], **__: object) -> None:
        asked.update({name: mask_of(name) for name in names})
        raise GeometryError("That is all.")

    monkeypatch.setattr("omnilines.pipelines.poses.sfm_poses", looks)
    monkeypatch.setattr("omnilines.pipelines.poses.without_copies", lambda arcs: arcs)
    with pytest.raises(GeometryError, match="That is all"):
        ol.estimate_poses(arcs, CAMERA)
    np.testing.assert_array_equal(asked["a.png"], side(True))
    assert asked["b.png"] is None and asked["c.png"] is None
