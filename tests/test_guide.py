"""A guided calibration: what is kept, what is written, when it ends, and its page; on rendered frames."""

import json
import math
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest
import torch

from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from camera_models import InputError, load
from camera_models.pose import Pose
from omnilines.calibration.options import CalibrationOptions
from omnilines.commands.guide import guide
from omnilines.files import write_png
from omnilines.guide.follow import follow
from omnilines.guide.options import GuideOptions
from omnilines.guide.server import served
from omnilines.guide.session import Session
from omnilines.guide.source import Source
from omnilines.synthetic.targets import example_camera

SIZE = (640, 480)
SPECIFICATION = "checkerboard:8x6:30mm"
BOARD = pattern(SPECIFICATION)
TRUTH = example_camera("opencv-fisheye", 150.0, SIZE, 3)
FISHEYE = CalibrationOptions(model="opencv-fisheye")


def photo(pose: Pose, seed: int = 0) -> np.ndarray:
    """A frame, of a lens that sees nothing beyond 75 degrees."""
    image = render_target(BOARD, TRUTH, pose, supersample=3, blur_px=0.6, noise_grey=2.0, seed=seed)
    angle = math.radians(75.0)
    rim, _ = TRUTH.project(np.array([[math.sin(angle), 0.0, math.cos(angle)]]))
    centre = TRUTH.centre_px.numpy()
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    outside = np.hypot(u - centre[0], v - centre[1]) > np.linalg.norm(rim[0] - centre)
    return np.where(outside, 3, image).astype(np.uint8)


