"""What trimesh makes of the six files beside this program, and what is right.

    python scripts/upstream/check.py

It needs trimesh alone. Each line names a file, what is measured, what is right and what trimesh
finds; the last says how many agree. Once all do, the readers that these files keep alive can go.
"""

import json
from pathlib import Path

import numpy as np
import trimesh

FOLDER = Path(__file__).parent


def measured(path: Path) -> dict[str, object]:
    """Number of faces, area and box of a file as trimesh reads it, or its error."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
        bounds = np.round(np.asarray(mesh.bounds), 4).tolist()
        return {"faces": len(mesh.faces), "area": round(float(mesh.area), 4), "bounds": bounds}
    except Exception as error:  # whatever it is, it is what a user sees
        return {"error": f"{type(error).__name__}: {error}"[:120]}


def main() -> None:
    cases = json.loads((FOLDER / "cases.json").read_text(encoding="utf-8"))
    count = 0
    for name, case in cases.items():
        found = measured(FOLDER / name)
        is_right = all(found.get(key) == value for key, value in case["right"].items())
        count += is_right
        print(f"{name}: {case['what']}\n  right: {case['right']}\n  found: {found}")
    print(f"trimesh {trimesh.__version__}: {count} of {len(cases)} agree")


if __name__ == "__main__":
    main()
