"""What `omnilines reconstruct PHOTOS` refuses before it looks at any photo, each in one sentence."""

import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from reconstruct_call import call

from camera_models import Calibration, InputError, Pinhole, load, save
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.commands import reconstruct as command
from omnilines.commands.render_scene import render_scene
from omnilines.files import find_photos, read_poses, write_poses
from omnilines.files.photos import write_png
from omnilines.pipelines.arcs import extract
from omnilines.pipelines.poses import estimate_poses
from omnilines.records import ImagePoses


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder `photos`, and its tables beside it."""
    folder = tmp_path_factory.mktemp("room")
    render_scene(folder / "photos", views=3, size=(160, 120), seed=11)
    for name in ("calibration.yaml", "poses.csv"):
        (folder / "photos" / name).rename(folder / name)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "poses", "sentence"),
    [
        (("--min-views", "2"), "poses.csv", "--min-views was expected to be a number from 3"),
        (("--tolerance-px", "0"), "poses.csv", "--tolerance-px above 0"),
        (("--pattern", "checkerboard:8x6:30mm"), "poses.csv", "--pattern counts only with --poses boards"),
        ((), "nowhere", "--poses was expected to be"),
        ((), "poses_2.csv", "poses_2.csv', and no file or folder is there; check the path"),
        ((), "rig", "rig"),
        (("--refine", "walls"), "poses.csv", "--refine was expected"),
        (("--pose-sigma-deg", "1"), "poses.csv", "counts only with --refine poses, of a table or a model"),
        (("--robust",), "poses.csv", "counts only with --segments in place of photos"),
        (("--refine", "lines,rig"), "poses.csv", "--refine rig was expected"),
        ((), "boards", "--pattern was expected"),
        (("--pattern", "chessboard:8x6"), "boards", "pattern"),
        (("--triangulation", "best"), "poses.csv", "a triangulation method among"),
        (("--cost", "least"), "poses.csv", "A cost is one of"),
        (("--loss", "soft"), "poses.csv", "A loss is one of"),
        (("--device", "tpu"), "poses.csv", "A device is one of"),
        ((), "calibration.yaml", "calibration.yaml"),
        ((), "colmap", "COLMAP model were expected"),
    ],
)
def test_bad_requests_are_refused_in_one_sentence_before_any_photo_is_looked_at(
    room, tmp_path, capsys, monkeypatch, options, poses, sentence
):
    monkeypatch.setattr(command, "extract", None)
    if poses == "colmap":
        (tmp_path / "colmap").mkdir()
        poses = str(tmp_path / "colmap")
    elif poses == "calibration.yaml":
        poses = str(room / "calibration.yaml")
    assert call(room / "photos", room, tmp_path, *options, poses=poses) == 2
    said = capsys.readouterr().err
    assert sentence in said and "Traceback" not in said


def test_what_the_end_would_refuse_is_refused_at_the_beginning(room, tmp_path, capsys, monkeypatch):
    """A viewer that is not installed, a name that COLMAP's files do not hold, and photos too few for structure from motion."""
    monkeypatch.setattr(command, "extract", None)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert call(room / "photos", room, tmp_path / "scene", "--recording") == 2
    assert "omnilines[viewer]" in capsys.readouterr().err
    (tmp_path / "photos").mkdir()
    for name in ("view00.png", "view01.png"):
        shutil.copy(room / "photos" / name, tmp_path / "photos")
    assert call(tmp_path / "photos", room, tmp_path / "scene", poses="sfm") == 2
    assert "3 photos or more, found 2" in capsys.readouterr().err
    shutil.copy(room / "photos" / "view02.png", tmp_path / "photos" / "view 02.png")
    assert call(tmp_path / "photos", room, tmp_path / "scene", "--colmap") == 2
    assert "names without blanks" in capsys.readouterr().err


def test_photos_or_segments_are_asked_for(room, tmp_path, capsys):
    arguments = ["reconstruct", "--calibration", room / "calibration.yaml", "--poses", room / "poses.csv", "--out", tmp_path]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in arguments])
    assert stopped.value.code == 2
    assert "found neither" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("named", "folder", "said"),
    [
        (("near", "far", "far"), "photos", ""),
        (("near", "far", "far"), "near", "found far in the column camera and the folder near"),
        (("near", "far", "wide"), "photos", "one of the cameras near, far, found the camera wide in the column camera"),
        (None, "near", ""),
        (None, "photos", "or with one in the column camera of poses.csv"),
    ],
)
def test_the_column_camera_says_whose_photos_are_in_no_folder_of_a_camera(
    room, tmp_path, capsys, monkeypatch, named, folder, said
):
    camera = load(room / "calibration.yaml")["cam0"]
    save(tmp_path / "calibration.yaml", Calibration({"near": camera, "far": camera}))
    write_poses(tmp_path / "poses.csv", replace(read_poses(room / "poses.csv"), cameras=named))
    shutil.copytree(room / "photos", tmp_path / folder)
    asked = []

    def looked(refs, cameras, *, camera_of, **options):
        asked.extend(camera_of[photo.name] for photo in refs)
        raise InputError("enough")

    monkeypatch.setattr(command, "extract", looked)
    assert call(tmp_path / folder, tmp_path, tmp_path / "out") == 2
    assert (said or "enough") in capsys.readouterr().err
    assert asked == ([] if said else list(named or 3 * [folder]))


def test_arcs_are_found_with_the_camera_that_is_named_for_a_photo(room):
    camera = load(room / "calibration.yaml")["cam0"]
    cameras = Calibration({"near": camera, "far": camera})
    named = dict(zip([photo.name for photo in find_photos([room / "photos"])], ("near", "far", "near"), strict=True))
    arcs = extract(room / "photos", cameras, camera_of=named)
    assert arcs.camera_of == named
    poses = replace(read_poses(room / "poses.csv"), cameras=tuple(named.values()))
    write_poses(room / "named.csv", poses)
    assert estimate_poses(room / "photos", cameras, room / "named.csv").poses.cameras == poses.cameras


@pytest.mark.parametrize(
    ("poses", "more"), [("rig", "take photos of more instants, with --poses sfm"), ("poses.csv", "give more")]
)
def test_two_photos_are_refused_before_they_are_looked_at(tmp_path, capsys, monkeypatch, poses: str, more: str) -> None:
    """Arcs were found in them first; of a rig more photos were asked for, which its poses refuse."""
    monkeypatch.setattr(command, "extract", None)
    lens = Pinhole.from_mapping({"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}, (64, 48))
    rig = {
        "left": RigCamera(Pose.identity()),
        "right": RigCamera(Pose.exp(torch.tensor([0.0, 0.0, 0.0, -0.1, 0.0, 0.0], dtype=torch.float64))),
    }
    save(tmp_path / "calibration.yaml", Calibration(dict.fromkeys(rig, lens), {}, rig))
    for camera in rig:
        (tmp_path / "photos" / camera).mkdir(parents=True)
        write_png(tmp_path / "photos" / camera / f"{camera}1.png", np.zeros((48, 64), dtype=np.uint8))
    names = ("left/left1.png", "right/right1.png")
    write_poses(tmp_path / "poses.csv", ImagePoses(names, Pose.identity(2), ("left", "right")))
    assert call(tmp_path / "photos", tmp_path, tmp_path / "scene", poses=poses) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "3 photos or more were expected to rebuild lines, found 2;" in said and more in said
