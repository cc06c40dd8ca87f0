from .benchmark import Benchmark
from .bop import BOPBenchmark
from .datasets import evaluate, score
from .pascal3d import Pascal3DBenchmark
from .protocol import Protocol
from .registry import DATASETS
from .sheet import contact_sheet
from .web import WebBenchmark

__all__ = [
    "DATASETS",
    "BOPBenchmark",
    "Benchmark",
    "Pascal3DBenchmark",
    "Protocol",
    "WebBenchmark",
    "contact_sheet",
    "evaluate",
    "score",
]
