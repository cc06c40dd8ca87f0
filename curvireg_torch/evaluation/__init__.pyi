from .benchmark import Benchmark
from .bop import BOPBenchmark
from .datasets import evaluate
from .pascal3d import Pascal3DBenchmark
from .pose_folder import PoseFolderBenchmark
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
