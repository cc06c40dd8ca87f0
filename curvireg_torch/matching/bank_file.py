"""Banks on disk: safetensors with the pipeline and a checksum of the contents in the header."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ..errors import BankError, CurviregError, MissingFileError
from ..geometry.views import ViewSphere
from ..io.meshes.colours import SurfaceColours, surface_colours
from ..io.meshes.mesh import mesh_unit
from ..io.meshes.up import mesh_up
from ..pipeline import Pipeline
from ..utils.digests import tensor_digest
from ..utils.files import write_tensors
from .fields import hog_layer

if TYPE_CHECKING:
    from .bank import ViewBank

__all__ = ["FORMAT", "FORMAT_VERSION", "read_bank", "write_bank"]

FORMAT, FORMAT_VERSION = "curvireg_torch.ViewBank", 4
_NO_UNIT = "none"


def write_bank(bank: "ViewBank", path: Path) -> None:
    """See :meth:`ViewBank.save`."""
    views = {f"views.{f.name}": getattr(bank.views, f.name) for f in fields(ViewSphere)}
    meshes = {}
    for i, mesh in enumerate(bank.meshes):
        meshes[f"mesh{i}.vertices"] = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
        meshes[f"mesh{i}.faces"] = torch.from_numpy(np.array(mesh.faces, dtype=np.int32))
        meshes |= {f"mesh{i}.{name}": torch.from_numpy(x.copy()) for name, x in colour_arrays(mesh).items()}
    tensors = {**bank.tensors, "descriptors": bank.descriptors.half(), **views, **meshes}
    metadata = {
        "format": FORMAT,
        "version": str(FORMAT_VERSION),
        "pipeline": bank.pipeline.to_json(),
        "units": " ".join(mesh_unit(mesh) or _NO_UNIT for mesh in bank.meshes),
        "up": " ".join(mesh_up(mesh) for mesh in bank.meshes),
        "checksum": tensor_digest(tensors, size=16),
    }
    write_tensors(path, tensors, metadata)


def read_bank(path: Path) -> "ViewBank":
    """See :meth:`ViewBank.load`; on the CPU."""
    from .bank import ViewBank

    again = "build it again with 'curvireg bank MESH --out FILE'"
    if not path.is_file():
        raise MissingFileError(f"{path}: no such bank; build one with 'curvireg bank MESH --out {path}'")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise BankError(f"{path}: not a view bank; build one with 'curvireg bank MESH --out FILE'")
            if metadata.get("version") != str(FORMAT_VERSION):
                raise BankError(
                    f"{path}: bank format {metadata.get('version')}, this library reads {FORMAT_VERSION}; {again}"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise BankError(f"{path}: truncated or not a safetensors file ({error}); {again}") from error
    try:
        if metadata["checksum"] != tensor_digest(tensors, size=16):
            raise BankError(f"{path}: changed since it was written (its checksum differs); {again}")
        pipeline = Pipeline.from_json(metadata["pipeline"])
        views = ViewSphere(**{f.name: tensors[f"views.{f.name}"] for f in fields(ViewSphere)})
        units, ups = metadata["units"].split(" "), metadata["up"].split(" ")
        meshes = [_mesh(tensors, i, *facts) for i, facts in enumerate(zip(units, ups, strict=True))]
        bank = ViewBank(meshes, views, pipeline, tensors)
        _check_contents(bank)
    except (KeyError, TypeError, ValueError, CurviregError) as error:
        if isinstance(error, BankError):
            raise
        raise BankError(f"{path}: incomplete bank ({error!r}); {again}") from error
    return bank


def _mesh(tensors: Mapping[str, Tensor], index: int, unit: str, up: str) -> trimesh.Trimesh:
    vertices, faces = tensors[f"mesh{index}.vertices"].numpy(), tensors[f"mesh{index}.faces"].numpy()
    if faces.size == 0 or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError(f"mesh {index} is not a mesh")
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    if unit != _NO_UNIT:
        mesh.units = unit
    mesh.metadata["up"] = up
    own = f"mesh{index}.colours."
    arrays = {name.removeprefix(own): x.numpy() for name, x in tensors.items() if name.startswith(own)}
    if arrays:
        textures = tuple(arrays[f"picture{k}"] for k in range(len(arrays) - 3))
        colours = SurfaceColours(arrays["corners"], arrays["uv"].astype(np.float32), arrays["texture"], textures)
        colours.check(len(faces))
        mesh.metadata["colours"] = colours
    return mesh


def colour_arrays(mesh: trimesh.Trimesh) -> dict[str, np.ndarray]:
    """The mesh's colours as a bank's file holds them, exact, so that a bank read again shows the same mesh."""
    colours = surface_colours(mesh)
    if colours is None:
        return {}
    parts: dict[str, np.ndarray] = {
        "corners": colours.corners,
        "uv": colours.uv,
        "texture": colours.texture,
    }
    parts |= {f"picture{k}": texture for k, texture in enumerate(colours.textures)}
    return {f"colours.{name}": x for name, x in parts.items()}


def _check_contents(bank: "ViewBank") -> None:
    """A checksum says that a file is as it was written, not that sense was written."""
    N, S = len(bank), bank.settings.image_size
    packed = (N, -(-(S**2) // 8))
    shapes = {
        "descriptors": (N, hog_layer(bank.settings).length),
        "boxes": (N, 4),
        "model": (N,),
        "points": packed,
        "silhouettes": packed,
    }
    wrong = [name for name, shape in shapes.items() if tuple(bank.tensors[name].shape) != shape]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: not of the shape that the settings say")
    boxes, angles = bank.boxes, torch.stack([bank.views.azimuth, bank.views.elevation, bank.views.theta])
    if not bool(angles.isfinite().all() and bank.views.distance.isfinite().all()):
        raise ValueError("viewpoints that are not finite")
    for name, features in bank.reranking_features.items():
        if features.ndim != 2 or len(features) != N or not bool(features.isfinite().all()):
            raise ValueError(f"features of {name} that do not fit the views, or are not finite")
    if not bool(bank.descriptors.isfinite().all()) or not bool(bank.descriptors.any()):
        raise ValueError("descriptors that are not finite, or all zero")
    if not bool(boxes.isfinite().all() and (boxes[:, 2:] > boxes[:, :2]).all()):
        raise ValueError("boxes that are empty or not finite")
    if int(bank.model.min()) < 0 or int(bank.model.max()) >= len(bank.meshes):
        raise ValueError("views of meshes that are not there")
