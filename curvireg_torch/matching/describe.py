"""Views of one mesh: framed as a photograph's crop is, rendered, filtered and described."""

from copy import copy
from functools import cached_property

import torch
import trimesh
from torch import Tensor, nn

from ..features import HOG, field_points
from ..filters import apparent_ridges, average_shading_gradient
from ..geometry.cameras import boxes_of, transform
from ..geometry.crops import crop_transforms, image_transforms, square_boxes
from ..mesh.edges import simplified
from ..mesh.mesh import as_mesh, extreme_points, measure, mesh_centre, mesh_radius
from ..pipeline import DEPTH_FIELDS, BankSettings
from ..rendering import DepthRenderer, make_renderer, render_colour, shade
from ..rendering.contours import LEVELS, MeshContours
from ..rendering.zbuffer import DeviceRenderer
from ..utils.aliases import Size
from ..utils.likes import MeshLike

VIEWS_AT_A_TIME = 64  # Views in memory at a time
# to which larger meshes are simplified for views: their contours are those of full size
VIEW_FACES = LEVELS[-1][1]
# Tolerance of equal rotations (entries) and distances (relative): 1e-4 px in a view
EQUAL_VIEWS = 1e-6
# Depth fields of the surface that a perspective camera sees: without the camera they are nearly HFN
OF_SURFACE = {"ASG": average_shading_gradient, "AR": apparent_ridges}
# Distances to step back so that a perspective view approximates parallel projection to a few per
# mille
PARALLEL_DISTANCE = 20.0


def depth_filter(settings: BankSettings) -> nn.Module:
    """The filter that turns rendered depth into vector fields; see :meth:`ViewDescriber.field` for
    perspective ones."""
    options = (
        {"sigma": settings.sigma, "formula": settings.formula}
        if settings.depth_field == "CS"
        else {}
    )
    return DEPTH_FIELDS[settings.depth_field](**options)


def hog_layer(settings: BankSettings) -> HOG:
    """The descriptor of views and photographs."""
    return HOG(grid=settings.grid, bins=settings.bins, block=settings.block, clip=settings.clip)


