"""The entry point: photographs, boxes and a mesh in; poses out."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from ..errors import CurviregError, InvalidInputError, WorkerError
from ..geometry.pose_prior import PosePrior
from ..geometry.viewpoint import ViewSphere
from ..matching import ViewBank, ViewMatcher, cached_bank
from ..pipeline import BankSettings, Pipeline
from ..rendering import DepthRenderer
from ..utils.checks import check_device, check_integer, check_option, check_symmetries
from ..utils.choices import MESH_KINDS
from ..utils.executors import Workers
from ..utils.likes import ArrayLike, BoxesLike, CameraLike, ImagesLike, MaskLike, MeshLike
from ..utils.precision import full_precision
from .block import share_of_worker
from .detection import detect_block
from .photograph import OnDemand, Photograph, as_photographs
from .refinement import refine
from .result import FailedRegistration, Registration, Results
from .several import register_views
from .stages import Items, register_photographs
from .target import Target

__all__ = ["Registrar"]


class _Task(NamedTuple):
    """A photograph, by its number in the call."""

    number: int
    item: Photograph | CurviregError
    detects: bool


ObjectLike: TypeAlias = MeshLike | ViewBank | ViewMatcher


class Registrar(Target):
    """Registers photographs to a mesh, or to the best of several.

    The views of the bank are ranked for each box; of the best distinct ones the most promising
    become hypotheses, to which contours are fitted (:func:`fit_contours`), and whose evidence
    decides their order. With a camera matrix the result is rotation and translation with their
    covariance; without, the rotation.

    Args:
        bank_or_mesh: a :class:`ViewBank`, a :class:`ViewMatcher`, a mesh, its path, or a list of
            meshes or paths, of which the best is reported, with its ``mesh_index``; the bank of a
            mesh is read from the disk cache or built.
        pipeline: all settings; default that of a bank, else ``Pipeline()``.
            ``replace(pipeline, contours=False)`` reports views of the bank,
            ``replace(pipeline, hypotheses=k)`` k hypotheses.
        views, settings: custom viewpoints and bank settings, for a mesh.
        field: custom photograph filter, see :class:`ViewMatcher`.
        renderer: for views of the mesh and a bank that is built; a custom renderer knows one mesh.
        mesh_is: "exact" for the mesh of this very object (None: the same), "similar" for that of
            another one of its kind. It decides how far fitted contours are trusted, and the
            probabilities of the hypotheses; a focal length is estimated with an exact mesh alone.
        symmetries: (S, 4, 4) of the mesh, from :func:`curvireg_torch.geometry.symmetry_transforms`;
            hypotheses that differ by one of them are reported once. Default: those of the shape of
            an exact mesh without colours, see :func:`curvireg_torch.mesh.mesh_symmetries`;
            ``torch.eye(4)[None]`` for none.
        device: of modules, bank and search.
        workers: processes that register photographs side by side on a CPU, from the first call on;
            1: this one. A script starts processes within ``if __name__ == "__main__":``. They show
            no progress.
        executor: of other workers, such as ``distributed.Client(address).get_executor()`` of a Dask
            cluster.
        progress: True shows bars. A callback gets (stage, done, total), with the stages "detection"
            (without a box), "bank", "ranking", "search" and "contours"; to cancel, it may raise
            what is no :class:`CurviregError`. On a CPU views are drawn and described on several
            threads, which a custom renderer and a custom field are then called from.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45,
        ...     elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> result = Registrar(bank)(torch.rand(1, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30]]))[0]
        >>> result.rotation.shape, result.translation.shape, result.camera.source
        (torch.Size([3, 3]), torch.Size([3]), 'estimated')
    """

    others: Sequence["Registrar"]

    def __init__(
        self,
        bank_or_mesh: ObjectLike | Sequence[ObjectLike],
        *,
        pipeline: Pipeline | None = None,
        views: ViewSphere | None = None,
        settings: BankSettings | None = None,
        field: nn.Module | None = None,
        renderer: str | DepthRenderer = "auto",
        mesh_is: str | None = None,
        symmetries: Tensor | None = None,
        device: torch.device | str | None = None,
        workers: int = 1,
        executor: Executor | None = None,
        progress: bool | Callable[[str, int, int], object] = False,
    ) -> None:
        check_integer(workers, "workers")
        if device is not None:
            check_device(device)
        if mesh_is is not None:
            check_option(mesh_is, MESH_KINDS, "mesh_is")
        if symmetries is not None:
            check_symmetries(symmetries)
        meshes = list(bank_or_mesh) if isinstance(bank_or_mesh, list | tuple) else [bank_or_mesh]
        if not meshes:
            raise InvalidInputError("Registrar: expected a mesh or several, got an empty list")
        if len(meshes) > 1 and not isinstance(renderer, str):
            raise InvalidInputError(
                f"renderer: a custom renderer knows one mesh, got {len(meshes)}; give a name"
            )
        same: dict[str, Any] = {
            "pipeline": pipeline,
            "views": views,
            "settings": settings,
            "field": field,
            "renderer": renderer,
            "device": device,
            "progress": progress,
        }
        known: dict[str, Any] = {"mesh_is": mesh_is, "symmetries": symmetries}
        self.others = [Registrar(mesh, **same, **known) for mesh in meshes[1:]]
        super().__init__(_matcher_of(meshes[0], **same), **known, progress=progress)
        self.workers = Workers(workers, executor) if workers > 1 or executor is not None else None
        if self.workers is not None and self.bank.device.type != "cpu":
            raise InvalidInputError(
                "workers: processes are for the CPU; a GPU registers photographs together"
            )

    @torch.no_grad()
    def __call__(
        self,
        images: ImagesLike,
        boxes: BoxesLike | None = None,
        camera_matrices: CameraLike | None = None,
        *,
        prior: PosePrior | Sequence[PosePrior | None] | None = None,
        masks: Sequence[MaskLike | None] | Tensor | None = None,
    ) -> Results:
        """Register a batch.

        Args:
            images: (B, C, H, W) or a list of (C, H, W) tensors, (H, W, C) arrays, Pillow pictures
                or paths, C = 1 or 3 (RGB), floating in [0, 1] or uint8. Pictures and files are
                turned as their EXIF data say.
            boxes: (B, 4) x0, y0, x1, y1 in px; None searches for the object in all photographs, see
                :func:`detect`.
            camera_matrices: (B, 3, 3) or (3, 3) in px, a :class:`Camera`, or a list of these. None:
                the camera of the EXIF data; without, its focal length is estimated with the pose,
                or with a similar mesh, rotations are relative to a camera that looks at the box.
            prior: what is known of the poses in advance, one for all photographs or a list.
            masks: B masks (H, W) of the objects, white in bool, uint8 or floating in [0, 1], paths,
                or None for some photographs with boxes. Contours are fitted to them; without boxes
                they give these.

        Returns:
            A :class:`Registration` for each photograph; a :class:`FailedRegistration` for one that
            cannot be registered (unreadable, box empty or outside, one colour, NaN) or, without a
            box, that does not show the object convincingly; it raises its error on access to a
            pose.

        Raises:
            InvalidInputError: not as many boxes, cameras, priors or masks as images.
        """
        items = as_photographs(images, boxes, camera_matrices, prior, masks)
        if boxes is None and masks is None:
            return self.register_prepared(items, detects=True)

        def located(index: int) -> Photograph | CurviregError:
            item = items[index]
            if isinstance(item, CurviregError) or item.has_box:
                return item
            return InvalidInputError(
                "has neither box nor mask; register it in a call without boxes, which searches"
            ).of_image(index)

        return self.register_prepared(OnDemand(located, len(items)))

    @torch.no_grad()
    @full_precision()
    def register_prepared(self, items: Items, *, detects: bool = False) -> Results:
        """Register photographs that :func:`.as_photographs` has prepared, each to the best of
        the meshes; ``detects`` searches for the object in the whole photographs.

        :meta private:
        """
        if self.workers is not None and len(items) > 1:
            return _register_by_workers(self, self.workers, items, detects=detects)
        detect = _detected if detects else None
        return register_photographs(self, items, self.others, detect=detect)

    def of_mesh(self, mesh_index: int) -> "Registrar":
        """Return the registrar of one of several meshes, by :attr:`Registration.mesh_index`."""
        return self.others[mesh_index - 1] if mesh_index else self

    def refine(
        self, images: ImagesLike, camera_matrices: CameraLike | None, poses: ArrayLike
    ) -> Results:
        """Refine known poses of the first mesh, see :func:`curvireg_torch.registration.refine`."""
        return refine(self, images, camera_matrices, poses)

    def register_views(
        self,
        images: ImagesLike,
        boxes: BoxesLike | None,
        camera_matrices: CameraLike | None,
        T_cam_from_world: ArrayLike,
    ) -> Registration:
        """Register photographs of one object together, see
        :func:`curvireg_torch.registration.register_views`."""
        return register_views(self, images, boxes, camera_matrices, T_cam_from_world)


def _detected(target: Target, items: Items, first: int) -> Results:
    """The most probable object in each of a few photographs."""
    return [found[0] for found in detect_block(target, items, first)]


def _matcher_of(
    source: Any,
    *,
    pipeline: Pipeline | None,
    views: ViewSphere | None,
    settings: BankSettings | None,
    field: nn.Module | None,
    renderer: str | DepthRenderer,
    device: torch.device | str | None,
    progress: bool | Callable[[str, int, int], object],
) -> ViewMatcher:
    """The matcher of a mesh or a bank, or a given one; see :class:`Registrar`."""
    if isinstance(source, ViewMatcher):
        given = any(value is not None for value in (pipeline, field, views, settings, device))
        if given or renderer != "auto":
            raise InvalidInputError(
                "Registrar: pipeline, field, views, settings, renderer and device belong to the "
                "matcher"
            )
        return source
    if not isinstance(source, ViewBank):
        pipeline = pipeline or Pipeline()
        pipeline = replace(pipeline, bank=settings or pipeline.bank)
        source = cached_bank(
            source,
            views,
            pipeline=pipeline,
            renderer=renderer,
            device=device or "cpu",
            progress=progress,
        )
    elif views is not None or settings is not None:
        raise InvalidInputError(
            "Registrar: views and settings belong to the bank; give them with a mesh only"
        )
    bank = source if device is None else source.to(device)
    return ViewMatcher(bank, pipeline=pipeline, field=field, renderer=renderer)


def _register_by_workers(
    registrar: Registrar,
    workers: Workers,
    items: Items,
    *,
    detects: bool,
) -> Results:
    """:meth:`.Registrar.register_prepared` by workers, which get a copy of the registrar each; a
    photograph that ends them fails."""
    size = share_of_worker(len(items), workers.count)
    numbers = range(len(items))
    # items are read on demand, so that few are in memory
    blocks = (
        [_Task(number, items[number], detects) for number in numbers[start : start + size]]
        for start in numbers[::size]
    )
    found: dict[int, Registration | FailedRegistration] = {}
    for task, result in workers.map(_register_block, _quiet_copy(registrar), blocks):
        if isinstance(result, WorkerError):
            found[task.number] = FailedRegistration(result.of_image(task.number))
        else:
            found[task.number] = result
    return [found[number] for number in range(len(items))]


def _register_block(registrar: Registrar, tasks: Sequence[_Task]) -> Results:
    """The results of a block, whose errors name the number of the photograph in the call."""
    items = [task.item for task in tasks]
    results = registrar.register_prepared(items, detects=tasks[0].detects)
    return [
        FailedRegistration(result.error.of_image(task.number))
        if isinstance(result, FailedRegistration) and isinstance(task.item, Photograph)
        else result
        for task, result in zip(tasks, results, strict=True)
    ]


def _quiet_copy(registrar: Registrar) -> Registrar:
    """A copy that shows no progress and has no workers of its own."""
    other = copy(registrar)
    other.progress = False
    other.workers = None
    other.others = [_quiet_copy(one) for one in registrar.others]
    return other
