"""A bank of rendered views of one mesh, described once and matched many times."""

import json
from dataclasses import asdict, fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from safetensors import SafetensorError, safe_open
from torch import Tensor
from tqdm import tqdm

from .._files import write_tensors
from .._threads import one_thread_each
from ..errors import BankError, InvalidInputError, MissingFileError
from ..geometry.mesh import as_mesh, mesh_radius
from ..geometry.up import mesh_up
from ..geometry.views import ViewSphere, sample_views
from ..rendering import DepthRenderer
from .describe import BankSettings, ViewDescriber

__all__ = ["FORMAT_VERSION", "ViewBank"]

FORMAT_VERSION = 1


class ViewBank:
    """N views of one mesh: descriptors, feature points, silhouettes and the cameras that saw them.

    Attributes:
        mesh: the mesh, in its file's own frame and unit.
        views: the N viewpoints.
        settings: what the views were made with.
        descriptors: (N, D) float32.
        points, silhouettes: (N, S, S) bool, unpacked on demand; :meth:`points_at` and :meth:`silhouettes_at` unpack a
            few views at a time, which a large bank asks for.
        boxes: (N, 4) float64 boxes of the object in normalised image coordinates, centre of the object on the axis.
    """

    def __init__(
        self, mesh: trimesh.Trimesh, views: ViewSphere, settings: BankSettings, tensors: dict[str, Tensor]
    ) -> None:
        self.mesh, self.views, self.settings = mesh, views, settings
        self.descriptors = tensors["descriptors"].float()
        self.boxes = tensors["boxes"]
        self._points, self._silhouettes = tensors["points"], tensors["silhouettes"]

    def __len__(self) -> int:
        return len(self.views)

    def __repr__(self) -> str:
        return f"ViewBank({len(self)} views, {len(self.mesh.faces)} faces, {self.settings})"

    @property
    def device(self) -> torch.device:
        return self.descriptors.device

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations model -> camera."""
        return self.views.rotations.to(self.device)

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

    @classmethod
    def build(
        cls,
        mesh: Any,
        views: ViewSphere | None = None,
        *,
        image_size: int = 256,
        camera: str = "perspective",
        renderer: str | DepthRenderer = "auto",
        settings: BankSettings | None = None,
        progress: bool = True,
        chunk_size: int = 24,
        device: torch.device | str = "cpu",
    ) -> "ViewBank":
        """Render, filter and describe every view, chunks of them in parallel on as many threads as torch may use.

        Args:
            mesh: a mesh or the path of one.
            views: default :func:`sample_views`, for objects that stand upright.
            image_size, camera: shortcuts into ``settings``.
            renderer: "auto", "embree", "pyrender", "torch" or a :class:`DepthRenderer` of this mesh.
            settings: everything else that may be chosen; overrides the shortcuts.
            progress: show a bar.
            chunk_size: views that a thread has in memory at a time (about 60 bytes x image_size^2 each). Those of one
                direction are rendered at once (:func:`render_views`) where they fall into one chunk.
            device: where views are filtered and described, and where the bank stays.

        Raises:
            MeshError, MissingFileError, InvalidInputError, RenderingError.

        Example:
            >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90, elevations=[20]),
            ...                       image_size=64, progress=False)
            >>> len(bank), bank.descriptors.shape
            (4, torch.Size([4, 1764]))
        """
        mesh = as_mesh(mesh)
        views = sample_views().for_up(mesh_up(mesh)) if views is None else views
        settings = settings or BankSettings(image_size=image_size, camera=camera)
        if chunk_size < 1:
            raise InvalidInputError(f"chunk_size: expected >= 1, got {chunk_size}")
        describe = ViewDescriber(mesh, settings, renderer=renderer, device=device)
        rotations, distances = views.rotations, views.distance * mesh_radius(mesh)

        def chunk(start: int) -> dict[str, Tensor]:
            described = describe(rotations[start : start + chunk_size], distances[start : start + chunk_size])
            return {
                "descriptors": described.descriptors,
                "points": _pack(described.points),
                "silhouettes": _pack(described.silhouettes),
                "boxes": described.boxes,
            }

        parts = []
        with tqdm(total=len(views), desc="views", unit="view", disable=not progress) as bar, one_thread_each() as pool:
            for part in pool.map(chunk, range(0, len(views), chunk_size)):
                parts.append(part)
                bar.update(len(part["boxes"]))
        return cls(mesh, views, settings, {name: torch.cat([part[name] for part in parts]) for name in parts[0]})

    def to(self, device: torch.device | str) -> "ViewBank":
        """The same bank on another device."""
        return ViewBank(self.mesh, self.views, self.settings, {k: v.to(device) for k, v in self._tensors().items()})

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "descriptors": self.descriptors,
            "boxes": self.boxes,
            "points": self._points,
            "silhouettes": self._silhouettes,
        }

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file; it appears whole or not at all, whoever else writes it at the same time.

        Descriptors are stored in float16: they move by at most 5e-4 of themselves, cosines by less than 1e-4
        (``tests/matching/test_bank.py``).
        """
        views = {f"views.{f.name}": getattr(self.views, f.name) for f in fields(ViewSphere)}
        mesh = {
            "mesh.vertices": torch.from_numpy(np.array(self.mesh.vertices, dtype=np.float64)),
            "mesh.faces": torch.from_numpy(np.array(self.mesh.faces, dtype=np.int32)),
        }
        tensors = {**self._tensors(), "descriptors": self.descriptors.half(), **views, **mesh}
        metadata = {
            "format": "curvireg_torch.ViewBank",
            "version": str(FORMAT_VERSION),
            "settings": json.dumps(asdict(self.settings)),
            "unit": self.mesh.units or "m",
        }
        write_tensors(Path(path), tensors, metadata)

    @classmethod
    def load(cls, path: str | PathLike[str], *, device: torch.device | str = "cpu") -> "ViewBank":
        """Read a bank written by :meth:`save`.

        Raises:
            MissingFileError: no such file.
            BankError: truncated, not a bank, or written by another version of the format.
        """
        path = Path(path)
        if not path.is_file():
            raise MissingFileError(f"{path}: no such bank; build one with 'curvireg bank MESH --out {path}'")
        try:
            with safe_open(path, framework="pt", device=str(device)) as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        except (SafetensorError, OSError) as error:
            raise BankError(f"{path}: truncated or not a safetensors file ({error}); build the bank again") from error
        if metadata.get("format") != "curvireg_torch.ViewBank":
            raise BankError(f"{path}: not a view bank; build one with 'curvireg bank MESH --out FILE'")
        if metadata.get("version") != str(FORMAT_VERSION):
            raise BankError(
                f"{path}: bank format version {metadata.get('version')}, this library reads {FORMAT_VERSION}; "
                "build the bank again"
            )
        try:
            settings = BankSettings(**json.loads(metadata["settings"]))
            views = ViewSphere(**{f.name: tensors[f"views.{f.name}"].cpu() for f in fields(ViewSphere)})
            mesh = trimesh.Trimesh(
                vertices=tensors["mesh.vertices"].cpu().numpy(),
                faces=tensors["mesh.faces"].cpu().numpy(),
                process=False,
            )
            mesh.units = metadata["unit"]
            bank = cls(mesh, views, settings, tensors)
            length = settings.descriptor().length
        except (KeyError, TypeError, ValueError) as error:
            raise BankError(f"{path}: incomplete bank ({error!r}); build it again") from error
        packed = (len(views), -(-(settings.image_size**2) // 8))
        shapes = {bank.descriptors.shape: (len(views), length), bank.boxes.shape: (len(views), 4)}
        if any(tuple(a) != b for a, b in shapes.items()) or {bank._points.shape, bank._silhouettes.shape} != {packed}:
            raise BankError(f"{path}: tensors do not match the settings; build the bank again")
        return bank


def _pack(mask: Tensor) -> Tensor:
    """(N, S, S) bool to (N, ceil(S * S / 8)) uint8."""
    return torch.from_numpy(np.packbits(mask.flatten(1).cpu().numpy(), axis=1)).to(mask.device)


def _unpack(packed: Tensor, size: int) -> Tensor:
    bits = np.unpackbits(packed.cpu().numpy(), axis=1, count=size * size)
    return torch.from_numpy(bits.view(bool)).view(-1, size, size).to(packed.device)
