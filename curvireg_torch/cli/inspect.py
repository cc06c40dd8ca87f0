"""The command ``curvireg inspect``."""

import argparse
import json
from typing import Any

from ..jobs.options import whole_number
from ..utils.choices import check_given
from ..utils.files import write_file
from .libraries import load_libraries
from .options import MESH, METHOD, add_command, add_options, add_path, input_files, register_options
from .stages import shown_stages


def add_inspect(commands: Any) -> None:
    parser = add_command(
        commands,
        "inspect",
        "curvireg inspect part.stl --unit mm --out out/inspect",
        "curvireg inspect chair.glb --pose upright --no-camera --n 200 --out out/chair",
        help="what to expect of photographs of MESH: symmetries, views that look alike, share of "
        "right answers",
        description="Writes DIR/inspect.json and DIR/inspect.html, from generated photographs of "
        "the mesh.",
        run=_run_inspect,
    )
    add_path(parser, "mesh", "MESH")
    add_path(parser, "--out", "DIR", required=True, help="folder of the report")
    add = parser.add_argument
    add(
        "--n",
        type=whole_number(0),
        default=60,
        metavar="N",
        help="generated photographs (default: 60; 0: none)",
    )
    add("--seed", type=int, default=0, help="of the photographs (default: 0)")
    add(
        "--no-camera",
        dest="with_camera",
        action="store_false",
        help="as if the camera were unknown",
    )
    add_path(
        parser, "--photo", "DIR", help="your own photographs without the object, as backgrounds"
    )
    add(
        "--clutter",
        action="store_true",
        help="other objects around the object, and at times in front of it",
    )
    add("--strict", action="store_true", help="exit code 3 for a mesh that cannot work")
    add_options(parser, *MESH, *METHOD)


def _run_inspect(arguments: argparse.Namespace) -> int:
    """Write the report and print it."""
    check_given([], [arguments.mesh], banks=False)
    load_libraries()
    from ..inspection import inspect
    from ..inspection.page import report_lines, report_page
    from ..jobs.lists import find_photographs
    from ..jobs.outputs import output_folder

    backgrounds = [] if arguments.photo is None else find_photographs(arguments.photo)
    options = register_options(arguments)
    inputs = input_files(arguments, arguments.mesh, *backgrounds)
    with output_folder(arguments.out, "inspect", inputs=inputs):
        with shown_stages(shown=options.progress) as show:
            report = inspect(
                options.load_mesh(arguments.mesh),
                n=arguments.n,
                seed=arguments.seed,
                with_camera=arguments.with_camera,
                pipeline=options.open_pipeline(),
                renderer=options.renderer,
                device=options.device,
                backgrounds=backgrounds,
                clutter=arguments.clutter,
                progress=show,
            )
        content = json.dumps(report.to_dict(), indent=2) + "\n"
        write_file(arguments.out / "inspect.json", content.encode())
        page = report_page(report, report.registrar, title=arguments.mesh.name)
        write_file(arguments.out / "inspect.html", page.encode(errors="backslashreplace"))
    print(
        "\n".join(
            [f"{arguments.mesh}", *report_lines(report), f"see {arguments.out / 'inspect.html'}"]
        )
    )
    return 3 if arguments.strict and report.is_hopeless else 0
