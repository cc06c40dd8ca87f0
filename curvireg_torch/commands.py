"""What the commands of ``curvireg`` do, once :mod:`curvireg_torch.cli` has read their options."""

import argparse
import json
import math
import platform
import time
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
import trimesh

from . import __version__
from ._choices import DEFAULT
from ._files import probe_folder, write_file
from .data import read_photo
from .errors import BankError
from .geometry import camera_matrix, load_mesh, rotation_error, whole_image_box
from .learned import LearnedCurvilinearSaliency, adapt
from .matching import ViewBank, cache_folder, cached_bank, clear_cache, list_cache
from .pipeline import Pipeline, preset_named
from .registration import RELIABLE, FailedRegistration, Registrar, Registration

__all__ = ["bank", "cache", "chosen_pipeline", "demo", "register"]

CONVENTIONS = {
    "rotation": "x_cam = R x_model + t, OpenCV camera: x right, y down, z forward; model frame of the mesh file",
    "translation": "in the mesh file's unit; null without --camera",
    "viewpoint": "PASCAL3D+ azimuth, elevation, theta in degrees",
    "pixels": "(0, 0) is the centre of the top-left pixel of the picture as viewers show it (EXIF orientation applied)",
    "boxes": "x0, y0, x1, y1 in those pixels",
    "score": "normalised correlation of photograph and view, 0 to 1",
    "confidence": "estimated probability that the rotation is within 30 degrees of the truth",
    "reliable": f"confidence of at least {RELIABLE:g}; false = no reliable match, the pose is a guess",
    "support": "how strongly edges of the photograph lie under the mesh's contours, 0 to 1",
    "covariance": "of turn (rad) about the camera's x, y, z, then translation along them: R_true = exp([w]x) R, "
    "t_true = t + e; null without --camera",
}


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
    return chosen if arguments.pose is None else chosen.posed(arguments.pose)


def _open_bank(arguments: argparse.Namespace, pipeline: Pipeline) -> ViewBank:
    if arguments.mesh.suffix == ".safetensors":
        bank = ViewBank.load(arguments.mesh)
        if arguments.pose not in (None, bank.pipeline.views.pose):
            raise BankError(
                f"{arguments.mesh}: made for --pose {bank.pipeline.views.pose}, asked for --pose {arguments.pose}; "
                "leave --pose out, or build it again with 'curvireg bank'"
            )
        return bank
    mesh = load_mesh(arguments.mesh, unit=arguments.unit, up=arguments.up)
    return cached_bank(mesh, pipeline=pipeline, renderer=arguments.renderer, progress=not arguments.quiet)


def register(arguments: argparse.Namespace) -> None:
    """``curvireg register``."""
    times = {"start": time.perf_counter()}
    photo = read_photo(arguments.photo, dtype=torch.uint8)
    image = photo.image
    box = whole_image_box(image) if arguments.box is None else torch.tensor(arguments.box)
    K = None if arguments.camera is None else camera_matrix(*arguments.camera, dtype=torch.float64)
    pipeline = chosen_pipeline(arguments)
    field = None if arguments.field is None else LearnedCurvilinearSaliency(weights=arguments.field)
    probe_folder(arguments.out, "--out")
    bank = _open_bank(arguments, pipeline).to(arguments.device)
    if arguments.mesh.suffix == ".safetensors" and arguments.preset is None and arguments.pipeline is None:
        pipeline = bank.pipeline
    times["bank"] = time.perf_counter()
    registrar = Registrar(
        bank,
        pipeline=pipeline,
        field=field,
        refine=not arguments.no_refine,
        hypotheses=arguments.top,
        renderer=arguments.renderer,
    )
    result = registrar([image], box[None], K)[0]
    if isinstance(result, FailedRegistration):
        raise type(result.error)(str(result.error).replace("image 0", str(arguments.photo)))
    times["register"] = time.perf_counter()
    document = _document(result, registrar, times)
    document["inputs"] = {"photo": str(arguments.photo), "mesh": str(arguments.mesh), "box": box.tolist()}
    document["inputs"]["picture"] = photo.facts()
    _write(arguments.out, document, registrar, result, image, box)
    if photo.notes:
        print(f"{arguments.photo}: {'; '.join(photo.notes)}")
    _print_result(document, arguments.out)


