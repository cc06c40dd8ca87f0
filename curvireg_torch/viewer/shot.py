"""A photograph of the page with its box, its result and the chosen pose, and how these are moved by
hand."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..data.images import Photo
from ..errors import InvalidInputError
from ..geometry import rotation_error, rotation_from_axis_angle
from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..jobs.entry import Entry
from ..jobs.options import RegisterOptions
from ..jobs.result_files import RegisteredViews
from ..registration import Hypothesis, Registrar, Registration, fit_contours
from ..registration.photograph import Photograph
from ..utils.aliases import Fields
from ..utils.likes import BoxLike
from ..visualization import contour_overlay, pose_glb
from ..visualization.encoding import png

MIN_SIDE = 3.0  # px of a new box; a smaller one was a click
NEAREST = 1.2  # least depth of the object's centre, in its radii, to which it can be moved by hand

Numbers = tuple[float, float, float, float]
Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Answer:
    """The pose that is shown and saved: a hypothesis, its number from 0, and what was done to it by
    hand, in words."""

    pose: Hypothesis
    number: int = 0
    edits: tuple[str, ...] = ()


@dataclass(eq=False)
class Result:
    """A registration with its inputs, of one photograph or of those of a rig, and its chosen
    answer.

    ``answer_before`` is that before the last change by hand.
    """

    registrar: Registrar
    registration: Registration
    document: dict[str, Any]  # the content of result.json, if the first answer is chosen
    photographs: Sequence[Photograph]  # of a rig
    inputs: tuple[RegisterOptions, tuple[Numbers | None, ...]]  # what was asked for, in which boxes
    answer: Answer
    answer_before: Answer | None = None

    @property
    def chosen(self) -> Registration:
        """The registration with the answer first; nobody knows how probable a pose is that was set
        by hand."""
        found = self.registration
        answer = self.answer
        if answer.number == 0 and not answer.edits:
            return found
        others = [k for k in range(len(found.hypotheses)) if k != answer.number]
        probabilities = found.probabilities
        if answer.edits:
            probabilities = ()
        elif probabilities:
            probabilities = tuple(probabilities[k] for k in (answer.number, *others))
        views = found.views
        if views:  # the same pose in the world, which nobody has compared with the photographs
            from_found = torch.linalg.inv(found.transform) @ answer.pose.transform
            views = tuple(
                replace(
                    view,
                    T_cam_from_model=view.T_cam_from_model @ from_found,
                    edge_support=None,
                    similarity=None,
                    contribution=0.0,
                )
                for view in views
            )
        return replace(
            found,
            hypotheses=(answer.pose, *(found.hypotheses[k] for k in others)),
            probabilities=probabilities,
            confidence_features={},
            views=views,
            axis=None,
            pair_probability=None,
        )

    @property
    def views(self) -> RegisteredViews:
        """The answer in the photographs of a rig."""
        return RegisteredViews(self.registrar, self.chosen, self.photographs, self.document)

    def centre(self, T: Tensor) -> Tensor:
        """(3,) of the object in the camera, at a (4, 4) pose."""
        return point_in_cameras(T, self.registrar.describer.centre)

    def moved(
        self,
        T: Tensor,
        rotation: Sequence[float] = (0, 0, 0),
        translation: Sequence[float] = (0, 0, 0),
    ) -> Tensor:
        """Return the (4, 4) pose ``T``, turned by degrees about the camera's axes and moved along
        them by radii.

        :class:`InvalidInputError` if the object would touch the camera.
        """
        describer = self.registrar.describer
        angles, shift = (
            torch.tensor(list(v), dtype=torch.float64) for v in (rotation, translation)
        )
        centre = self.centre(T) + describer.radius * shift
        if float(centre[2]) < NEAREST * describer.radius:
            raise InvalidInputError("the object would touch the camera; move it away")
        R = rotation_from_axis_angle(torch.deg2rad(angles)) @ T[:3, :3]
        return pose_around(R, centre, describer.centre)

    def dragged(self, T: Tensor, K: Tensor, start: Point, end: Point, *, turns: bool) -> Tensor:
        """Return the pose after a drag: the object's centre follows the mouse or, if it ``turns``,
        its near side."""
        dx = end[0] - start[0]
        dy = end[1] - start[1]
        if max(abs(dx), abs(dy)) < 1.0:  # a click
            return T
        # that one pixel is long
        radii = float(self.centre(T)[2]) / float(K[0, 0]) / self.registrar.describer.radius
        if turns:
            return self.moved(
                T, rotation=(math.degrees(dy * radii), -math.degrees(dx * radii), 0.0)
            )
        return self.moved(T, translation=(dx * radii, dy * radii, 0.0))

    def scaled(self, T: Tensor, factor: float, roll: float = 0.0) -> Tensor:
        """Return the pose that shows the object larger, at the same place in the photograph, and
        rolled by degrees."""
        shift = (1.0 / factor - 1.0) * self.centre(T) / self.registrar.describer.radius
        return self.moved(T, rotation=(0.0, 0.0, roll), translation=shift.tolist())


@dataclass(eq=False)
class Shot:
    """A photograph, without the distortion of a calibrated camera, and what belongs to it.

    ``box_before`` is that before the last change by hand, ``view`` its row of a rig, ``found_box``
    (4,) the box with which the pose was found. Photographs of a rig share their result.
    """

    path: Path = Path()
    photo: Photo | None = None
    box: Numbers | None = None
    view: Entry | None = None
    box_before: Numbers | None = None
    result: Result | None = None
    found_box: Tensor | None = None

    @property
    def image(self) -> Tensor:
        """(3, H, W) of the photograph."""
        assert self.photo is not None
        return self.photo.image

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the photograph."""
        return int(self.image.shape[-2]), int(self.image.shape[-1])

    @property
    def is_undistorted(self) -> bool:
        """Whether the distortion of the camera was removed from the photograph."""
        return self.photo is not None and "undistorted" in self.photo.notes

    @property
    def has_box_of_view(self) -> bool:
        """Whether the box is that of the row of the rig, and was not drawn."""
        given = None if self.view is None or self.view.box is None else numbers(self.view.box)
        if given is not None and self.is_undistorted:
            return self.box is not None and self.box_before is None
        return self.box == given

    @property
    def answer(self) -> Answer | None:
        """The chosen answer of the result."""
        return None if self.result is None else self.result.answer

    @property
    def projection(self) -> tuple[Tensor, Tensor]:
        """(4, 4) ``T_cam_from_model`` of the answer in this photograph, and (3, 3) camera
        matrix."""
        return self.projection_of(self.require_result().answer.pose)

    def projection_of(self, pose: Hypothesis) -> tuple[Tensor, Tensor]:
        """Like :attr:`projection` of any pose of the result."""
        if self.view is None or pose.transform is None:
            return pose.projection
        camera, T = self.view.in_world
        return T @ pose.transform, camera.at(self.size).matrix

    def set_box(self, box: Numbers | None) -> None:
        """Replace the box."""
        if box != self.box:
            self.box_before = self.box
            self.box = box

    def require_result(self) -> Result:
        """The result; an error if there is none yet."""
        if self.result is None:
            raise InvalidInputError("there is no result yet; register first")
        return self.result

    def snapshot(self) -> "Shot":
        """A copy with the present answer, whatever is chosen or found meanwhile."""
        return replace(self, result=None if self.result is None else replace(self.result))

    def document(self) -> Fields:
        """``result.json`` with the answer as its result; ``viewer`` tells what was chosen or done
        by hand."""
        result = self.require_result()
        document = dict(result.document)
        registration = result.chosen
        answer = result.answer
        if registration is not result.registration:
            document |= registration.to_dict()
            if registration.views:
                rows = zip(result.document["photographs"], document["photographs"], strict=True)
                document["photographs"] = [{**row, **moved} for row, moved in rows]
            if "detection" in document:
                first, *others = document["detection"]["instances"]
                first = {**first, "confidence": registration.confidence, **answer.pose.pose_dict()}
                document["detection"] = {**document["detection"], "instances": [first, *others]}
        by_hand = {"hypothesis": answer.number, "by_hand": list(answer.edits)}
        return {**document, "viewer": {**document["viewer"], **by_hand}}

    def choose(self, number: int) -> None:
        """Make a hypothesis the answer, by its number from 0."""
        result = self.require_result()
        result.answer = Answer(result.registration.hypotheses[number], number)
        result.answer_before = None

    def place(self, T: Tensor, edit: str = "moved") -> None:
        """Move the answer to (4, 4) ``T_cam_from_model``, without its measurements; ``edit`` says
        how, in words."""
        result = self.require_result()
        answer = result.answer
        before, K = self.projection
        centre = result.centre(T)
        degrees = float(rotation_error(T[:3, :3], before[:3, :3]))
        radii = (
            float(torch.linalg.vector_norm(centre - result.centre(before)))
            / result.registrar.describer.radius
        )
        allocentric = rotation_towards(centre).mT @ T[:3, :3]
        has_translation = answer.pose.translation is not None
        placed = T if self.view is None else torch.linalg.inv(self.view.in_world[1]) @ T
        pose = replace(
            answer.pose,
            rotation=placed[:3, :3].clone() if has_translation else allocentric,
            translation=placed[:3, 3].clone() if has_translation else None,
            score=float("nan"),
            evidence={},
            allocentric_rotation=allocentric,
            distance=float(torch.linalg.vector_norm(centre)),
            projection=(T, K),
            edge_support=None,
            covariance=None,
        )
        edit = f"{edit}: rotated {degrees:.1f} degrees, shifted {radii:.2f} radii"
        result.answer_before = answer
        result.answer = Answer(pose, answer.number, (*answer.edits, edit))

    def fit(self) -> None:
        """Fit the contours at the answer to the photograph's edges, unless another one is chosen or
        found meanwhile."""
        result = self.require_result()
        answer = result.answer
        registrar = result.registrar
        T, K = self.projection_of(answer.pose)
        contours = registrar.describer.contours
        margin = registrar.bank.settings.margin
        fit = fit_contours(contours, self.image, self.require_box(), K, T[None], margin=margin)
        supports = f"{float(fit.start_support[0]):.2f} to {float(fit.edge_support[0]):.2f}"
        if self.answer is answer:
            self.place(fit.transform[0], f"contours fitted, edge support {supports}")

    def require_box(self) -> Tensor:
        """The box in which the object was registered; :class:`InvalidInputError` without one."""
        if self.found_box is None:
            raise InvalidInputError("box: the object was not found in this photograph")
        return self.found_box

    def undo(self) -> None:
        """Take back the last change by hand; a second call repeats it."""
        result = self.result
        if result is not None and result.answer_before is not None:
            result.answer, result.answer_before = result.answer_before, result.answer

    def glb(self) -> bytes:
        """The answer as a GLB file, see :func:`curvireg_torch.visualization.pose_glb`."""
        result = self.require_result()
        if result.photographs:
            return result.views.glb()
        return pose_glb(result.registrar.bank.mesh, *result.answer.pose.projection, self.image)

    def overlay(self) -> bytes:
        """The contours at the answer on the photograph, or on those of the rig, as a PNG file."""
        result = self.require_result()
        if result.photographs:
            return result.views.overlay()
        return png(
            contour_overlay(result.registrar, result.answer.pose, self.image, self.require_box())
        )


def numbers(box: BoxLike) -> Numbers:
    """A box as four numbers."""
    x0, y0, x1, y1 = map(float, box)
    return x0, y0, x1, y1


def dragged_box(box: Numbers | None, start: Point, end: Point, *, reach: float) -> Numbers | None:
    """The box in px after a drag: of an edge or corner within ``reach`` px, of all of it from
    inside, or a new one."""
    at = np.array(start)
    to = np.array(end)
    edges = np.array(box or (np.inf, np.inf, -np.inf, -np.inf)).reshape(2, 2)
    if (edges[0] - reach <= at).all() and (at <= edges[1] + reach).all():
        # inside, at most a third of the box is near to an edge
        inside = np.minimum(reach, (edges[1] - edges[0]) / 3)
        is_low = at <= edges[0] + inside
        is_near = np.stack([is_low, ~is_low & (at >= edges[1] - inside)])
        edges = np.where(is_near, to, edges) if is_near.any() else edges + to - at
    else:
        edges = np.stack([at, to])
    low = edges.min(axis=0)
    high = edges.max(axis=0)
    return box if (high - low).min() < MIN_SIDE else numbers([*low.round(1), *high.round(1)])
