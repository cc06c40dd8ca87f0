"""The facade that joins it all: photographs, boxes and a mesh to poses."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from ..errors import ImageError, InvalidInputError
from ..geometry.cameras import check_camera_matrix, rotation_towards
from ..geometry.mesh import as_mesh, mesh_radius
from ..geometry.translation import place_view
from ..geometry.up import mesh_up
from ..geometry.views import ViewSphere, sample_views
from ..matching import (
    BankCollection,
    BankSettings,
    QueryFeatures,
    Ranking,
    ViewBank,
    ViewDescriber,
    ViewMatcher,
    cached_bank,
    normalized_correlation,
)
from .confidence import confidence, distinct_views
from .contour import fit_contours
from .pose import Registration
from .refine import RefinedPose, coherent_views, refine_pose

__all__ = ["Registrar"]

_FLAT = 1.0 / 255.0


class Registrar:
    """Registers photographs to one mesh.

    Each box is cropped, turned into a field and ranked against the bank; coherent views around the best are searched in
    small steps, and the contours of the best are pulled onto the photograph's edges (:func:`fit_contours`). With a
    camera matrix that yields rotation and translation with their covariance; without, the rotation.

    Args:
        bank_or_mesh: a :class:`ViewBank`, a :class:`ViewMatcher` of one model's bank, a mesh, or the path of a mesh;
            for a mesh the bank comes from the disk cache or is built.
        views, settings: of the bank built for a mesh.
        field: photograph filter, see :class:`ViewMatcher`; that of a given matcher stays.
        refine: run the coarse-to-fine search and the contour stage.
        contours: False leaves out the contour stage; the box then gives the translation.
        renderer: of the views rendered in it.
        top: distinct hypotheses to report.
        symmetries: (S, 4, 4) of the mesh, from :func:`curvireg_torch.geometry.symmetry_transforms`; hypotheses that
            differ by one of them are reported once.
        progress: show bars.

    Example:
        >>> import trimesh
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> result = Registrar(bank, refine=False)(torch.rand(1, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30]]))[0]
        >>> result.rotation.shape, result.translation
        (torch.Size([3, 3]), None)
    """

    def __init__(
        self,
        bank_or_mesh: Any,
        *,
        views: ViewSphere | None = None,
        settings: BankSettings | None = None,
        field: nn.Module | None = None,
        refine: bool = True,
        contours: bool = True,
        renderer: str = "auto",
        top: int = 5,
        symmetries: Tensor | None = None,
        progress: bool = False,
    ) -> None:
        bank = bank_or_mesh.bank if isinstance(bank_or_mesh, ViewMatcher) else bank_or_mesh
        if isinstance(bank, ViewBank):
            if views is not None or settings is not None:
                raise InvalidInputError("Registrar: views and settings belong to the bank; give them with a mesh only")
        elif isinstance(bank, BankCollection):
            raise InvalidInputError("Registrar: expected the bank of one model; choose one with BankCollection.locate")
        else:
            bank = as_mesh(bank)
            views = views or sample_views().for_up(mesh_up(bank))
            bank = cached_bank(bank, views, settings or BankSettings(), progress=progress, renderer=renderer)
        self.bank: ViewBank = bank
        self.matcher = bank_or_mesh if isinstance(bank_or_mesh, ViewMatcher) else ViewMatcher(bank, field=field)
        self.refine, self.contours, self.top = refine, refine and contours, top
        self.symmetries = symmetries
        self._renderer = renderer
        self._describer: ViewDescriber | None = None
        self.radius = mesh_radius(self.bank.mesh)
        self._fine = replace(bank.settings, grid=min(2 * bank.settings.grid, bank.settings.image_size))
        self._fine_descriptor = self._fine.descriptor()

    @property
    def describe(self) -> ViewDescriber:
        """Renders and describes further views of the bank's mesh, on a grid twice as fine; made on first use."""
        if self._describer is None:
            self._describer = ViewDescriber(
                self.bank.mesh, self._fine, renderer=self._renderer, device=self.bank.device
            )
        return self._describer

    def search(
        self, field: Tensor, order: Tensor, *, box: Tensor | None = None, camera_matrix: Tensor | None = None
    ) -> RefinedPose:
        """Refine the best coherent views of a ranking, see :func:`refine_pose`.

        Args:
            field: (1, 2, S, S) of the photograph's crop.
            order: (N,) view indices of the bank, best first.
            box, camera_matrix: (4,) and (3, 3) of the photograph; both or none.
        """
        start = coherent_views(self.bank.rotations, order)
        return refine_pose(
            self.describe,
            self._fine_descriptor(field),
            self.bank.rotations[start].cpu(),
            distance=float(self.bank.views.distance[start[0]]) * self.radius,
            radius=self.radius,
            box=box,
            camera_matrix=camera_matrix,
        )

    @torch.no_grad()
    def __call__(
        self, images: Tensor | Sequence[Tensor], boxes: Tensor, camera_matrices: Tensor | None = None
    ) -> list[Registration]:
        """Register a batch.

        Args:
            images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, in [0, 1].
            boxes: (B, 4) x0, y0, x1, y1 in px.
            camera_matrices: (B, 3, 3) or (3, 3) in px; without them translations are None and rotations are relative to
                a camera that looks straight at the box.

        Raises:
            InvalidInputError: wrong shapes, an unusable box or camera matrix.
            ImageError: a box that shows one colour.
        """
        if camera_matrices is not None:
            check_camera_matrix(camera_matrices)
            if camera_matrices.ndim == 3 and len(camera_matrices) not in (1, len(images)):
                raise InvalidInputError(
                    f"camera_matrices: expected one or {len(images)} matrices, got {len(camera_matrices)}"
                )
            camera_matrices = camera_matrices.expand(len(images), 3, 3)
        results: list[Registration] = []
        for i in range(0, len(images), self.matcher.chunk_size):
            chunk = slice(i, i + self.matcher.chunk_size)
            query = self.matcher.query(images[chunk], boxes[chunk])
            crops = query.crops
            contrast = crops.amax(dim=(1, 2, 3)) - crops.amin(dim=(1, 2, 3))
            if bool((contrast < _FLAT).any()):
                flat = i + int((contrast < _FLAT).nonzero()[0])
                raise ImageError(f"image {flat}: the box shows one colour, nothing to register; check image and box")
            ranking = self.matcher.rank(query)
            trust = confidence(ranking, self.bank.rotations)
            for k in range(len(crops)):
                K = None if camera_matrices is None else camera_matrices[i + k]
                results.append(
                    self._register(
                        images[i + k], query[k : k + 1], ranking[k : k + 1], float(trust[k]), boxes[i + k], K
                    )
                )
        return results

    def _register(
        self, image: Tensor, query: QueryFeatures, ranking: Ranking, trust: float, box: Tensor, K: Tensor | None
    ) -> Registration:
        bank, order = self.bank, ranking.order[0]
        best = int(order[0])
        if self.refine:
            pose = self.search(query.field, order, box=box, camera_matrix=K)
        else:
            distance = float(bank.views.distance[best]) * self.radius
            pose = RefinedPose(bank.rotations[best].double().cpu(), distance, float(ranking.hog[0, best]), 0)
        rotation, translation = pose.rotation, None
        if K is not None:
            rotation, translation = place_view(self.describe.hull, pose.rotation, box, K)
        result = Registration(
            rotation=rotation,
            translation=translation,
            score=pose.score,
            confidence=trust,
            ranking=ranking,
            candidates=distinct_views(order, bank.rotations, count=self.top, symmetries=self.symmetries),
            view_rotation=pose.rotation,
            view_distance=pose.distance,
            iterations=pose.iterations,
        )
        return self._follow_contours(result, image, query, box, K) if self.contours else result

    def _follow_contours(
        self, result: Registration, image: Tensor, query: QueryFeatures, box: Tensor, K: Tensor | None
    ) -> Registration:
        """``result`` with the pose that :func:`fit_contours` finds from it."""
        describe, margin = self.describe, self.bank.settings.margin
        if K is not None and result.transform is not None:
            start, camera = result.transform, K
        else:
            start, camera = describe.camera_of_box(result.view_rotation, result.view_distance, box)
        fit = fit_contours(
            describe.renderer,
            image,
            box,
            camera,
            start[None],
            centre=describe.centre,
            radius=self.radius,
            margin=margin,
        )
        R, t = fit.transform[0, :3, :3], fit.transform[0, :3, 3]
        position = R @ describe.centre + t
        view_rotation, view_distance = rotation_towards(position).T @ R, float(torch.linalg.vector_norm(position))
        covariance = fit.covariance[0] if K is not None and bool(fit.covariance[0].isfinite().all()) else None
        views = describe(view_rotation[None], torch.tensor([view_distance], dtype=torch.float64))
        similarity = normalized_correlation(self._fine_descriptor(query.field), views.descriptors)
        return replace(
            result,
            rotation=R if K is not None else view_rotation,
            translation=t if K is not None else None,
            score=float(similarity),
            view_rotation=view_rotation,
            view_distance=view_distance,
            support=float(fit.support[0]),
            covariance=covariance,
        )
