"""The meshes of a USD file as arrays: a program of its own, without the rest of the package.

    python usd_parts.py FILE.usd OUT.npz MOST_PARTS MOST_FACES

OUT has an entry ``about``, a text in JSON: unit, axis and parts, or an ``error``. Arrays of part
number k are called ``k.points``, ``k.counts``, and so on. OpenUSD follows references and prints; so
:mod:`.usd` runs this in a process that may end as it likes.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Sdf, Usd, UsdGeom, UsdShade

MAX_PRIMS_PER_PART = 20  # groups, materials and lights beside the parts
MAX_LAYERS = 1000
DAMAGED = "not a USD file, or damaged"
Fields = dict[str, Any]
COLOUR_NAMES = ("diffuseColor", "baseColor", "base_color")


def main() -> None:
    path, out, most_parts, most_faces = sys.argv[1:]
    arrays: Fields = {}
    try:
        layers = _used_layers(path)
        about = {**read(path, arrays, int(most_parts), int(most_faces)), "layers": layers}
    except ValueError as error:
        about = {"error": str(error)}
    except RuntimeError:  # of OpenUSD, in several lines
        about = {"error": DAMAGED}
    np.savez(out, about=np.array(json.dumps(about)), **arrays)


def _used_layers(path: str) -> list[str]:
    """The files beside the first one that a stage would open, which must lie in its folder or
    package."""
    folder = Path(path).resolve().parent
    waiting = [path]
    known = {path}
    beside = []
    while waiting:
        identifier = waiting.pop()
        layer = Sdf.Layer.FindOrOpen(identifier)
        if layer is None:
            if identifier == path:
                raise ValueError(DAMAGED)
            continue  # a stage goes on without it
        layer.Traverse("/", _refuse_clips(layer))
        # a part that refers to another of the same file names none
        for name in filter(None, layer.GetCompositionAssetDependencies()):
            target = layer.ComputeAbsolutePath(name)
            package = Ar.SplitPackageRelativePathOuter(target)[0]
            if "://" in name or "`" in name or not is_inside(package, path, folder):
                raise ValueError(f"it refers to {name[:100]!r}, outside of its folder; flatten it")
            if target not in known:
                known.add(target)
                waiting.append(target)
                if package != path:
                    beside.append(str(Path(package).resolve().relative_to(folder)))
            if len(known) > MAX_LAYERS:
                raise ValueError(f"it refers to more than {MAX_LAYERS:,} files; flatten it")
    return beside


def is_inside(package: str, path: str, folder: Path) -> bool:
    """Whether a file is the first one itself, or in its folder; a package stands alone."""
    if package == path:
        return True
    return not path.lower().endswith(".usdz") and Path(package).resolve().is_relative_to(folder)


def _refuse_clips(layer: Any) -> Any:
    """A visitor that refuses animation by further files."""

    def visit(place: Any) -> None:
        if place.IsPrimPath() and layer.GetPrimAtPath(place).HasInfo("clips"):
            raise ValueError("value clips are not read; export one frame")

    return visit


def read(path: str, arrays: Fields, most_parts: int, most_faces: int) -> Fields:
    """Unit, axis and parts of a stage at its first frame."""
    stage = Usd.Stage.Open(path)
    if stage is None:
        raise ValueError(DAMAGED)
    metres = None
    if UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    parts: list[Fields] = []
    left_out: set[str] = set()
    places = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    faces = 0
    walk = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for number, prim in enumerate(walk):
        if len(parts) > most_parts or number >= MAX_PRIMS_PER_PART * most_parts:
            raise ValueError(f"more than {most_parts:,} parts; join them")
        if is_hidden(prim):
            walk.PruneChildren()
        elif prim.IsA(UsdGeom.PointInstancer):
            raise ValueError("point instancers are not read; export their copies as meshes")
        elif prim.IsA(UsdGeom.Mesh):
            part = read_mesh(UsdGeom.Mesh(prim), f"{len(parts)}.", arrays)
            if part is None:
                continue
            faces += part.pop("faces")
            if faces > most_faces:
                raise ValueError(f"more than {most_faces:,} faces; simplify it")
            part["place"] = np.array(places.GetLocalToWorldTransform(prim)).T.tolist()
            parts.append(part)
        elif prim.IsA(UsdGeom.Gprim):
            left_out.add(prim.GetTypeName())
    up = str(UsdGeom.GetStageUpAxis(stage)).lower()
    return {"metres": metres, "up": up, "parts": parts, "left_out": sorted(left_out)}


def is_hidden(prim: Any) -> bool:
    """Whether a part is only a helper, or switched off."""
    image = UsdGeom.Imageable(prim)
    if not image:
        return False
    is_helper = image.GetPurposeAttr().Get() in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy)
    return is_helper or _first_value(image.GetVisibilityAttr()) == UsdGeom.Tokens.invisible


def read_mesh(mesh: Any, key: str, arrays: Fields) -> Fields | None:
    """A mesh: its arrays, and what is known of its materials; None without faces."""
    points = _array(mesh.GetPointsAttr(), np.float64).reshape(-1, 3)
    counts = _array(mesh.GetFaceVertexCountsAttr())
    indices = _array(mesh.GetFaceVertexIndicesAttr())
    if not len(counts):
        return None
    if counts.min() < 0 or counts.sum() != len(indices):
        raise ValueError("faces that do not fit their corners")
    if indices.size and not 0 <= indices.min() <= indices.max() < len(points):
        raise ValueError("a face names a vertex that does not exist")
    used, own = np.unique(indices, return_inverse=True)  # copies have only the points of faces
    arrays[key + "points"] = points[used]
    arrays[key + "counts"] = counts
    arrays[key + "indices"] = own.reshape(-1)
    prim = mesh.GetPrim()
    primvars = UsdGeom.PrimvarsAPI(prim)
    shown = primvars.FindPrimvarWithInheritance("displayColor")
    colour = _by_corner(shown, counts, indices)
    if colour is not None:
        arrays[key + "colour"] = colour.reshape(-1, 3)
    materials: list[Fields] = []
    of_face = np.zeros(len(counts), np.int64)
    subsets = UsdGeom.Subset.GetAllGeomSubsets(mesh)
    bound = [(one.GetPrim(), _array(one.GetIndicesAttr())) for one in subsets]
    for owner, faces in [(prim, np.arange(len(counts))), *bound]:
        material = UsdShade.MaterialBindingAPI(owner).ComputeBoundMaterial()[0]
        if not material or not faces.size:
            continue
        surface = _surface_of(material)
        uv = None
        if name := surface.get("coordinates"):
            uv = _by_corner(primvars.FindPrimvarWithInheritance(name), counts, indices)
        if uv is None:
            surface.pop("texture", None)
        else:
            arrays[f"{key}uv{len(materials)}"] = uv.reshape(-1, 2)
        materials.append(surface)
        of_face[faces] = len(materials)
    of_face[_array(mesh.GetHoleIndicesAttr())] = -1
    arrays[key + "material"] = of_face
    is_left_handed = _first_value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
    triangles = int(np.maximum(counts - 2, 0).sum())
    return {"faces": triangles, "materials": materials, "left_handed": is_left_handed}


def _first_value(attribute: Any) -> Any:
    """The value of an attribute at the first frame; None without an attribute."""
    return attribute.Get(Usd.TimeCode.EarliestTime()) if attribute else None


def _array(attribute: Any, kind: Any = np.int64) -> Any:
    values = _first_value(attribute)
    return np.array([] if values is None else values, kind)


def _by_corner(primvar: Any, counts: Any, indices: Any) -> Any:
    """Values of a primvar for each corner of each face; None if it has none, or too few."""
    if not primvar or not primvar.HasValue():
        return None
    values = np.array(primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()) or [], np.float64)
    index = {
        UsdGeom.Tokens.constant: np.zeros(len(indices), np.int64),
        UsdGeom.Tokens.uniform: np.repeat(np.arange(len(counts)), counts),
        UsdGeom.Tokens.vertex: indices,
        UsdGeom.Tokens.varying: indices,
        UsdGeom.Tokens.faceVarying: np.arange(len(indices)),
    }.get(primvar.GetInterpolation())
    return None if index is None or index.max(initial=0) >= len(values) else values[index]


def _surface_of(material: Any) -> Fields:
    """The colour of a material, linear, or its texture and the name of its coordinates."""
    shader = material.ComputeSurfaceSource()[0]
    if not shader:
        return {}
    for name in COLOUR_NAMES:
        entry = shader.GetInput(name)
        if not entry:
            continue
        value = _first_value(value_of(entry))
        if value is not None:
            return {"colour": [float(v) for v in value][:3]}
        source = entry.GetConnectedSources()[0]
        return texture_of(UsdShade.Shader(source[0].source.GetPrim())) if source else {}
    return {}


def texture_of(shader: Any) -> Fields:
    """The file of a texture, the factors of its colours, and the primvar of its coordinates."""
    file = value_of(shader.GetInput("file")) if shader else None
    asset = _first_value(file)
    if asset is None:
        return {"unread": True}
    found = {"texture": asset.path, **_place_of(file, asset), "coordinates": "st"}
    for name in ("scale", "bias"):
        value = _first_value(value_of(shader.GetInput(name)))
        if value is not None:
            found[name] = [float(v) for v in value][:3]
    coordinates = shader.GetInput("st")
    source = coordinates.GetConnectedSources()[0] if coordinates else None
    if source:
        reader = UsdShade.Shader(source[0].source.GetPrim())
        if reader.GetIdAttr().Get() == "UsdTransform2d":
            return {"unread": True}
        found["coordinates"] = str(_first_value(value_of(reader.GetInput("varname"))) or "st")
    return found


def value_of(entry: Any) -> Any:
    """The attribute that holds the value of an input: its own, or one of the material that it is
    connected to; None without one."""
    found = entry.GetValueProducingAttributes() if entry else ()
    return found[0] if found else None


def _place_of(attribute: Any, asset: Any) -> dict[str, str]:
    """Where the file lies that an asset names, relative to the layer that names it, and what it is
    within that file if that is a package."""
    layer = attribute.GetPropertyStack(Usd.TimeCode.EarliestTime())[0].layer
    place = asset.resolvedPath or layer.ComputeAbsolutePath(asset.path)
    package, inner = Ar.SplitPackageRelativePathOuter(place)
    folder = Path(Ar.SplitPackageRelativePathOuter(layer.realPath)[0]).parent
    return {"file": str(folder / package), "inner": inner}


if __name__ == "__main__":
    main()
