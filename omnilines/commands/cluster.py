"""Where photos are worked on: in this process, or by the workers of a Dask scheduler (`pip install 'omnilines[cluster]'`).

with workers("local") as executor:      # processes of this machine, one for each core
with workers("10.0.0.5:8786") as executor:      # those of a scheduler that runs already
with workers("slurm:jobs=10") as executor:      # jobs of Slurm (`slurm.py`)
"""

import logging
import re
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager
from types import ModuleType
from typing import Any

from camera_models import InputError
from omnilines.commands.slurm import SLURM, SlurmJobs, is_slurm, slurm_cluster
from omnilines.machine import POOLS, THREADS, cores
from omnilines.progress import ProgressCallback, silent

LOCAL = "local"
ANSWER_S, WORKER_S = 30, 60
"""How long a scheduler has to answer, and the first worker to come."""
MORE_TRIES = 2
"""Times that a batch is worked on again of which a worker died."""

LARGE_TASK = "1GB"
"""What Dask sends without a warning."""


@contextmanager
def workers(where: str | None, *, progress: ProgressCallback = silent, wait_s: float = WORKER_S) -> Iterator[Executor | None]:
    """What works on photos within it: `local`, HOST:PORT of a scheduler, or `slurm`; None stands for the cores of this process.

    Raises InputError where Dask or Slurm is missing, the scheduler does not answer within ANSWER_S, or no worker comes within
    `wait_s`, of Slurm within what it is told.
    """
    if where is None:
        yield None
        return
    jobs = SlurmJobs.of(where) if is_slurm(where) else None
    address = where if where == LOCAL or jobs is not None else _address(where)
    distributed = _distributed()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if where == LOCAL:
        progress("starting workers", 0, 0)
        with _on_this_machine(distributed) as cluster, distributed.Client(cluster) as client:
            yield client.get_executor(pure=False)
        return
    progress("waiting for workers", 0, 0)
    if jobs is not None:
        with _settings(), slurm_cluster(jobs) as cluster, distributed.Client(cluster) as client:
            look = "look at `squeue` and at the slurm-*.out of the jobs, or wait longer with wait=2h after slurm:"
            _wait(client, "of Slurm", jobs.wait_s, look)
            yield client.get_executor(pure=False)
        return
    client = _client(distributed, str(address), where)
    with _settings(), client:
        _wait(client, f"at the scheduler {where}", wait_s, f"start workers with `dask worker {where} --nthreads 1`")
        yield client.get_executor(pure=False)


def _client(distributed: ModuleType, address: str, where: str) -> Any:
    """Of the scheduler there. It is made in a thread that is left alone where nothing comes of it: Dask waits without end for a
    server that takes the connection and says nothing. Raises InputError where no scheduler answers."""
    made: Future[Any] = Future()

    def make() -> None:
        try:
            made.set_result(distributed.Client(address, timeout=ANSWER_S))
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=make, daemon=True).start()
    try:
        return made.result(2 * ANSWER_S)
    except Exception as error:  # whatever a server of another kind says is read as lengths and messages
        raise InputError(
            f"A Dask scheduler was expected at {where}, found none that answers as one within {ANSWER_S} seconds "
            f"({type(error).__name__}); start one with `dask scheduler`, or check host and port."
        ) from None


def _wait(client: Any, whose: str, wait_s: float, advice: str) -> None:
    """Until the first worker is there. Raises InputError where none comes."""
    try:
        client.wait_for_workers(1, timeout=wait_s)
    except TimeoutError:
        raise InputError(f"A worker was expected {whose}, none came within {wait_s:g} seconds; {advice}.") from None


def _distributed() -> ModuleType:
    try:
        import distributed
    except ImportError:
        raise InputError(
            "`cluster` was expected with Dask installed, found none; run pip install 'omnilines[cluster]'."
        ) from None
    return distributed


@contextmanager
def _on_this_machine(distributed: ModuleType) -> Iterator[Any]:
    """A scheduler and a process of one thread for each core, which listen on this machine only."""
    import dask

    with (
        _settings(),
        dask.config.set({"distributed.nanny.pre-spawn-environ": {name: "1" for name in (THREADS, *POOLS)}}),
        distributed.LocalCluster(
            n_workers=cores(),
            threads_per_worker=1,
            host="127.0.0.1",
            # Any free port: Dask's own, which another scheduler may have, brings a warning.
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


def _settings() -> AbstractContextManager[Any]:
    """Of a scheduler in this process, and of what is sent: tasks of photos full of edges hold more than Dask warns of."""
    import dask

    set_to = {"distributed.scheduler.allowed-failures": MORE_TRIES, "distributed.admin.large-graph-warning-threshold": LARGE_TASK}
    settings: AbstractContextManager[Any] = dask.config.set(set_to)
    return settings


def _address(where: str) -> str:
    """The address of a scheduler. Raises InputError where it is none."""
    if not re.fullmatch(r"((tcp|tls)://)?(\[[0-9a-fA-F:]+\]|[\w.-]+):\d{1,5}", where):
        raise InputError(
            f"`cluster` was expected as {LOCAL}, {SLURM} or HOST:PORT of a Dask scheduler, such as 10.0.0.5:8786, found "
            f"'{where[:80]}'."
        )
    return where if "://" in where else f"tcp://{where}"
