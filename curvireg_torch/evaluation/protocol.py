"""The conditions of an evaluation: what the method is told about an object, and what of that is
drawn at random."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_from_axis_angle, viewpoint_from_rotation
from ..geometry.pose_prior import PosePrior
from ..utils.checks import check_integer, check_option
from ..utils.choices import BOX_KINDS


@dataclass(frozen=True)
class Protocol:
    """The information that the method gets about an object, besides the photograph.

    Attributes:
        cad: "annotated": that CAD. "any": all CADs of the class, the best wins. "other": another
            CAD of the class, drawn at random.
        pose: pose prior: "upright" or "any".
        box: 0: as annotated; x > 0 moves each edge at random by up to x of the side; None: the
            object is detected.
        box_is: "whole": boxes are those of whole objects. "visible": those of their visible parts,
            and the method is told so; for datasets that have them.
        hint: "azimuth:45": the azimuth lies within 45 degrees of a value that is itself up to 45
            degrees off; "pose:45": the same of the whole rotation; "none".
        views: photographs of one pose that are registered together, each once as the first; for
            datasets of cameras.
        seed: of the random numbers, which depend on the object's label besides.

    Raises:
        InvalidInputError: an unknown choice, a box outside [0, 0.45], a hint outside (0, 180), or
            fewer than one view.

    Example:
        >>> protocol = Protocol.parse(["cad=any", "box=0.1"])
        >>> str(protocol)
        'cad=any pose=upright box=0.1 seed=0'
        >>> str(Protocol(pose="any"))
        'cad=annotated pose=any box=annotated'
    """

    cad: str = "annotated"
    pose: str = "upright"
    box: float | None = 0.0
    box_is: str = "whole"
    hint: str = "none"
    views: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        check_option(self.cad, ("annotated", "any", "other"), "cad")
        check_option(self.pose, ("upright", "any"), "pose")
        check_option(self.box_is, BOX_KINDS, "box_is")
        if self.box is not None and not 0.0 <= self.box <= 0.45:
            raise InvalidInputError(f"box: expected a fraction in [0, 0.45], got {self.box}")
        if self.hint != "none":
            self.hint_tolerance()
        check_integer(self.views, "views")
        if self.seed and str(self) == str(replace(self, seed=0)):
            raise InvalidInputError("protocol: seed: nothing is drawn at random; leave it out")
        if self.views > 1 and self.hint != "none":
            raise InvalidInputError(
                "protocol: hints are given with one photograph; leave hint or views out"
            )

    @classmethod
    def parse(cls, words: Iterable[str], *, pose: str = "upright") -> "Protocol":
        """Parse words KEY=VALUE; ``box=annotated`` is 0, ``box=none`` is None. ``pose`` is the
        default of that key."""
        values: dict[str, str | float | int | None] = {}
        named = {"annotated": 0.0, "none": None}
        for word in words:
            key, _, value = word.partition("=")
            check_option(key, [f.name for f in fields(cls)], "protocol")
            if key in values:
                raise InvalidInputError(f"protocol: {key} is given twice; give it once")
            try:
                if key == "box":
                    values[key] = named[value] if value in named else float(value)
                else:
                    values[key] = int(value) if key in ("seed", "views") else value
            except ValueError as error:
                raise InvalidInputError(f"protocol: expected {key}=NUMBER, got {word!r}") from error
        return cls(**{"pose": pose} | values)  # type: ignore[arg-type]

    def hint_tolerance(self) -> tuple[str, float]:
        """Kind of the hint and its tolerance in degrees."""
        kind, _, text = self.hint.partition(":")
        try:
            degrees = float(text)
        except ValueError as error:
            raise InvalidInputError(
                f"hint: expected azimuth:DEGREES or pose:DEGREES, got {self.hint!r}"
            ) from error
        check_option(kind, ("azimuth", "pose"), "hint")
        if not 0.0 < degrees < 180.0:
            raise InvalidInputError(f"hint: expected degrees in (0, 180), got {self.hint!r}")
        return kind, degrees

    def __str__(self) -> str:
        box = "none" if self.box is None else f"{self.box:g}" if self.box else "annotated"
        hint = "" if self.hint == "none" else f" hint={self.hint}"
        views = "" if self.views == 1 else f" views={self.views}"
        draws = self.box or hint or views or self.cad == "other"
        seed = f" seed={self.seed}" if draws else ""
        kind = "" if self.box_is == "whole" else f" box_is={self.box_is}"
        return f"cad={self.cad} pose={self.pose} box={box}{kind}{hint}{views}{seed}"


def perturbed_box(box: Tensor, protocol: Protocol, label: str) -> Tensor:
    """The box (4,) in px that the method gets for ``label``: edges move by up to ``protocol.box``
    of a side."""
    if not protocol.box:
        return box
    offset = (
        2.0 * torch.rand(4, generator=random_numbers(protocol, label), dtype=torch.float64) - 1.0
    )
    sides = (box[2:] - box[:2]).repeat(2)
    return (box + protocol.box * offset * sides).to(box.dtype)


def hint_of_truth(
    rotation: Tensor, frame: Tensor, protocol: Protocol, label: str
) -> PosePrior | None:
    """The hint about the object ``label``: a range around its true pose moved at random by up to
    half its width.

    ``rotation`` (3, 3) is the true one, NaN where it is unknown, ``frame`` that of the mesh, see
    :func:`curvireg_torch.geometry.pose_prior.object_frame`.
    """
    if protocol.hint == "none" or not bool(rotation.isfinite().all()):
        return None
    kind, degrees = protocol.hint_tolerance()
    generator = random_numbers(protocol, f"hint {label}")
    R = rotation.double()
    if kind == "azimuth":
        offset = degrees * (2.0 * torch.rand((), generator=generator, dtype=torch.float64) - 1.0)
        centre = float(viewpoint_from_rotation(R @ frame.mT)[0] + offset)
        return PosePrior(azimuth=((centre - degrees) % 360.0, (centre + degrees) % 360.0))
    axis = torch.nn.functional.normalize(
        torch.randn(3, generator=generator, dtype=torch.float64), dim=0
    )
    angle = torch.deg2rad(degrees * torch.rand((), generator=generator, dtype=torch.float64))
    return PosePrior(rotation=rotation_from_axis_angle(axis * angle) @ R, within=degrees)


def random_numbers(protocol: Protocol, label: str) -> torch.Generator:
    """The generator that draws what the protocol leaves to chance about the object ``label``."""
    seed = int.from_bytes(hashlib.sha256(f"{protocol.seed} {label}".encode()).digest()[:7])
    return torch.Generator().manual_seed(seed)
