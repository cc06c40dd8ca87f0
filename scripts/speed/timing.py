"""Paired timing of functions of images."""

import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def least_times(
    functions: Sequence[Callable[[], object]], rounds: int, seconds: float, device: str = "cpu"
) -> list[float]:
    """Least time in s of each function, on a CPU that of the processor, on a GPU until it has
    finished; the functions run in turn, so that all meet the same conditions."""
    repeats = []
    for function in functions:
        function()
        repeats.append(max(1, int(seconds / max(_mean_time(function, 1, device), 1e-6))))
    least = [math.inf] * len(functions)
    for _ in range(rounds):
        for k, (function, count) in enumerate(zip(functions, repeats, strict=True)):
            least[k] = min(least[k], _mean_time(function, count, device))
    return least


def _mean_time(function: Callable[[], object], count: int, device: str) -> float:
    on_gpu = device != "cpu"
    clock = time.perf_counter if on_gpu else time.process_time
    if on_gpu:
        torch.cuda.synchronize()
    start = clock()
    for _ in range(count):
        function()
    if on_gpu:
        torch.cuda.synchronize()
    return (clock() - start) / count


def forward(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with torch.no_grad():
        return function(x)


def backward(function: Callable[[Tensor], Tensor], x: Tensor) -> None:
    x.grad = None
    function(x).square().sum().backward()
