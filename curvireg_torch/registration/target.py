"""The object that photographs are registered to."""

import threading
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import torch
import trimesh
from torch import Tensor

from ..evidence import RANK_ALONE, EvidenceWeights
from ..fitting.keypoints import KeypointMatches, Keypoints
from ..geometry.framing import CropFrame, around_visible, border_sides, photograph_box
from ..geometry.viewpoint import rotation_error
from ..matching import ViewDescriber, ViewMatcher
from ..matching.detector import Detector
from ..mesh import Mesh, mesh_radius, mesh_symmetries
from ..mesh.round_axis import RoundAxis, round_axis
from ..mesh.symmetry import FEATURE_FRACTION, feature_fractions
from ..terms import QueryFeatures
from ..utils.computed import without_computed
from .photograph import Photograph

# Symmetries that are compared, the identity among them: every 30 degrees of a body of revolution
MAX_SIBLINGS = 12

NOTABLE_FRACTION = 0.01
"""Fraction of the surface from which a feature matters: poses that it tells apart are different
answers, also where a photograph does not show it. The pull tab of a can has half of it."""


@dataclass(frozen=True)
class TellingSymmetries:
    """Symmetries of a mesh's shape that a small feature tells from the identity.

    Attributes:
        transforms: (K, 4, 4), the identity first.
        others: (S, 4, 4) that no feature tells from it, the identity first.
        notable: whether the feature has ``NOTABLE_FRACTION`` of the surface.
    """

    transforms: Tensor
    others: Tensor
    notable: bool = False

    def __len__(self) -> int:
        return len(self.transforms)


def telling_symmetries(mesh: trimesh.Trimesh, symmetries: Tensor) -> TellingSymmetries:
    """Those of the symmetries (S, 4, 4) of a mesh's shape that a small feature tells from the
    identity, at most ``MAX_SIBLINGS``, far from each other; and all others."""
    if len(symmetries) == 1:
        return TellingSymmetries(symmetries, symmetries)
    chosen = spread(symmetries)
    fractions = feature_fractions(mesh, chosen)
    telling = fractions > FEATURE_FRACTION
    others = symmetries
    if bool(telling.any()):
        others = symmetries[feature_fractions(mesh, symmetries) <= FEATURE_FRACTION]
    telling[0] = True
    notable = bool(fractions.max() >= NOTABLE_FRACTION)
    return TellingSymmetries(chosen[telling], others, notable)


def spread(symmetries: Tensor) -> Tensor:
    """At most ``MAX_SIBLINGS`` of the symmetries (S, 4, 4), the identity first, far from each
    other."""
    R = symmetries[:, :3, :3].double()
    chosen = [0]
    nearest = rotation_error(R, R[0])
    while len(chosen) < min(MAX_SIBLINGS, len(R)):
        farthest = int(nearest.argmax())
        chosen.append(farthest)
        nearest = torch.minimum(nearest, rotation_error(R, R[farthest]))
    return symmetries[torch.tensor(chosen)]


# Thickness of a mesh, as a fraction of its radius, below which it counts as flat
FLAT_EXTENT = 1e-3

_SHAPE_LOCK = threading.Lock()


