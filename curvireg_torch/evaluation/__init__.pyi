from .benchmarks import Benchmark, BOPBenchmark, Pascal3DBenchmark, PoseFolderBenchmark, Protocol
from .datasets import evaluate
from .registry import DATASETS

__all__ = ["DATASETS", "BOPBenchmark", "Benchmark", "Pascal3DBenchmark", "PoseFolderBenchmark", "Protocol", "evaluate"]
