"""Photos, models and matching worked on by executors: the same results, and what is said where these fail."""

import pickle
import socket
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_views import board_corners, board_views
from matching_scenes import room
from worker_scene import PATTERN, VIEWS, Scene

import omnilines as ol
from calib_patterns import Detection
from camera_models import InputError, OpenCVFisheye
from omnilines.calibration.select import Candidate, select_model
from omnilines.matching import hypotheses
from omnilines.matching.match import match_arcs
from omnilines.pipelines import batches
from omnilines.pipelines.batches import one_by_one
from omnilines.pipelines.part_workers import matching_workers


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(tmp_path_factory.mktemp("workers"), VIEWS)


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """More batches than one."""
    monkeypatch.setattr(batches, "BATCH", 2)


class Pickled(Executor):
    """Does at once what it is given, as it comes out of a pickle; `before` is told how many batches there were, and may raise."""

    def __init__(self, before: Callable[[int], object] = lambda count: None) -> None:
        self.before, self.count, self.bytes = before, 0, 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        sent = pickle.dumps((fn, args, kwargs))
        self.bytes = max(self.bytes, len(sent))
        done: Future[Any] = Future()
        self.count += 1
        try:
            self.before(self.count)
            work, given, named = pickle.loads(sent)
            done.set_result(pickle.loads(pickle.dumps(work(*given, **named))))
        except BaseException as error:
            done.set_exception(error)
        return done


def fails(*counts: int, error: BaseException) -> Callable[[int], None]:
    """Before these batches."""

    def before(count: int) -> None:
        if count in counts:
            raise error

    return before


@pytest.mark.slow
def test_any_executor_finds_what_this_process_does(scene: Scene) -> None:
    told: list[tuple[int, int]] = []
    with ThreadPoolExecutor(2) as threads:
        scene.require_same_arcs(ol.extract(scene.room, scene.cameras, executor=threads))
    pickled = Pickled()
    found = ol.extract(scene.room, scene.cameras, executor=pickled, progress=lambda stage, *count: told.append(count))
    scene.require_same_arcs(found)
    assert pickled.count == 3 and told == [(2, 5), (4, 5), (5, 5)]
    # Names and options travel, not pixels.
    assert pickled.bytes < 20_000


@pytest.mark.slow
def test_models_fitted_by_workers_are_those_fitted_here() -> None:
    """One task a model and stage, equal to the last bit; what a worker cannot fit is said as here."""
    lens = OpenCVFisheye([320.0, 320.0, 645.0, 470.0, -0.05, 0.03, -0.02, 0.004], (1280, 960))
    corners = board_corners(lens, board_views(lens, 80, 6, 4), 0.1, 1)
    few = tuple(Candidate(*one) for one in (("opencv-fisheye", {}), ("scaramuzza", {"degree": 4})))
    pickled, told = Pickled(), []
    each = partial(
        one_by_one,
        stage="fitting",
        executor=pickled,
        noun="camera models",
        progress=lambda stage, *count: told.append((stage, *count)),
    )
    here, there = (
        select_model(corners, (1280, 960), candidates=few),
        select_model(corners, (1280, 960), candidates=few, each=each),
    )
    assert pickled.count == 4 and told == 2 * [("fitting", 1, 2), ("fitting", 2, 2)]
    assert there.chosen.candidate == here.chosen.candidate and there.reason == here.reason
    assert [trial.failure for trial in there.trials] == [trial.failure for trial in here.trials]
    np.testing.assert_array_equal([one.held_out_px for one in there.trials], [one.held_out_px for one in here.trials])
    np.testing.assert_array_equal(*(one.result.model.parameters.numpy() for one in (there, here)))
    pickled.before = fails(5, error=BrokenExecutor("a process was terminated abruptly"))
    with pytest.raises(InputError, match="The camera models opencv-fisheye to opencv-fisheye could not be worked on"):
        select_model(corners, (1280, 960), candidates=few, each=each)


