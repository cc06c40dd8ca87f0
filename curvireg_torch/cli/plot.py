"""``curvireg plot KIND``: pictures of a registration."""

import argparse
from io import BytesIO
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError
from ..utils.choices import check_given
from ..utils.files import check_writable, write_file
from .options import (
    add_box_and_camera,
    common_options,
    examples,
    mesh_options,
    pipeline_options,
    register_options,
)

PICTURES = {
    "overlay": "the photograph with the contours at the pose",
    "fields": "the photograph and its field, the pose and its field",
    "viewpoints": "score over the viewing directions, and the hypotheses",
}
FORMATS = (".png", ".svg", ".pdf")


def add_parser(commands: Any) -> None:
    plot = commands.add_parser(
        "plot",
        help="draw a picture of a registration",
        **examples(
            "curvireg plot overlay photo.jpg part.stl --unit mm --box 410 220 890 700 --out overlay.png",
            "curvireg plot viewpoints photo.jpg part.stl --unit mm --box 410 220 890 700 --out viewpoints.png",
        ),
    )
    kinds = plot.add_subparsers(required=True, metavar="KIND")
    for kind, text in PICTURES.items():
        parents = [common_options(), pipeline_options(), mesh_options()]
        example = examples(f"curvireg plot {kind} photo.jpg part.stl --out {kind}.png")
        parser = kinds.add_parser(kind, parents=parents, help=text, **example)
        parser.add_argument("photo", type=Path, metavar="PHOTO")
        parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh or a bank")
        add_box_and_camera(parser, fov=False)
        parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=", ".join(FORMATS))
        parser.set_defaults(run=draw, kind=kind)


def draw(arguments: argparse.Namespace) -> None:
    """Register one photograph and draw a picture of the result."""
    check_given([arguments.photo], [arguments.mesh])
    _check_out(arguments.out)
    import torch

    from ..data import read_photo
    from ..evaluation.opening import check_camera, open_registrar
    from ..evaluation.runner import register_entry
    from ..registration.result import used_box
    from ..utils.threads import one_torch_thread
    from ..visualization import contour_overlay, plots

    options = register_options(arguments, [arguments.photo], [arguments.mesh])
    check_camera(options.camera, options.guess)
    photo = read_photo(options.photos[0], dtype=torch.uint8)
    with one_torch_thread():
        registrar = open_registrar(options, options.meshes)
        result, document = register_entry(options.entry(options.photos[0]), photo, registrar, bank_seconds=0.0)
        box = torch.tensor(used_box(document))
        if arguments.kind == "viewpoints":
            figure = plots.viewpoints(registrar.bank, result)
        elif arguments.kind == "fields":
            figure = plots.fields(registrar, result, photo.image, box)
        else:
            figure = plots.picture(contour_overlay(registrar, result, photo.image, box))
    content = BytesIO()
    figure.savefig(content, format=arguments.out.suffix[1:].lower(), dpi=150)
    write_file(arguments.out, content.getvalue())
    print(arguments.out)


def _check_out(out: Path) -> None:
    if out.suffix.lower() not in FORMATS:
        raise InvalidInputError(f"--out {out}: expected a name that ends in {', '.join(FORMATS)}")
    check_writable(out.parent, "--out")
