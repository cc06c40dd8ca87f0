from .benchmarks import Benchmark, BOPBenchmark, Pascal3DBenchmark, PoseFolderBenchmark
from .datasets import evaluate
from .protocol import Protocol
from .registry import DATASETS

__all__ = [
    "DATASETS",
    "BOPBenchmark",
    "Benchmark",
    "Pascal3DBenchmark",
    "PoseFolderBenchmark",
    "Protocol",
    "evaluate",
]
