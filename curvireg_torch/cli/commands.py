"""What the commands of ``curvireg`` do, once :mod:`curvireg_torch.cli` has read their options."""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
import torch
from torch import nn

from ..errors import BankError, InvalidInputError
from ..evaluation.lists import (
    Entry,
    Listing,
    is_one_photograph,
    list_photographs,
    read_list,
    register_entry,
    register_list,
)
from ..evaluation.loops import POSE_SOURCES
from ..evaluation.store import to_json
from ..geometry import camera_matrix, rotation_error
from ..geometry.cameras import camera_of_view
from ..io import read_photo
from ..io.meshes import load_mesh
from ..matching import ViewBank, cache_folder, cached_bank, clear_cache, list_cache
from ..models import LearnedCurvilinearSaliency
from ..pipeline import Pipeline, field_digest, preset_named
from ..registration import Registrar, Registration
from ..registration.document import corners, correction, result_document, used_box
from ..training import adapt
from ..utils.checks import check_square_pixels
from ..utils.choices import DEFAULT
from ..utils.digests import code_digest
from ..utils.files import probe_folder, write_file

__all__ = ["bank", "cache", "chosen_pipeline", "demo", "open_registrar", "register"]


MAX_GLB_FACES = 300_000
"""Of a mesh that is written to ``pose.glb``; a larger file than 30 MB is more than viewers open with ease."""


def bank(arguments: argparse.Namespace) -> None:
    """``curvireg bank``."""
    probe_folder(arguments.out.parent, "--out")
    if arguments.adapt is not None:
        probe_folder(arguments.adapt.parent, "--adapt")
    start = time.perf_counter()
    pipeline = chosen_pipeline(arguments)
    mesh = load_mesh(arguments.mesh, unit=arguments.unit, up=arguments.up)
    bank = ViewBank.build(
        mesh, pipeline=pipeline, renderer=arguments.renderer, progress=not arguments.quiet, device=arguments.device
    )
    bank.save(arguments.out)
    size = arguments.out.stat().st_size / 1e6
    print(f"{arguments.out}: {len(bank)} views, {size:.1f} MB, {time.perf_counter() - start:.1f} s")
    if arguments.adapt is not None:
        start = time.perf_counter()
        upright = 1.0 if arguments.pose == "upright" else 0.0
        adapt(mesh, upright=upright, workers=1, progress=not arguments.quiet).save(arguments.adapt)
        print(f"{arguments.adapt}: adapted field, {time.perf_counter() - start:.1f} s")


def cache(arguments: argparse.Namespace) -> None:
    """``curvireg cache``."""
    if arguments.clear:
        print(f"{cache_folder()}: {clear_cache()} banks removed")
        return
    banks = list_cache()
    for bank in banks:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(bank.used))
        print(f"{bank.size / 1e6:8.1f} MB   last used {used}   {bank.path.name}")
    print(f"{cache_folder()}: {len(banks)} banks, {sum(bank.size for bank in banks) / 1e6:.1f} MB")


def chosen_pipeline(arguments: argparse.Namespace) -> Pipeline:
    """What ``--preset``, ``--pipeline`` and ``--pose`` ask for."""
    chosen = preset_named(arguments.preset or DEFAULT)
    if arguments.pipeline is not None:
        chosen = Pipeline.read(arguments.pipeline)
    return chosen if arguments.pose is None else chosen.with_pose_prior(arguments.pose)


