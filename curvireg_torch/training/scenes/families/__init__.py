"""Families of procedural objects. A family is a function from a random generator to parts."""

from collections.abc import Callable

from ..surfaces import Part, Rng
from . import furniture, household, solids, vehicles

__all__ = ["FAMILIES"]

FAMILIES: dict[str, Callable[[Rng], list[Part]]] = {
    "compound": solids.compound,
    "stack": solids.stack,
    "vessel": household.vessel,
    "chair": furniture.chair,
    "table": furniture.table,
    "sofa": furniture.sofa,
    "car": vehicles.car,
    "bicycle": vehicles.bicycle,
    "aircraft": vehicles.aircraft,
    "boat": vehicles.boat,
    "screen": furniture.screen,
    "train": vehicles.train,
    "creature": household.creature,
    "bracket": solids.bracket,
    "frame": furniture.frame,
    "lump": solids.lump,
    "package": household.package,
}
