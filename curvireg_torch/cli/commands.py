"""The commands of the command line but for ``register`` and ``follow``."""

import argparse
import time
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError, MissingFileError
from ..evaluation.registry import DATASETS
from ..jobs.options import whole_number
from ..jobs.store import to_json
from ..utils.choices import check_given
from ..utils.executors import opened_workers
from ..utils.files import check_writable, write_file
from ..version import __version__
from .libraries import load_libraries
from .options import (
    BOXES,
    MESH,
    METHOD,
    PHOTOGRAPH,
    add_command,
    add_limits,
    add_options,
    add_path,
    add_workers,
    input_files,
    register_options,
)
from .stages import shown_stages

LOCAL = "127.0.0.1"
PICTURES = {
    "overlay": "the photograph with the contours at the pose",
    "fields": "the photograph and its field, the pose and its field",
    "viewpoints": "score over the viewing directions, and the hypotheses",
}
PROTOCOL = (
    "cad=annotated|any|other: the annotated CAD model, the best of the class, or another one of "
    "it (seed=N); pose=upright|any: whether objects are known to stand upright; "
    "box=annotated|none|FRACTION: as annotated; detected; or each edge moved by up to FRACTION of "
    "the side (seed=N); box_is=whole|visible: boxes of whole objects, or of their visible parts "
    "(bop); hint=none|azimuth:DEG|pose:DEG: azimuth or rotation known to lie within "
    "DEG of a value that is off by up to DEG; views=N: N photographs of one pose together (bop; "
    "seed=N)"
)
FORMATS = (".png", ".svg", ".pdf")


def _add_inspect(commands: Any) -> None:
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
        write_file(arguments.out / "inspect.json", to_json(report.to_dict()).encode())
        page = report_page(report, title=arguments.mesh.name)
        write_file(arguments.out / "inspect.html", page.encode(errors="backslashreplace"))
    print(arguments.mesh, *report_lines(report), f"see {arguments.out / 'inspect.html'}", sep="\n")
    return 3 if arguments.strict and report.is_hopeless else 0


def _add_bank(commands: Any) -> None:
    parser = add_command(
        commands,
        "bank",
        "curvireg bank part.stl --unit mm --out part.safetensors",
        "curvireg bank chair.glb --pose upright --out chair.safetensors",
        help="render and describe the views of MESH",
        run=_build_bank,
    )
    add_path(parser, "mesh", "MESH")
    add_path(parser, "--out", "FILE", required=True, help="the bank, as .safetensors")
    add_options(parser, *MESH, *METHOD)


def _build_bank(arguments: argparse.Namespace) -> None:
    """Build and save a bank."""
    check_given([], [arguments.mesh], banks=False)
    if arguments.out.suffix != ".safetensors" or arguments.out.is_dir():
        raise InvalidInputError(
            f"--out {arguments.out}: expected the name of a file that ends in .safetensors"
        )
    load_libraries()
    from ..jobs.outputs import check_output_file
    from ..matching import ViewBank
    from ..utils.threads import one_torch_thread

    start = time.perf_counter()
    options = register_options(arguments)
    check_output_file(arguments.out, input_files(arguments, arguments.mesh))
    pipeline = options.open_pipeline()
    mesh = options.load_mesh(arguments.mesh)
    with one_torch_thread():
        bank = ViewBank.build(
            mesh,
            pipeline=pipeline,
            renderer=options.renderer,
            progress=options.progress,
            device=options.device,
        )
    bank.save(arguments.out)
    size = arguments.out.stat().st_size / 1e6
    print(f"{arguments.out}: {len(bank)} views, {size:.1f} MB, {time.perf_counter() - start:.1f} s")


def _add_cache(commands: Any) -> None:
    text = "list or clear the banks cached on disk"
    examples = ("curvireg cache list", "curvireg cache clear")
    parser = add_command(commands, "cache", *examples, help=text, run=show_cache)
    parser.add_argument(
        "action", nargs="?", choices=("list", "clear"), default="list", help="default: list"
    )
    parser.add_argument("--clear", action="store_true", help="the same as clear")