class Target:
    """What is known of an object that photographs are registered to.

    Attributes:
        matcher: compares photographs with the views of its ``bank``, by the settings of its
            ``pipeline``.
        mesh_is: "exact", "similar" or None, see :class:`.Registrar`.
        symmetries: (S, 4, 4) that were given, or None.
        progress: whether, or by what callback, progress is shown.
        others: further candidates for the object.
    """

    others: Sequence["Target"]

    def __init__(
        self,
        matcher: ViewMatcher,
        *,
        mesh_is: str | None = None,
        symmetries: Tensor | None = None,
        progress: bool | Callable[[str, int, int], object] = False,
    ) -> None:
        self.matcher = matcher
        self.bank = matcher.bank
        self.pipeline = matcher.pipeline
        self.mesh_is = mesh_is
        self.symmetries = symmetries
        self.progress = progress

    def __getstate__(self) -> dict[str, Any]:
        """Without what follows from the rest: renderers cannot be pickled."""
        return without_computed(self)

    def __copy__(self) -> Self:
        """With what was computed: it follows from the mesh, which a copy shares."""
        other = type(self).__new__(type(self))
        vars(other).update(vars(self))
        return other

    @property
    def is_exact(self) -> bool:
        """Whether the mesh counts as that of this very object."""
        return self.mesh_is != "similar"

    def symmetries_of(self, *, exact: bool) -> Tensor | None:
        """(S, 4, 4) that were given, or those of the shape of an exact mesh; None if there are
        none but the identity."""
        if not exact or self.symmetries is not None or self.bank.mesh.has_colours:
            return self.symmetries
        with _SHAPE_LOCK:  # photographs share them
            symmetries = mesh_symmetries(self.bank.mesh)
        return symmetries if len(symmetries) > 1 else None

    def score_weights(self, *, exact: bool) -> EvidenceWeights:
        """What evidence counts for with an exact mesh, or with a similar one."""
        return self.pipeline.fit.weights if exact else RANK_ALONE

    @cached_property
    def telling_symmetries(self) -> TellingSymmetries:
        """Symmetries of the shape of an exact mesh whose poses are compared; the identity alone if
        they are given, and trusted."""
        symmetries = self.symmetries_of(exact=True)
        if self.symmetries is not None or symmetries is None:
            one = torch.eye(4, dtype=torch.float64)[None]
            return TellingSymmetries(one, one)
        return telling_symmetries(self.bank.mesh.surface, symmetries)

    def symmetries_of_answers(self, *, feature_is_hidden: bool) -> Tensor | None:
        """(S, 4, 4) after which a pose is the same answer: :meth:`symmetries_of` the mesh without
        those that a small feature tells apart, unless it is not notable and
        ``feature_is_hidden``."""
        if not self.is_exact:
            return self.symmetries
        telling = self.telling_symmetries
        if len(telling) == 1 or (feature_is_hidden and not telling.notable):
            return self.symmetries_of(exact=True)
        return telling.others

    @cached_property
    def round_axis(self) -> RoundAxis | None:
        """The axis about which the mesh is nearly a body of revolution. Colours tell its ends
        apart."""
        axis = round_axis(self.bank.mesh)
        return axis and axis._replace(
            ends_are_alike=axis.ends_are_alike and not self.bank.mesh.has_colours
        )

    def frame_of(self, box: Tensor, size: tuple[int, int]) -> CropFrame | None:
        """The frame in which fitted poses are compared with a box (4,) at the border of a
        photograph of ``size`` (H, W), or of a visible part. None for other boxes: the view of a
        pose that is a little off resembles the object more by itself. None for a similar mesh,
        without the contour fit, and for orthographic views, too."""
        if not self.has_frame(box, size):
            return None
        settings = self.bank.settings
        shown = self.shown_around(box, size)
        return CropFrame.of(box, shown, side=settings.image_size, margin=settings.margin)

    def has_frame(self, box: Tensor, size: tuple[int, int]) -> bool:
        """Whether there is a :meth:`frame_of` a box."""
        return self._has_frames and (self.boxes_are_visible or border_sides(box, size) > 0)

    @property
    def _has_frames(self) -> bool:
        is_fitted = self.is_exact and self.pipeline.contours
        return is_fitted and self.bank.settings.camera != "orthographic"

    @property
    def boxes_are_visible(self) -> bool:
        """Whether boxes count as those of the visible part, behind which the object may go on."""
        return self._has_frames and self.pipeline.box_is == "visible"

    def shown_around(self, box: Tensor, size: tuple[int, int]) -> Tensor:
        """(4,) the part of a photograph of ``size`` (H, W) that poses are compared with in a box
        (4,)."""
        return around_visible(box, size) if self.boxes_are_visible else photograph_box(size)

    @property
    def uses_keypoints(self) -> bool:
        """Whether keypoints give starts and evidence: with an exact mesh and the contour fit."""
        return self.is_exact and self.pipeline.contours

    def keypoint_matches(
        self, item: Photograph, box: Tensor | None = None
    ) -> KeypointMatches | None:
        """Keypoints of the mesh's print in a photograph, or in a ``box`` (4,) of it; None without
        colours or a camera matrix.

        :meta private:
        """
        if not self.describer.draws_colours or item.camera is None:
            return None
        with _SHAPE_LOCK:  # photographs share them
            keypoints = self._keypoints
        return keypoints.matches(item.image, item.K, box)

    @cached_property
    def _keypoints(self) -> Keypoints:
        return Keypoints(self.describer, least=self.pipeline.fit.min_keypoints)

    @cached_property
    def mesh_warnings(self) -> tuple[str, ...]:
        """What makes every pose of this mesh questionable, in words."""
        return _flat_mesh_warnings(self.bank.mesh)

    @property
    def mesh_notes(self) -> tuple[str, ...]:
        """What the mesh lacks, in words."""
        return tuple(warning.text for warning in self.bank.mesh.warnings)

    @cached_property
    def describer(self) -> ViewDescriber:
        """Renderer, contours and descriptor of the mesh, on a grid twice as fine as the bank's."""
        settings = self.bank.settings
        return self.matcher.describer.with_settings(
            replace(settings, grid=min(2 * settings.grid, settings.image_size))
        )

    @cached_property
    def detector(self) -> Detector:
        """Proposes boxes where none are given."""
        return Detector(self.matcher)

    def object_mask(self, query: QueryFeatures, items: Sequence[Photograph]) -> Tensor | None:
        """(B, 1, S, S) probability that pixels of the crops belong to the object: given, predicted,
        or None."""
        settings = self.bank.settings
        masks = [item.mask_crop(settings.image_size, settings.margin) for item in items]
        if query.mask is not None:
            pairs = zip(masks, query.mask.split(1), strict=True)
            masks = [predicted if given is None else given for given, predicted in pairs]
        known = next((mask for mask in masks if mask is not None), None)
        if known is None:
            return None
        return torch.cat(
            [torch.ones_like(known) if mask is None else mask.to(known) for mask in masks]
        )

    def with_hypotheses(self, count: int) -> Self:
        """The same target with at least ``count`` hypotheses, of which a joint result needs more
        than it reports.

        :meta private:
        """
        if self.pipeline.hypotheses >= count:
            return self
        _ = self.describer  # shared
        other = copy(self)
        other.pipeline = replace(self.pipeline, hypotheses=count)
        return other

    def of_mesh(self, mesh_index: int) -> "Target":
        """The target that is one of several meshes, by :attr:`Registration.mesh_index`."""
        return self.others[mesh_index - 1] if mesh_index else self

    def share(self) -> None:
        """Create what threads share once, before they use it.

        :meta private:
        """
        _ = self.describer.contours, self.mesh_warnings
        _ = self.is_exact and (self.telling_symmetries, self.round_axis)

    def report_progress(self, stage: str) -> None:
        """Call the progress callback, if there is one."""
        if callable(self.progress):
            self.progress(stage, 0, 1)


def nearest_view(target: Target, rotation: Tensor) -> int:
    """The view of the bank that is most similar to an allocentric rotation (3, 3)."""
    R = target.bank.rotations
    return int((R.flatten(1) @ rotation.flatten().to(R)).argmax())


def _flat_mesh_warnings(mesh: Mesh) -> tuple[str, ...]:
    """What makes every pose of a flat mesh questionable, in words."""
    vertices = torch.from_numpy(mesh.vertices.copy()).double()
    thickness = (
        float(torch.linalg.svdvals(vertices - vertices.mean(dim=0))[-1]) / len(vertices) ** 0.5
    )
    if mesh.has_colours or thickness > FLAT_EXTENT * mesh_radius(mesh):
        return ()
    return ("the mesh is flat and has no colours: front and back look alike",)
