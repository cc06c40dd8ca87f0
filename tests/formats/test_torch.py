"""The readers of other tools' files know no torch."""

import subprocess
import sys
from pathlib import Path

import curvireg_torch.formats


def test_no_reader_imports_torch():
    folder = Path(curvireg_torch.formats.__file__).parent
    files = [
        file for file in folder.rglob("*.py") if not file.stem.endswith(("__init__", "_parts"))
    ]
    names = [".".join(file.relative_to(folder.parents[1]).with_suffix("").parts) for file in files]
    modules = ", ".join(["sys", "curvireg_torch.formats", *names])
    command = [sys.executable, "-c", f"import {modules}; print('torch' in sys.modules)"]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
