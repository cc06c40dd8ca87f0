"""Banks on disk: safetensors with the pipeline and a checksum of the contents in the header."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ..errors import BankError, CurviregError, MissingFileError
from ..geometry.views import ViewSphere
from ..mesh.colours import SurfaceColours, surface_colours
from ..mesh.mesh import mesh_unit
from ..mesh.up import mesh_up
from ..pipeline import Pipeline
from ..settings import BankSettings
from ..utils.files import tensor_digest, write_tensors
from .fields import hog_layer

__all__ = ["FORMAT", "FORMAT_VERSION", "RERANKING", "read_bank", "write_bank"]

FORMAT, FORMAT_VERSION = "curvireg_torch.ViewBank", 4
RERANKING = "reranking."
"""Prefix of the names of reranking features among a bank's tensors."""

_NO_UNIT = "none"


def write_bank(
    path: Path, meshes: Sequence[trimesh.Trimesh], views: ViewSphere, pipeline: Pipeline, tensors: Mapping[str, Tensor]
) -> None:
    """Write the parts of a bank, see :meth:`ViewBank.save`."""
    contents = {**tensors, "descriptors": tensors["descriptors"].half()}
    contents |= {f"views.{f.name}": getattr(views, f.name) for f in fields(ViewSphere)}
    for i, mesh in enumerate(meshes):
        contents[f"mesh{i}.vertices"] = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
        contents[f"mesh{i}.faces"] = torch.from_numpy(np.array(mesh.faces, dtype=np.int32))
        contents |= {f"mesh{i}.{name}": torch.from_numpy(x.copy()) for name, x in colour_arrays(mesh).items()}
    metadata = {
        "format": FORMAT,
        "version": str(FORMAT_VERSION),
        "pipeline": pipeline.to_json(),
        "units": " ".join(mesh_unit(mesh) or _NO_UNIT for mesh in meshes),
        "up": " ".join(mesh_up(mesh) for mesh in meshes),
        "checksum": tensor_digest(contents, size=16),
    }
    write_tensors(path, contents, metadata)


def read_bank(path: Path) -> tuple[list[trimesh.Trimesh], ViewSphere, Pipeline, dict[str, Tensor]]:
    """Read and check what :func:`write_bank` wrote: meshes, views, pipeline and tensors on the CPU."""
    rebuild = "build it again with 'curvireg bank MESH --out FILE'"
    if not path.is_file():
        raise MissingFileError(f"no such bank; build one with 'curvireg bank MESH --out {path}'", subject=path)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise BankError("not a view bank; build one with 'curvireg bank MESH --out FILE'", subject=path)
            if (version := metadata.get("version")) != str(FORMAT_VERSION):
                message = f"bank format {version}, this library reads {FORMAT_VERSION}; {rebuild}"
                raise BankError(message, subject=path)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise BankError(f"truncated or not a safetensors file ({error}); {rebuild}", subject=path) from error
    try:
        if metadata["checksum"] != tensor_digest(tensors, size=16):
            raise BankError(f"changed since it was written (its checksum differs); {rebuild}", subject=path)
        pipeline = Pipeline.from_json(metadata["pipeline"])
        views = ViewSphere(**{f.name: tensors[f"views.{f.name}"] for f in fields(ViewSphere)})
        units, ups = metadata["units"].split(" "), metadata["up"].split(" ")
        meshes = [_mesh(tensors, i, *names) for i, names in enumerate(zip(units, ups, strict=True))]
        _check_contents(len(meshes), views, pipeline.bank, tensors)
    except (KeyError, TypeError, ValueError, CurviregError) as error:
        if isinstance(error, BankError):
            raise
        raise BankError(f"incomplete bank ({error!r}); {rebuild}", subject=path) from error
    return meshes, views, pipeline, tensors


def _mesh(tensors: Mapping[str, Tensor], index: int, unit: str, up: str) -> trimesh.Trimesh:
    vertices, faces = tensors[f"mesh{index}.vertices"].numpy(), tensors[f"mesh{index}.faces"].numpy()
    if faces.size == 0 or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError(f"mesh {index} is not a mesh")
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    if unit != _NO_UNIT:
        mesh.units = unit
    mesh.metadata["up"] = up
    prefix = f"mesh{index}.colours."
    arrays: dict[str, Any] = {n.removeprefix(prefix): x.numpy() for n, x in tensors.items() if n.startswith(prefix)}
    if arrays:
        textures = tuple(arrays[f"picture{k}"] for k in range(len(arrays) - 3))
        colours = SurfaceColours(arrays["corners"], arrays["uv"].astype(np.float32), arrays["texture"], textures)
        colours.check(len(faces))
        mesh.metadata["colours"] = colours
    return mesh


def colour_arrays(mesh: trimesh.Trimesh) -> dict[str, np.ndarray]:
    """The mesh's colours as arrays, without loss; empty for a mesh without colours."""
    colours = surface_colours(mesh)
    if colours is None:
        return {}
    arrays: dict[str, np.ndarray] = {"corners": colours.corners, "uv": colours.uv, "texture": colours.texture}
    arrays |= {f"picture{k}": texture for k, texture in enumerate(colours.textures)}
    return {f"colours.{name}": x for name, x in arrays.items()}


def _check_contents(meshes: int, views: ViewSphere, settings: BankSettings, tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError for contents that no bank has: a checksum only shows that the file was not changed."""
    N, S = len(views), settings.image_size
    packed = (N, -(-(S**2) // 8))
    descriptors, boxes, model = tensors["descriptors"], tensors["boxes"], tensors["model"]
    shapes = {"descriptors": (N, hog_layer(settings).length), "boxes": (N, 4), "model": (N,)}
    shapes |= {"points": packed, "silhouettes": packed}
    wrong = [name for name, shape in shapes.items() if tuple(tensors[name].shape) != shape]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: not of the shape that the settings say")
    viewpoints = torch.stack([getattr(views, f.name).double() for f in fields(ViewSphere)])
    valid: dict[str, Tensor | bool] = {
        "viewpoints that are not finite": viewpoints.isfinite().all(),
        "descriptors that are not finite, or all zero": _is_finite(descriptors) and descriptors.any(),
        "boxes that are empty or not finite": boxes.isfinite().all() and (boxes[:, 2:] > boxes[:, :2]).all(),
        "views of meshes that do not exist": ((model >= 0) & (model < meshes)).all(),
    }
    for name in (name for name in tensors if name.startswith(RERANKING)):
        x, message = tensors[name], f"features of {name} that do not fit the views, or are not finite"
        valid[message] = _is_finite(x) and x.ndim == 2 and len(x) == N
    for message, passed in valid.items():
        if not bool(passed):
            raise ValueError(message)


def _is_finite(x: Tensor) -> Tensor:
    """Whether all half-precision values are finite: their sum in float32 cannot overflow otherwise, and is fast."""
    return x.sum(dtype=torch.float32).isfinite()
