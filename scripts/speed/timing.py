"""Paired timing of functions of images."""

import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def least_times(functions: Sequence[Callable[[], object]], rounds: int, seconds: float) -> list[float]:
    """Least processor time in s of each function; the functions run in turn, so that all meet the same conditions."""
    repeats = []
    for function in functions:
        function()
        start = time.process_time()
        function()
        repeats.append(max(1, int(seconds / max(time.process_time() - start, 1e-6))))
    least = [math.inf] * len(functions)
    for _ in range(rounds):
        for k, (function, count) in enumerate(zip(functions, repeats, strict=True)):
            start = time.process_time()
            for _ in range(count):
                function()
            least[k] = min(least[k], (time.process_time() - start) / count)
    return least


def forward(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with torch.no_grad():
        return function(x)


def backward(function: Callable[[Tensor], Tensor], x: Tensor) -> None:
    x.grad = None
    function(x).square().sum().backward()
