"""The processes that share an evaluation or a list."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch.distributed as dist

from ..errors import InvalidInputError

__all__ = ["Workers", "run_processes", "workers"]

T = TypeVar("T")


@dataclass(frozen=True)
class Workers:
    """This process is number ``rank`` of ``size``; ``joined``: they can wait for each other."""

    rank: int = 0
    size: int = 1
    joined: bool = False

    @property
    def leads(self) -> bool:
        """Whether this process merges the store when all are done."""
        return self.rank == 0 and (self.joined or self.size == 1)

    @property
    def reports(self) -> bool:
        """Whether this process prepares the store and writes the tables once it is complete; in a job array each."""
        return self.leads or not self.joined

    def wait(self) -> None:
        """Wait for all processes; a job array does not."""
        if self.joined:
            dist.barrier()

    def part(self, items: Sequence[T]) -> Sequence[T]:
        """The items of this process: neighbours stay together."""
        n = len(items)
        return items[self.rank * n // self.size : (self.rank + 1) * n // self.size]


@contextmanager
def workers() -> Iterator[Workers]:
    """The processes that ``torchrun`` started, joined; without it those of a job array, or this one alone.

    A job array sets ``RANK``, from 0, and ``WORLD_SIZE``; its processes need not run at the same time.

    Raises:
        InvalidInputError: ``RANK`` or ``WORLD_SIZE`` out of range.

    Example:
        >>> with workers() as group:
        ...     group.rank, group.size
        (0, 1)
    """
    if not (dist.is_available() and dist.is_torchelastic_launched()):
        rank, size = os.environ.get("RANK", "0"), os.environ.get("WORLD_SIZE", "1")
        if not (rank.isdecimal() and size.isdecimal() and int(rank) < int(size)):
            raise InvalidInputError(f"RANK, WORLD_SIZE: expected 0 <= RANK < WORLD_SIZE, got {rank!r} and {size!r}")
        yield Workers(int(rank), int(size))
        return
    # Parts differ in cost, and the first process to finish waits for the last.
    dist.init_process_group("gloo", timeout=timedelta(days=7))
    try:
        yield Workers(dist.get_rank(), dist.get_world_size(), joined=True)
    finally:
        dist.destroy_process_group()


def run_processes(count: int, words: Sequence[str]) -> bool:
    """Run ``curvireg WORDS`` in ``count`` processes; False if ``count`` is 1, or this is one of those processes.

    Raises:
        InvalidInputError: a process failed.
    """
    if count <= 1 or "TORCHELASTIC_RUN_ID" in os.environ:
        return False
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    environment = {"OMP_NUM_THREADS": "1", **os.environ}
    done = subprocess.run([*torchrun, "-m", "curvireg_torch", *words], env=environment, check=False)
    if done.returncode:
        raise InvalidInputError(f"--jobs: a process ended with {done.returncode}; its message is above")
    return True
