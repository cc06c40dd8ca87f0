"""``curvireg inspect``: one report of a mesh, before anyone takes a photograph."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..matching import cached_bank
from ..mesh import as_mesh
from ..pipeline import Pipeline
from ..registration import Registrar
from ..registration.photograph import as_photo
from ..utils.aliases import Fields, Progress
from ..utils.checks import check_device, check_integer, check_pixels
from ..utils.likes import ImageLike, MeshLike
from ..utils.threads import one_torch_thread
from .facts import MeshFacts, mesh_facts
from .look_alikes import LookAlike, confused_sides, look_alikes
from .photographs import SIZE, PhotographGenerator
from .trial import Trial, report_nothing, run_trial

ELEVATIONS = (-90.0, -45.0, 0.0, 45.0, 90.0)  # Borders of the ranges of the report, degrees
PIXELS_ACROSS = (0.0, 128.0, 192.0, 256.0, math.inf)
MIN_RIGHT = 0.5  # Expected share of right answers below which a warning says so
MANY_ALIKE = 0.1  # Share of directions with a look-alike from which a warning says so


@dataclass(frozen=True)
class Inspection:
    """What is to be expected of photographs of a mesh.

    Attributes:
        facts: the state of the mesh.
        pairs: of each direction from which the mesh was looked at, the most similar other view,
            most similar first.
        trial: generated photographs, registered; None for a mesh without hope, or where none were
            asked for.
        seed: of the photographs.
        with_camera: whether the camera was known.
        clutter: whether other objects stood around the object.
        registrar: of the mesh, which draws the pictures of the report; None for a mesh without
            hope.
    """

    facts: MeshFacts
    pairs: tuple[LookAlike, ...] = ()
    trial: Trial | None = None
    seed: int = 0
    with_camera: bool = True
    clutter: bool = False
    registrar: Registrar | None = None

    @property
    def alike(self) -> tuple[LookAlike, ...]:
        """The pairs that a photograph does not tell apart by shape."""
        return tuple(pair for pair in self.pairs if pair.is_alike)

    @property
    def told_by_print(self) -> int:
        """Number of those pairs that the mesh's print tells apart."""
        return sum(pair.print_tells for pair in self.alike)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before taking photographs, in words."""
        warnings = list(self.facts.warnings)
        if self.alike_share >= MANY_ALIKE:
            warnings.append(self._alike_in_words())
        if self.trial is not None and self.trial.expected.right < MIN_RIGHT:
            right = 100 * self.trial.expected.right
            warnings.append(
                f"only {right:.0f} % of generated photographs were registered right: expect wrong "
                f"answers"
            )
        return tuple(warnings)

    @property
    def alike_share(self) -> float:
        """Share of the directions from which a photograph does not tell another side from it."""
        return len(self.alike) / max(len(self.pairs), 1)

    @property
    def in_brief(self) -> str:
        """One sentence: what the mesh is, what looks alike, and what would help.

        Example:
            >>> import trimesh
            >>> Inspection(mesh_facts(trimesh.creation.icosphere(3))).in_brief
            'grey mesh: a sphere: it looks the same from everywhere, so its rotation cannot be seen'
        """
        kind = "coloured mesh" if self.facts.is_coloured else "grey mesh"
        if self.is_hopeless:
            return f"{kind}: {self.facts.verdicts[-1]}"
        if self.alike_share >= MANY_ALIKE:
            return f"{kind}: {self._alike_in_words()}"
        return "; ".join([f"{kind}: its sides differ in shape", *self.facts.verdicts])

    def _alike_in_words(self) -> str:
        """Which sides look alike, from how many views, and what tells them apart."""
        hints = Counter(pair.hint for pair in self.alike)
        hint = f"a pose prior ({hints.most_common(1)[0][0]})"
        shape = "in shape " if self.facts.is_coloured else ""
        sides = confused_sides(self.alike, self.facts.up)
        share = f"{sides} look alike {shape}from {100.0 * self.alike_share:.0f} % of the views"
        if not self.facts.is_coloured:
            return f"{share}; give a texture or {hint}"
        if self.told_by_print == len(self.alike):
            return f"{share}; its print tells them apart"
        told = 100.0 * self.told_by_print / len(self.alike)
        return f"{share}; its print tells {told:.0f} % of these apart, {hint} the others"

    @property
    def is_hopeless(self) -> bool:
        """Whether this mesh cannot work."""
        return self.facts.is_hopeless

    def to_dict(self) -> Fields:
        """The content of ``inspect.json``; its keys are described in docs/guides/inspect.md."""
        document: Fields = {
            "schema": 1,
            "mesh": self.facts.to_dict(),
            "symmetries": [symmetry.to_dict() for symmetry in self.facts.symmetries],
            "look_alikes": {
                "directions": len(self.pairs),
                "alike": len(self.alike),
                "told_by_print": self.told_by_print,
                "pairs": [pair.to_dict() for pair in self.pairs],
            },
            "warnings": list(self.warnings),
            "hopeless": self.is_hopeless,
            "expected": None,
        }
        if self.trial is None:
            return document
        elevations = self.trial.by(lambda outcome: outcome.elevation, ELEVATIONS)
        sizes = self.trial.by(lambda outcome: outcome.photograph.pixels_across, PIXELS_ACROSS)
        compared = {
            name: {"without": before.to_dict(), "with": after.to_dict()}
            for name, (before, after) in self.trial.compared.items()
        }
        document["expected"] = {
            **self.trial.expected.to_dict(),
            "by_elevation_deg": {name: expected.to_dict() for name, expected in elevations.items()},
            "by_pixels_across": {name: expected.to_dict() for name, expected in sizes.items()},
            "compared": compared,
            "with_camera": self.with_camera,
            "clutter": self.clutter,
            "seed": self.seed,
        }
        return document


def inspect(
    mesh: MeshLike,
    *,
    n: int = 60,
    seed: int = 0,
    with_camera: bool = True,
    compare: bool = True,
    pipeline: Pipeline | None = None,
    renderer: str = "auto",
    device: torch.device | str = "cpu",
    backgrounds: Sequence[ImageLike] = (),
    clutter: bool = False,
    progress: Progress | None = None,
) -> Inspection:
    """Examine a mesh, look for views that are alike, and register generated photographs of it.

    Args:
        mesh: a mesh (:func:`curvireg_torch.load_mesh`), its path, or a :class:`Registrar` of it.
        n: photographs; 0 leaves them out.
        seed: of the photographs.
        with_camera: whether the camera is known.
        compare: also register a fifth of the photographs under other conditions.
        pipeline: settings; ``Pipeline().with_pose_prior("upright")`` for objects that stand as in
            their file.
        renderer, device: of the views, see :class:`Registrar`.
        backgrounds: pictures as :func:`register` takes them, instead of generated ones.
        clutter: other objects stand around the object, and at times in front of it.
        progress: called with the stage ("mesh", "bank", "look-alikes" or "photographs"), done and
            total, perhaps in another thread; to cancel, it may raise.

    Returns:
        the report; ``to_dict()`` is the content of ``inspect.json``.

    Raises:
        InvalidInputError: a mesh that cannot be read, a number below 0, or a ``pipeline`` beside a
            :class:`Registrar`, which has its own.
        ImageError: a background that cannot be read.

    Example:
        >>> import trimesh
        >>> report = inspect(trimesh.creation.icosphere(3))
        >>> report.facts.is_watertight, report.is_hopeless, report.trial
        (True, True, None)
    """
    check_integer(n, "n", least=0)
    check_integer(seed, "seed", least=0)
    check_device(device)
    registrar = mesh if isinstance(mesh, Registrar) else None
    if registrar is not None and (pipeline is not None or renderer != "auto"):
        raise InvalidInputError("pipeline, renderer: a Registrar has its own, leave them out")
    pictures = [_background(picture) for picture in backgrounds]
    report = progress or report_nothing
    report("mesh", 0, 1)
    clean = as_mesh(mesh) if not isinstance(mesh, Registrar) else mesh.bank.mesh
    facts = mesh_facts(clean)
    report("mesh", 1, 1)
    found = Inspection(facts, seed=seed, with_camera=with_camera, clutter=clutter)
    if facts.is_hopeless:
        return found
    with one_torch_thread():
        if registrar is None:
            bank = cached_bank(
                clean, pipeline=pipeline, renderer=renderer, device=device, progress=report
            )
            registrar = Registrar(bank, mesh_is="exact", renderer=renderer)
        pairs = look_alikes(registrar, report)
        found = replace(found, pairs=pairs, registrar=registrar)
        if n == 0:
            return found
        upright = registrar.pipeline.views.pose == "upright"
        generate = PhotographGenerator(clean, seed, upright, pictures, clutter)
        trial = run_trial(
            registrar, generate, n, with_camera=with_camera, compare=compare, report=report
        )
        return replace(found, trial=trial)


def _background(picture: ImageLike) -> Tensor:
    """(3, H, W) float of the generated photographs' size."""
    image = as_photo(picture).image
    pixels = image.float() / 255.0 if image.dtype == torch.uint8 else image.float()
    check_pixels(pixels, "of a background")
    resized = torch.nn.functional.interpolate(pixels[None], SIZE, mode="area")[0]
    return resized.expand(3, *SIZE)
