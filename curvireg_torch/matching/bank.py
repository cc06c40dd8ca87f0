"""A bank of rendered views of a mesh, described once, stored as safetensors, and matched many
times."""

import json
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
import trimesh
from safetensors import SafetensorError, safe_open
from torch import Tensor
from tqdm import tqdm

from ..errors import BankError, CurviregError, InvalidInputError, MissingFileError
from ..features.whitening import Precision, Whitening, ledoit_wolf
from ..geometry.viewpoint import ViewSphere, up_rotation
from ..mesh import Mesh, MeshWarning, SurfaceColours, mesh_symmetries
from ..mesh.mesh import (
    as_mesh,
    checked_triangles,
    extreme_points,
    mesh_radius,
    principal_rotation,
)
from ..mesh.reflections import is_its_own_mirror_image
from ..mesh.round_axis import RoundAxis, round_axis
from ..pipeline import BankSettings, Pipeline, ViewPolicy
from ..rendering import DepthRenderer
from ..terms import Appearance
from ..utils.aliases import Fields, PathName, Progress
from ..utils.arrays import Array
from ..utils.checks import check_device, check_finite, check_symmetries, check_tensor
from ..utils.files import tensor_checksum, write_tensors
from ..utils.likes import MeshLike
from ..utils.precision import full_precision
from ..utils.threads import single_threaded_pool
from .cells import Packing, packing_of_views
from .describe import VIEW_FACES, ViewDescriber, hog_layer, view_mesh

FORMAT = "curvireg_torch.ViewBank"
FORMAT_VERSION = 13
PIXELS_AT_A_TIME = 72 * 128**2  # of views that a thread holds in memory, about 60 bytes each
TURNS = 24  # in-plane rotations of the default views: quarter turns among them share a rendering
VIEWS_ON_DEVICE = 480  # the same on another device than the CPU
EXTREME_TOLERANCE = 0.02  # radii by which the points that bound projections may miss the mesh's box
REBUILD = "build it again"


