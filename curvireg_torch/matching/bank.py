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
from ..io.meshes.mesh import as_mesh, mesh_radius
from ..io.meshes.up import mesh_up
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..settings import BankSettings
from ..utils.threads import one_thread_each
from .describe import ViewDescriber

__all__ = ["ViewBank"]

RERANKING = "reranking."
"""Before the names of features of late terms."""


class ViewBank:
    """N views of one mesh, or of several: descriptors, feature points, silhouettes and the cameras that saw them.

    Attributes:
        meshes: the meshes, in their files' own frames and units.
        model: (N,) int64: which of the meshes each view shows.
        views: the N viewpoints.
        pipeline: what the views were made for.
        descriptors: (N, D) float32.
        points, silhouettes: (N, S, S) bool, unpacked on demand; :meth:`points_at` and :meth:`silhouettes_at` unpack a
            few views at a time, which a large bank asks for.
        boxes: (N, 4) float64 boxes of the object in normalised image coordinates, centre of the object on the axis.
        late: features of the views by the name of their :class:`RerankingTerm`, (N, D) float16; none in a large bank.
            Meshes with colours have grey and coloured features one after the other.
    """

    def __init__(
        self, meshes: Sequence[trimesh.Trimesh], views: ViewSphere, pipeline: Pipeline, tensors: dict[str, Tensor]
    ) -> None:
        self.meshes, self.views, self.pipeline = tuple(meshes), views, pipeline
        self.descriptors = tensors["descriptors"].float()
        self.boxes, self.model = tensors["boxes"], tensors["model"]
        self._points, self._silhouettes = tensors["points"], tensors["silhouettes"]
        self.reranking_features = {
            name.removeprefix(RERANKING): x for name, x in tensors.items() if name.startswith(RERANKING)
        }

    def __len__(self) -> int:
        return len(self.views)

    def __repr__(self) -> str:
        faces = sum(len(mesh.faces) for mesh in self.meshes)
        return f"ViewBank({len(self)} views of {len(self.meshes)} meshes, {faces} faces, {self.settings})"

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The one mesh.

        Raises:
            InvalidInputError: there are several; see ``meshes``.
        """
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

    def check_made_for(self, pipeline: Pipeline) -> None:
        """Raise :class:`BankError` if the views were made in another way than ``pipeline`` asks for.

        Views that came with the call (``pose="given"``) were chosen by the caller and go with every ``pipeline.views``.
        """
        made, asked = asdict(self.settings), asdict(pipeline.bank)
        if self.pipeline.views.pose != "given":
            made |= self.pipeline.views.key_fields()
            asked |= pipeline.views.key_fields()
        differ = [name for name in {**made, **asked} if made.get(name) != asked.get(name)]
        if differ:
            told = ", ".join(f"{n} {made[n]}, asked for {asked[n]}" for n in differ if n in made and n in asked)
            raise BankError(f"bank: made with other settings ({told}); build it again, or use bank.pipeline")

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
        """Render, filter and describe every view, chunks of them in parallel on as many threads as torch may use.

        Args:
            mesh: a mesh or the path of one.
            views: viewpoints of one's own; default those of the pipeline.
            image_size, camera: instead of the pipeline's.
            renderer: "auto", "embree", "pyrender", "torch" or a :class:`DepthRenderer` of this mesh.
            settings: instead of the pipeline's ``bank``.
            pipeline: what the bank is made for; default ``Pipeline()``.
            progress: show a bar; or a function that is told "bank", views done and views in all, and may raise to stop.
            chunk_size: views that a thread has in memory at a time (about 60 bytes x image_size^2 each). Those that are
                quarter turns of each other are rendered once where they fall into one chunk.
            device: where views are filtered and described, and where the bank stays.

        Raises:
            MeshError, MissingFileError, InvalidInputError, RenderingError.

        Example:
            >>> from curvireg_torch.geometry import sample_views
            >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90, elevations=[20]),
            ...                       image_size=64, progress=False)
            >>> len(bank), bank.descriptors.shape
            (4, torch.Size([4, 1764]))
        """
        mesh = as_mesh(mesh)
        pipeline = Pipeline() if pipeline is None else pipeline
        settings = pipeline.bank if settings is None else settings
        settings = settings if image_size is None else replace(settings, image_size=image_size)
        settings = settings if camera is None else replace(settings, camera=camera)
        pipeline = replace(pipeline, bank=settings)
        if views is None:
            views = pipeline.views.sphere(mesh_up(mesh))
        elif len(views) != 0:
            pipeline = pipeline.with_pose_prior("given")
        if len(views) == 0:
            raise InvalidInputError("views: expected at least one viewpoint")
        if chunk_size < 1:
            raise InvalidInputError(f"chunk_size: expected >= 1, got {chunk_size}")
        describe = ViewDescriber(mesh, settings, renderer=renderer, device=device)
        rotations, distances = views.rotations, views.distance * mesh_radius(mesh)
        late = {t.name: t.build(None).to(device) for t in pipeline.reranking_terms(len(views))}

        def chunk(start: int) -> dict[str, Tensor]:
            some = rotations[start : start + chunk_size], distances[start : start + chunk_size]
            described = describe(*some)
            return {
                **{RERANKING + name: module.describe(describe.shaded(*some)).half() for name, module in late.items()},
                "descriptors": described.descriptors,
                "points": _pack(described.points),
                "silhouettes": _pack(described.silhouettes),
                "boxes": described.boxes,
            }

        parts = []
        with (
            tqdm(total=len(views), desc="views", unit="view", disable=progress is not True) as bar,
            one_thread_each() as pool,
        ):
            for part in pool.map(chunk, range(0, len(views), chunk_size)):
                parts.append(part)
                bar.update(len(part["boxes"]))
                if callable(progress):
                    progress("bank", min(chunk_size * len(parts), len(views)), len(views))
        tensors = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        tensors["model"] = torch.zeros(len(views), dtype=torch.long, device=tensors["boxes"].device)
        return cls([mesh], views, pipeline, tensors)

    @classmethod
    def join(cls, banks: "Sequence[ViewBank]") -> "ViewBank":
        """The views of several banks, one after the other: which model fits a photograph best?

        Args:
            banks: at least one, all made for the same pipeline and on one device.

        Raises:
            InvalidInputError: no bank, or banks that do not go together.

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
            if bank.settings != first.settings:
                raise InvalidInputError(
                    f"banks: expected one set of settings, but bank {i} has {bank.settings} and bank 0 {first.settings}"
                )
            if bank.pipeline.views.key_fields() != first.pipeline.views.key_fields():
                raise InvalidInputError(
                    f"banks: expected one view policy, but bank {i} has {bank.pipeline.views.key_fields()} and bank 0 "
                    f"{first.pipeline.views.key_fields()}"
                )
            if bank.device != first.device:
                raise InvalidInputError(
                    f"banks: expected one device, but bank {i} is on {bank.device}, not {first.device}"
                )
        names = [name for name in first.tensors if all(name in bank.tensors for bank in banks)]
        tensors = {name: _joined([bank.tensors[name] for bank in banks]) for name in names}
        shift = torch.tensor([0, *(len(bank.meshes) for bank in banks)]).cumsum(0)[:-1].tolist()
        tensors["model"] = torch.cat([bank.model + n for bank, n in zip(banks, shift, strict=True)])
        views = ViewSphere(*(torch.cat([getattr(b.views, f.name) for b in banks]) for f in fields(ViewSphere)))
        return cls([mesh for bank in banks for mesh in bank.meshes], views, first.pipeline, tensors)

    def locate(self, index: int) -> tuple[int, int]:
        """Number of the model, and of the view among its views, of one of the N views."""
        if not 0 <= index < len(self):
            raise InvalidInputError(f"index: expected 0 <= index < {len(self)}, got {index}")
        model = int(self.model[index])
        return model, int((self.model[:index] == model).sum())

    def to(self, device: torch.device | str) -> "ViewBank":
        """The same bank on another device."""
        return ViewBank(self.meshes, self.views, self.pipeline, {k: v.to(device) for k, v in self.tensors.items()})

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All that was computed of the views; masks packed eight pixels to a byte."""
        return {
            "descriptors": self.descriptors,
            "boxes": self.boxes,
            "points": self._points,
            "silhouettes": self._silhouettes,
            "model": self.model,
            **{RERANKING + name: features for name, features in self.reranking_features.items()},
        }

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file; it appears whole or not at all, whoever else writes it at the same time.

        Descriptors are stored in float16: they move by at most 5e-4 of themselves, cosines by less than 1e-4
        (``tests/matching/test_bank_files.py``).
        """
        from .bank_file import write_bank

        write_bank(self, Path(path))

    @classmethod
    def load(cls, path: str | PathLike[str], *, device: torch.device | str = "cpu") -> "ViewBank":
        """Read a bank written by :meth:`save`.

        Raises:
            MissingFileError: no such file.
            BankError: truncated, changed, not a bank, or written by another version of the format.
        """
        from .bank_file import read_bank

        return read_bank(Path(path)).to(device)


def _joined(parts: list[Tensor]) -> Tensor:
    """One after the other; those of meshes without colours hold their grey features twice beside others."""
    widest = max(part.shape[1:].numel() for part in parts)
    return torch.cat([p.repeat(1, widest // p.shape[1]) if p.ndim == 2 else p for p in parts])


def _pack(mask: Tensor) -> Tensor:
    """(N, S, S) bool to (N, ceil(S * S / 8)) uint8."""
    return torch.from_numpy(np.packbits(mask.flatten(1).cpu().numpy(), axis=1)).to(mask.device)


def _unpack(packed: Tensor, size: int) -> Tensor:
    bits = np.unpackbits(packed.cpu().numpy(), axis=1, count=size * size)
    return torch.from_numpy(bits.view(bool)).view(-1, size, size).to(packed.device)
