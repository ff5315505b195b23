"""Where photos are worked on: in this process, or by the workers of a Dask scheduler (`pip install 'omnilines[cluster]'`).

with workers("local") as executor:      # processes of this machine, one for each core
with workers("10.0.0.5:8786") as executor:      # those of a scheduler that runs already
"""

import logging
import re
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from camera_models import InputError
from omnilines.machine import POOLS, THREADS, cores
from omnilines.progress import ProgressCallback, silent

LOCAL = "local"
ANSWER_S, WORKER_S = 30, 60
"""How long a scheduler has to answer, and the first worker to come."""
MORE_TRIES = 2
"""Times that a batch is worked on again of which a worker died."""


@contextmanager
def workers(where: str | None, *, progress: ProgressCallback = silent, wait_s: float = WORKER_S) -> Iterator[Executor | None]:
    """What works on photos within it: `local`, or HOST:PORT of a scheduler; None stands for the cores of this process.

    Raises InputError where Dask is missing, the scheduler does not answer within ANSWER_S, or no worker comes within `wait_s`.
    """
    if where is None:
        yield None
        return
    address = where if where == LOCAL else _address(where)
    distributed = _distributed()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if where == LOCAL:
        progress("starting workers", 0, 0)
        with _on_this_machine(distributed) as cluster, distributed.Client(cluster) as client:
            yield client.get_executor(pure=False)
        return
    progress("waiting for workers", 0, 0)
    try:
        client = distributed.Client(address, timeout=ANSWER_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"A Dask scheduler was expected at {where}, found none that answers within {ANSWER_S} seconds "
            f"({type(error).__name__}); start one with `dask scheduler`, or check host and port."
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=wait_s)
        except TimeoutError:
            raise InputError(
                f"A worker was expected at the scheduler {where}, none came within {wait_s:g} seconds; start workers with "
                f"`dask worker {where} --nthreads 1`."
            ) from None
        yield client.get_executor(pure=False)


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

    each = {name: "1" for name in (THREADS, *POOLS)}
    settings = {"distributed.scheduler.allowed-failures": MORE_TRIES, "distributed.nanny.pre-spawn-environ": each}
    with (
        dask.config.set(settings),
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


def _address(where: str) -> str:
    """The address of a scheduler. Raises InputError where it is none."""
    if not re.fullmatch(r"((tcp|tls)://)?(\[[0-9a-fA-F:]+\]|[\w.-]+):\d{1,5}", where):
        raise InputError(
            f"`cluster` was expected as {LOCAL} or HOST:PORT of a Dask scheduler, such as 10.0.0.5:8786, found '{where[:80]}'."
        )
    return where if "://" in where else f"tcp://{where}"
