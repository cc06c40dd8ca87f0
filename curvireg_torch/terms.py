"""Ranking terms: photographs are described in crops of their boxes, and compared with views; the
ranking multiplies."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from dataclasses import field as dataclass_field
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .errors import BankError, InvalidInputError
from .features.backbone import SHA256, Backbone, describe, similarity
from .features.learned_field import LearnedCurvilinearSaliency
from .features.whitening import Whitening
from .filters.operations import fill_missing, may_have_missing, missing_mask, to_grey
from .geometry.crops import check_boxes, crop_squares, square_boxes
from .utils.checks import (
    check_integer,
    check_option,
    check_photograph,
    check_positive,
    check_tensor,
)
from .utils.threads import map_on_threads

__all__ = [
    "TERMS",
    "Appearance",
    "BoxShape",
    "Correlation",
    "QueryFeatures",
    "Repeatability",
    "Term",
]
# of a box cut off by the image's border, as a fraction of its longer side, plus 1 px
BORDER_DISTANCE = 0.01
# whose points are counted, and in which they are compared
VIEWS_AT_A_TIME = 64
LEAST_LENGTH = 1e-12  # of a descriptor that is divided by its length
CELLS_AT_A_TIME = 64
# Shifts in x and y in units of the box jitter, and the exponent of the scale
_JITTER = (
    (-0.75, 0, 0),
    (0.75, 0, 0),
    (0, -0.75, 0),
    (0, 0.75, 0),
    (0, 0, -1),
    (0, 0, 1),
)


@dataclass(frozen=True)
class QueryFeatures:
    """B photographs, each described as its box shows it first, then as jittered copies of the box
    would, K in all.

    Attributes:
        crops: (B, C, S, S) of the boxes, in [0, 1]; NaN where pixels of the photograph are missing.
        field: (B, 2, S, S) of the crops.
        descriptors: (B, K, D).
        points: (B, K, S, S) bool feature points.
        shapes: (B,) log of width / height of the boxes, NaN where unknown.
        mask: (B, 1, S, S) probability that pixels of the crops belong to the object, where the
            field predicts it.
        computed: features of the crops that terms have computed, by the term's name.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=90, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> query = cr.ViewMatcher(bank).query([scene.image], scene.box[None])
        >>> query.crops.shape, query.field.shape
        (torch.Size([1, 3, 64, 64]), torch.Size([1, 2, 64, 64]))
    """

    crops: Tensor
    field: Tensor
    descriptors: Tensor
    points: Tensor
    shapes: Tensor
    mask: Tensor | None = None
    computed: dict[str, Tensor] = dataclass_field(default_factory=dict, compare=False)

    def __getitem__(self, index: Tensor | slice) -> "QueryFeatures":
        """Some of the photographs."""
        known = {field.name: getattr(self, field.name) for field in fields(QueryFeatures)}
        computed = {name: x[index] for name, x in known.pop("computed").items()}
        some: dict[str, Any] = {name: None if x is None else x[index] for name, x in known.items()}
        return QueryFeatures(**some, computed=computed)

    def split(self) -> "list[QueryFeatures]":
        """Each photograph by itself."""
        return [self[k : k + 1] for k in range(len(self.crops))]


def photograph_field(field: nn.Module, crops: Tensor) -> tuple[Tensor, Tensor | None]:
    """(B, 2, S, S) field of (B, 1 or 3, S, S) crops, in grey unless the filter has an attribute
    ``colour = True``, and the mask (B, 1, S, S) that the learned field predicts with it.
    Missing pixels (NaN or infinite) are filled from their surroundings before the filter; the field
    is 0 there."""
    grey = crops.shape[1] == 3 and not getattr(field, "colour", False)
    holes = missing_mask(crops) if may_have_missing(crops) else None
    crops = crops if holes is None else fill_missing(crops, holes)
    crops = to_grey(crops) if grey else crops
    mask: Tensor | None
    if type(field) is LearnedCurvilinearSaliency and not _has_hooks(field):
        out, mask = field.field_and_mask(crops)
    else:
        out = field(crops)
        mask = field.mask(crops) if isinstance(field, LearnedCurvilinearSaliency) else None
    check_tensor(out, "field", (len(crops), 2, *crops.shape[2:]))
    return out if holes is None else out.masked_fill(holes.any(dim=1, keepdim=True), 0.0), mask


def _has_hooks(module: nn.Module) -> bool:
    """Whether a call of ``module`` does more than its ``forward``."""
    own = (
        module._forward_hooks,
        module._forward_pre_hooks,
        module._backward_hooks,
        module._backward_pre_hooks,
    )
    of_all = torch.nn.modules.module
    return any(own) or bool(of_all._global_forward_hooks or of_all._global_forward_pre_hooks)


def jittered_fields(field: Tensor, box_jitter: float, margin: float) -> Tensor:
    """(B, K, 2, S, S) of the fields (B, 2, S, S) of crops of boxes with a ``margin``: each field,
    then as it would be of the box shifted by 3/4 ``box_jitter`` of its longer side, four times, and
    scaled by 1 + ``box_jitter``, twice; 0 beyond the crop. ``box_jitter`` is a fraction in [0,
    0.45]; K = 7, or 1 for ``box_jitter`` = 0."""
    check_box_jitter(box_jitter)
    if box_jitter == 0.0:
        return field[:, None]
    jitter = torch.tensor(_JITTER, dtype=field.dtype, device=field.device)
    scale = (1.0 + box_jitter) ** jitter[:, 2]
    # from -1 to 1 lies the square crop, of which a box's longer side is a part
    shift = jitter[:, :2] * (2.0 * box_jitter / (1.0 + 2.0 * margin))
    maps = torch.cat([torch.diag_embed(scale[:, None].expand(-1, 2)), shift[:, :, None]], dim=2)
    B, _, H, W = field.shape
    grid = F.affine_grid(maps, [len(maps), 2, H, W], align_corners=False)
    copies = field[:, None].expand(-1, len(maps), -1, -1, -1)
    sampled = F.grid_sample(copies.flatten(0, 1), grid.repeat(B, 1, 1, 1), align_corners=False)
    return torch.cat([field[:, None], sampled.view(copies.shape)], dim=1)


def check_box_jitter(box_jitter: float) -> None:
    """Refuse what is no fraction in [0, 0.45]."""
    if not 0.0 <= box_jitter <= 0.45:
        raise InvalidInputError(f"box_jitter: expected a fraction in [0, 0.45], got {box_jitter}")


def crop_photographs(
    images: Tensor | Sequence[Tensor], boxes: Tensor, *, size: int, margin: float
) -> Tensor:
    """(B, C, S, S) crops of the boxes (B, 4) in px, as :func:`crop_images` cuts them, on the device
    of the boxes. Images are (B, C, H, W), or a list of (C, H, W), floating in [0, 1] or uint8; if
    channel counts differ, grey ones get three channels."""
    for image in images:
        check_photograph(image)
    check_boxes(boxes, [(int(image.shape[-2]), int(image.shape[-1])) for image in images])
    if not len(images):
        return boxes.new_zeros(0, 3, size, size)
    channels = max(image.shape[0] for image in images)
    crops = []
    for image, square in zip(images, square_boxes(boxes, margin), strict=True):
        crop = crop_squares(image, square[None], size).to(boxes.device)
        crops.append(crop.expand(-1, channels, -1, -1))
    return torch.cat(crops)


def box_shapes(boxes: Tensor) -> Tensor:
    """(...,) log of width / height of (..., 4) boxes x0, y0, x1, y1."""
    sides = boxes[..., 2:] - boxes[..., :2]
    return torch.log(sides[..., 0] / sides[..., 1])


def whole_box_shapes(boxes: Tensor, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """(B,) shapes of (B, 4) boxes in px in images of ``sizes`` (H, W); NaN if the border may cut
    the object off."""
    end = (
        torch.tensor([[W, H] for H, W in sizes], dtype=boxes.dtype, device=boxes.device).view(-1, 2)
        - 0.5
    )
    border = 1.0 + BORDER_DISTANCE * (boxes[:, 2:] - boxes[:, :2]).amax(dim=1, keepdim=True)
    inside = (boxes[:, :2] > -0.5 + border).all(dim=1) & (boxes[:, 2:] < end - border).all(dim=1)
    return torch.where(inside, box_shapes(boxes), torch.nan)


Comparison = Callable[[QueryFeatures], Tensor]


@dataclass(frozen=True)
class Term(ABC):
    """One factor of the score S = prod S_t^w_t of a view for a photograph, left out where its
    ``weight`` w is 0. A new term is a frozen dataclass of plain numbers with a ``name`` and a
    method ``build``, added to ``curvireg_torch.terms.TERMS`` if JSON files of pipelines name it.

    Example:
        >>> BoxShape.name, isinstance(BoxShape(), Term)
        ('box', True)
    """

    name: ClassVar[str]
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self.weight, f"{self.name}: weight", zero_ok=True)

    @abstractmethod
    def build(self, views: Any) -> Comparison:
        """A function that compares B photographs with the N views of a
        :class:`curvireg_torch.ViewBank`, on its device: :class:`QueryFeatures` -> (B, N) raw
        scores."""

    def log_score(self, raw: Tensor) -> Tensor:
        """(B, N) log S_t <= 0 from raw scores, 0 for the best view of each photograph or near it.
        By default ``(s - max s) / std s`` of each photograph's scores s: the log of a softmax of
        z-scores."""
        # Not by std, which warns of empty batches.
        spread = (raw - raw.mean(dim=1, keepdim=True)).square().mean(dim=1, keepdim=True).sqrt()
        return (raw - raw.amax(dim=1, keepdim=True)) / torch.where(
            spread > 0, spread, torch.ones_like(spread)
        )


@dataclass(frozen=True)
class Correlation(Term):
    r"""S_hog: how well descriptors D agree, the best over the jittered fields.

    With the mean :math:`\mu` and the covariance :math:`\Sigma` of the bank's views, which is shrunk
    (Ledoit-Wolf) where a bank has fewer views than a descriptor has entries, the raw score is

    - ``"none"``: the cosine of both descriptors, without the two;
    - ``"bank"``: the cosine of :math:`\Sigma^{-1/2}(D_{view} - \mu)` and
      :math:`\Sigma^{-1/2}(D_{query} - \mu)`;
    - ``"paper"``: :math:`(D_{view} - \mu)^T \Sigma^{-1} D_{query}`, as the paper prints it.

    Attributes:
        whitening: which of these.

    Example:
        >>> Correlation(whitening="bank").weight
        1.0
    """

    name: ClassVar[str] = "hog"
    whitening: str = "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_option(self.whitening, ("none", "bank", "paper"), "whitening")

    def build(self, views: Any) -> Comparison:
        whitening: Whitening | None = views.whitening if self.whitening == "bank" else None

        def normalized(descriptors: Tensor) -> Tensor:
            return F.normalize(descriptors if whitening is None else whitening(descriptors), dim=1)

        known = views.descriptors
        if self.whitening == "paper":
            described = views.precision
            known = known - views.precision.mean
            lengths = known.new_ones(len(known))
        else:
            described = normalized
            known = known if whitening is None else whitening(known)
            # A normalised copy takes as much memory as all descriptors.
            lengths = torch.linalg.vector_norm(known, dim=1).clamp(min=LEAST_LENGTH)

        def compare(query: QueryFeatures) -> Tensor:
            B, K = query.descriptors.shape[:2]
            queries = described(query.descriptors.flatten(0, 1)).to(known.dtype)
            products: Tensor = (queries @ known.T) / lengths
            return products.float().view(B, K, len(known)).amax(dim=1)

        return compare


@dataclass(frozen=True)
class Repeatability(Term):
    r"""S_rep: the photograph's feature points have points of the view nearby, the best over the
    jittered fields.

    The raw score Rep is the fraction of the photograph's points that have a view's point within eps
    (the paper's Rep, view -> query), 0 without points. With :math:`R = 1 - Rep`, S_rep is

    - ``"monotone"``: :math:`\exp(-(R - \min R)^2 / (2\sigma^2))`: the most repeatable view scores
      1;
    - ``"paper"``: :math:`\exp(-(R - \mathrm{mean} R)^2 / (2\sigma^2))`, which favours average
      views.

    Attributes:
        sigma, mode: of the score; the paper's :math:`\sigma_r`.
        eps: largest distance of matching points, as a fraction of the crop's side.

    Example:
        >>> Repeatability().log_score(torch.tensor([[0.9, 0.8]])).tolist()[0][0]
        -0.0
    """

    name: ClassVar[str] = "repeatability"
    sigma: float = 0.1
    mode: str = "monotone"
    eps: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.sigma, "sigma")
        check_option(self.mode, ("monotone", "paper"), "mode")
        check_positive(self.eps, "eps", zero_ok=True)

    def build(self, views: Any) -> Comparison:
        S = views.settings.image_size
        # Cells of at most eps px keep the matrix product small.
        cell = max(1, min(int(self.eps * S), S // 64))

        # Pixels of each cell within eps of a view's points, (cells, N), and all of its pixels, (1,
        # cells)
        cells = (-(-S // cell)) ** 2
        device = views.descriptors.device
        near = torch.empty(cells, len(views), dtype=_count_dtype(cell), device=device)

        def count(start: int) -> None:
            some = slice(start, start + VIEWS_AT_A_TIME)
            points = dilate_points(views.points_at(some), self.eps * S)
            counted = cell_counts(points, cell).flatten(1)
            near[:, some] = counted.T.contiguous()  # it is transposed faster by itself

        map_on_threads(count, range(0, len(views), VIEWS_AT_A_TIME), device=device)
        area = cell_counts(torch.ones(1, S, S, dtype=torch.bool, device=device), cell).flatten(1)

        def compare(query: QueryFeatures) -> Tensor:
            B, K = query.points.shape[:2]
            # A point in a cut cell counts as much as any other.
            points = cell_counts(query.points.flatten(0, 1), cell).flatten(1).float()
            # Most cells have no points. A float32 copy of the others at once would take longer than
            # the product, and near[few] ten times as long as index_select.
            matched = points.new_zeros(len(points), near.shape[1])
            for few in points.any(dim=0).nonzero()[:, 0].split(CELLS_AT_A_TIME):
                matched.addmm_(points[:, few] / area[:, few], near.index_select(0, few).float())
            rep = matched / points.sum(dim=1, keepdim=True).clamp(
                min=torch.finfo(torch.float32).tiny
            )
            return rep.view(B, K, near.shape[1]).amax(dim=1)

        return compare

    def log_score(self, raw: Tensor) -> Tensor:
        R = 1.0 - raw
        centre = (
            R.amin(dim=1, keepdim=True) if self.mode == "monotone" else R.mean(dim=1, keepdim=True)
        )
        return -(R - centre).square() / (2.0 * self.sigma**2)


def dilate_points(points: Tensor, eps: float) -> Tensor:
    """Pixels within ``eps`` >= 0 px (Euclidean) of a point: (N, H, W) bool -> (N, H, W) bool."""
    radius = int(eps)
    if radius == 0 or points.numel() == 0:
        return points
    offsets = np.arange(-radius, radius + 1)
    disc = (offsets[:, None] ** 2 + offsets**2 <= eps**2).astype(np.uint8)
    # All planes one below the other, with empty rows between: a call for each costs more than to
    # dilate it.
    planes = np.pad(points.cpu().numpy().view(np.uint8), [(0, 0), (0, radius), (0, 0)])
    dilated = np.asarray(cv2.dilate(planes.reshape(-1, planes.shape[2]), disc)).reshape(
        planes.shape
    )
    return torch.from_numpy(dilated[:, :-radius].view(bool)).to(points.device)


def _count_dtype(cell: int) -> torch.dtype:
    """The integers of :func:`cell_counts`: of 8 bits if that suffices for a cell, else of 16."""
    return torch.uint8 if cell**2 < 256 else torch.int16


def cell_counts(points: Tensor, cell: int) -> Tensor:
    """(N, C, C) number of set pixels of (N, S, S) bool in cells of ``cell`` px, the last of which
    may be cut."""
    over = -points.shape[-1] % cell
    count = F.pad(points.view(torch.uint8), (0, over, 0, over)).to(_count_dtype(cell))
    for dim in (1, 2):  # rows first: they are contiguous
        count = functools.reduce(torch.add, count.unfold(dim, cell, cell).unbind(dim=3))
    return count


@dataclass(frozen=True)
class BoxShape(Term):
    r"""S_box in (0, 1], best view 1: :math:`\exp(-(d^2 - \min d^2) / (2\sigma^2))` with the
    difference d of the logs of width / height of the boxes of photograph and view. All views score
    1 if the photograph's box reaches its border.

    Example:
        >>> BoxShape().log_score(torch.tensor([[1.0, 0.5]])).tolist()
        [[0.0, -0.6931471824645996]]
    """

    name: ClassVar[str] = "box"
    sigma: float = 0.2  # corresponds to a box that is a fifth too wide

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.sigma, "sigma")

    def build(self, views: Any) -> Comparison:
        shapes = box_shapes(views.boxes).float()

        def compare(query: QueryFeatures) -> Tensor:
            square = (query.shapes.float()[:, None] - shapes).nan_to_num(0.0).square()
            return torch.exp((square.amin(dim=1, keepdim=True) - square) / (2.0 * self.sigma**2))

        return compare

    def log_score(self, raw: Tensor) -> Tensor:
        return raw.clamp(min=torch.finfo(raw.dtype).tiny).log()


@dataclass(frozen=True)
class Appearance(Term):
    """Appearance score: features of an ImageNet network agree, cell by cell, between photograph and
    shaded view. A mesh with colours is rendered in grey and in its colours, and the better match
    counts for each view: a print distinguishes top from bottom, and the grey picture remains where
    it misleads. Raw scores are mean cosines.

    A bank of up to ``exhaustive_limit`` views stores the features of all its views. Of a larger
    bank a fixed packing is compared, with views at least ``min_angle`` degrees apart: of its cells,
    the ``top`` that hold the best views of the other terms. Every other view gets the score of the
    nearest compared view, and NaN as raw score. ``weights`` is the digest of the network's.

    Example:
        >>> from curvireg_torch.pipeline import Pipeline
        >>> Pipeline().with_term("appearance", top=32).terms[-1] == Appearance(top=32)
        True
    """

    name: ClassVar[str] = "appearance"
    weight: float = 2.0
    exhaustive_limit: int = 1000
    top: int = 64
    min_angle: float = 20.0
    weights: str = SHA256[:16]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.min_angle, "min_angle", zero_ok=True)
        check_integer(self.top, f"{self.name}: top")
        check_integer(self.exhaustive_limit, f"{self.name}: exhaustive_limit", least=0)
        if self.weights != SHA256[:16]:
            raise InvalidInputError(
                f"appearance: expected weights {self.weights}, got installed weights {SHA256[:16]}"
            )

    def build(self, views: Any = None) -> "AppearanceModule":
        return AppearanceModule(self)


class AppearanceModule(Backbone):
    """Describes pictures of views, and compares photographs with them."""

    def __init__(self, term: Appearance) -> None:
        super().__init__()
        self.term = term

    def describe(self, pictures: Tensor) -> Tensor:
        """(N, D) features of pictures of views: (N, 1, S, S) grey, or (N, 4, S, S) grey and in the
        mesh's colours."""
        kinds = [pictures[:, :1], pictures[:, 1:]]
        return torch.cat([describe(kind, self) for kind in kinds if kind.shape[1]], dim=1)

    def compare(self, query: QueryFeatures, features: Tensor) -> Tensor:
        """(B, N) raw scores of B photographs and the (N, D) features of N views."""
        if Appearance.name not in query.computed:  # shared by ranking and rescoring
            query.computed[Appearance.name] = describe(query.crops, self)
        crops = query.computed[Appearance.name]
        # of a file, which may hold anything
        if features.shape[1] not in (crops.shape[1], 2 * crops.shape[1]):
            raise BankError(
                f"bank: appearance of {features.shape[1]} numbers a view, expected "
                f"{crops.shape[1]} or twice"
            )
        similarities = similarity(crops, features.reshape(-1, crops.shape[1]))
        return similarities.view(len(crops), len(features), -1).amax(dim=2)


# Terms by the name that JSON files of pipelines use
TERMS: dict[str, type[Term]] = {
    term.name: term for term in (Correlation, Repeatability, BoxShape, Appearance)
}
