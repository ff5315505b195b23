"""Workers as jobs of Slurm, by dask-jobqueue: `slurm`, or `slurm:jobs=10,queue=long,account=me,walltime=2:00:00,memory=4GB`.

What is not said is as Dask's own configuration has it (`jobqueue.slurm`): network interfaces, local disks, further directives.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from camera_models import InputError
from omnilines.machine import POOLS, THREADS

SLURM = "slurm"
SUBMIT = "sbatch"
KEYS = {
    "jobs": r"[1-9]\d{0,4}",
    "queue": r"[\w.@+-]+",
    "account": r"[\w.@+-]+",
    "walltime": r"\d+(-\d+)?(:\d+){0,2}",
    "cores": r"[1-9]\d{0,3}",
    "memory": r"\d+(\.\d+)?[KMGT]i?B",
    "wait": r"\d+(s|m|h)",
}
"""What may be said of the jobs, and how each is written."""
SECONDS = {"s": 1, "m": 60, "h": 3600}


@dataclass(frozen=True)
class SlurmJobs:
    """Which jobs are asked for."""

    jobs: int = 4
    """Number of jobs, as many at once as the queue lets run."""
    queue: str | None = None
    """The partition."""
    account: str | None = None
    """Who pays."""
    walltime: str | None = None
    """How long a job may run, as Slurm writes it; one that ends is followed by another."""
    cores: int | None = None
    """Of a job, each a process of one thread; unless Dask's configuration says, 1."""
    memory: str | None = None
    """Of a job; unless Dask's configuration says, 4 GB for each core."""
    wait_s: float = 3600.0
    """How long the first job may stand in the queue."""

    @staticmethod
    def of(text: str) -> "SlurmJobs":
        """From `slurm` or `slurm:KEY=VALUE,...`. Raises InputError where a key or value is none, or is given twice."""
        parts = [part.partition("=") for part in text.removeprefix(SLURM).removeprefix(":").split(",") if part]
        given = {key: value for key, _, value in parts}
        wrong = [key for key, value in given.items() if key not in KEYS or not re.fullmatch(KEYS[key], value)]
        if wrong or len(given) < len(parts):
            raise InputError(
                "`cluster` was expected as slurm:jobs=10,queue=long,account=me,walltime=2:00:00,cores=8,memory=16GB,wait=2h, "
                f"each of these once or not at all, found '{text[:80]}'; correct {wrong[0] if wrong else 'what is given twice'}."
            )
        wait, said = (
            given.pop("wait", None),
            {key: given[key] for key in ("queue", "account", "walltime", "memory") if key in given},
        )
        counts = {key: int(given[key]) for key in ("jobs", "cores") if key in given}
        seconds = {} if wait is None else {"wait_s": float(wait[:-1]) * SECONDS[wait[-1]]}
        return SlurmJobs(**said, **counts, **seconds)  # type: ignore[arg-type]


def is_slurm(where: str) -> bool:
    """Whether that names Slurm, and not the port of a host that is called so."""
    return where == SLURM or (where.startswith(f"{SLURM}:") and not re.fullmatch(r"\d+", where.removeprefix(f"{SLURM}:")))


@contextmanager
def slurm_cluster(asked: SlurmJobs) -> Iterator[Any]:
    """A Dask scheduler in this process and workers in jobs, which end with it.

    Raises InputError where dask-jobqueue or Slurm is missing, or Slurm refuses such a job.
    """
    if shutil.which(SUBMIT) is None:
        raise InputError(
            f"Slurm was expected on this machine, found no {SUBMIT} on the PATH; run this where jobs are submitted, or give "
            "HOST:PORT of a Dask scheduler."
        )
    jobqueue = _jobqueue()
    import dask

    own = {key: dask.config.get(f"jobqueue.slurm.{key}", None) for key in ("cores", "memory", "processes")}
    cores = asked.cores or own["cores"] or 1
    prologue = dask.config.get("jobqueue.slurm.job-script-prologue", None) or []
    options = {"dashboard_address": ":0", **(dask.config.get("jobqueue.slurm.scheduler-options", None) or {})}
    with jobqueue.SLURMCluster(
        queue=asked.queue,
        account=asked.account,
        walltime=asked.walltime,
        cores=cores,
        processes=cores,
        memory=asked.memory or own["memory"] or f"{4 * cores}GB",
        job_script_prologue=[*prologue, *(f"export {name}=1" for name in (THREADS, *POOLS))],
        scheduler_options=options,
    ) as cluster:
        _require_accepted(cluster.job_script())
        # Adaptive, though between equal numbers: a job whose time has run out is followed by another.
        cluster.adapt(minimum_jobs=asked.jobs, maximum_jobs=asked.jobs)
        yield cluster


def _require_accepted(script: str) -> None:
    """Raises InputError with what Slurm says where it would not take the job. Nothing is submitted."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "job.sh"
        path.write_text(script)
        said = subprocess.run([SUBMIT, "--test-only", str(path)], capture_output=True, text=True, check=False)
    if said.returncode:
        why = " ".join((said.stderr or said.stdout).split())[:300] or f"status {said.returncode}"
        raise InputError(
            f"Slurm was expected to take a job, found that {SUBMIT} refuses it ({why}); correct queue, account, walltime, cores "
            "or memory after slurm:."
        )


def _jobqueue() -> ModuleType:
    try:
        import dask_jobqueue
    except ImportError:
        raise InputError(
            "`cluster` was expected with dask-jobqueue installed, found none; run pip install 'omnilines[cluster]'."
        ) from None
    return dask_jobqueue
