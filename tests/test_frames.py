"""Videos: which frames are taken, what comes of them, and what is said of files that are none."""

import csv
import doctest
import inspect
import itertools
import math
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rendered_video import Path6, Shutter, random_path, write_video

import camera_models
import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from camera_models import InputError
from camera_models.pose import Pose
from omnilines.calibration.telling import ViewInformation, telling_instants
from omnilines.cli import main
from omnilines.commands.frames import with_frames
from omnilines.commands.result import CommandResult
from omnilines.files import find_photos
from omnilines.files.footage import Footage, Frame
from omnilines.files.split import Split
from omnilines.files.videos import Video, find_videos, together
from omnilines.footage.alignment import lead_s, put_together
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import spaced
from omnilines.pipelines.instants import Lens, instants_of
from omnilines.progress import silent

BOARD = "checkerboard:8x6:30mm"
LENS = camera_models.OpenCVFisheye([120.0, 120.0, 191.5, 143.5, 0.02, -0.004, 0.0, 0.0], (384, 288))
OTHER = camera_models.OpenCVFisheye([125.0, 125.0, 190.0, 145.0, 0.01, -0.002, 0.0, 0.0], (384, 288))
RATE = 10.0
OPTIONS = FrameOptions(most_of_target=12)


@pytest.fixture(scope="module")
def path() -> Path6:
    poses = random_board_poses(pattern(BOARD), LENS, 12, math.radians(60), seed=2)
    return random_path(poses, move_s=0.5, rest_s=0.3)


