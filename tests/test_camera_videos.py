"""What a command refuses of videos, it refuses before it reads their frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import camera_models
from camera_models import Calibration, OpenCVFisheye
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.commands.camera_videos import cameras_of_videos
from omnilines.commands.frames import with_frames
from omnilines.commands.result import CommandResult
from omnilines.files.videos import Video

LENS = OpenCVFisheye([20.0, 20.0, 31.5, 23.5, 0.0, 0.0, 0.0, 0.0], (64, 48))
BOARD = ("--pattern", "checkerboard:8x6:30mm")


@pytest.fixture
def unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A video `walk.avi` whose frames nobody may read, and calibrations beside it."""
    film = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (64, 48))
    for _ in range(5):
        film.write(np.full((48, 64, 3), 90, dtype=np.uint8))
    film.release()
    rig = {name: RigCamera(Pose.identity()) for name in ("left", "right")}
    camera_models.save(tmp_path / "rig.yaml", Calibration(dict.fromkeys(rig, LENS), {}, rig))
    camera_models.save(tmp_path / "one.yaml", Calibration({"cam0": LENS}))
    larger = OpenCVFisheye(LENS.parameters, (128, 96))
    (tmp_path / "wrong.csv").write_text("image,what\n1.png,2\n")
    cv2.imwrite(str(tmp_path / "small.png"), np.full((24, 32), 255, dtype=np.uint8))
    camera_models.save(tmp_path / "larger.yaml", Calibration({"cam0": larger}))

    def read(*_: object) -> None:
        raise AssertionError("frames were read")

    monkeypatch.setattr(Video, "frames", read)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "walk.avi"


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What a command says that ends with status 2."""
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    assert ended.value.code == 2
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (("reconstruct", "--calibration", "none.yaml", "--poses", "sfm"), "none.yaml does not exist"),
        (("reconstruct", "--calibration", "rig.yaml", "--poses", "sfm"), "Videos named like the cameras left, right of rig.yaml"),
        (("reconstruct", "--calibration", "larger.yaml", "--poses", "sfm"), "walk: A video of 128x96 px was expected"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "poses.csv"), "found 'poses.csv'"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "boards"), "--pattern was expected with --poses boards"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "sfm", "--refine", "line"), "line"),
        (("reconstruct", "--calibration", "equirectangular", "--poses", "sfm"), "twice as wide as high"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "wrong.csv"), "wrong.csv, line 1"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "."), "of a COLMAP model were expected"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "sfm", "--segments", "wrong.csv"), "wrong.csv, line 1"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "sfm", "--mask", "none.png"), "which does not exist"),
        (("reconstruct", "--calibration", "one.yaml", "--poses", "sfm", "--mask", "small.png"), "found 32x24 px"),
        (("extract", "--calibration", "one.yaml", "--mask", "small.png"), "found 32x24 px"),
        (("directions", "--calibration", "one.yaml", "--mask", "none.png"), "which does not exist"),
        (("extract", "--calibration", "rig.yaml"), "Videos named like the cameras"),
        (("directions", "--calibration", "larger.yaml"), "A video of 128x96 px"),
        (("check", "--calibration", "rig.yaml"), "Videos named like the cameras"),
        (("rectify", "--calibration", "one.yaml", "--view", "round"), "round"),
        (("rectify", "--calibration", "one.yaml", "--poses", "wrong.csv"), "wrong.csv, line 1"),
        (("rectify", "--calibration", "one.yaml", "--poses", "none.csv"), "none.csv"),
        (("rectify", "--calibration", "one.yaml", "--body", "one.yaml"), "--body was expected with --poses of a trajectory"),
        (("detect", *BOARD, "--calibration", "rig.yaml"), "the calibration of one camera was expected"),
        (("calibrate", *BOARD, "--model", "opencv"), "A camera model is one of"),
        (("calibrate", "--pattern", "lines", "--model", "opencv"), "A camera model is one of"),
    ],
)
def test_what_is_wrong_with_videos_is_said_before_they_are_read(
    given: tuple[str, ...], says: str, unread: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were read whole first, a minute for four short ones."""
    command, *options = given
    assert says in refused(capsys, command, unread.name, *options, "--out", "out")
    assert not (unread.parent / "out").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--model", "up=pinhole"), "found 'up'"),
        (("--calibration", "rig.yaml"), "found 'left'"),
        (("--boards", "known"), "--boards known was expected"),
    ],
)
def test_a_rig_of_videos_that_is_not_that_of_the_options_is_refused_before_they_are_read(
    options: tuple[str, ...], says: str, unread: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (unread.parent / "run.avi").write_bytes(unread.read_bytes())
    assert says in refused(capsys, "calibrate", "walk.avi", "run.avi", *BOARD, *options, "--out", "out")


def test_a_check_of_a_video_needs_a_folder(unread: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It said that the video is no photo, though its help names videos."""
    assert "--out was expected beside walk.avi" in refused(capsys, "check", "walk.avi", "--calibration", "one.yaml")


def test_one_video_of_a_rig_is_of_the_camera_that_it_is_named_like(unread: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As photos in a folder named so are: it was asked for the calibration of its camera alone."""
    monkeypatch.undo()
    folder = unread.parent
    unread.rename(folder / "left.avi")
    asked: list[Path] = []

    def command(paths: list[Path]) -> CommandResult:
        asked.extend(paths)
        return CommandResult((), {})

    with_frames(command, [folder / "left.avi"], folder / "out", check=lambda sizes: cameras_of_videos(folder / "rig.yaml", sizes))
    assert asked == [folder / "out" / "frames" / "left"] and list(asked[0].glob("*.png"))
