"""The registrar of some mesh files or banks, as options ask for it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..errors import BankError
from ..matching import ViewBank, cached_bank
from ..pipeline import Pipeline
from ..registration import Registrar
from ..utils.aliases import Progress
from .options import RegisterOptions


def open_registrar(
    options: RegisterOptions,
    meshes: Sequence[Path],
    *,
    progress: Progress | None = None,
) -> Registrar:
    """The registrar of mesh files or banks; ``progress`` is called while banks are built, instead
    of showing a bar."""
    pipeline = options.open_pipeline()
    banks = [_open_bank(options, mesh, pipeline, progress or options.progress) for mesh in meshes]
    banks = [bank.to(options.device) for bank in banks]
    if all(mesh.suffix == ".safetensors" for mesh in meshes):
        if options.bank_decides:
            pipeline = banks[0].pipeline
        elif options.pose is None and options.pipeline is None:  # a preset does not fix the views
            pipeline = replace(pipeline, views=banks[0].pipeline.views)
    if not options.refine:
        pipeline = replace(pipeline, contours=False, search=False)
    if options.box_is is not None:
        pipeline = pipeline.with_boxes(options.box_is)
    if options.hypotheses is not None:
        pipeline = replace(pipeline, hypotheses=options.hypotheses)
    return Registrar(
        banks,
        pipeline=pipeline,
        field=options.network,
        renderer=options.renderer,
        mesh_is=options.mesh_is,
    )


def _open_bank(
    options: RegisterOptions,
    mesh: Path,
    pipeline: Pipeline,
    progress: bool | Progress,
) -> ViewBank:
    if mesh.suffix != ".safetensors":
        loaded = options.load_mesh(mesh)
        return cached_bank(loaded, pipeline=pipeline, renderer=options.renderer, progress=progress)
    if options.link is not None:
        raise BankError(
            "a bank has the links that it was built with; leave --link out", subject=mesh
        )
    unit = options.unit if options.unit_is_given else None
    bank = load_bank(mesh, unit=unit, up=options.up)
    if options.pose not in (None, bank.pipeline.views.pose):
        pose = bank.pipeline.views.pose
        built = "given views" if pose == "given" else f"--pose {pose}"
        message = f"built for {built}, not for --pose {options.pose}; leave --pose out, or "
        raise BankError(f"{message}build it again with 'curvireg bank'", subject=mesh)
    return bank


def load_bank(path: Path, *, unit: str | None, up: str | None) -> ViewBank:
    """The bank of a file; refuses a unit or an axis that is not that of its mesh, unless it is
    None."""
    bank = ViewBank.load(path)
    built_unit = bank.mesh.unit
    built_up = bank.mesh.up
    if unit not in (None, built_unit):
        built = f"with unit {built_unit}" if built_unit else "without a unit"
        message = f"built {built}, not {unit}; leave the unit out, or build it again"
        raise BankError(message, subject=path, kind="bank unit")
    if up not in (None, built_up):
        message = f"built with {built_up} up, not {up}; leave the axis out, or build it again"
        raise BankError(message, subject=path, kind="bank up")
    return bank
