"""The processes that share an evaluation."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch.distributed as dist

__all__ = ["Workers", "workers"]


@dataclass(frozen=True)
class Workers:
    """This process is number ``rank`` of ``size``."""

    rank: int = 0
    size: int = 1

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def workers() -> Iterator[Workers]:
    """The processes that ``torchrun`` started, joined through gloo; this one alone without it.

    Example:
        >>> with workers() as group:
        ...     group.rank, group.size
        (0, 1)
    """
    if not (dist.is_available() and dist.is_torchelastic_launched()):
        yield Workers()
        return
    # Shares differ in cost, and the first to finish waits for the last.
    dist.init_process_group("gloo", timeout=timedelta(days=7))
    try:
        yield Workers(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
