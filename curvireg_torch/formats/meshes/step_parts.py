"""STEP and IGES files as GLB by OpenCASCADE: a program of its own, without the rest of the package.

    python step_parts.py FILE.step OUT.glb step|iges LINEAR_TOLERANCE ANGULAR_TOLERANCE

OpenCASCADE prints, and damaged files may end or stop it; so :mod:`.cad` runs this in a process that
may end as it likes.
"""

import sys
from pathlib import Path

import cascadio


def main() -> None:
    path, out, kind, linear, angular = sys.argv[1:]
    content = cascadio.to_glb_bytes(
        Path(path).read_bytes(),
        cascadio.FileType.IGES if kind == "iges" else cascadio.FileType.STEP,
        tol_linear=float(linear),
        tol_angular=float(angular),
        tol_relative=True,
        use_parallel=False,
    )
    Path(out).write_bytes(content)


if __name__ == "__main__":
    main()