def demo(arguments: argparse.Namespace) -> None:
    """``curvireg demo``."""
    from .synthetic import example_mesh, random_pose, synthesize_photograph

    probe_folder(arguments.out, "--out")
    times = {"start": time.perf_counter()}
    generator = torch.Generator().manual_seed(arguments.seed)
    mesh, size = example_mesh(), (360, 480)
    K = camera_matrix(520.0, 520.0, 239.5, 179.5, dtype=torch.float64)
    truth = random_pose(mesh, K, size, generator)
    image, box = synthesize_photograph(mesh, truth, K, size, generator)
    pipeline = chosen_pipeline(arguments)
    bank = cached_bank(mesh, pipeline=pipeline, renderer=arguments.renderer, progress=not arguments.quiet)
    times["bank"] = time.perf_counter()
    registrar = Registrar(bank, pipeline=pipeline, renderer=arguments.renderer, device=arguments.device)
    result = registrar([image], box[None], K)[0]
    assert isinstance(result, Registration)
    times["register"] = time.perf_counter()
    document = _document(result, registrar, times)
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


def _document(result: Registration, registrar: Registrar, times: dict[str, float]) -> dict[str, Any]:
    bank = registrar.bank
    top = [
        {
            "rotation": h.rotation.tolist(),
            "translation": None if h.translation is None else h.translation.tolist(),
            "viewpoint": dict(zip(("azimuth", "elevation", "theta"), h.viewpoint, strict=True)),
            "score": h.score,
            "evidence": dict(h.evidence),
            "view": h.view,
            "terms": {n: float(r[0, h.view]) for n, r in result.ranking.terms.items() if r[0, h.view].isfinite()},
        }
        for h in result.hypotheses
    ]
    deviations = result.standard_deviations
    return {
        "rotation": result.rotation.tolist(),
        "translation": None if result.translation is None else result.translation.tolist(),
        "unit": bank.mesh.units,
        "viewpoint": dict(zip(("azimuth", "elevation", "theta"), result.viewpoint, strict=True)),
        "score": result.score,
        "confidence": result.confidence,
        "reliable": result.reliable,
        "support": result.support,
        "standard_deviations": None
        if deviations is None
        else {"rotation_deg": _known(deviations[0]), "translation": _known(deviations[1])},
        "covariance": None if result.covariance is None else result.covariance.tolist(),
        "top": top,
        "views": len(bank),
        "pipeline": registrar.pipeline.describe(),
        "seconds": {"bank": times["bank"] - times["start"], "register": times["register"] - times["bank"]},
        "versions": {
            "curvireg_torch": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "kornia": kornia.__version__,
            "trimesh": trimesh.__version__,
        },
        "conventions": CONVENTIONS,
    }


def _known(deviations: torch.Tensor) -> list[float | None]:
    """Numbers that JSON can hold: None for a deviation without bound."""
    return [None if math.isinf(v) else v for v in deviations.tolist()]


def _write(out: Path, document: dict[str, Any], registrar: Registrar, result: Registration, *scene: Any) -> None:
    from .visualization import registration_sheet

    sheet = registration_sheet(registrar, result, *scene)
    (out / "result.json").unlink(missing_ok=True)  # an older one never stands beside this picture
    _write_picture(out / "overlay.png", sheet)
    write_file(out / "result.json", (json.dumps(document, indent=2) + "\n").encode())


def _write_picture(path: Path, picture: np.ndarray) -> None:
    write_file(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())


def _print_result(document: dict[str, Any], out: Path) -> None:
    angles = ", ".join(f"{name} {value:.1f}" for name, value in document["viewpoint"].items())
    seconds = document["seconds"]
    print(f"viewpoint: {angles} degrees   score {document['score']:.3f}   confidence {document['confidence']:.2f}")
    if not document["reliable"]:
        print("no reliable match: take the pose as a guess; check that the box is tight and the mesh is the object's")
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