def open_registrar(
    arguments: argparse.Namespace,
    meshes: Sequence[Path],
    field: nn.Module | None,
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> Registrar:
    """What ``register``'s options ask for, on a mesh or bank, or on several; ``progress`` is told instead of a bar."""
    pipeline, told = chosen_pipeline(arguments), progress or not arguments.quiet
    banks = [_open_bank(arguments, mesh, pipeline, told) for mesh in meshes]
    own = all(mesh.suffix == ".safetensors" for mesh in meshes)
    bank = ViewBank.join(banks).to(arguments.device)
    if own and arguments.pose is None and arguments.pipeline is None:  # presets say nothing of the views
        pipeline = replace(pipeline, views=bank.pipeline.views)
    if own and arguments.preset is None and arguments.pipeline is None:
        pipeline = bank.pipeline
    if arguments.no_refine:
        pipeline = replace(pipeline, search=False, contours=False)
    if arguments.top is not None:
        pipeline = replace(pipeline, hypotheses=arguments.top)
    return Registrar(bank, pipeline=pipeline, field=field, renderer=arguments.renderer)


def _open_bank(
    arguments: argparse.Namespace, mesh: Path, pipeline: Pipeline, progress: bool | Callable[[str, int, int], object]
) -> ViewBank:
    if mesh.suffix != ".safetensors":
        shape = load_mesh(mesh, unit=arguments.unit, up=arguments.up)
        return cached_bank(shape, pipeline=pipeline, renderer=arguments.renderer, progress=progress)
    bank = ViewBank.load(mesh)
    if arguments.pose not in (None, bank.pipeline.views.pose):
        raise BankError(
            f"{mesh}: made for --pose {bank.pipeline.views.pose}, asked for --pose {arguments.pose}; "
            "leave --pose out, or build it again with 'curvireg bank'"
        )
    return bank


def register(arguments: argparse.Namespace) -> None:
    """``curvireg register``."""
    chosen_pipeline(arguments)  # refused before anything is read
    field = None if arguments.field is None else LearnedCurvilinearSaliency(weights=arguments.field)
    if arguments.camera is not None:
        check_square_pixels(camera_matrix(*arguments.camera), "--camera")
    if arguments.list is None and is_one_photograph(arguments.photos):
        _register_one(arguments, field)
    elif arguments.out is not None:
        _register_several(arguments, arguments.out, field)
    else:
        with tempfile.TemporaryDirectory() as folder:
            _register_several(arguments, Path(folder), field)


def _register_one(arguments: argparse.Namespace, field: nn.Module | None) -> None:
    start = time.perf_counter()
    path = arguments.photos[0]
    entry = _asked(arguments, Entry((), str(path), path, tuple(arguments.meshes), arguments.box, arguments.camera))
    photo = read_photo(path, dtype=torch.uint8)
    if arguments.out is not None:
        probe_folder(arguments.out, "--out")
    registrar = open_registrar(arguments, entry.meshes, field)
    ready = time.perf_counter() - start
    if entry.box is None and not arguments.quiet:
        print(f"{path}: looking for the object; --box X0 Y0 X1 Y1 is faster and surer", file=sys.stderr)
    result, document = register_entry(entry, photo, registrar, bank_seconds=ready)
    if arguments.out is not None:
        _write(arguments.out, document, registrar, result, photo.image, used_box(document))
    if document["inputs"]["camera_source"] in ("exif", "fov"):
        focal = document["inputs"]["camera"][0]
        print(
            f"{path}: camera guessed, focal length {focal:.0f} px; distances err as it does", file=_notes_to(arguments)
        )
    if photo.notes:
        print(f"{path}: {'; '.join(photo.notes)}", file=_notes_to(arguments))
    if arguments.json:
        print(to_json(document), end="")
    else:
        _print_result(document, arguments.out)


def _register_several(arguments: argparse.Namespace, out: Path, field: nn.Module | None) -> None:
    settings = {
        "pipeline": chosen_pipeline(arguments).describe(),
        "bank_decides": arguments.preset is None and arguments.pipeline is None,
        "field": None if field is None else field_digest(field),
        "device": str(arguments.device),
        "code": code_digest(*POSE_SOURCES),
        **{name: getattr(arguments, name) for name in ("pose", "unit", "up", "top", "no_refine", "renderer")},
    }
    counts = register_list(
        _listing(arguments, out),
        out,
        lambda meshes: open_registrar(arguments, meshes, field),
        settings=settings,
        progress=not arguments.quiet,
    )
    if arguments.json:
        print((out / "results.jsonl").read_text(encoding="utf-8"), end="")
    table = "" if arguments.out is None else f"; see {out}/results.csv"
    print(f"{counts}{table}", file=_notes_to(arguments))
    if not counts.ok:
        raise InvalidInputError("not one photograph could be registered; the message of each says why")


def _listing(arguments: argparse.Namespace, out: Path) -> Listing:
    if arguments.list is not None:
        listing = read_list(arguments.list, arguments.meshes)
        probe_folder(out, "--out")
    else:
        probe_folder(out, "--out")
        options = {"box": arguments.box, "camera": arguments.camera, "every": arguments.every}
        listing = list_photographs(arguments.photos, arguments.meshes, **options, frames=out / "frames")
        given = [f"--{name}" for name in ("box", "camera") if getattr(arguments, name) is not None]
        if given:
            print(f"{' and '.join(given)}: of all {len(listing.entries)} photographs", file=sys.stderr)
    if _guess(arguments) is not None:
        print("cameras that are not given are guessed; distances err as the guesses do", file=sys.stderr)
    return replace(listing, entries=tuple(_asked(arguments, entry) for entry in listing.entries))


def _asked(arguments: argparse.Namespace, entry: Entry) -> Entry:
    """An entry with the options that hold for all photographs."""
    distance = None if arguments.distance is None else tuple(arguments.distance)
    return replace(entry, guess=_guess(arguments), instances=arguments.instances, distance=distance)


def _guess(arguments: argparse.Namespace) -> str | float | None:
    """What is taken where no camera is given."""
    if arguments.fov is not None:
        camera_of_view(arguments.fov, (1, 1))  # says what is wrong with it
    return "exif" if arguments.exif else arguments.fov


def _notes_to(arguments: argparse.Namespace) -> TextIO:
    """Where is printed what is no result: with ``--json``, standard output holds results alone."""
    return sys.stderr if arguments.json else sys.stdout


def demo(arguments: argparse.Namespace) -> None:
    """``curvireg demo``."""
    from ..synthetic import example_mesh, random_pose, synthesize_photograph

    probe_folder(arguments.out, "--out")
    start = time.perf_counter()
    generator = torch.Generator().manual_seed(arguments.seed)
    mesh, size = example_mesh(), (360, 480)
    K = camera_matrix(520.0, 520.0, 239.5, 179.5, dtype=torch.float64)
    truth = random_pose(mesh, K, size, generator)
    image, box = synthesize_photograph(mesh, truth, K, size, generator)
    pipeline = chosen_pipeline(arguments)
    bank = cached_bank(mesh, pipeline=pipeline, renderer=arguments.renderer, progress=not arguments.quiet)
    ready = time.perf_counter()
    registrar = Registrar(bank, pipeline=pipeline, renderer=arguments.renderer, device=arguments.device)
    result = registrar([image], box[None], K)[0]
    assert isinstance(result, Registration)
    seconds = {"bank": ready - start, "register": time.perf_counter() - ready}
    document = result_document(result, registrar, seconds)
    assert result.translation is not None
    document["rotation_error_deg"] = float(rotation_error(result.rotation, truth[:3, :3]))
    document["translation_error"] = float((result.translation - truth[:3, 3]).norm() / truth[:3, 3].norm())
    document["truth"] = {"rotation": truth[:3, :3].tolist(), "translation": truth[:3, 3].tolist()}
    document["inputs"] = {"seed": arguments.seed, "box": box.tolist()}
    _write(arguments.out, document, registrar, result, image, box)
    write_file(arguments.out / "mesh.ply", mesh.export(file_type="ply"))
    _write_picture(arguments.out / "photo.png", (image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
    _print_result(document, arguments.out)
    print(
        f"error against the truth: rotation {document['rotation_error_deg']:.1f} degrees, "
        f"translation {100 * document['translation_error']:.1f} % of the distance"
    )


def _write(out: Path, document: dict[str, Any], registrar: Registrar, result: Registration, *scene: Any) -> None:
    from ..visualization import pose_glb, registration_sheet

    sheet = registration_sheet(registrar, result, *scene)
    mesh = registrar.bank.meshes[result.model]
    for older in ("result.json", "pose.glb"):
        (out / older).unlink(missing_ok=True)  # never stands beside this picture
    _write_picture(out / "overlay.png", sheet)
    if len(mesh.faces) <= MAX_GLB_FACES:
        write_file(out / "pose.glb", pose_glb(mesh, *result.projection, scene[0]))
    write_file(out / "result.json", to_json(document).encode())


def _write_picture(path: Path, picture: np.ndarray) -> None:
    write_file(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())


def _print_result(document: dict[str, Any], out: Path) -> None:
    angles = ", ".join(f"{name} {value:.1f}" for name, value in document["viewpoint"].items())
    seconds = document["seconds"]
    print(f"viewpoint: {angles} degrees   score {document['score']:.3f}   confidence {document['confidence']:.2f}")
    if not document["reliable"]:
        upright = document["pipeline"]["views"]["pose"] == "upright"
        stands = ", and that it stands as in its file (--pose upright, --up)" if upright else ""
        looked_for = "the object was looked for: give its --box, and check that"
        checks = looked_for if "localization" in document else "check that the box is tight and"
        print(f"no reliable match: take the pose as a guess; {checks} the mesh is the object's{stands}")
    if ", " in document.get("inputs", {}).get("mesh", ""):
        print(f"mesh: {document['mesh']}")
    for line in correction(document):
        print(line)
    if "localization" in document:
        for found in document["localization"]["instances"]:
            print(f"found in box {corners(found['box'])}: there with probability {found['presence']:.2f}")
    if document["translation"] is not None:
        print(f"translation: {', '.join(f'{v:.4g}' for v in document['translation'])} {document['unit']}")
    deviations = document["standard_deviations"]
    if deviations is not None:
        turn, shift = (
            ", ".join("unknown" if v is None else f"{v:.2g}" for v in deviations[name])
            for name in ("rotation_deg", "translation")
        )
        print(f"standard deviations: {turn} degrees; {shift} {document['unit']}   (about and along the camera's axes)")
    print(f"bank {seconds['bank']:.1f} s, registration {seconds['register']:.1f} s; see {out}/overlay.png")
