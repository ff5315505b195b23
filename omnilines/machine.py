"""What the process may take of the machine: cores and memory, also in a container that was given a part of them."""

import math
import os
from pathlib import Path

CONTROL_GROUP = Path("/sys/fs/cgroup")


def cores() -> int:
    """Cores that the process may run on: of the machine, of its affinity (`taskset`) and of its control group's quota."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = _said(CONTROL_GROUP / "cpu.max").partition(" ")
    if quota.isdigit() and period.isdigit() and int(period) > 0:
        found = min(found, math.ceil(int(quota) / int(period)))
    return max(1, found)


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