@measure
def view_mesh(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """What framed views of a mesh of more than ``VIEW_FACES`` faces are rendered from, see
    :func:`.simplified`."""
    centre = mesh_centre(mesh).numpy()
    vertices, faces = simplified(mesh, centre, VIEW_FACES)
    return trimesh.Trimesh(vertices + centre, faces, process=False)


class ViewDescriber:
    """Renders, filters and describes arbitrary views of one clean mesh, see
    :meth:`curvireg_torch.ViewBank.build`. Framed views are rendered from a mesh of about
    ``VIEW_FACES`` faces, ``view_mesh``; ``renderer`` is one of the whole mesh.

    Example:
        >>> import curvireg_torch as cr
        >>> describer = ViewDescriber(cr.synthetic.example_mesh(), cr.BankSettings(image_size=64))
        >>> R = cr.rotation_from_viewpoint(torch.tensor([0.0, 90.0]), 20.0)
        >>> describer.fields(R, torch.full((2,), 5.0 * describer.radius)).shape
        torch.Size([2, 2, 64, 64])
    """

    def __init__(
        self,
        mesh: MeshLike,
        settings: BankSettings,
        *,
        renderer: str | DepthRenderer = "auto",
        device: torch.device | str = "cpu",
    ) -> None:
        self._mesh = mesh = as_mesh(mesh)
        self.view_mesh = mesh.surface
        self.renderer = self.view_renderer = make_renderer(mesh, renderer, many_views=True)
        self.centre = mesh_centre(mesh)
        self.radius = mesh_radius(mesh)
        self.hull = extreme_points(mesh)
        self._device = torch.device(device)
        if isinstance(renderer, str) and len(mesh.faces) > VIEW_FACES:
            self.view_mesh = view_mesh(mesh)
            self.view_renderer = make_renderer(self.view_mesh, renderer, many_views=True)
        if renderer == "auto" and self._device.type != "cpu":
            self.view_renderer = DeviceRenderer(self.view_mesh, self._device)
        self._set(settings)

    def _set(self, settings: BankSettings) -> None:
        self.settings = settings
        self._orthographic = settings.camera == "orthographic"
        self._filter = depth_filter(settings)
        self.descriptor = hog_layer(settings)

    @cached_property
    def contours(self) -> MeshContours:
        """Occluding contours and creases at any pose, on the CPU."""
        return MeshContours(self.view_mesh)

    @cached_property
    def device_contours(self) -> MeshContours:
        """The same, on the device of the views."""
        return self.contours.to(self._device)

    def with_settings(self, settings: BankSettings) -> "ViewDescriber":
        """The same mesh and renderer with other settings; convex hulls of large meshes take
        seconds."""
        other = copy(self)
        other._set(settings)
        return other

    def cameras(self, rotations: Tensor, distances: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cameras that look at the object's centre, cropped to its box as a photograph is: T (N, 4,
        4), K (N, 3, 3) of the crops, and boxes (N, 4), all float64. As in all methods,
        ``rotations`` (N, 3, 3) are model -> camera, ``distances`` (N,) those of the object's centre
        in model units."""
        R = rotations.double().cpu()
        t = -(R @ self.centre)
        t[:, 2] += distances.double().cpu()
        T = transform(R, t)
        K = torch.eye(3, dtype=torch.float64)
        boxes = boxes_of(self.hull, T, K, orthographic=self._orthographic)
        return (
            T,
            crop_transforms(square_boxes(boxes, self.settings.margin), self.settings.image_size),
            boxes,
        )

    def cameras_of_boxes(
        self, rotations: Tensor, distances: Tensor, boxes: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Perspective cameras that look straight at the object and project it into the photographs'
        (N, 4) boxes. They replace unknown cameras of photographs. For orthographic views the camera
        is far away. Returns T_cam_from_model (N, 4, 4) and camera matrices (N, 3, 3) in px of the
        photographs, float64."""
        T, K, _ = self.cameras(rotations, distances)
        if self._orthographic:
            z = distances.double().cpu()
            T[:, 2, 3] += PARALLEL_DISTANCE * z
            K[:, :2, :2] *= (1.0 + PARALLEL_DISTANCE) * z[:, None, None]
        squares = square_boxes(boxes.double().cpu(), self.settings.margin)
        return T, image_transforms(squares, self.settings.image_size) @ K

    def depth(self, rotations: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
        """Depth (N, 1, S, S) of the framed views, and their boxes (N, 4)."""
        T, K, boxes = self.cameras(rotations, distances)
        return self._depth(T, K), boxes.to(self._device)

    def _depth(self, T: Tensor, K: Tensor) -> Tensor:
        """Depth (N, 1, S, S) of poses (N, 4, 4) seen by cameras (N, 3, 3)."""
        size = (self.settings.image_size,) * 2
        depth = self.view_renderer.render(T, K, size, orthographic=self._orthographic)
        return depth.to(self._device)

    def fields(self, rotations: Tensor, distances: Tensor) -> Tensor:
        """(N, 2, S, S) fields of the framed views."""
        T, K, _ = self.cameras(rotations, distances)
        return self.field(self._depth(T, K), K)

    def field(self, depth: Tensor, K: Tensor) -> Tensor:
        """(N, 2, S, S) field of depth (N, 1, S, S) that was seen by cameras (N, 3, 3) of the
        settings' kind."""
        of_surface = None if self._orthographic else OF_SURFACE.get(self.settings.depth_field)
        if of_surface is None:
            field: Tensor = self._filter(depth)
            return field
        return of_surface(depth, camera_matrix=K.to(depth.device))

    @torch.no_grad()
    def shaded(self, rotations: Tensor, distances: Tensor) -> Tensor:
        """(N, 1, S, S) grey pictures of the framed views, see
        :func:`curvireg_torch.rendering.shade`. With the mesh's colours (N, 4, S, S): grey, then RGB
        of :func:`curvireg_torch.rendering.render_colour`."""
        T, K, _ = self.cameras(rotations, distances)
        return self._shaded(self._depth(T, K), T, K)

    @torch.no_grad()
    def seen_by(self, T: Tensor, K: Tensor, *, shaded: bool) -> tuple[Tensor, Tensor | None]:
        """Fields (N, 2, S, S) of poses (N, 4, 4) seen by cameras (N, 3, 3), and, if ``shaded``, the
        pictures of :meth:`shaded`, of the same depth images."""
        depth = self._depth(T, K)
        return self.field(depth, K), self._shaded(depth, T, K) if shaded else None

    def _shaded(self, depth: Tensor, T: Tensor, K: Tensor) -> Tensor:
        S = self.settings.image_size
        projection = {"orthographic": self._orthographic}
        grey = shade(depth, K, **projection)
        if not self._mesh.has_colours:
            return grey
        colour = render_colour(self._mesh, T, K, (S, S), renderer=self.renderer, **projection)
        return torch.cat([grey, colour.to(grey)], dim=1)

    @property
    def draws_colours(self) -> bool:
        """Whether the mesh has colours, and :meth:`draw` can show them."""
        return self._mesh.has_colours and hasattr(self.renderer, "faces_at")

    def draw(self, T: Tensor, K: Tensor, size: Size, supersampling: int = 2) -> Tensor:
        """(N, 3, H, W) of :func:`curvireg_torch.rendering.render_colour`."""
        return render_colour(
            self._mesh, T, K, size, renderer=self.renderer, supersampling=supersampling
        )

    @torch.no_grad()
    def descriptors(self, rotations: Tensor, distances: Tensor) -> Tensor:
        """(N, D) descriptors of the framed views."""
        chunks = zip(
            rotations.split(VIEWS_AT_A_TIME), distances.split(VIEWS_AT_A_TIME), strict=True
        )
        return torch.cat([self.descriptor(self.fields(R, z)) for R, z in chunks])

    @torch.no_grad()
    def __call__(self, rotations: Tensor, distances: Tensor) -> dict[str, Tensor]:
        """Describe views; those that differ by a multiple of 90 degrees about the optical axis are
        rendered once. ``descriptors`` (N, D) float32; ``points`` and ``silhouettes`` (N, S, S)
        bool; ``boxes`` (N, 4) float64 of the object in normalised image coordinates (focal length
        1), its centre on the axis; orthographic in model units."""
        # An orthographic camera does not see the distance.
        seen = torch.ones_like(distances) if self._orthographic else distances
        source, quarters = _quarter_turns(rotations, seen)
        rendered = source == torch.arange(len(source))
        T, K, boxes = self.cameras(rotations[rendered], distances[rendered])
        boxes = boxes.to(self._device)
        depth = self._depth(T, K)
        field = self.field(depth, K)
        points = field_points(field, fraction=self.settings.point_fraction)[:, 0]
        silhouettes = depth[:, 0] > 0
        if rendered.all():
            descriptors = self.descriptor(field)
        else:
            selected = quarters.to(self._device), (rendered.cumsum(0) - 1)[source].to(self._device)
            turned = self.descriptor.with_quarter_turn(field)
            halves = (self.descriptor.rotated_by_180(x) for x in turned)
            descriptors = torch.stack([*turned, *halves])[selected]
            masks = torch.stack([points, silhouettes])
            points, silhouettes = torch.stack([masks.rot90(-k, (2, 3)) for k in range(4)], dim=1)[
                :, *selected
            ]
            x0, y0, x1, y1 = boxes.T
            clockwise = [x0, y0, x1, y1, -y1, x0, -y0, x1, -x1, -y1, -x0, -y0, y0, -x1, y1, -x0]
            boxes = torch.stack(clockwise, dim=1).view(-1, 4, 4).transpose(0, 1)[selected]
        return {
            "descriptors": descriptors,
            "points": points,
            "silhouettes": silhouettes,
            "boxes": boxes,
        }


def _quarter_turns(rotations: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
    """Group views that are the same picture rotated in the plane by a multiple of 90 degrees.
    Returns, on the CPU, the index (N,) of the first view of each view's group, and the number (N,)
    of clockwise 90 degree rotations, 0 to 3, from that view to this one."""
    x = rotations[:, 0].double().cpu()
    y = rotations[:, 1].double().cpu()
    z = distances.double().cpu()
    frames = [torch.cat(pair, dim=1) for pair in ((x, y), (-y, x), (-x, -y), (y, -x))]
    apart = torch.cdist(torch.stack(frames), frames[0], compute_mode="donot_use_mm_for_euclid_dist")
    close = (apart < EQUAL_VIEWS) & ((z[:, None] - z).abs() <= EQUAL_VIEWS * z)
    grouped = close.any(dim=0)
    first = (grouped * torch.arange(len(x), 0, -1)[:, None]).argmax(dim=0)
    return first, close[:, first, torch.arange(len(x))].int().argmax(dim=0)
