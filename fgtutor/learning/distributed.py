"""Training on several processes (torchrun): ranks, seeds and devices, and what is exchanged.

Reads the variables that torchrun sets; gives rsl_rl's runner for these processes. Each simulates
its own robots, with their curriculum, on its own ground; gradients are averaged, so that all hold
the same networks. With one process, everything here is the identity.
Source: rsl_rl's `OnPolicyRunner`, which does the same but insists on GPUs.
"""

import contextlib
import os
from collections.abc import Iterator
from typing import Any, TypeVar

# rsl_rl's logger imports GitPython, which otherwise refuses to load where git is not installed.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import torch
from rsl_rl.runners import OnPolicyRunner

from fgtutor.errors import ConfigError

T = TypeVar("T")
SEED_STRIDE = 1_000_003
"""Between the seeds of two processes: further apart than the seeds that a person tries."""


def processes() -> int:
    """Return how many processes train together."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def rank() -> int:
    """Return which of them this is, from 0."""
    return int(os.environ.get("RANK", "0")) if processes() > 1 else 0


def leads() -> bool:
    """Tell whether this is the process that writes files and shows progress."""
    return rank() == 0


def own_seed(seed: int) -> int:
    """Return this process's seed: its robots, its ground and its noise are its own."""
    return (seed + SEED_STRIDE * rank()) % 2**32


def own_device(device: str) -> str:
    """Return this process's device: of several GPUs on a machine, each takes one."""
    if processes() > 1 and device.startswith("cuda"):
        return f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    return device


def check_device(device: str) -> None:
    """Raise `ConfigError` if this machine has no such device."""
    gpus = [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    if device not in ("cpu", *gpus, *(["cuda"] if gpus else [])):
        raise ConfigError(
            f"there is no device {device} here: choose of {', '.join(('cpu', *gpus))}"
        )


def gather(value: T) -> list[T]:
    """Return this value of every process, in the order of their ranks."""
    if processes() == 1:
        return [value]
    values: list[Any] = [None] * processes()
    torch.distributed.all_gather_object(values, value)
    return values


def mean(row: dict[str, float]) -> dict[str, float]:
    """Return the mean of each number over all processes."""
    rows = gather(row)
    return {name: sum(r[name] for r in rows) / len(rows) for name in row}


class Runner(OnPolicyRunner):
    """rsl_rl's runner, also for processes without GPUs, which gloo joins instead of NCCL."""

    def _configure_multi_gpu(self) -> None:
        if processes() == 1 or self.device != "cpu":
            super()._configure_multi_gpu()
            return
        self.is_distributed, self.gpu_world_size = True, processes()
        self.gpu_local_rank = int(os.environ.get("LOCAL_RANK", "0"))
        self.gpu_global_rank = rank()
        self.cfg["multi_gpu"] = {
            "global_rank": self.gpu_global_rank,
            "local_rank": self.gpu_local_rank,
            "world_size": self.gpu_world_size,
        }
        torch.distributed.init_process_group("gloo")


@contextlib.contextmanager
def leave_at_end() -> Iterator[None]:
    """Part from the other processes at the end of the block, also after an error."""
    try:
        yield
    finally:
        if processes() > 1 and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
