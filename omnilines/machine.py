"""What the process may take of the machine: cores and memory, also in a container that was given a part of them."""

import math
import os
import sys
from pathlib import Path

CONTROL_GROUP = Path("/sys/fs/cgroup")
THREADS = "OMNILINES_THREADS"
"""The most cores that may be used, where it is set."""
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""How torch, the linear algebra of NumPy and SciPy, and OpenCV are told a number of threads before they are imported."""

WAITING = "OMP_WAIT_POLICY"
"""Whether threads of torch sleep while they wait for each other."""


def cores() -> int:
    """Cores that the process may run on: of the machine, of its affinity (`taskset`), of its control group's quota and of
    OMNILINES_THREADS."""
    found = _seen()
    quota, _, period = _said(CONTROL_GROUP / "cpu.max").partition(" ")
    if quota.isdigit() and period.isdigit() and int(period) > 0:
        found = min(found, math.ceil(int(quota) / int(period)))
    wanted = os.environ.get(THREADS, "")
    if wanted.isascii() and wanted.isdigit() and int(wanted) > 0:
        found = min(found, int(wanted))
    return max(1, found)


def _seen() -> int:
    """Cores that the system shows the process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def agree_on_threads(wanted: int | None = None) -> None:
    """All pools of threads of this process, and of those that it starts, get one number: `wanted`, at most `cores()`.

    Torch's threads sleep while they wait, unless the user has set OMP_WAIT_POLICY.

    To be called before torch, NumPy and OpenCV are imported, which read the environment then; where torch and OpenCV are there
    already they are told. Without `wanted` that is done where the process may use fewer cores than it sees (a container's
    quota), which these pools do not ask for, and numbers that the user has set stay as they are.
    """
    # Torch's threads would turn in a loop between two products, each on a core that others could use.
    os.environ.setdefault(WAITING, "PASSIVE")
    if wanted is None and (any(os.environ.get(name) for name in POOLS) or cores() == _seen()):
        return
    if wanted is not None:
        os.environ[THREADS] = str(wanted)
    number = cores()
    os.environ.update(dict.fromkeys(POOLS, str(number)))
    if wanted is not None and "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(number)
    if wanted is not None and "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(number)


def available_bytes() -> int | None:
    """Memory that can still be taken: of the machine and of the control group the process runs in; None where nobody says."""
    found = []
    rows = dict(line.split(":", 1) for line in _said(Path("/proc/meminfo")).splitlines() if ":" in line)
    if "MemAvailable" in rows:
        found.append(1024 * int(rows["MemAvailable"].split()[0]))
    elif hasattr(os, "sysconf") and {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= set(os.sysconf_names):
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    limit, used = (_said(CONTROL_GROUP / name) for name in ("memory.max", "memory.current"))
    if limit.isdigit() and used.isdigit():
        found.append(max(0, int(limit) - int(used)))
    return min(found) if found else None


def _said(path: Path) -> str:
    """What a file of the system says; nothing where there is none."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""
