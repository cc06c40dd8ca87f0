"""Views of one mesh, framed as a photograph's crop is, rendered, filtered and described."""

from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from .._checks import check_option, check_positive
from ..descriptors import HOG, field_points
from ..errors import InvalidInputError
from ..filters import DepthCurvilinearSaliency
from ..geometry.cameras import projected_boxes, transform
from ..geometry.crops import crop_transforms, square_boxes
from ..geometry.mesh import extreme_points, mesh_centre
from ..rendering import DepthRenderer, make_renderer, render_views

__all__ = ["BankSettings", "DescribedViews", "ViewDescriber"]

CAMERAS = ("perspective", "orthographic")

FAR = 20.0
"""Distances farther away than usual: parallel projection but for a few per mille."""


@dataclass(frozen=True)
class BankSettings:
    """Everything, besides mesh and views, that decides what a bank holds. Photographs are cropped the same way.

    Attributes:
        image_size: side of views and crops in px.
        camera: "perspective" or "orthographic".
        margin: room around the object's box, as a share of its longer side.
        sigma, formula: of :func:`depth_curvilinear_saliency`.
        grid, bins, block, clip: of :func:`hog`.
        point_share: of :func:`field_points`.
    """

    image_size: int = 256
    camera: str = "perspective"
    margin: float = 0.1
    sigma: float = 1.0
    formula: str = "geometric"
    grid: int = 8
    bins: int = 9
    block: int = 2
    clip: float = 0.2
    point_share: float = 0.04

    def __post_init__(self) -> None:
        check_option(self.camera, CAMERAS, "camera")
        check_positive(self.margin, "margin", zero_ok=True)
        if self.image_size < self.grid:
            raise InvalidInputError(f"image_size: expected at least grid = {self.grid}, got {self.image_size}")

    def descriptor(self) -> HOG:
        return HOG(grid=self.grid, bins=self.bins, block=self.block, clip=self.clip)

    def depth_filter(self) -> DepthCurvilinearSaliency:
        return DepthCurvilinearSaliency(sigma=self.sigma, formula=self.formula)


@dataclass(frozen=True)
class DescribedViews:
    """N described views.

    Attributes:
        descriptors: (N, D) float32.
        points, silhouettes: (N, S, S) bool.
        boxes: (N, 4) float64 boxes of the object in normalised image coordinates (focal length 1), the object's centre
            on the axis; model units for an orthographic camera.
    """

    descriptors: Tensor
    points: Tensor
    silhouettes: Tensor
    boxes: Tensor


class ViewDescriber:
    """Renders, filters and describes any views of one mesh.

    Args:
        mesh: a clean mesh, from :func:`curvireg_torch.load_mesh`.
        settings: what views are made with.
        renderer: "auto", "embree", "pyrender" or a :class:`DepthRenderer` of this mesh.
        device: where views are filtered and described.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        settings: BankSettings,
        *,
        renderer: str | DepthRenderer = "auto",
        device: torch.device | str = "cpu",
    ) -> None:
        self.settings = settings
        self.centre = mesh_centre(mesh)
        self.renderer = make_renderer(mesh, renderer, device=device)
        self.hull = extreme_points(mesh)
        self._orthographic = settings.camera == "orthographic"
        self._filter, self._descriptor = settings.depth_filter(), settings.descriptor()
        self._device = device

    def cameras(self, rotations: Tensor, distances: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cameras that look at the object's centre and are cropped to its box, as a photograph is.

        Args:
            rotations: (N, 3, 3) model -> camera.
            distances: (N,) of the object's centre, in model units.

        Returns:
            T (N, 4, 4), K (N, 3, 3) of the crops, and boxes (N, 4), see :class:`DescribedViews`. All float64.
        """
        R = rotations.double().cpu()
        t = -(R @ self.centre)
        t[:, 2] += distances.double().cpu()
        T = transform(R, t)
        boxes = projected_boxes(self.hull, T, torch.eye(3, dtype=torch.float64), orthographic=self._orthographic)
        return T, crop_transforms(square_boxes(boxes, self.settings.margin), self.settings.image_size), boxes

    def camera_of_box(self, rotation: Tensor, distance: float, box: Tensor) -> tuple[Tensor, Tensor]:
        """A perspective camera that would see the object, straight ahead, where a photograph's box has it.

        For photographs of unknown cameras. An orthographic describer's camera is one from far away.

        Args:
            rotation: (3, 3).
            distance: of the object's centre, in model units.
            box: (4,) x0, y0, x1, y1 in px of the photograph.

        Returns:
            T_cam_from_model (4, 4) and camera matrix (3, 3) in px of the photograph, float64.
        """
        T, K, _ = self.cameras(rotation[None], torch.tensor([distance], dtype=torch.float64))
        T, K = T[0].clone(), K[0].clone()
        if self._orthographic:
            T[2, 3] += FAR * distance
            K[:2, :2] *= distance + FAR * distance
        to_crop = crop_transforms(square_boxes(box.double().cpu(), self.settings.margin), self.settings.image_size)
        return T, torch.linalg.inv(to_crop).triu() @ K  # exact zeros below; torch 2.5 leaves 1e-16

    def depth(self, rotations: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
        """Depth (N, 1, S, S) of the framed views, and their boxes (N, 4)."""
        S = self.settings.image_size
        T, K, boxes = self.cameras(rotations, distances)
        depth = render_views(self.renderer, T, K, (S, S), orthographic=self._orthographic)
        return depth.to(self._device), boxes.to(self._device)

    @torch.no_grad()
    def __call__(self, rotations: Tensor, distances: Tensor) -> DescribedViews:
        """Describe (N, 3, 3) rotations at (N,) distances of the object's centre, in model units."""
        depth, boxes = self.depth(rotations, distances)
        field = self._filter(depth)
        points = field_points(field, share=self.settings.point_share)[:, 0]
        return DescribedViews(self._descriptor(field), points, depth[:, 0] > 0, boxes)