def write_video(path: pathlib.Path, images: list[np.ndarray], frames_per_s: float) -> None:
    """Grey frames as a video."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), frames_per_s, SIZE)
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """Twelve photos of random poses, in a random order."""
    poses = random_board_poses(BOARD, TRUTH, 12, math.radians(66.0), seed=2)
    return [photo(poses[k], k) for k in np.random.default_rng(1).permutation(12).tolist()]


@pytest.mark.slow
def test_frames_that_tell_something_are_kept_and_written(frames: list[np.ndarray], tmp_path: pathlib.Path) -> None:
    out = tmp_path / "out"
    session = Session(BOARD, out, GuideOptions(first_frames=5), FISHEYE)
    assert not session.offer(np.full((SIZE[1], SIZE[0]), 90, np.uint8)) and session.message == "no board is found"
    assert session.offer(frames[0]) and not session.offer(frames[0]) and "move the board" in session.message
    assert not session.offer(cv2.GaussianBlur(frames[1], (0, 0), 4.0)) and not session.stale
    assert all(session.offer(image) for image in frames[1:5]) and session.stale
    assert not session.offer(frames[5]) and session.message == "the camera is being calibrated"
    session.refit()
    assert session.known is not None and not session.stale
    first = session.known.advice
    assert (out / "frames" / "0004.png").is_file() and len(session.kept) == 5
    assert load(out / "calibration.yaml")["cam0"].NAME == "opencv-fisheye" and (out / "report.html").is_file()
    kept = [session.offer(image) for image in frames[5:]]
    assert sum(kept) >= 3
    expected = float(session.known.projection.sigma_px.max())
    session.refit()
    assert session.known.advice.worst_px < first.worst_px
    assert 0.7 < session.known.advice.worst_px / expected < 1.4
    # The same command goes on where it was stopped.
    again = Session(BOARD, out, GuideOptions(first_frames=5), FISHEYE)
    assert len(again.kept) == len(session.kept) and again.stale
    assert again.finish().fit.rms_px_per_axis < 0.1


@pytest.mark.slow
def test_a_stream_that_follows_the_advice_ends_soon(frames: list[np.ndarray], tmp_path: pathlib.Path) -> None:
    """What twelve random frames reach takes half as many that are held as the guide says, the first four being random."""
    random_session = Session(BOARD, tmp_path / "random", GuideOptions(first_frames=12, apart_share=0.0), FISHEYE)
    for image in frames:
        random_session.offer(image)
    random_session.refit()
    assert random_session.known is not None and len(random_session.kept) == 12
    wanted = random_session.known.advice.worst_px
    session = Session(BOARD, tmp_path / "advised", GuideOptions(wanted, first_frames=4), FISHEYE)

    def stream():
        yield from frames[:4]
        while len(session.kept) < 12:
            yield photo(session.known.advice.poses[0].cam_from_board, seed=50 + session.offered)

    follow(session, stream(), waits=True)
    assert session.over.is_set() and session.known.advice.worst_px <= wanted
    assert len(session.kept) <= 8, len(session.kept)
    print(len(session.kept), wanted)


def test_source_of_a_video_a_folder_and_nothing(frames: list[np.ndarray], tmp_path: pathlib.Path) -> None:
    video = tmp_path / "video.avi"
    write_video(video, [image for image in frames[:3] for _ in range(6)], 30.0)
    assert len(list(Source(str(video), 5.0).frames())) == 3
    folder = tmp_path / "folder"
    folder.mkdir()
    coming = Source(str(folder), 5.0).frames()
    assert next(coming) is None
    write_png(folder / "b.png", frames[0])
    (folder / "c.png").write_bytes(b"")
    assert next(coming) is not None and next(coming) is None
    write_png(folder / "c.png", frames[1])
    assert np.array_equal(next(coming), frames[1])
    with pytest.raises(InputError, match="does not exist"):
        Source(str(tmp_path / "absent.mp4"), 5.0)
    (tmp_path / "no.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be decoded"):
        Source(str(tmp_path / "no.mp4"), 5.0)
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(InputError, match="a pipe"):
        Source(str(tmp_path / "pipe.mp4"), 5.0)
    shutil.rmtree(folder)
    assert next(coming) is None
    with pytest.raises(InputError, match="cannot be read"):
        next(coming)


def test_too_little_is_refused_in_a_sentence(frames: list[np.ndarray], tmp_path: pathlib.Path) -> None:
    video = tmp_path / "short.avi"
    write_video(video, frames[:1], 5.0)
    with pytest.raises(InputError, match="found 1 that show the board"):
        guide(str(video), SPECIFICATION, tmp_path / "out", announce=lambda _: None)
    assert not (tmp_path / "out").exists()
    (tmp_path / "no.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be decoded"):
        guide(str(tmp_path / "no.mp4"), SPECIFICATION, tmp_path / "none", announce=lambda _: None)
    assert not (tmp_path / "none").exists()
    with pytest.raises(InputError, match="outside of the photos"):
        folder = tmp_path / "folder"
        folder.mkdir()
        write_png(folder / "a.png", frames[0])
        Session(BOARD, folder, inputs=[folder]).offer(frames[0])


def test_the_page_is_for_who_has_its_address(tmp_path: pathlib.Path, frames: list[np.ndarray]) -> None:
    session = Session(BOARD, tmp_path / "out", GuideOptions(), FISHEYE)
    session.offer(frames[0])
    with served(session) as address:
        with pytest.raises(InputError, match="free `port`"), served(session, int(address.split(":")[2].split("/")[0])):
            pass
        port = int(re.match(r"http://127\.0\.0\.1:(\d+)/[\w-]{20,}/$", address)[1])
        with urllib.request.urlopen(address + "state.json") as answer:
            assert json.load(answer)["kept"] == 1 and answer.headers["Cache-Control"] == "no-store"
        for name in ("live.jpg", "map.jpg"):
            with urllib.request.urlopen(address + name) as answer:
                picture = answer.read()
            assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR) is not None
        elsewhere = [
            (f"http://127.0.0.1:{port}/", {}, None),
            (f"http://127.0.0.1:{port}/wrong/state.json", {}, None),
            (address + "../../etc/passwd", {}, None),
            (address + "state.json", {"Host": "evil.example"}, None),
            (f"http://127.0.0.1:{port}/wrong/finish", {}, b""),
        ]
        for url, headers, body in elsewhere:
            with pytest.raises(urllib.error.HTTPError, match="404") as refused:
                urllib.request.urlopen(urllib.request.Request(url, data=body, headers=headers))
            refused.value.close()
        assert not session.over.is_set()
        urllib.request.urlopen(urllib.request.Request(address + "finish", data=b"")).close()
        assert session.over.is_set()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["video", pytest.param("folder", marks=pytest.mark.full)])
def test_in_chromium(kind: str, frames: list[np.ndarray], tmp_path: pathlib.Path) -> None:
    """A video, or a growing folder, is shown, its frames are counted, the next pose is said; the end of the video, or `Finish`,
    ends it with a calibration."""
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    if not pathlib.Path(chromium).exists():
        if os.environ.get("CI"):
            pytest.fail("CI must have Debian's chromium (apt-get install chromium); it is absent.")
        pytest.skip("Debian's chromium is absent; install it to test the page in a browser")
    from playwright.sync_api import sync_playwright

    source, told, results = tmp_path / ("photos" if kind == "folder" else "video.avi"), list[str](), []
    if kind == "folder":
        source.mkdir()
    else:
        write_video(source, [image for image in frames for _ in range(3)], 15.0)
    options = GuideOptions(first_frames=4)

    def job() -> None:
        """What the command does."""
        out = tmp_path / "out"
        results.append(guide(str(source), SPECIFICATION, out, options, calibration=FISHEYE, announce=told.append))

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        asked, errors = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        thread = threading.Thread(target=job)
        thread.start()
        while not told:
            time.sleep(0.01)
        page.goto(told[0])
        for k, image in enumerate(frames[:7] if kind == "folder" else []):
            write_png(source / f"{k:02d}.png", image)
        page.wait_for_function("document.getElementById('next').textContent.startsWith('Hold the board')", timeout=120_000)
        assert "largest uncertainty" in page.inner_text("#figures")
        page.wait_for_function(
            "document.getElementById('live').naturalWidth == 640 && document.getElementById('map').naturalWidth > 0"
        )
        page.wait_for_function("Number(document.body.dataset.kept) >= 5", timeout=120_000)
        if shots := os.environ.get("OMNILINES_SCREENSHOTS"):
            page.wait_for_timeout(1000)
            page.screenshot(path=pathlib.Path(shots) / f"guide-{kind}.png", full_page=True)
        if kind == "folder":
            page.click("#finish")
        page.wait_for_selector("body[data-state=ended], body[data-state=over]", timeout=60_000)
        browser.close()
    thread.join(timeout=120)
    assert not thread.is_alive() and not errors and all(url.startswith("http://127.0.0.1:") for url in asked)
    (result,) = results
    assert result.data["rms_px_per_axis"] < 0.2 and result.data["frames"]["kept"] >= 5
    assert all(path.is_file() for path in result.files)


@pytest.mark.slow
def test_ctrl_c_ends_it_and_what_was_found_stays(frames: list[np.ndarray], tmp_path: pathlib.Path) -> None:
    folder, out = tmp_path / "photos", tmp_path / "out"
    folder.mkdir()
    for k, image in enumerate(frames[:8]):
        write_png(folder / f"{k:02d}.png", image)
    arguments = ["guide", str(folder), "--pattern", SPECIFICATION, "--out", str(out), "--model", "opencv-fisheye"]
    code = "import sys; from omnilines.cli import main; main(sys.argv[1:])"
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True)
    for _ in range(1200):
        if (out / "report.html").is_file() or process.poll() is not None:
            break
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "the same command goes on from there" in said and "Open http://127.0.0.1:" in said
    assert "Traceback" not in said
    assert load(out / "calibration.yaml")["cam0"].NAME == "opencv-fisheye" and len(list((out / "frames").iterdir())) >= 6
    assert torch.isfinite(load(out / "calibration.yaml")["cam0"].parameters).all()
