"""Photos worked on by whatever workers there are: the cores of this process, or a pool or cluster of others.

One seam: an `executor` is any of `concurrent.futures`: threads, processes, Dask's `client.get_executor()`. What travels to it are
batches of names and options, and numbers back: each worker reads the photos of its batches itself. Workers run the same functions
as this process does, photo by photo, so that results are equal to the last bit whoever worked on them.
"""

import socket
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from queue import SimpleQueue
from typing import TypeVar

from camera_models import InputError
from omnilines.files import Photo, PhotoRef, photos_at_once
from omnilines.files.fingerprint import revision
from omnilines.progress import ProgressCallback, on_all_cores, one_torch_thread

T = TypeVar("T")
R = TypeVar("R")

BATCH = 25
"""Photos of a task: enough that sending it costs nothing beside the work, few enough that little is lost with a worker."""
TRIES = 3
"""Times that all batches whose workers had no disk or memory left fail again, one and all, before they are given up."""
NOT_READ = "during deserialization"
"""Says Dask where its scheduler, or a worker, does not know what it is sent."""
SOURCES = ("camera_models", "calib_patterns", "omnilines")


def look_at(
    work: Callable[[T], R],
    items: Sequence[T],
    photos: Sequence[Photo],
    stage: str,
    *,
    executor: Executor | None,
    bytes_per_pixel: int,
    progress: ProgressCallback,
    keep: Callable[[int, R], None] = lambda place, result: None,
) -> list[R]:
    """The results of `work` in the order of the items, each of which stands for one of the photos: on all cores of this process,
    one photo per core in memory, or by the workers of an executor, for which `work` and the items must be picklable.

    Each result is handed to `keep`, with its place, as soon as it is there. Raises what `work` raises, and
    InputError where a worker cannot see a photo, runs another omnilines, or could not work on a batch.
    """
    if executor is None:

        def here(place: int) -> R:
            """The result of one photo, in this process."""
            result = work(items[place])
            keep(place, result)
            return result

        return on_all_cores(here, range(len(items)), stage, progress, photos_at_once(photos, bytes_per_pixel))
    paths = [str(photo.path) if isinstance(photo, PhotoRef) else None for photo in photos]
    names = [photo.name for photo in photos]
    return _by_workers(
        work, items, names, stage, executor=executor, noun="photos", batch=BATCH, paths=paths, progress=progress, keep=keep
    )


def one_by_one(
    work: Callable[[T], R],
    items: Sequence[T],
    names: Sequence[str],
    stage: str,
    *,
    executor: Executor | None,
    noun: str,
    progress: ProgressCallback,
) -> list[R]:
    """The results of `work`, which needs no photo, in the order of the items: one after another in this process, or each a task
    of the workers of an executor. Results are equal: torch has one thread either way. Raises as `look_at`."""
    if executor is not None:
        return _by_workers(work, items, names, stage, executor=executor, noun=noun, batch=1, paths=(), progress=progress)
    found = []
    with one_torch_thread():
        for done, item in enumerate(items):
            progress(f"{stage} {names[done]}", done, len(items))
            found.append(work(item))
    return found


def _by_workers(
    work: Callable[[T], R],
    items: Sequence[T],
    names: Sequence[str],
    stage: str,
    *,
    executor: Executor,
    noun: str,
    batch: int,
    paths: Sequence[str | None],
    progress: ProgressCallback,
    keep: Callable[[int, R], None] = lambda place, result: None,
) -> list[R]:
    """The results of the workers, `batch` items a task; `noun` and `names` are what the items are called, `paths` those of files
    that workers have to see, by item."""
    found: dict[int, R] = {}
    waiting: dict[Future[list[R]], int] = {}
    done: SimpleQueue[Future[list[R]]] = SimpleQueue()
    round_of = 1

    def begin(first: int) -> None:
        """Hand a batch to a worker."""
        part = slice(first, first + batch)
        files = [path for path in paths[part] if path is not None]
        try:
            task = executor.submit(_of_batch, work, items[part], files, revision(*SOURCES), round_of)
        except BrokenExecutor as error:
            raise _lost(noun, names[part], error) from None
        waiting[task] = first
        task.add_done_callback(done.put)

    begun, fruitless = list(range(0, len(items), batch)), 0
    try:
        while begun:
            # A worker without disk fails at once and is free at once: what failed waits until all others are through.
            failed: dict[int, BaseException] = {}
            before = len(found)
            for first in begun:
                begin(first)
            while waiting:
                task = done.get()
                first = waiting.pop(task)
                try:
                    results = task.result()
                except (OSError, MemoryError) as error:
                    failed[first] = error
                    continue
                except _worker_died() as error:
                    raise _lost(noun, names[first : first + batch], error) from None
                except (ImportError, RuntimeError) as error:
                    if isinstance(error, ImportError) or NOT_READ in str(error):
                        raise _not_installed(error) from None
                    raise
                for place, result in enumerate(results, first):
                    found[place] = result
                    keep(place, result)
                progress(stage, len(found), len(items))
            fruitless = fruitless + 1 if len(found) == before else 0
            round_of, begun = round_of + 1, list(failed)
            if begun and fruitless == TRIES:
                first = begun[0]
                raise _lost(noun, names[first : first + batch], failed[first], TRIES)
    finally:
        # After an error, or where the user stops it, what has not begun does not begin.
        for task in waiting:
            task.cancel()
    return [found[place] for place in range(len(items))]


def _of_batch(work: Callable[[T], R], items: Sequence[T], paths: Sequence[str], made_by: str, turn: int) -> list[R]:
    """On a worker: the results of one batch. `turn` tells a repeated batch from the first to engines that remember results."""
    here = f"The worker on {socket.gethostname()}"
    if revision(*SOURCES) != made_by:
        raise InputError(
            f"{here} was expected to run the same omnilines as this process, found another version; install the same on both."
        )
    for path in paths:
        try:
            with open(path, "rb"):
                pass
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            raise InputError(
                f"{here} cannot see the photo {path}: expected a folder that all workers share; put the photos in one, or work "
                "without `cluster`."
            ) from None
    with one_torch_thread():
        return [work(item) for item in items]


def _worker_died() -> tuple[type[BaseException], ...]:
    """What executors raise where a worker is gone for good. Dask has tried again by itself by then."""
    distributed = sys.modules.get("distributed")
    return (BrokenExecutor, CancelledError, *(() if distributed is None else (distributed.KilledWorker,)))


def _not_installed(error: BaseException) -> InputError:
    why = " ".join(str(error.__cause__ or error).split())[:200]
    return InputError(
        f"Scheduler and workers were expected to have omnilines installed, the same as this process, found one without ({why}); "
        "install it there."
    )


def _lost(noun: str, names: Sequence[str], error: BaseException, turn: int = 1) -> InputError:
    times = "" if turn == 1 else f", tried {turn} times"
    why = " ".join(str(error).split()) or "no reason given"
    smaller = ", or make `partition` smaller" if noun == "parts" else ""
    return InputError(
        f"The {noun} {names[0]} to {names[-1]} could not be worked on: {type(error).__name__}{times}. Workers that "
        f"last were expected, found one that ended or lacks memory or disk ({why}); give them more, or use fewer at a "
        f"time{smaller}."
    )
