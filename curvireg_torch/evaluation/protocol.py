"""The conditions of an evaluation: which CADs, which pose prior, which box."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_option

__all__ = ["Protocol", "perturbed_box"]

CHOICES = {"cad": ("annotated", "any", "fused"), "pose": ("upright", "any")}


@dataclass(frozen=True)
class Protocol:
    """The information that the method gets about an object, besides the photograph.

    Attributes:
        cad: "annotated": the annotated CAD. "any": all CADs of the class, the best hypothesis wins. "fused": the scores
            of a view are averaged over the CADs of the class, the best view wins.
        pose: pose prior: "upright" or "any".
        box: 0 for the annotated box; x > 0 moves each edge at random by up to x of the side; None: the object is
            localized.
        seed: of the random numbers, which depend on the object's key besides.

    Raises:
        InvalidInputError: an unknown choice, or a box outside [0, 0.45].

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
    seed: int = 0

    def __post_init__(self) -> None:
        for name, options in CHOICES.items():
            check_option(getattr(self, name), options, name)
        if self.box is not None and not 0.0 <= self.box <= 0.45:
            raise InvalidInputError(f"box: expected a fraction in [0, 0.45], got {self.box}")

    @classmethod
    def parse(cls, words: Iterable[str], *, pose: str = "upright") -> "Protocol":
        """Parse words such as ``cad=any``, ``pose=any``, ``box=0.1``, ``seed=1``.

        Args:
            words: KEY=VALUE each; ``box=annotated`` is 0, ``box=none`` is None.
            pose: the default of ``pose``.

        Raises:
            InvalidInputError: an unknown key or value.
        """
        values: dict[str, str | float | int | None] = {"pose": pose}
        named = {"annotated": 0.0, "none": None}
        for word in words:
            key, _, value = word.partition("=")
            check_option(key, [f.name for f in fields(cls)], "protocol")
            try:
                if key == "box":
                    values[key] = named[value] if value in named else float(value)
                else:
                    values[key] = int(value) if key == "seed" else value
            except ValueError as error:
                raise InvalidInputError(f"protocol: expected {key}=NUMBER, got {word!r}") from error
        return cls(**values)  # type: ignore[arg-type]

    def __str__(self) -> str:
        box = f"box={self.box:g} seed={self.seed}" if self.box else f"box={'none' if self.box is None else 'annotated'}"
        return f"cad={self.cad} pose={self.pose} {box}"


def perturbed_box(box: Tensor, protocol: Protocol, key: str) -> Tensor:
    """The box that the method gets for the object ``key``.

    Args:
        box: (4,) x0, y0, x1, y1 in px.

    Returns:
        (4,) px, with edges moved by up to ``protocol.box`` of the side.

    Example:
        >>> box = torch.tensor([0.0, 0.0, 100.0, 50.0])
        >>> moved = perturbed_box(box, Protocol(box=0.1), "car 1")
        >>> bool(((moved - box).abs() <= torch.tensor([10.0, 5.0, 10.0, 5.0])).all() and (moved != box).all())
        True
    """
    if not protocol.box:
        return box
    seed = int.from_bytes(hashlib.sha256(f"{protocol.seed} {key}".encode()).digest()[:7])
    offset = 2.0 * torch.rand(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1.0
    sides = (box[2:] - box[:2]).repeat(2)
    return (box + protocol.box * offset * sides).to(box.dtype)
