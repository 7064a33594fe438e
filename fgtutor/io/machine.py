"""Cores and memory that this process may use, also within a container or a batch job.

Reads the scheduler's affinity, free memory, and the limits of Linux's control groups, versions 1
and 2; gives a number of cores and of bytes, and holds torch to one thread. Sources:
sched_getaffinity(2); the kernel's cgroup-v2 "cpu.max" and "memory.max", and cgroup-v1
"cpu.cfs_quota_us" and "memory.limit_in_bytes".
"""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fgtutor.errors import TooLargeError

ALWAYS_LEFT = 2**28
"""Bytes that any machine has left; for fewer, nothing is read (a confined process may not)."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute in one thread: on a busy core more mostly wait, and sums round alike."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def usable_cores(root: Path = Path("/")) -> int:
    """Return how many cores this process can keep busy, at least 1.

    `root` is where the kernel's files are found, for tests.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    quotas = (quota for group in _groups(root, "cpu") for quota in _quota(group))
    quota = min(quotas, default=math.inf)
    return max(1, cores if quota >= cores else math.ceil(quota))


def available_memory(root: Path = Path("/")) -> int:
    """Return how many bytes this process can still take, by the system, its groups and `ulimit`.

    `root` is where the kernel's files are found, for tests.
    """
    import psutil  # here: a browser has none, nor asks

    rooms = [psutil.virtual_memory().available]
    rooms += [room for group in _groups(root, "memory") for room in _room(group)]
    with suppress(ImportError):  # Windows has no such limits
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            rooms.append(limit - psutil.Process().memory_info().vms)
    return max(0, min(rooms))


def require_memory(needed: float, what: str, cure: str, *, fits: bool = True) -> None:
    """Raise `TooLargeError` if `what` needs more bytes than are left, before it takes them.

    Linux kills a process that takes too much without a word. `fits` says that nothing else forbids
    the size.
    """
    if needed < ALWAYS_LEFT and fits:
        return
    left = available_memory()
    if needed > left or not fits:
        raise TooLargeError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory, and {left / 1e9:.3g} GB are left"
            f"{'' if fits else '; it is too large for the search too'}: {cure}"
        )


def _groups(root: Path, controller: str) -> Iterator[Path]:
    """Yield the folder of every control group above this process that may limit something."""
    top = root / "sys/fs/cgroup"
    try:
        entries = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # no Linux
        return
    for entry in entries:
        _, controllers, path = entry.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        for mount in (top / controllers, top / (controller if controllers else "unified")):
            # A container sees its own group at the mount, though its path may be the host's.
            group = mount / path.strip("/")
            yield from (group, *group.parents)


def _room(group: Path) -> Iterator[int]:
    """Yield the bytes that a group may still take, if it has a limit; its file cache gives way."""
    for limit, usage, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            room = int((group / limit).read_text()) - int((group / usage).read_text())
            stat = (group / "memory.stat").read_text()
            yield room + int(dict(line.split() for line in stat.splitlines())[cache])
        except (OSError, ValueError, KeyError):  # "max" says that there is none
            continue


def _quota(group: Path) -> Iterator[float]:
    """Yield a group's own quota, if it has one ("max" and -1 say that it has none)."""
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        try:
            quota, period = " ".join((group / name).read_text() for name in names).split()
            if float(quota) > 0:
                yield float(quota) / float(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue
