"""``curvireg bank MESH --out FILE``."""

import argparse
import time
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError
from ..utils.choices import check_given
from ..utils.files import check_writable
from .options import common_options, examples, mesh_options, pipeline_options, register_options


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "bank",
        parents=[common_options(), pipeline_options(), mesh_options()],
        help="render and describe the views of MESH",
        **examples(
            "curvireg bank part.stl --unit mm --out part.safetensors",
            "curvireg bank chair.glb --pose upright --out chair.safetensors",
        ),
    )
    parser.add_argument("mesh", type=Path, metavar="MESH")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the bank, as .safetensors")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Build and save a bank."""
    check_given([], [arguments.mesh])
    if arguments.out.suffix != ".safetensors" or arguments.out.is_dir():
        raise InvalidInputError(f"--out {arguments.out}: expected the name of a file that ends in .safetensors")
    check_writable(arguments.out.parent, "--out")
    if arguments.mesh.suffix == ".safetensors":
        raise InvalidInputError("a bank where a mesh is expected", subject=arguments.mesh)
    from ..matching import ViewBank
    from ..mesh import load_mesh
    from ..utils.threads import one_torch_thread

    start, options = time.perf_counter(), register_options(arguments)
    pipeline = options.open_pipeline()
    mesh = load_mesh(arguments.mesh, unit=options.unit, up=options.up)
    settings: dict[str, Any] = {"renderer": options.renderer, "progress": options.progress, "device": options.device}
    with one_torch_thread():
        bank = ViewBank.build(mesh, pipeline=pipeline, **settings)
    bank.save(arguments.out)
    size = arguments.out.stat().st_size / 1e6
    print(f"{arguments.out}: {len(bank)} views, {size:.1f} MB, {time.perf_counter() - start:.1f} s")