class ViewBank:
    """N views of a mesh: descriptors, feature points, silhouettes and cameras.

    Attributes:
        mesh: in its file's own frame and unit.
        views: the N viewpoints.
        pipeline: the pipeline that the bank was built for.
        descriptors: (N, D) float32.
        boxes: (N, 4) float64 boxes of the object in normalised image coordinates, centre of the
            object on the axis.
        appearance: (N, D) float16 features for the :class:`Appearance` term; None in a large bank.
            Meshes with colours have grey features followed by coloured ones.
        described_views_file: where those of a large bank are kept, as views are described; None
            keeps them in memory.

    Example:
        >>> import curvireg_torch as cr
        >>> views = cr.sample_views(azimuth_step=60, elevations=[20])
        >>> mesh = cr.synthetic.example_mesh()
        >>> bank = cr.ViewBank.build(mesh, views, image_size=64, progress=False)
        >>> len(bank), bank.rotations.shape
        (6, torch.Size([6, 3, 3]))
    """

    described_views_file: Path | None = None

    def __init__(
        self,
        mesh: Mesh,
        views: ViewSphere,
        pipeline: Pipeline,
        tensors: Mapping[str, Tensor],
    ) -> None:
        self.mesh = mesh
        self.views = views
        self.pipeline = pipeline
        self.descriptors = tensors["descriptors"].float()
        self.boxes = tensors["boxes"]
        self._points = tensors["points"]
        self._silhouettes = tensors["silhouettes"]
        self.appearance = tensors.get("appearance")
        self._packings: dict[float, Packing] = {}

    def __len__(self) -> int:
        return len(self.views)

    def __repr__(self) -> str:
        return (
            f"ViewBank({len(self)} views of a mesh of {len(self.mesh.faces)} faces, "
            f"{self.settings})"
        )

    @property
    def settings(self) -> BankSettings:
        """How the views are rendered and described."""
        return self.pipeline.bank

    @property
    def device(self) -> torch.device:
        return self.descriptors.device

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations model -> camera."""
        return self.views.rotations.to(self.device)

    @property
    def distances(self) -> Tensor:
        """(N,) float64 distances of the object's centre, in the mesh's unit."""
        return self.views.distance.to(self.device, torch.float64) * mesh_radius(self.mesh)

    def packing(self, angle: float) -> Packing:
        """Views that stand for the others, more than ``angle`` degrees apart."""
        if angle not in self._packings:
            self._packings[angle] = packing_of_views(self.rotations, angle)
        return self._packings[angle]

    @cached_property
    def whitening(self) -> Whitening:
        """By mean and shrunk covariance of the views' descriptors, for
        ``Correlation(whitening="bank")``."""
        return Whitening(*ledoit_wolf(self._different_descriptors()))

    @cached_property
    def precision(self) -> Precision:
        """Inverse of the shrunk covariance of the views' descriptors, for
        ``Correlation(whitening="paper")``."""
        return Precision(self._different_descriptors())

    def _different_descriptors(self) -> Tensor:
        """(K, D) descriptors, one of each picture: to an orthographic camera views at several
        distances are the same one, which counted several times would look like more data."""
        if self.settings.camera == "perspective":
            return self.descriptors
        rotations = self.views.rotations.flatten(1).numpy()
        _, first = np.unique(rotations, axis=0, return_index=True)
        return self.descriptors[torch.from_numpy(first).to(self.device)]

    def points_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool feature points of some views."""
        return _unpack(self._points[index], self.settings.image_size)

    def silhouettes_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool silhouettes of some views."""
        return _unpack(self._silhouettes[index], self.settings.image_size)

    def check_compatible(self, pipeline: Pipeline) -> None:
        """Raise :class:`BankError` unless settings and view policy are those of ``pipeline``; views
        that were passed by the caller (``pose="given"``) fit every policy."""
        mine = asdict(self.settings)
        theirs = asdict(pipeline.bank)
        if self.pipeline.views.pose != "given":
            mine |= self.pipeline.views.key_fields()
            theirs |= pipeline.views.key_fields()
        if mine != theirs:
            names = [n for n in mine if n in theirs and mine[n] != theirs[n]]
            differences = ", ".join(f"{n} {mine[n]}, expected {theirs[n]}" for n in names)
            raise BankError(
                f"bank: built with other settings ({differences}); build it again, or use "
                f"bank.pipeline"
            )

    @classmethod
    @full_precision()
    def build(
        cls,
        mesh: MeshLike,
        views: ViewSphere | None = None,
        *,
        image_size: int | None = None,
        camera: str | None = None,
        renderer: str | DepthRenderer = "auto",
        pipeline: Pipeline | None = None,
        progress: bool | Progress = True,
        device: torch.device | str = "cpu",
    ) -> "ViewBank":
        """Render, filter and describe every view, in chunks on several threads.

        Args:
            mesh: a mesh or the path of one, see :func:`curvireg_torch.load_mesh`.
            views: custom viewpoints; default those of the pipeline.
            image_size, camera: instead of the pipeline's.
            renderer: "auto", "embree", "pyrender" or a :class:`DepthRenderer` of this mesh.
            pipeline: default ``Pipeline()``.
            progress: show a bar; or a callback (stage "bank", views done, views in all) that may
                raise to cancel.
            device: where views are filtered and described, and where the bank is stored.

        Example:
            >>> from curvireg_torch.geometry import sample_views
            >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90,
            ...     elevations=[20]),
            ...                       image_size=64, progress=False)
            >>> len(bank), bank.descriptors.shape
            (4, torch.Size([4, 1764]))
        """
        check_device(device)
        mesh = as_mesh(mesh)
        pipeline = pipeline or Pipeline()
        given = {"image_size": image_size, "camera": camera}
        changed: Fields = {k: v for k, v in given.items() if v is not None}
        pipeline = replace(pipeline, bank=replace(pipeline.bank, **changed))
        if views is None:
            views = views_of(mesh, pipeline.views)
        elif len(views) == 0:
            raise InvalidInputError("views: expected at least one viewpoint")
        else:
            pipeline = pipeline.with_pose_prior("given")
        describe = ViewDescriber(mesh, pipeline.bank, renderer=renderer, device=device)
        term = pipeline.stored_appearance(len(views))
        appearance = None if term is None else term.build().to(device)

        def describe_chunk(rotations: Tensor, distances: Tensor) -> dict[str, Tensor]:
            tensors = packed(describe(rotations, distances))
            if appearance is not None:
                shaded = describe.shaded(rotations, distances)
                tensors["appearance"] = appearance.describe(shaded).half()
            return tensors

        on_cpu = torch.device(device).type == "cpu"
        at_a_time = views_at_a_time(pipeline.bank.image_size) if on_cpu else VIEWS_ON_DEVICE
        distances = views.distance * mesh_radius(mesh)
        chunks = views.rotations.split(at_a_time), distances.split(at_a_time)
        parts = []
        with (
            tqdm(total=len(views), desc="views", unit="view", disable=progress is not True) as bar,
            single_threaded_pool() if on_cpu else nullcontext() as pool,
        ):
            for part in (map if pool is None else pool.map)(describe_chunk, *chunks):
                parts.append(part)
                bar.update(len(part["boxes"]))
                if callable(progress):
                    progress("bank", sum(len(each["boxes"]) for each in parts), len(views))
        tensors = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        return cls(mesh, views, pipeline, tensors)

    def to(self, device: torch.device | str) -> "ViewBank":
        """The same bank on another device."""
        if str(device) != "meta":  # shapes alone
            check_device(device)
        bank = ViewBank(
            self.mesh, self.views, self.pipeline, {k: v.to(device) for k, v in self.tensors.items()}
        )
        # another device rounds differently: a file has the features of a CPU
        on_cpu = bank.device.type == "cpu"
        bank.described_views_file = self.described_views_file if on_cpu else None
        bank._packings = {
            angle: Packing(*(x.to(device) for x in packing))
            for angle, packing in self._packings.items()
        }
        return bank

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the views; masks packed eight pixels to a byte."""
        return {
            "descriptors": self.descriptors,
            "boxes": self.boxes,
            "points": self._points,
            "silhouettes": self._silhouettes,
            **({} if self.appearance is None else {"appearance": self.appearance}),
        }

    def save(self, path: PathName) -> None:
        """Write a safetensors file atomically. Descriptors in float16 change cosines by less than
        1e-4."""
        contents = {**self.tensors, "descriptors": self.descriptors.half()}
        contents |= {f"views.{name}": x for name, x in self.views.columns().items()}
        arrays = {f"mesh.{name}": x for name, x in colour_arrays(self.mesh).items()}
        surfaces = {"mesh": self.mesh.surface}
        if len(self.mesh.faces) > VIEW_FACES:
            surfaces["view_mesh"] = view_mesh(self.mesh)
        for kind, surface in surfaces.items():
            arrays[f"{kind}.vertices"] = np.array(surface.vertices, np.float64)
            arrays[f"{kind}.faces"] = np.array(surface.faces, np.int32)
        contents |= {name: torch.from_numpy(x.copy()) for name, x in arrays.items()}
        contents["extreme_points"] = extreme_points(self.mesh)
        if not self.mesh.has_colours:
            contents["mesh_symmetries"] = mesh_symmetries(self.mesh)
        axis = round_axis(self.mesh)
        if axis is not None:
            contents["round_axis"] = torch.stack([axis.direction, axis.point])
        angle = self._compared_angle()
        if angle is not None:
            contents |= {f"packing.{name}": x for name, x in self.packing(angle)._asdict().items()}
        metadata = {
            "format": FORMAT,
            "version": str(FORMAT_VERSION),
            "pipeline": self.pipeline.to_json(),
            "mesh": self.mesh.file_name,
            "unit": self.mesh.unit or "",
            "up": self.mesh.up,
            "is_its_own_mirror_image": str(is_its_own_mirror_image(self.mesh)),
            "ends_are_alike": json.dumps(axis and axis.ends_are_alike),
            "warnings": json.dumps([asdict(warning) for warning in self.mesh.warnings]),
            "packing": json.dumps(angle),
            "checksum": tensor_checksum(contents),
        }
        write_tensors(Path(path), contents, metadata)

    def _compared_angle(self) -> float | None:
        """How far apart the views are that a photograph's appearance is compared with; None if it
        is compared with all, or with none."""
        terms = (term for term in self.pipeline.terms if isinstance(term, Appearance))
        return next((term.min_angle for term in terms if len(self) > term.exhaustive_limit), None)

    @classmethod
    def load(cls, path: PathName, *, device: torch.device | str = "cpu") -> "ViewBank":
        """Read a bank written by :meth:`save`.

        Raises:
            MissingFileError: no such file.
            BankError: truncated, changed, not a bank, or written by another version of the format.
        """
        path = Path(path)
        if not path.is_file():
            raise MissingFileError("no such bank; build one", subject=path, kind="bank")
        try:
            tensors, metadata = _contents(path)
            pipeline = Pipeline.from_json(metadata["pipeline"])
            views = ViewSphere(**{f.name: tensors[f"views.{f.name}"] for f in fields(ViewSphere)})
            mesh = _mesh(tensors, metadata)
            _check_contents(views, pipeline.bank, tensors)
            packings = _packings(tensors, json.loads(metadata["packing"]), len(views))
        except BankError as error:
            raise error.with_subject(path) from None
        except (SafetensorError, OSError) as error:
            raise BankError(
                f"truncated or not a safetensors file ({error}); {REBUILD}",
                subject=path,
                kind="bank",
            ) from error
        except Exception as error:  # a file may hold anything
            reason = str(error) if isinstance(error, CurviregError) else repr(error)
            reason = reason.partition("\n")[0][:200]
            raise BankError(
                f"incomplete bank ({reason}); {REBUILD}", subject=path, kind="bank"
            ) from error
        bank = cls(mesh, views, pipeline, tensors)
        bank._packings = packings
        return bank.to(device)


