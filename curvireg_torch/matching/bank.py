"""A bank of rendered views of one or several meshes, described once and matched many times."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor
from tqdm import tqdm

from ..errors import BankError, InvalidInputError
from ..geometry.views import ViewSphere
from ..mesh.mesh import as_mesh, mesh_radius
from ..mesh.up import mesh_up
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..settings import BankSettings
from ..utils.threads import single_threaded_pool
from .bank_file import RERANKING, read_bank, write_bank
from .describe import ViewDescriber

__all__ = ["ViewBank"]


class ViewBank:
    """N views of one mesh, or of several: descriptors, feature points, silhouettes and cameras.

    Attributes:
        meshes: the meshes, in their files' own frames and units.
        model: (N,) int64: which of the meshes each view shows.
        views: the N viewpoints.
        pipeline: the pipeline that the bank was built for.
        descriptors: (N, D) float32.
        points, silhouettes: (N, S, S) bool, unpacked on demand. For a large bank use :meth:`points_at` and
            :meth:`silhouettes_at`, which unpack a few views at a time.
        boxes: (N, 4) float64 boxes of the object in normalised image coordinates, centre of the object on the axis.
        reranking_features: features of the views by the name of their :class:`RerankingTerm`, (N, D) float16; none in a
            large bank. Meshes with colours have grey features followed by coloured ones.
    """

    def __init__(
        self, meshes: Sequence[trimesh.Trimesh], views: ViewSphere, pipeline: Pipeline, tensors: dict[str, Tensor]
    ) -> None:
        self.meshes, self.views, self.pipeline = tuple(meshes), views, pipeline
        self.descriptors = tensors["descriptors"].float()
        self.boxes, self.model = tensors["boxes"], tensors["model"]
        self._points, self._silhouettes = tensors["points"], tensors["silhouettes"]
        reranking = (name for name in tensors if name.startswith(RERANKING))
        self.reranking_features = {name.removeprefix(RERANKING): tensors[name] for name in reranking}

    def __len__(self) -> int:
        return len(self.views)

    def __repr__(self) -> str:
        faces = sum(len(mesh.faces) for mesh in self.meshes)
        return f"ViewBank({len(self)} views of {len(self.meshes)} meshes, {faces} faces, {self.settings})"

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The mesh of a bank of one mesh; an error if there are several."""
        if len(self.meshes) != 1:
            raise InvalidInputError(f"bank: has {len(self.meshes)} meshes; choose one of bank.meshes")
        return self.meshes[0]

    @property
    def settings(self) -> BankSettings:
        """How the views are rendered and described."""
        return self.pipeline.bank

    @property
    def device(self) -> torch.device:
        return self.descriptors.device

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations model -> camera, each in its own model's frame."""
        return self.views.rotations.to(self.device)

    @property
    def distances(self) -> Tensor:
        """(N,) float64 distances of the object's centre, in the unit of each view's mesh."""
        radii = torch.tensor([mesh_radius(mesh) for mesh in self.meshes], dtype=torch.float64, device=self.device)
        return self.views.distance.to(radii) * radii[self.model]

    @property
    def points(self) -> Tensor:
        """(N, S, S) bool feature points of the views."""
        return self.points_at(slice(None))

    @property
    def silhouettes(self) -> Tensor:
        """(N, S, S) bool: pixels that show the object."""
        return self.silhouettes_at(slice(None))

    def points_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool feature points of some views."""
        return _unpack(self._points[index], self.settings.image_size)

    def silhouettes_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool silhouettes of some views."""
        return _unpack(self._silhouettes[index], self.settings.image_size)

    def check_compatible(self, pipeline: Pipeline) -> None:
        """Raise :class:`BankError` unless the bank's settings and view policy are those of ``pipeline``.

        Views that were passed by the caller (``pose="given"``) fit every view policy.
        """
        mine, theirs = asdict(self.settings), asdict(pipeline.bank)
        if self.pipeline.views.pose != "given":
            mine |= self.pipeline.views.key_fields()
            theirs |= pipeline.views.key_fields()
        if mine != theirs:
            names = [n for n in mine if n in theirs and mine[n] != theirs[n]]
            differences = ", ".join(f"{n} {mine[n]}, expected {theirs[n]}" for n in names)
            raise BankError(f"bank: built with other settings ({differences}); build it again, or use bank.pipeline")

    @classmethod
    def build(
        cls,
        mesh: Any,
        views: ViewSphere | None = None,
        *,
        image_size: int | None = None,
        camera: str | None = None,
        renderer: str | DepthRenderer = "auto",
        settings: BankSettings | None = None,
        pipeline: Pipeline | None = None,
        progress: bool | Callable[[str, int, int], object] = True,
        chunk_size: int = 24,
        device: torch.device | str = "cpu",
    ) -> "ViewBank":
        """Render, filter and describe every view, in chunks on as many threads as torch may use.

        Args:
            mesh: a mesh or the path of one.
            views: custom viewpoints; default those of the pipeline.
            image_size, camera: instead of the pipeline's.
            renderer: "auto", "embree", "pyrender", "torch" or a :class:`DepthRenderer` of this mesh.
            settings: instead of the pipeline's ``bank``.
            pipeline: default ``Pipeline()``.
            progress: show a bar; or a callback (stage "bank", views done, views in all) that may raise to cancel.
            chunk_size: views that a thread holds in memory, about 60 bytes x image_size^2 each.
            device: where views are filtered and described, and where the bank is stored.

        Raises:
            MeshError, MissingFileError, InvalidInputError, RenderingError.

        Example:
            >>> from curvireg_torch.geometry import sample_views
            >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90, elevations=[20]),
            ...                       image_size=64, progress=False)
            >>> len(bank), bank.descriptors.shape
            (4, torch.Size([4, 1764]))
        """
        mesh, pipeline = as_mesh(mesh), pipeline or Pipeline()
        options: dict[str, Any] = {"image_size": image_size, "camera": camera}
        settings = replace(settings or pipeline.bank, **{k: v for k, v in options.items() if v is not None})
        pipeline = replace(pipeline, bank=settings)
        if views is None:
            views = pipeline.views.sphere(mesh_up(mesh))
        elif len(views) == 0:
            raise InvalidInputError("views: expected at least one viewpoint")
        else:
            pipeline = pipeline.with_pose_prior("given")
        if chunk_size < 1:
            raise InvalidInputError(f"chunk_size: expected >= 1, got {chunk_size}")
        describe = ViewDescriber(mesh, settings, renderer=renderer, device=device)
        rotations, distances = views.rotations, views.distance * mesh_radius(mesh)
        reranking = {t.name: t.build(None).to(device) for t in pipeline.reranking_terms(len(views))}

        def describe_chunk(start: int) -> dict[str, Tensor]:
            chunk = rotations[start : start + chunk_size], distances[start : start + chunk_size]
            described = describe(*chunk)
            tensors = vars(described) | {n: _pack(getattr(described, n)) for n in ("points", "silhouettes")}
            return tensors | {
                RERANKING + n: module.describe(describe.shaded(*chunk)).half() for n, module in reranking.items()
            }

        parts = []
        with (
            tqdm(total=len(views), desc="views", unit="view", disable=progress is not True) as bar,
            single_threaded_pool() as pool,
        ):
            for part in pool.map(describe_chunk, range(0, len(views), chunk_size)):
                parts.append(part)
                bar.update(len(part["boxes"]))
                if callable(progress):
                    progress("bank", min(chunk_size * len(parts), len(views)), len(views))
        tensors = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        tensors["model"] = torch.zeros(len(views), dtype=torch.long, device=tensors["boxes"].device)
        return cls([mesh], views, pipeline, tensors)

    @classmethod
    def join(cls, banks: "Sequence[ViewBank]") -> "ViewBank":
        """Concatenate one or more banks of equal settings, view policies and devices into one of several models.

        A single bank is returned as it is.

        Example:
            >>> from curvireg_torch.geometry import sample_views
            >>> views = sample_views(azimuth_step=90, elevations=[20])
            >>> meshes = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 3))
            >>> both = ViewBank.join([ViewBank.build(m, views, image_size=64, progress=False) for m in meshes])
            >>> len(both), both.model.tolist()
            (8, [0, 0, 0, 0, 1, 1, 1, 1])
        """
        if not banks:
            raise InvalidInputError("banks: expected at least one bank, got none")
        first = banks[0]
        for i, bank in enumerate(banks):
            for what, mine, theirs in (
                ("set of settings", bank.settings, first.settings),
                ("view policy", bank.pipeline.views.key_fields(), first.pipeline.views.key_fields()),
                ("device", bank.device, first.device),
            ):
                if mine != theirs:
                    raise InvalidInputError(f"banks: expected one {what}, but bank {i} has {mine} and bank 0 {theirs}")
        if len(banks) == 1:
            return first
        names = [name for name in first.tensors if all(name in bank.tensors for bank in banks)]
        tensors = {name: _concatenate([bank.tensors[name] for bank in banks]) for name in names}
        shift = torch.tensor([0, *(len(bank.meshes) for bank in banks)]).cumsum(0)[:-1].tolist()
        tensors["model"] = torch.cat([bank.model + n for bank, n in zip(banks, shift, strict=True)])
        views = ViewSphere(*(torch.cat([getattr(b.views, f.name) for b in banks]) for f in fields(ViewSphere)))
        return cls([mesh for bank in banks for mesh in bank.meshes], views, first.pipeline, tensors)

    def to(self, device: torch.device | str) -> "ViewBank":
        """The same bank on another device."""
        return ViewBank(self.meshes, self.views, self.pipeline, {k: v.to(device) for k, v in self.tensors.items()})

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the views; masks packed eight pixels to a byte."""
        return {
            "descriptors": self.descriptors,
            "boxes": self.boxes,
            "points": self._points,
            "silhouettes": self._silhouettes,
            "model": self.model,
            **{RERANKING + name: features for name, features in self.reranking_features.items()},
        }

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file atomically. Descriptors in float16 change cosines by less than 1e-4."""
        write_bank(Path(path), self.meshes, self.views, self.pipeline, self.tensors)

    @classmethod
    def load(cls, path: str | PathLike[str], *, device: torch.device | str = "cpu") -> "ViewBank":
        """Read a bank written by :meth:`save`.

        Raises:
            MissingFileError: no such file.
            BankError: truncated, changed, not a bank, or written by another version of the format.
        """
        return cls(*read_bank(Path(path))).to(device)


def _concatenate(parts: list[Tensor]) -> Tensor:
    """Concatenate; beside coloured meshes, the grey features of meshes without colours are repeated."""
    widest = max(part.shape[1:].numel() for part in parts)
    return torch.cat([p.repeat(1, widest // p.shape[1]) if p.ndim == 2 else p for p in parts])


def _pack(mask: Tensor) -> Tensor:
    """(N, S, S) bool to (N, ceil(S * S / 8)) uint8."""
    return torch.from_numpy(np.packbits(mask.flatten(1).cpu().numpy(), axis=1)).to(mask.device)


def _unpack(packed: Tensor, size: int) -> Tensor:
    bits = np.unpackbits(packed.cpu().numpy(), axis=1, count=size * size)
    return torch.from_numpy(bits.view(bool)).view(-1, size, size).to(packed.device)
