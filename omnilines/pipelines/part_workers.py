"""Parts of a scene adjusted by the workers of an executor, the same that photos are handed to (`batches.py`)."""

import shutil
import socket
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from camera_models import InputError
from omnilines.adjustment.parts import require_divisible, why_in_one_piece
from omnilines.adjustment.parts_engine import PARTS, Workers, here
from omnilines.files.fingerprint import revision
from omnilines.files.folders import work_folder
from omnilines.pipelines.batches import SOURCES, TRIES, worker_died
from omnilines.pipelines.options import SceneOptions
from omnilines.progress import one_torch_thread

T = TypeVar("T")
R = TypeVar("R")


def part_workers(executor: Executor | None, work: str | Path | None) -> Workers:
    """Workers of an executor, or this process; parts lie in the folder `work`, where one is given, else in a temporary one.

    Parts that a run which was killed has left there are removed.
    """
    folder = None if work is None else work_folder(work)
    for left in () if folder is None else folder.glob(f"{PARTS}*"):
        shutil.rmtree(left, ignore_errors=True)
    return Workers(here if executor is None else _Each(executor), folder)


def check_partition(options: SceneOptions, *, rig: bool, prior: bool = False) -> None:
    """Raises InputError for a `partition` of what is adjusted in one piece only."""
    poses, cameras = "poses" in options.refine, "intrinsics" in options.refine
    whole = why_in_one_piece(cost=options.cost, poses=poses, cameras=cameras, rig=rig, prior=prior, device=options.device)
    require_divisible(options.partition, whole)


@dataclass(frozen=True)
class _Each:
    """Hands every item to a worker."""

    executor: Executor

    def __call__(self, work: Callable[[T], R], items: Sequence[T], /) -> list[R]:
        """The results in order. Raises InputError where a worker cannot see the parts, runs another omnilines or is lost."""
        tasks: list[Future[R]] = []
        try:
            tasks.extend(self._begun(work, item, 1) for item in items)
            return [self._result(task, work, item) for task, item in zip(tasks, items, strict=True)]
        finally:
            # After an error, or where the user stops it, what has not begun does not begin.
            for task in tasks:
                task.cancel()

    def _begun(self, work: Callable[[T], R], item: T, turn: int) -> "Future[R]":
        try:
            return self.executor.submit(_on_worker, work, item, revision(*SOURCES), turn)
        except BrokenExecutor as error:
            raise _lost(error, turn) from None

    def _result(self, task: "Future[R]", work: Callable[[T], R], item: T) -> R:
        for turn in range(1, TRIES + 1):
            try:
                return task.result()
            except (OSError, MemoryError) as error:
                if turn == TRIES:
                    raise _lost(error, turn) from None
                task = self._begun(work, item, turn + 1)
            except worker_died() as error:
                raise _lost(error, turn) from None
        raise AssertionError("the last turn returns or raises")


def _on_worker(work: Callable[[T], R], item: T, made_by: str, turn: int) -> R:
    """On a worker. `turn` tells a repeated task from the first to engines that remember results."""
    here_ = f"The worker on {socket.gethostname()}"
    if revision(*SOURCES) != made_by:
        raise InputError(
            f"{here_} was expected to run the same omnilines as this process, found another version; install the same on both."
        )
    try:
        with one_torch_thread():
            return work(item)
    except FileNotFoundError as error:
        raise InputError(
            f"{here_} cannot see the part {error.filename}: expected a folder that all workers share; write to one, or work "
            "without `cluster`."
        ) from None


def _lost(error: BaseException, turn: int) -> InputError:
    times = "" if turn == 1 else f", tried {turn} times"
    why = " ".join(str(error).split()) or "no reason given"
    return InputError(
        f"A part of the scene could not be adjusted: {type(error).__name__}{times}. Workers that last were expected, found one "
        f"that ended or lacks memory or disk ({why}); give them more, or make `partition` smaller."
    )