def show_cache(arguments: argparse.Namespace) -> None:
    """List the cached banks, or remove them."""
    from ..matching import cache_folder, clear_cache, list_cache

    if arguments.clear or arguments.action == "clear":
        print(f"{cache_folder()}: {clear_cache()} banks removed")
        return
    banks = list_cache()
    for bank in banks:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(bank.used))
        print(
            f"{bank.size / 1e6:8.1f} MB   last used {used}   {_mesh_of(bank.path)}   "
            f"{bank.path.name}"
        )
    print(f"{cache_folder()}: {len(banks)} banks, {sum(bank.size for bank in banks) / 1e6:.1f} MB")


def _mesh_of(bank: Path) -> str:
    """Name of the mesh file that a bank was built for."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(bank, framework="numpy") as file:
            return (file.metadata() or {}).get("mesh") or "a mesh without a file"
    except (SafetensorError, OSError):
        return "damaged"


def _add_evaluate(commands: Any) -> None:
    example = "curvireg evaluate bop data/bop/lm --out out/lm"
    datasets = add_command(
        commands, "evaluate", example, help="register and score a dataset"
    ).add_subparsers(required=True, metavar="DATASET")
    for name, kind in DATASETS.items():
        dataset = add_command(
            datasets,
            name,
            f"curvireg evaluate {name} {kind.example} --out out/{name}",
            f"curvireg evaluate {name} {kind.example} --jobs 2 --limit 100 --preset fast --out "
            f"out/{name}-fast",
            help=kind.help,
            description="Writes DIR/summary.json, DIR/predictions.csv and DIR/index.html; the "
            "same command resumes.",
            run=_run_evaluation,
        )
        dataset.set_defaults(dataset=name)
        kind.add_arguments(dataset)
        add = dataset.add_argument
        protocol = f"{PROTOCOL} (default: cad=annotated pose={kind.pose} box=annotated)"
        add("--protocol", nargs="+", default=[], metavar="KEY=VALUE", help=protocol)
        add_options(dataset, "preset", "pipeline", "renderer", "progress")
        add_workers(dataset, "that share the objects")
        add(
            "--limit",
            type=whole_number(1),
            metavar="N",
            help="only N objects, spread evenly over the set",
        )
        add_path(
            dataset,
            "--out",
            "DIR",
            required=True,
            help="folder of the results; made if it does not exist",
        )


def _run_evaluation(arguments: argparse.Namespace) -> None:
    """Evaluate a dataset and print the headline."""
    if not Path(arguments.root).is_dir():
        raise MissingFileError(
            "no such folder; docs/datasets.md shows the layout", subject=arguments.root
        )
    from ..evaluation.datasets import evaluate
    from ..evaluation.protocol import Protocol
    from ..utils.threads import one_torch_thread

    kind = DATASETS[arguments.dataset]
    out = arguments.out
    options = register_options(arguments)
    protocol = Protocol.parse(arguments.protocol, pose=kind.pose)
    pipeline = options.open_pipeline()
    benchmark = kind.scored(kind.open(arguments.root, **kind.chosen(arguments)), protocol)
    check_writable(out)
    with (
        one_torch_thread(),
        opened_workers(arguments.jobs, arguments.scheduler) as workers,
    ):
        summary = evaluate(
            benchmark,
            out,
            pipeline=pipeline,
            limit=arguments.limit,
            renderer=options.renderer,
            progress=options.progress,
            workers=workers,
        )
    if summary["n"] == 0:
        skipped = ", ".join(f"{count} {reason}" for reason, count in summary["skipped"].items())
        reasons = skipped or "no object is annotated"
        raise InvalidInputError(
            f"{arguments.root}: nothing was scored ({reasons}); see {arguments.out}/summary.json"
        )
    print(
        f"{summary['n']} objects, {summary['failed']} failed, {sum(summary['skipped'].values())} "
        f"skipped"
    )
    numbers = {**summary, **summary.get("detection", {})}.items()
    print("   ".join(f"{name} {value:.3f}" for name, value in numbers if isinstance(value, float)))
    if "n_posed" in summary:
        print(f"{summary['reliable']} reliable; the true pose of {summary['n_posed']} is known")
    print(f"protocol: {summary['protocol']}; see {arguments.out}/summary.json")


def _add_view(commands: Any) -> None:
    parser = add_command(
        commands,
        "view",
        "curvireg view",
        "curvireg view photo.jpg part.stl --unit mm",
        help="register in the browser: draw the box, inspect the result, correct it",
        description="Opens a page on this machine; needs the extra [viewer].",
        run=view,
    )
    add_path(parser, "photo", "PHOTO", nargs="?")
    add_path(parser, "mesh", "MESH", nargs="?", help="a mesh or a bank; both can be added later")
    options = [name for name in PHOTOGRAPH if name != "mask"]
    add_options(parser, *options, *BOXES, box="in px; can be drawn")
    add_limits(parser)
    hosts = f"who may connect: {LOCAL}, only this machine (default), or 0.0.0.0 or ::, everyone"
    parser.add_argument("--host", default=LOCAL, help=hosts)
    parser.add_argument(
        "--port", type=whole_number(0, 65535), default=0, help="default: a free one"
    )
    parser.add_argument(
        "--no-browser", dest="browser", action="store_false", help="only print the address"
    )


def view(arguments: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    photos, meshes = ([path] if path else [] for path in (arguments.photo, arguments.mesh))
    if photos and photos[0].suffix.lower() == ".csv":
        message = "a table where a photograph is expected; drop a rig file on the page"
        raise InvalidInputError(message, subject=photos[0])
    check_given(photos, meshes, packages=["nicegui"])
    load_libraries()
    from ..utils.threads import one_torch_thread
    from ..viewer.server import serve

    options = register_options(arguments, photos, meshes)
    with one_torch_thread():
        serve(options, host=arguments.host, port=arguments.port, browser=arguments.browser)


def _add_plot(commands: Any) -> None:
    examples = [
        f"curvireg plot {kind} photo.jpg part.stl --box 410 220 890 700 --out {kind}.png"
        for kind in PICTURES
    ]
    plot = add_command(commands, "plot", *examples, help="draw a picture of a registration")
    kinds = plot.add_subparsers(required=True, metavar="KIND")
    for (kind, text), example in zip(PICTURES.items(), examples, strict=True):
        parser = add_command(kinds, kind, example, help=text, run=draw)
        parser.set_defaults(kind=kind)
        add_path(parser, "photo", "PHOTO")
        add_path(parser, "mesh", "MESH", help="a mesh or a bank")
        add_options(parser, *PHOTOGRAPH)
        add_limits(parser)
        add_path(parser, "--out", "FILE", required=True, help=", ".join(FORMATS))


def draw(arguments: argparse.Namespace) -> None:
    """Register one photograph and draw a picture of the result."""
    check_given([arguments.photo], [arguments.mesh], packages=["matplotlib"])
    if arguments.out.suffix.lower() not in FORMATS:
        raise InvalidInputError(
            f"--out {arguments.out}: expected a name that ends in {', '.join(FORMATS)}"
        )
    load_libraries()
    from ..jobs.entry import entry_of, prepare
    from ..jobs.opening import open_registrar
    from ..jobs.outputs import check_output_file
    from ..jobs.photograph import register_entry
    from ..utils.threads import one_torch_thread
    from ..visualization import plots

    options = register_options(arguments, [arguments.photo], [arguments.mesh])
    check_output_file(arguments.out, input_files(arguments, arguments.photo, arguments.mesh))
    entry = entry_of(arguments.photo, options)
    photograph = prepare(entry)
    with one_torch_thread():
        registrar = open_registrar(options, options.meshes)
        found = register_entry(entry, photograph, registrar)
        if arguments.kind == "viewpoints":
            figure = plots.viewpoints(registrar.bank, found)
        elif arguments.kind == "fields":
            figure = plots.fields(registrar, found, found.photograph)
        else:
            figure = found.plot()
    content = BytesIO()
    kind = arguments.out.suffix[1:].lower()
    author = {"Software" if kind == "png" else "Creator": f"curvireg_torch {__version__}"}
    figure.savefig(content, format=kind, dpi=150, metadata=author)
    write_file(arguments.out, content.getvalue())
    print(arguments.out)


def _add_demo(commands: Any) -> None:
    examples = (
        "curvireg demo --out out/demo",
        "curvireg demo --seed 7 --preset fast --out out/demo",
    )
    text = "register a generated scene, whose true pose is known"
    parser = add_command(commands, "demo", *examples, help=text, run=demo)
    parser.set_defaults(pose="upright")
    parser.add_argument("--seed", type=int, default=2, help="number of the scene (default: 2)")
    add_path(parser, "--out", "DIR", required=True, help="folder of the results")
    add_options(parser, *METHOD)


def demo(arguments: argparse.Namespace) -> None:
    """Generate a photograph of the example mesh, register it and print the error."""
    out = arguments.out
    load_libraries()
    from ..geometry import Camera, rotation_error
    from ..jobs.entry import entry_of, prepare
    from ..jobs.outputs import output_folder
    from ..jobs.photograph import register_entry
    from ..synthetic import demo_scene
    from ..utils.threads import one_torch_thread
    from ..visualization.encoding import png, to_uint8
    from .printing import print_result
    from .registering import opened_registrar

    options = register_options(arguments, [out / "photo.png"], [out / "mesh.ply"])
    with one_torch_thread(), output_folder(out, "demo", inputs=input_files(arguments)):
        scene = demo_scene(arguments.seed)
        write_file(out / "mesh.ply", scene.mesh.export(file_type="ply"))
        write_file(out / "photo.png", png(to_uint8(scene.image)))
        options = replace(
            options, box=tuple(scene.box.tolist()), camera=Camera(scene.camera_matrix)
        )
        with opened_registrar(options) as (registrar, seconds):
            entry = entry_of(out / "photo.png", options)
            found = register_entry(entry, prepare(entry), registrar, bank_seconds=seconds)
        assert found.translation is not None
        R = scene.truth[:3, :3]
        t = scene.truth[:3, 3]
        degrees = float(rotation_error(found.rotation, R))
        fraction = float((found.translation - t).norm() / t.norm())
        truth = {"rotation": R.tolist(), "translation": t.tolist()}
        found.document.update(rotation_error_deg=degrees, translation_error=fraction, truth=truth)
        found.document["inputs"]["seed"] = arguments.seed
        found.write(out)
    print_result(found.document, out)
    print(
        f"error against the truth: rotation {degrees:.1f} degrees, translation "
        f"{100 * fraction:.1f} % of the distance"
    )


def _add_compare(commands: Any) -> None:
    parser = add_command(
        commands,
        "compare",
        "curvireg compare out/lm-fast out/lm",
        "curvireg compare out/lm-fast out/lm --json",
        help="compare two evaluations of one dataset, object by object",
        description="Prints each score with its 95 % interval, how often B is better than A and "
        "worse,\n"
        "the p of a sign test, and a Markdown and a LaTeX row of each run. Objects in one run "
        "only do not count.",
        run=_compare_runs,
    )
    add_path(parser, "a", "RUN_A", help="folder of 'curvireg evaluate --out'")
    add_path(parser, "b", "RUN_B", help="another one, of the same dataset")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")


def _compare_runs(arguments: argparse.Namespace) -> None:
    """Compare two evaluations."""
    from ..evaluation.compare import compare, in_words, read_run

    first = read_run(arguments.a)
    second = read_run(arguments.b)
    comparisons = compare(first, second)
    if not arguments.json:
        print(in_words(first, second, comparisons), end="")
        return
    scores = [asdict(each) for each in comparisons]
    print(to_json({"a": first.name, "b": second.name, "comparisons": scores}), end="")


COMMANDS = (
    _add_inspect,
    _add_bank,
    _add_cache,
    _add_evaluate,
    _add_view,
    _add_plot,
    _add_demo,
    _add_compare,
)
