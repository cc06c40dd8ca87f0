"""Datasets registered and scored: one loop puts predictions on disk, another scores what is there.

``curvireg evaluate pascal3d|bop|web ROOT --out DIR``; with ``torchrun``, ``-m curvireg_torch.evaluation pascal3d ROOT
--out DIR`` shares the objects among processes. A new dataset: a benchmark, and a row in :mod:`.registry`.
"""

from typing import TYPE_CHECKING

from .._lazy import lazy

if TYPE_CHECKING:
    from ..pipeline import DEFAULT, PRESETS, Pipeline
    from .benchmark import Benchmark
    from .bop import BOPBenchmark
    from .command import add_parser, run
    from .loops import evaluate, score
    from .pascal3d import Pascal3DBenchmark
    from .protocol import Protocol
    from .registry import KINDS
    from .sheet import contact_sheet
    from .web import WebBenchmark
else:
    __getattr__, __dir__ = lazy(
        __name__,
        {
            ".pipeline": "DEFAULT PRESETS Pipeline",
            "benchmark": "Benchmark",
            "bop": "BOPBenchmark",
            "command": "add_parser run",
            "loops": "evaluate score",
            "pascal3d": "Pascal3DBenchmark",
            "protocol": "Protocol",
            "registry": "KINDS",
            "sheet": "contact_sheet",
            "web": "WebBenchmark",
        },
    )

__all__ = [
    "DEFAULT",
    "KINDS",
    "PRESETS",
    "BOPBenchmark",
    "Benchmark",
    "Pascal3DBenchmark",
    "Pipeline",
    "Protocol",
    "WebBenchmark",
    "add_parser",
    "contact_sheet",
    "evaluate",
    "run",
    "score",
]
