"""What workers of an executor do beside looking at photos (`batches.py`): they compare arcs, and adjust parts of a scene."""

import shutil
import socket
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from camera_models import InputError
from omnilines.adjustment.parts import require_divisible, why_in_one_piece
from omnilines.adjustment.parts_engine import PARTS, Workers, here
from omnilines.files.folders import work_folder
from omnilines.pipelines.batches import one_by_one
from omnilines.pipelines.options import SceneOptions
from omnilines.progress import Each, silent

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


def matching_workers(executor: Executor | None) -> Each | None:
    """Workers of an executor, for arcs that are compared; None where there are none, and all cores do it."""
    return None if executor is None else _Each(executor, "matching arcs", "tasks of matching")


def check_partition(options: SceneOptions, *, rig: bool, prior: bool = False) -> None:
    """Raises InputError for a `partition` of what is adjusted in one piece only."""
    poses, cameras = "poses" in options.refine, "intrinsics" in options.refine
    whole = why_in_one_piece(cost=options.cost, poses=poses, cameras=cameras, rig=rig, prior=prior, device=options.device)
    require_divisible(options.partition, whole)


@dataclass(frozen=True)
class _Each:
    """Hands every item to a worker."""

    executor: Executor
    stage: str = "adjusting parts"
    noun: str = "parts"

    def __call__(self, work: Callable[[T], R], items: Sequence[T], /) -> list[R]:
        """The results in order. Raises InputError where a worker cannot see the parts, runs another omnilines or is lost."""
        names = [str(number) for number in range(1, len(items) + 1)]
        return one_by_one(_Reading(work), items, names, self.stage, executor=self.executor, noun=self.noun, progress=silent)


@dataclass(frozen=True)
class _Reading(Generic[T, R]):
    """Work with parts that lie in files."""

    work: Callable[[T], R]

    def __call__(self, item: T) -> R:
        """The result. Raises InputError where this worker does not see the part."""
        try:
            return self.work(item)
        except FileNotFoundError as error:
            raise InputError(
                f"The worker on {socket.gethostname()} cannot see the part {error.filename}: expected a folder that all workers "
                "share; write to one, or work without `cluster`."
            ) from None
