"""The entry point: photographs, boxes and meshes in; poses out."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from ..errors import CurviregError, InvalidInputError
from ..geometry.pose_prior import PosePrior
from ..geometry.views import ViewSphere
from ..matching import ViewBank, ViewMatcher, cached_bank
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..settings import BankSettings
from ..utils.checks import check_device, check_symmetries
from ..utils.threads import map_on_threads
from .correction import corrected
from .estimator import PoseEstimator
from .inputs import ImageItem, image_items
from .localization import localize
from .refinement import refine
from .results import FailedRegistration, Registration

__all__ = ["Registrar"]


class Registrar(PoseEstimator):
    """Registers photographs to a mesh, or to the best of several.

    The views of the bank are ranked for each box; the best distinct ones become hypotheses, which a search in small
    steps (:func:`search`) and a fit of contours (:func:`fit_contours`) refine, and whose evidence decides their order.
    With a camera matrix the result is rotation and translation with their covariance; without, the rotation.

    Args:
        bank_or_mesh: a :class:`ViewBank`, a :class:`ViewMatcher`, a mesh, its path, or a list of meshes or paths, of
            which the best is reported; the bank of a mesh is read from the disk cache or built.
        pipeline: all settings; default that of a bank, else ``Pipeline()``. ``replace(pipeline, search=False,
            contours=False)`` reports views of the bank, ``replace(pipeline, hypotheses=k)`` k hypotheses.
        views, settings: custom viewpoints and bank settings, for a mesh.
        field: custom photograph filter, see :class:`ViewMatcher`.
        renderer: for search, contour fit and a bank that is built; a custom renderer knows one mesh.
        mesh_is: "exact" for the mesh of this very object, "similar" for that of another one of its kind. It decides how
            far fitted contours are trusted, and the probabilities of the answers. Default: exact for photographs with a
            camera matrix, similar for others.
        symmetries: (S, 4, 4) of the mesh, from :func:`curvireg_torch.geometry.symmetry_transforms`; hypotheses that
            differ by one of them are reported once. Default: those of the shape of a single exact mesh without colours,
            see :func:`curvireg_torch.mesh.mesh_symmetries`; ``torch.eye(4)[None]`` for none.
        device: of modules, bank and search.
        progress: True shows bars. A callback gets (stage, done, total), with the stages "localization" (without a box),
            "bank", "ranking", "search" and "contours"; it may raise to cancel. On a CPU photographs are registered in
            parallel: callback, custom renderer and custom field are then called from several threads.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> result = Registrar(bank)(torch.rand(1, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30]]))[0]
        >>> result.rotation.shape, result.translation
        (torch.Size([3, 3]), None)
    """

    def __init__(
        self,
        bank_or_mesh: Any,
        *,
        pipeline: Pipeline | None = None,
        views: ViewSphere | None = None,
        settings: BankSettings | None = None,
        field: nn.Module | None = None,
        renderer: str | DepthRenderer = "auto",
        mesh_is: str | None = None,
        symmetries: Tensor | None = None,
        device: torch.device | str | None = None,
        progress: bool | Callable[[str, int, int], object] = False,
    ) -> None:
        options: dict[str, Any]
        if device is not None:
            check_device(device)
        if isinstance(bank_or_mesh, ViewBank | ViewMatcher):
            if views is not None or settings is not None:
                raise InvalidInputError("Registrar: views and settings belong to the bank; give them with a mesh only")
        else:
            pipeline = pipeline or Pipeline()
            pipeline = replace(pipeline, bank=settings or pipeline.bank)
            meshes = list(bank_or_mesh) if isinstance(bank_or_mesh, list | tuple) else [bank_or_mesh]
            if not meshes:
                raise InvalidInputError("Registrar: expected a mesh or several, got an empty list")
            options = {"pipeline": pipeline, "renderer": renderer, "progress": progress, "device": device or "cpu"}
            bank_or_mesh = ViewBank.join([cached_bank(mesh, views, **options) for mesh in meshes])
        if isinstance(bank_or_mesh, ViewMatcher):
            if pipeline is not None or field is not None:
                raise InvalidInputError("Registrar: pipeline and field belong to the matcher; give them to ViewMatcher")
            matcher = bank_or_mesh
        else:
            bank = bank_or_mesh if device is None else bank_or_mesh.to(device)
            # Built on one thread, so that rounding does not depend on the number of threads.
            options = {"pipeline": pipeline, "field": field, "renderer": renderer}
            matcher = map_on_threads(lambda bank: ViewMatcher(bank, **options), [bank])[0]
        if not isinstance(renderer, str) and (n := len(matcher.bank.meshes)) != 1:
            raise InvalidInputError(f"renderer: a custom renderer knows one mesh, the bank has {n}; give a name")
        if symmetries is not None:
            check_symmetries(symmetries)
        super().__init__(matcher, mesh_is=mesh_is, symmetries=symmetries, progress=progress)

    @torch.no_grad()
    def __call__(
        self,
        images: Tensor | Sequence[Any],
        boxes: Any | None = None,
        camera_matrices: Any | None = None,
        *,
        prior: PosePrior | Sequence[PosePrior | None] | None = None,
    ) -> list[Registration | FailedRegistration]:
        """Register a batch.

        Args:
            images: (B, C, H, W) or a list of (C, H, W) tensors, (H, W, C) arrays or paths, C = 1 or 3, floating in
                [0, 1] or uint8.
            boxes: (B, 4) x0, y0, x1, y1 in px; None searches for the object, see :func:`localize`.
            camera_matrices: (B, 3, 3) or (3, 3) in px; None: rotations are relative to a camera that looks at the box.
            prior: what is known of the poses in advance, one for all photographs or a list.

        Returns:
            A :class:`Registration` for each photograph; a :class:`FailedRegistration` for one that cannot be registered
            (unreadable, box empty or outside, one colour, NaN), which raises its error on access to a pose.

        Raises:
            InvalidInputError: not as many boxes, cameras or priors as images, or a distance limited without cameras.
        """
        if boxes is None:
            return [results[0] for results in localize(self, images, camera_matrices, prior=prior)]
        return self.map_items(image_items(images, boxes, camera_matrices, prior), self._register_boxes)

    def refine(
        self, images: Tensor | Sequence[Any], camera_matrices: Any, poses: Any
    ) -> list[Registration | FailedRegistration]:
        """Refine known poses, see :func:`curvireg_torch.registration.refine`."""
        return refine(self, images, camera_matrices, poses)

    def _register_boxes(
        self, items: Sequence[ImageItem | CurviregError], first: int
    ) -> list[Registration | FailedRegistration]:
        results = self.register_items(items, first=first)
        return corrected(self, items, results) if self.pipeline.box_jitter and self.pipeline.search else results