@pytest.fixture(scope="module")
def video(path: Path6, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board moved by hand before a fisheye, blurred and sheared as it moves."""
    file = tmp_path_factory.mktemp("video") / "board.avi"
    write_video(file, pattern(BOARD), LENS, path, Shutter(0.03, 0.03, 3), RATE)
    return file


@pytest.mark.slow
def test_frames_of_a_target_are_those_at_rest(video: Path, path: Path6) -> None:
    chosen = ol.frames(video, BOARD, options=OPTIONS)
    assert 8 <= len(chosen.taken) <= 12 and chosen.notes == ()
    cycle = path.move_s + path.rest_s
    resting = [0.0 <= row.time_s % cycle <= path.rest_s for row in chosen.taken]
    every = path.rest_s / cycle
    assert np.mean(resting) > 2 * every
    assert all(row.corners >= 20 for row in chosen.taken)
    assert {row.reason for row in chosen.taken} == {"it tells much of the camera"}
    assert all(row.reason for row in chosen.rows)


@pytest.mark.full
def test_frames_of_several_targets_are_those_of_each(video: Path) -> None:
    alone = ol.frames(video, BOARD, options=OPTIONS)
    other = "charuco:5x4:30mm:22mm:DICT_4X4_50"
    both = ol.frames(video, f"{other}, {BOARD}", options=OPTIONS)
    assert [row.index for row in both.taken] == [row.index for row in alone.taken] and len(both.taken) >= 8
    assert [row.corners for row in both.rows] == [row.corners for row in alone.rows]
    with pytest.raises(InputError, match=f"{other} or aprilgrid:6x6:35mm:0.3:36h11 was expected in at least one"):
        ol.frames(video, f"{other},aprilgrid:6x6:35mm:0.3:36h11", options=OPTIONS)


@pytest.mark.slow
def test_the_command_says_in_full_why_frames_are_left_out(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["frames", str(video), "--pattern", BOARD, "--out", str(tmp_path / "out")])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    reasons = {row["reason"] for row in csv.DictReader((tmp_path / "out/frames.csv").read_text().splitlines())} - {""}
    assert reasons and any(f" frames: {reason}" in said for reason in reasons)


@pytest.mark.slow
def test_a_video_is_calibrated_by_one_command(video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", str(video), "--pattern", BOARD, "--model", "opencv-fisheye", "--out", str(tmp_path / "out")])
    assert ended.value.code == 0
    assert "frames that were looked at closely were taken" in capsys.readouterr().err
    rows = list(csv.DictReader((tmp_path / "out/frames/frames.csv").read_text().splitlines()))
    taken = {row["image"] for row in rows if row["taken"] == "yes"}
    assert taken == {path.name for path in (tmp_path / "out/frames").glob("*.png")} and len(taken) >= 8
    found = ol.load(tmp_path / "out/calibration.yaml")["cam0"]
    focal = found.named_parameters()
    assert abs(focal["fx"] - 120.0) < 0.5 and abs(focal["cx"] - 191.5) < 0.7


@pytest.mark.full
def test_the_example_holds(video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("board.mp4").write_bytes(video.read_bytes())
    example = doctest.DocTestParser().get_doctest(str(inspect.getdoc(ol.frames)), {"ol": ol}, "frames", None, None)
    told: list[str] = []
    doctest.DocTestRunner().run(example, out=told.append)
    assert example.examples and not told, "".join(told)


def test_a_second_run_leaves_no_frame_of_the_first(video: Path, tmp_path: Path) -> None:
    for most in (6, 3):
        with pytest.raises(SystemExit) as ended:
            settings = ["--set", f"frames.most_of_scene={most}", "--set", "frames.step_share=0"]
            main(["frames", str(video), "--out", str(tmp_path / "f"), *settings])
        assert ended.value.code == 0
    rows = csv.DictReader((tmp_path / "f/frames.csv").read_text().splitlines())
    taken = {row["image"] for row in rows if row["taken"] == "yes"}
    assert taken == {path.name for path in (tmp_path / "f").glob("*.png")} and 1 <= len(taken) <= 3


@pytest.mark.slow
def test_the_videos_of_a_rig_give_the_same_instants(path: Path6, tmp_path: Path) -> None:
    right_from_left = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([-0.05, 0.0, 0.0], dtype=torch.float64))
    few = Path6(Pose(path.poses.rotation[:6], path.poses.translation[:6]), path.move_s, path.rest_s)
    beside = Path6(right_from_left @ few.poses, few.move_s, few.rest_s)
    write_video(tmp_path / "left.avi", pattern(BOARD), LENS, few, frames_per_s=RATE)
    write_video(tmp_path / "right.avi", pattern(BOARD), OTHER, beside, frames_per_s=RATE)
    chosen = ol.frames(tmp_path, BOARD, options=FrameOptions(most_of_target=6, frames_of_run=1))
    left, right = ([row for row in chosen.taken if row.lens == number] for number in (0, 1))
    assert [row.index for row in left] == [row.index for row in right] and len(left) == 6
    assert left[0].image == f"left/{left[0].index:06d}.png"
    files = chosen.save(tmp_path / "out")
    assert len(files) == 13 and all(file.is_file() for file in files)
    found = ol.detect_rig(tmp_path / "out", BOARD)
    assert set(found.image_sizes) == {"left", "right"}
    assert found.corners.times_s is not None
    taken = {row.image: row.time_s for row in chosen.taken}
    assert np.allclose(found.corners.times_s, [taken[image] for image in found.corners.images], atol=1e-6)
    in_memory = ol.detect_rig(chosen.photos(), BOARD)
    assert in_memory.corners.times_s is not None and in_memory.corners.images == found.corners.images
    assert np.allclose(in_memory.corners.times_s, found.corners.times_s, atol=1e-6)
    runs = ol.frames(tmp_path, BOARD, options=FrameOptions(most_of_target=2, frames_of_run=3))
    numbers = sorted({row.index for row in runs.taken})
    assert 4 <= len(numbers) <= 6 and sum(a + 1 == b for a, b in itertools.pairwise(numbers)) >= 3


def test_when_videos_began_is_told_by_the_motion_in_them() -> None:
    rng = np.random.default_rng(0)
    times_s = np.arange(900) / 30.0
    motion = np.convolve(rng.gamma(0.3, 1.0, 900 + 120), np.ones(8) / 8, mode="same")

    def seen(start: int, of: int, noise: float) -> np.ndarray:
        return motion[start : start + of] * 3.0 + noise * rng.gamma(1.0, 1.0, of)

    first = seen(0, 900, 0.3)
    # What the first shows at its frame 70 the other shows at its beginning.
    found = lead_s(times_s, first, times_s, 0.4 * seen(70, 900, 0.3), 0.5, 1e-3)
    assert found is not None and abs(found + 70 / 30) < 0.02
    assert lead_s(times_s, first, times_s, seen(0, 900, 0.3), 0.5, 1e-3) == 0.0
    unrelated = [np.convolve(rng.gamma(0.3, 1.0, 900), np.ones(8) / 8, mode="same") for _ in range(20)]
    assert sum(lead_s(times_s, first, times_s, other, 0.5, 1e-3) is not None for other in unrelated) <= 1
    assert lead_s(times_s, np.zeros(900), times_s, first, 0.5, 1e-3) is None
    assert lead_s(times_s[:1], first[:1], times_s, first, 0.5, 1e-3) is None


def test_lenses_side_by_side_are_cut_apart(tmp_path: Path) -> None:
    (tmp_path / "both").mkdir()
    rng = np.random.default_rng(0)
    left, right = rng.integers(0, 256, (2, 48, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "both/7.png"), np.hstack([left, right]))
    film = cv2.VideoWriter(str(tmp_path / "both.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (128, 48))
    for _ in range(5):
        film.write(np.hstack([left, right]))
    film.release()
    chosen = ol.frames(tmp_path / "both.avi", split="left,right")
    assert [lens.image_size for lens in chosen.lenses] == [(64, 48)] * 2
    photos = {photo.name: photo.pixels for photo in chosen.photos()}
    assert sorted(photos) == ["left/000000.png", "right/000000.png"]
    assert np.abs(photos["right/000000.png"].astype(int) - right).mean() < 3.0  # colours of half resolution
    assert [part.shape for part in Split.of("top/bottom").parts(left)] == [(24, 64, 3)] * 2
    seen: list[list[Path]] = []

    def command(paths: list[Path]) -> CommandResult:
        seen.append(paths)
        return CommandResult((), {})

    with_frames(command, [tmp_path / "both"], tmp_path / "out", split="left,right")
    assert seen == [[tmp_path / "out/frames"]]
    assert np.array_equal(cv2.imread(str(tmp_path / "out/frames/right/7.png")), right)
    for wrong in ("left", "a,a", "a,b/c", "../x,y"):
        with pytest.raises(InputError, match="names of lenses"):
            Split.of(wrong)
    with pytest.raises(InputError, match="equal parts"):
        Split.of("a,b,c").parts(left)


@pytest.mark.parametrize("split", [None, "left,right"])
def test_frames_of_one_run_are_not_read_by_another(split: str | None, tmp_path: Path) -> None:
    given = []
    for name, grey in (("a", 40), ("b", 200)):
        picture = np.full((48, 128, 3), grey, dtype=np.uint8)
        if split is None:
            given.append(tmp_path / f"{name}.avi")
            film = cv2.VideoWriter(str(given[-1]), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (128, 48))
            for _ in range(5):
                film.write(picture)
            film.release()
        else:
            given.append(tmp_path / name)
            given[-1].mkdir()
            cv2.imwrite(str(given[-1] / "000000.png"), picture)
    seen: list[int] = []

    def last(paths: list[Path]) -> CommandResult:
        """It reads its frames."""
        seen.append(int(cv2.imread(str(find_photos(paths)[0].path)).mean().round()))
        return CommandResult((), {})

    def first(paths: list[Path]) -> CommandResult:
        """Another run begins before this one has read its frames."""
        with pytest.raises(InputError, match=r"out was expected to be written to by one run at a time, found another one"):
            with_frames(last, given[1:], tmp_path / "out", split=split)
        return last(paths)

    with_frames(first, given[:1], tmp_path / "out", split=split)
    with_frames(last, given[1:], tmp_path / "out", split=split)
    assert seen == [40, 200]


def test_frames_of_a_scene_are_apart(video: Path) -> None:
    chosen = ol.frames(video, options=FrameOptions(step_share=0.05, looked_per_s=RATE))
    assert 0 < len(chosen.taken) < len(chosen.rows)
    assert [photo.name for photo in chosen.photos()] == [row.image for row in chosen.taken]
    assert spaced([0.0, 1.0, 2.0, 3.0, 10.0], 2.5, 10) == [0, 3, 4]
    assert spaced([0.0, 1.0, 2.0, 3.0, 10.0], 0.1, 2) == [0, 4]
    assert spaced([], 1.0, 3) == []


def test_frames_are_read_again_as_they_were(video: Path) -> None:
    source = Video.of(video)
    every = {frame.index: frame.pixels for frame in source.frames()}
    assert list(every) == list(range(len(every))) and abs(len(every) - source.count) <= 1
    again = list(source.frames([3, 17, 5]))
    assert [frame.index for frame in again] == [3, 5, 17]
    assert all(np.array_equal(frame.pixels, every[frame.index]) for frame in again)
    assert [round(frame.time_s * RATE) for frame in again] == [3, 5, 17]


def _plain_video(file: Path, rate: float, seconds: float) -> Path:
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), rate, (64, 48))
    for k in range(int(rate * seconds)):
        writer.write(np.full((48, 64, 3), k % 256, np.uint8))
    writer.release()
    return file


def test_videos_of_other_rates_are_put_together_by_time(tmp_path: Path) -> None:
    slow, fast = (Video.of(_plain_video(tmp_path / f"{rate}.avi", rate, 3.0)) for rate in (10.0, 25.0))
    times_s = [np.array([frame.time_s for frame in video.frames()]) for video in (slow, fast)]
    pairs = list(together([slow, fast], put_together(times_s, [0.0, 0.0])))
    assert len(pairs) >= 28
    assert max(abs(one.time_s - other.time_s) for one, other in pairs) <= 0.5 / 25.0 + 1e-6
    late = put_together(times_s, [0.0, -0.52])
    assert len({other for _, other in late}) == len(late) == 25
    assert max(abs(times_s[1][other] - times_s[0][one] + 0.52) for one, other in late) <= 0.5 / 25.0 + 1e-6
    # Of the faster one first, no frame of the slower stands in two instants.
    swapped = put_together(times_s[::-1], [0.0, 0.0])
    assert len({slower for _, slower in swapped}) == len(swapped) >= 28


@dataclass(frozen=True)
class _Timed(Footage):
    """Frames of the same grey at some times, as a video whose frame rate varies."""

    times_s: tuple[float, ...] = ()
    title, name, stamped, begins_ns = "", "", False, None

    def frames(self, wanted: Collection[int] | None = None) -> Iterator[Frame]:
        for k, time_s in enumerate(self.times_s):
            if wanted is None or k in wanted:
                yield Frame(k, time_s, np.full((48, 64, 3), k % 2, np.uint8))

    def doubts(self, times_s: np.ndarray) -> tuple[str, ...]:
        return ()


def test_videos_whose_frame_rate_varies_are_put_together_by_time() -> None:
    """Two phones that drop as many frames, each at another time: of one rate and length, but not frame by frame."""
    every = np.arange(60) / 30.0
    times_s = [tuple(np.delete(every, dropped).tolist()) for dropped in (range(10, 16), range(40, 46))]
    videos = [_Timed(Path(f"{k}.mp4"), 27.0, 54, (64, 48), own) for k, own in enumerate(times_s)]
    found, _ = instants_of([Lens(video, None, 0, str(k)) for k, video in enumerate(videos)], OPTIONS, silent)
    assert all(abs(instant.time_s[0] - instant.time_s[1]) < 0.5 / 30.0 for instant in found)
    # What one of them dropped no instant shows.
    assert len(found) == 48
    # Frames that jitter by less than half the gap between them are of one number.
    rng = np.random.default_rng(0)
    steady = [_Timed(Path(f"{k}.mp4"), 30.0, 60, (64, 48), tuple((every + rng.uniform(0, 0.01, 60)).tolist())) for k in (0, 1)]
    found, _ = instants_of([Lens(video, None, 0, str(k)) for k, video in enumerate(steady)], OPTIONS, silent)
    assert [instant.index for instant in found] == [(k, k) for k in range(60)]


def test_telling_instants_are_nearly_the_best(seed: int = 0) -> None:
    """Against all sets of the same size."""
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.rand(9, 1, 1, generator=generator, dtype=torch.float64)
    factors = sizes * torch.randn(9, 2, 4, generator=generator, dtype=torch.float64)
    matrix = factors.mT @ factors
    names = tuple(str(k) for k in range(9))
    instants, alike = {name: k for k, name in enumerate(names)}, torch.ones(9, dtype=torch.float64)
    chosen = telling_instants([ViewInformation(names, matrix, alike)], instants, 9, 4)
    best = max(float(torch.logdet(matrix[list(group)].sum(0))) for group in itertools.combinations(range(9), 4))
    assert len(set(chosen)) == 4 and float(torch.logdet(matrix[chosen].sum(0))) > best - 0.05
    loud = alike.clone()
    loud[chosen[:2]] = 3.0
    others = telling_instants([ViewInformation(names, matrix, loud)], instants, 9, 4)
    assert len(set(others)) == 4 and not set(others) & set(chosen[:2])
    assert set(telling_instants([ViewInformation(names, matrix, 3.0 * alike)], instants, 9, 4)) == set(chosen)


@pytest.mark.parametrize("out", ["file", "file/out"])
def test_a_file_in_the_place_of_the_results_is_named(out: str, video: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"A folder to write to was expected at .*file.*, found that .*file is no folder"):
        with_frames(lambda _: CommandResult((), {}), [video], tmp_path / out)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("count", [1, 5])
def test_a_short_video_is_not_called_cut_short(count: int, tmp_path: Path) -> None:
    """The last of a few frames begins well before the end."""
    film = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (64, 48))
    for _ in range(count):
        film.write(np.full((48, 64, 3), 90, dtype=np.uint8))
    film.release()
    assert ol.frames(tmp_path / "a.avi").notes == ()


@pytest.mark.parametrize("kind", ["text", "cut", "playlist", "empty"])
def test_what_is_no_video_is_refused(kind: str, video: Path, tmp_path: Path) -> None:
    other = tmp_path / "secret.avi"
    other.write_bytes(video.read_bytes())
    contents = {
        "text": b"not a video",
        "cut": video.read_bytes()[:3000],
        "playlist": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{other}\n#EXT-X-ENDLIST\n".encode(),
        "empty": b"",
    }
    file = tmp_path / "film.mp4"
    file.write_bytes(contents[kind])
    with pytest.raises(InputError, match=r"film\.mp4"):
        ol.frames(file)


def test_a_video_that_is_cut_short_is_named(tmp_path: Path) -> None:
    file = _plain_video(tmp_path / "film.avi", 10.0, 3.0)
    assert ol.frames(file).notes == ()
    content = file.read_bytes()
    frames = [match.start() for match in re.finditer(b"00dc", content)]
    file.write_bytes(content[: frames[5]])
    (note,) = ol.frames(file).notes
    said = "film.avi states 30 frames in 3.0 s, of which 4 can be decoded, the last at 0.3 s: it is damaged or cut short"
    assert said in note
    with pytest.raises(InputError, match=re.escape(said)) as none_found:
        ol.frames(file, BOARD)
    assert "inner corners." not in str(none_found.value)


@pytest.mark.parametrize(("suffix", "frames", "holes"), [("mp4", 30, 0), ("mp4", 26, 1), ("mkv", 26, 0)])
def test_frames_missing_in_between_are_told_where_the_container_counts_them(suffix: str, frames: int, holes: int) -> None:
    """Frames that do not decode are passed over; containers of streams may state a rate that they do not keep."""
    times_s = np.linspace(0.0, 2.9, frames)
    told = Video(Path(f"film.{suffix}"), 10.0, 30, (384, 288)).doubts(times_s)
    assert len(told) == holes and all(
        "states 30 frames in 3.0 s, of which 26 can be decoded, the last at 2.9 s" in one for one in told
    )


def test_videos_and_photos_together_are_refused(video: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((20, 20), np.uint8))
    with pytest.raises(InputError, match="one after the other"):
        find_videos([video, tmp_path / "a.png"])
    (tmp_path / "film.avi").write_bytes(video.read_bytes())
    assert find_videos([tmp_path]) == []
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "film.avi").write_bytes(video.read_bytes())
    with pytest.raises(InputError, match="two called film"):
        ol.frames([tmp_path / "film.avi", tmp_path / "b" / "film.avi"])


def test_a_video_without_the_target_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found in none"):
        ol.frames(_plain_video(tmp_path / "grey.avi", 10.0, 1.0), BOARD)
