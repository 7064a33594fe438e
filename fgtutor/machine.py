"""What the machine lets this process use, where a container or a batch system gives it less.

Reads the scheduler's affinity and the quotas of Linux's control groups, versions 1 and 2; gives a
number of cores. Sources: sched_getaffinity(2); the kernel's cgroup-v2 "cpu.max" and cgroup-v1
"cpu.cfs_quota_us".
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path


def usable_cores(root: Path = Path("/")) -> int:
    """Return how many cores this process can keep busy, at least 1.

    `root` is where the kernel's files are found, for tests.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    quota = min(_quotas(root), default=math.inf)
    return max(1, cores if quota >= cores else math.ceil(quota))


def _quotas(root: Path) -> Iterator[float]:
    """Yield every CPU quota above this process, in cores."""
    top = root / "sys/fs/cgroup"
    try:
        entries = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # no Linux
        return
    for entry in entries:
        _, controllers, path = entry.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        for mount in (top / controllers, top / ("cpu" if controllers else "unified")):
            # A container sees its own group at the mount, though its path may be the host's.
            group = mount / path.strip("/")
            for folder in (group, *group.parents):
                yield from _quota(folder)


def _quota(group: Path) -> Iterator[float]:
    """Yield a group's own quota, if it has one ("max" and -1 say that it has none)."""
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        try:
            quota, period = " ".join((group / name).read_text() for name in names).split()
            if float(quota) > 0:
                yield float(quota) / float(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue
