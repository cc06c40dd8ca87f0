"""``curvireg demo --out DIR``."""

import argparse
import time
from pathlib import Path
from typing import Any

from ..utils.files import check_writable, write_file
from .options import common_options, examples, pipeline_options, register_options
from .stages import show_stages


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "demo",
        parents=[common_options(), pipeline_options()],
        help="register a generated scene, whose true pose is known",
        **examples("curvireg demo --out out/demo", "curvireg demo --seed 7 --preset fast --out out/demo"),
    )
    parser.add_argument("--seed", type=int, default=2, help="number of the scene (default: 2)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the results")
    parser.set_defaults(run=run, pose="upright")


def run(arguments: argparse.Namespace) -> None:
    """Generate a photograph of the example mesh, register it and print the error."""
    check_writable(arguments.out, "--out")
    from ..utils.threads import one_torch_thread

    with one_torch_thread():
        _register_scene(arguments)


def _register_scene(arguments: argparse.Namespace) -> None:
    from ..evaluation.result_files import write_result
    from ..geometry import rotation_error
    from ..matching import cached_bank
    from ..registration import Registrar, Registration
    from ..registration.result import result_document
    from ..synthetic import demo_scene
    from ..visualization.encoding import png
    from ..visualization.overlay import to_uint8
    from .report import print_result

    scene = demo_scene(arguments.seed)
    mesh, image, box, K, truth = scene.mesh, scene.image, scene.box, scene.camera_matrix, scene.truth
    options = register_options(arguments)
    pipeline = options.open_pipeline()
    with show_stages(enabled=options.progress) as progress:
        start = time.perf_counter()
        bank = cached_bank(mesh, pipeline=pipeline, renderer=options.renderer, progress=progress or options.progress)
        ready = time.perf_counter()
        registrar = Registrar(
            bank, pipeline=pipeline, renderer=options.renderer, device=options.device, progress=progress or False
        )
        result = registrar([image], box[None], K)[0]
    assert isinstance(result, Registration)
    assert result.translation is not None
    seconds = {"bank": ready - start, "register": time.perf_counter() - ready}
    document = result_document(result, registrar, seconds)
    document["rotation_error_deg"] = float(rotation_error(result.rotation, truth[:3, :3]))
    document["translation_error"] = float((result.translation - truth[:3, 3]).norm() / truth[:3, 3].norm())
    document["truth"] = {"rotation": truth[:3, :3].tolist(), "translation": truth[:3, 3].tolist()}
    document["inputs"] = {"seed": arguments.seed, "box": box.tolist()}
    write_result(arguments.out, document, registrar, result, image, box)
    write_file(arguments.out / "mesh.ply", mesh.export(file_type="ply"))
    write_file(arguments.out / "photo.png", png(to_uint8(image)))
    print_result(document, arguments.out)
    print(
        f"error against the truth: rotation {document['rotation_error_deg']:.1f} degrees, "
        f"translation {100 * document['translation_error']:.1f} % of the distance"
    )