def _contents(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a bank's file, unchanged since it was written."""
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata() or {}
        if metadata.get("format") != FORMAT:
            raise BankError("not a view bank; build one", kind="bank")
        if (version := metadata.get("version")) != str(FORMAT_VERSION):
            message = f"bank format {version}, this library reads {FORMAT_VERSION}; {REBUILD}"
            raise BankError(message, kind="bank")
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    if metadata["checksum"] != tensor_checksum(tensors):
        message = f"changed since it was written (its checksum differs); {REBUILD}"
        raise BankError(message, kind="bank")
    return tensors, metadata


def views_at_a_time(image_size: int) -> int:
    """How many views a thread describes together: all turns of some directions."""
    return TURNS * max(1, PIXELS_AT_A_TIME // (TURNS * image_size**2))


def view_frame(mesh: Mesh, policy: ViewPolicy) -> Tensor:
    """(3, 3) float64 rotation from the mesh's frame to the one in which the policy's azimuth and
    elevation are."""
    return principal_rotation(mesh) if policy.frame == "principal" else up_rotation(mesh.up)


def views_of(mesh: Mesh, policy: ViewPolicy) -> ViewSphere:
    """The policy's views of a mesh, in the mesh's own frame."""
    if policy.frame == "principal":
        return policy.sphere().in_frame(view_frame(mesh, policy))
    return policy.sphere(mesh.up)


def packed(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What :class:`ViewDescriber` says of N views, with its masks (N, S, S) bool as (N, ceil(S * S
    / 8)) uint8."""
    masks = {name: tensors[name] for name in ("points", "silhouettes")}
    return {**tensors, **{name: _pack(mask.flatten(1)) for name, mask in masks.items()}}


def _pack(mask: Tensor) -> Tensor:
    """(N, ceil(P / 8)) uint8 of (N, P) bool."""
    return torch.from_numpy(np.packbits(mask.cpu().numpy(), axis=1)).to(mask.device)


def _mesh(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> Mesh:
    """The mesh of a bank's file, with what this knows of it."""
    noticed = json.loads(metadata.get("warnings", "[]"))
    mesh = Mesh(
        _triangles(tensors, "mesh"),
        unit=metadata["unit"] or None,
        up=metadata["up"],
        colours=_colours(tensors),
        warnings=tuple(MeshWarning(str(one["kind"]), str(one["text"])) for one in noticed),
        file_name=metadata["mesh"],
    )
    if mesh.colours is not None:
        mesh.colours.check(len(mesh.faces))
    measures = mesh.measures
    measures |= {n: tensors[n] for n in ("extreme_points", "mesh_symmetries") if n in tensors}
    if len(mesh.faces) > VIEW_FACES:
        measures["view_mesh"] = _triangles(tensors, "view_mesh")
    measures["is_its_own_mirror_image"] = metadata["is_its_own_mirror_image"] == "True"
    measures["round_axis"] = _round_axis(tensors, json.loads(metadata["ends_are_alike"]))
    _check_extreme_points(mesh)
    if not mesh.has_colours:
        check_symmetries(mesh_symmetries(mesh))
    return mesh


def _colours(tensors: Mapping[str, Tensor]) -> SurfaceColours | None:
    """What :func:`colour_arrays` are of."""
    prefix = "mesh.colours."
    arrays = {n.removeprefix(prefix): x.numpy() for n, x in tensors.items() if prefix in n}
    if "uv" not in arrays:
        return None
    textures = tuple(arrays[f"picture{k}"] for k in range(len(arrays) - 3))
    uv = arrays["uv"].astype(np.float32)
    return SurfaceColours(arrays["corners"], uv, arrays["texture"], textures)


def _triangles(tensors: Mapping[str, Tensor], name: str) -> trimesh.Trimesh:
    vertices = tensors[f"{name}.vertices"]
    faces = tensors[f"{name}.faces"]
    check_tensor(vertices, f"{name}.vertices", (None, 3))
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype != torch.int32 or not len(faces):
        raise ValueError(f"{name}: not a mesh")
    mesh = trimesh.Trimesh(vertices=vertices.double().numpy(), faces=faces.numpy(), process=False)
    checked_triangles(mesh, name)
    return mesh


def _round_axis(tensors: Mapping[str, Tensor], ends_are_alike: bool | None) -> RoundAxis | None:
    """The axis of a mesh that is nearly round, whose ends are alike, or not; else None."""
    if ends_are_alike is None:
        return None
    axis = tensors["round_axis"]
    check_tensor(axis, "round_axis", (2, 3))
    check_finite(axis, "round_axis")
    return RoundAxis(axis[0], axis[1], ends_are_alike)


def _check_extreme_points(mesh: Mesh) -> None:
    """Raise for points that do not fill the mesh's box, as those outermost in all directions do."""
    points = extreme_points(mesh)
    check_tensor(points, "extreme_points", (None, 3))
    if points.dtype != torch.float64:
        raise ValueError("extreme_points: expected float64")
    check_finite(points, "extreme_points")
    tolerance = EXTREME_TOLERANCE * mesh_radius(mesh)
    if not len(points) or not np.allclose(
        torch.stack(points.aminmax(dim=0)), mesh.bounds, rtol=0.0, atol=tolerance
    ):
        raise ValueError("extreme_points: those of another mesh")


def colour_arrays(mesh: Mesh) -> dict[str, Array]:
    """The mesh's colours as arrays, without loss; empty for a mesh without colours."""
    colours = mesh.colours
    if colours is None:
        return {}
    arrays = dict(vars(colours))
    arrays |= {f"picture{k}": texture for k, texture in enumerate(arrays.pop("textures"))}
    return {f"colours.{name}": x for name, x in arrays.items()}


def _check_contents(
    views: ViewSphere, settings: BankSettings, tensors: Mapping[str, Tensor]
) -> None:
    """Raise ValueError for contents that no bank has: a checksum only shows that the file was not
    changed."""
    N = len(views)
    masks = -(-(settings.image_size**2) // 8)
    widths = {
        "descriptors": hog_layer(settings).length,
        "boxes": 4,
        "points": masks,
        "silhouettes": masks,
    }
    if "appearance" in tensors:
        widths["appearance"] = tensors["appearance"].shape[-1]
    for name, width in widths.items():
        x = tensors[name]
        # A sum in float32 is finite if all half-precision values are, and fast.
        total = x.sum(dtype=torch.float32) if x.is_floating_point() else None
        if x.shape != (N, width) or (total is not None and not total.isfinite()):
            raise ValueError(f"{name}: not of the shape that the settings say, or not finite")
        if name == "descriptors" and not total:
            raise ValueError("descriptors that are all zero")
    if any(tensors[name].dtype != torch.uint8 for name in ("points", "silhouettes")):
        raise ValueError("points, silhouettes: expected uint8")
    if not all(x.isfinite().all() for x in views.columns().values()):
        raise ValueError("viewpoints that are not finite")
    # a sheet that is seen from its edge has a box of no height
    if not (tensors["boxes"][:, 2:] >= tensors["boxes"][:, :2]).all():
        raise ValueError("boxes of negative size")


def _packings(
    tensors: Mapping[str, Tensor], angle: float | None, count: int
) -> dict[float, Packing]:
    """The packing that a file holds of its ``count`` views, by its angle."""
    if angle is None:
        return {}
    packing = Packing(tensors["packing.representatives"], tensors["packing.cells"])
    limits = count, len(packing.representatives)
    is_valid = packing.representatives.ndim == 1 and packing.cells.shape == (count,)
    for index, limit in zip(packing, limits, strict=True):
        is_valid &= index.dtype == torch.int64 and 0 <= int(index.min()) <= int(index.max()) < limit
    if not is_valid:
        raise ValueError("packing: not of the bank's views")
    return {float(angle): packing}


def _unpack(packed: Tensor, size: int) -> Tensor:
    bits = np.unpackbits(packed.cpu().numpy(), axis=1, count=size * size)
    return torch.from_numpy(bits.view(bool)).view(-1, size, size).to(packed.device)
