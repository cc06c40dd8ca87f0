"""Measurements that are stored part by part: an interrupted run goes on where it was."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from scripts._shared import write_json


@dataclass(frozen=True)
class Part:
    """What is measured and stored together, such as the photographs of one mesh.

    Attributes:
        path: of its record; a name of its own for each request.
        arguments: of the function that measures, which returns a JSON value.
        size: number of photographs.
    """

    path: Path
    arguments: tuple[Any, ...]
    size: int


def complete(
    parts: Sequence[Part], measure: Callable[..., Any], *, label: str, jobs: int, quiet: bool
) -> None:
    """Measure the parts without a record in ``jobs`` processes, and store each when it is known."""
    missing = [part for part in parts if not part.path.exists()]
    total = sum(part.size for part in parts)
    done = total - sum(part.size for part in missing)
    if not missing:
        return
    columns = zip(*(part.arguments for part in missing), strict=True)
    with tqdm(total=total, initial=done, desc=label, unit="photo", disable=quiet) as bar:
        if jobs == 1 or len(missing) < 2:
            _store(missing, map(measure, *columns), bar)
            return
        one_thread = {"initializer": torch.set_num_threads, "initargs": (1,)}
        with ProcessPoolExecutor(jobs, get_context("spawn"), **one_thread) as pool:
            _store(missing, pool.map(measure, *columns), bar)


def _store(parts: Sequence[Part], records: Any, bar: "tqdm[Any]") -> None:
    for part, record in zip(parts, records, strict=True):
        write_json(part.path, finite(record), indent=0)
        bar.update(part.size)


def read(part: Part) -> Any:
    """The record of a part."""
    return json.loads(part.path.read_text(encoding="utf-8"))


def finite(value: Any) -> Any:
    """The same with None in place of what JSON has no number for."""
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and value - value != 0.0 else value
