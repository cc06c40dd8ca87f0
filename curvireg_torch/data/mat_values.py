"""A program that :mod:`.mat_files` starts: a variable of MATLAB files, as lines of JSON.

Its arguments are a JSON file with the variable's name, the largest size in bytes and the paths, and
the file that gets a line for each path: null where it cannot be read.
"""

import json
import sys
from pathlib import Path
from typing import Any

from scipy.io import loadmat


def plain(value: Any) -> Any:
    """A struct array as a list of objects, text, or a list of real numbers in MATLAB's order;
    None for all else."""
    cells = value.ravel("F")
    if names := value.dtype.names:
        return [{name: plain(cell[name]) for name in names} for cell in cells]
    if value.dtype.kind == "U":
        return "".join(cells)
    return cells.astype(float).tolist() if value.dtype.kind in "biuf" else None


if __name__ == "__main__":
    variable, most, *paths = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    with open(sys.argv[2], "w", encoding="utf-8") as out:
        for path in paths:
            try:
                if Path(path).stat().st_size > most:
                    raise ValueError("no annotation")
                content = loadmat(path, appendmat=False, variable_names=[variable])
                line = json.dumps(plain(content[variable]))
            except Exception:  # SciPy raises errors of any kind for damaged files
                line = "null"
            print(line, file=out, flush=True)