@pytest.mark.full
def test_any_executor_calibrates_as_this_process_does(scene: Scene) -> None:
    pickled = Pickled()
    here, there = ol.detect(scene.board, PATTERN), ol.detect(scene.board, PATTERN, executor=pickled)
    np.testing.assert_array_equal(there.corners.pixels, here.corners.pixels)
    np.testing.assert_array_equal(there.corners.ids, here.corners.ids)
    # A photo whose corners were missed is searched again.
    fewer = here.updated({here.corners.images[1]: Detection.empty()})
    calibrated = [ol.calibrate(fewer, model="opencv-fisheye", executor=one) for one in (None, pickled)]
    np.testing.assert_array_equal(*(result.camera.parameters.numpy() for result in calibrated))
    assert pickled.count > 3 and all(view.used for view in calibrated[1].views)
    chosen = [ol.calibrate(here, model="auto", executor=one) for one in (None, pickled)]
    np.testing.assert_array_equal(*(result.camera.parameters.numpy() for result in chosen))
    assert chosen[0].warnings == chosen[1].warnings


def test_what_came_back_is_kept_where_a_worker_is_lost(scene: Scene, tmp_path: Path) -> None:
    """As much as one batch is done again."""
    lost = Pickled(fails(3, error=BrokenExecutor("a process was terminated abruptly")))
    with pytest.raises(InputError, match=r"view04.png to view04.png could not be worked on: BrokenExecutor. Workers that last"):
        ol.extract(scene.room, scene.cameras, executor=lost, work=tmp_path / "work")
    assert len(list((tmp_path / "work" / "arcs").glob("*.npz"))) == 4
    again = Pickled()
    scene.require_same_arcs(ol.extract(scene.room, scene.cameras, executor=again, work=tmp_path / "work"))
    assert again.count == 1


def test_arcs_compared_by_workers_make_the_same_tracks_and_a_lost_worker_costs_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hypotheses, "PHOTOS_A_TASK", 4)
    arcs = room("fisheye").arcs(0.3, 3)
    here = match_arcs(arcs, tolerance_px=0.3)
    tasks = -(-arcs.images // 4)
    assert tasks > 2
    for before, count in ((lambda count: None, tasks), (fails(2, error=MemoryError()), tasks + 1)):
        pickled = Pickled(before)
        found = match_arcs(arcs, tolerance_px=0.3, workers=matching_workers(pickled))
        assert pickled.count == count
        np.testing.assert_array_equal(found.tracks.track, here.tracks.track)
        np.testing.assert_array_equal(found.hypotheses.inverse_depth, here.hypotheses.inverse_depth)
        np.testing.assert_array_equal(found.tracks.lines.covariance.numpy(), here.tracks.lines.covariance.numpy())
    gone = matching_workers(Pickled(fails(3, error=BrokenExecutor("a process was terminated abruptly"))))
    with pytest.raises(InputError, match="tasks of matching 3 to 3 could not be worked on: BrokenExecutor"):
        match_arcs(arcs, tolerance_px=0.3, workers=gone)


def test_a_batch_whose_worker_has_no_disk_or_memory_left_is_tried_again_and_then_named(scene: Scene) -> None:
    full = OSError(28, "No space left on device")
    twice = Pickled(fails(1, 4, error=full))
    scene.require_same_arcs(ol.extract(scene.room, scene.cameras, executor=twice))
    assert twice.count == 5
    always = Pickled(fails(*range(1, 100), error=full))
    with pytest.raises(InputError, match=r"OSError, tried 3 times.*No space left on device.*give them more"):
        ol.extract(scene.room, scene.cameras, executor=always)
    with pytest.raises(ZeroDivisionError):
        ol.extract(scene.room, scene.cameras, executor=Pickled(fails(2, error=ZeroDivisionError())))


@pytest.mark.slow
def test_workers_that_cannot_see_a_photo_or_run_another_version_are_named(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "only-here").mkdir()
    for photo in scene.room.glob("*.png"):
        (tmp_path / "only-here" / photo.name).write_bytes(photo.read_bytes())
    elsewhere = Pickled(lambda count: (tmp_path / "only-here" / "view01.png").unlink(missing_ok=True))
    with pytest.raises(
        InputError, match=rf"on {socket.gethostname()} cannot see .*view01.png: expected a folder that all workers"
    ):
        ol.extract(tmp_path / "only-here", scene.cameras, executor=elsewhere)
    older = Pickled(lambda count: monkeypatch.setattr(batches, "revision", lambda *packages: "older"))
    with pytest.raises(InputError, match="found another version; install the same on both"):
        ol.extract(scene.room, scene.cameras, executor=older)
    for error in (ModuleNotFoundError("No module named 'omnilines'"), RuntimeError("Error during deserialization of the graph")):
        with pytest.raises(InputError, match=r"expected to have omnilines installed.*found one without"):
            ol.extract(scene.room, scene.cameras, executor=Pickled(fails(2, error=error)))
