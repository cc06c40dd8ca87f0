"""What is wrong with a mesh that can be used: parts left over far away, and coordinates without
digits."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from ..formats.meshes.source import MeshWarning
from ..utils.arrays import Flags, Indices, Integers
from .sampling import faces_at

SAMPLES = 20_000  # Points of the surface that say where it is
# Parts that together hold less than this fraction of the surface, and lie farther from the rest
# than one to two cells of this fraction of its size, are left over: a leftover of a scan, a marker
# of the origin
STRAY_FRACTION = 0.002
STRAY_GAP = 0.1
# The box is looked at if it is so many times as large as that of almost all of the surface
SPREAD = 1.15
# Steps between coordinates, as a fraction of the mesh's size, that show in its contours
COARSE_STEP = 2e-4


def stray_faces(mesh: trimesh.Trimesh) -> Flags:
    """(F,): which faces belong to parts of almost no area that lie apart from the rest and enlarge
    the mesh's box.

    Space is divided into cells; what shares a cell, or lies in neighbouring ones, is one part.
    """
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.faces)
    none = np.zeros(len(faces), bool)
    area = np.asarray(mesh.area_faces)
    face = faces_at(area, (np.arange(SAMPLES) + 0.5) / SAMPLES)
    weights = np.random.default_rng(0).dirichlet(np.ones(3), SAMPLES)
    points = np.einsum("nk,nkj->nj", weights, vertices[faces[face]])
    low, high = np.quantile(points, [0.5 * STRAY_FRACTION, 1.0 - 0.5 * STRAY_FRACTION], axis=0)
    size = float(np.linalg.norm(high - low))
    if not size > 0.0 or np.linalg.norm(mesh.extents) < SPREAD * size:
        return none
    everything = np.concatenate([points, vertices[faces].reshape(-1, 3)])
    steps = np.floor((everything - low) / (STRAY_GAP * size))
    part = _parts(np.clip(steps, -(2**18), 2**18).astype(np.int64), face, len(faces))
    shares = np.bincount(part, area) / area.sum()
    stray = (shares < STRAY_FRACTION)[part]
    if area[stray].sum() >= STRAY_FRACTION * area.sum():
        return none
    rest = vertices[faces[~stray]].reshape(-1, 3)
    inside = (vertices >= rest.min(axis=0)) & (vertices <= rest.max(axis=0))
    part_inside = np.ones(len(shares), bool)
    np.logical_and.at(part_inside, part, inside.all(axis=1)[faces].all(axis=1))
    return np.asarray(stray & ~part_inside[part])


def stray_warning(mesh: trimesh.Trimesh, stray: Flags) -> MeshWarning:
    """What was left out of a mesh, and where it lies."""
    count = int(stray.sum())
    area = np.asarray(mesh.area_faces)
    fraction = float(area[stray].sum() / area.sum())
    centre = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[stray]].mean(axis=(0, 1))
    place = ", ".join(f"{value:.4g}" for value in centre)
    faces = f"of {len(stray):,} faces {count:,} near ({place}), with {fraction:.2g} of the area"
    return MeshWarning("stray", f"{faces}, apart from the rest: left out")


def precision_warning(mesh: trimesh.Trimesh) -> MeshWarning | None:
    """A warning where coordinates are so large, as those of maps, that single precision has rounded
    them."""
    vertices = np.asarray(mesh.vertices)
    largest = float(np.abs(vertices).max())
    step = float(np.spacing(np.float32(largest)))
    size = float(np.linalg.norm(mesh.extents))
    is_single = bool((vertices.astype(np.float32) == vertices).all())
    if step < COARSE_STEP * size or not is_single:
        return None
    text = (
        f"its coordinates are rounded to steps of {step:.2g}: move the object near the origin, "
        f"and export it again"
    )
    return MeshWarning("precision", text)


def _parts(cells: Integers, face: Integers, count: int) -> Indices:
    """(F,) numbers of the parts that the faces belong to; ``cells`` are those of the samples, which
    are of ``face``, and then of the three corners of each of the ``count`` faces."""
    unique, place = trimesh.grouping.unique_rows(cells)
    near = cKDTree(cells[unique]).query_pairs(1.0, p=np.inf, output_type="ndarray")
    corners = place[SAMPLES:].reshape(count, 3)
    samples = np.column_stack([place[:SAMPLES], corners[face, 0]])
    links = np.concatenate([near, corners[:, :2], corners[:, 1:], samples])
    label = trimesh.graph.connected_component_labels(links, node_count=len(unique))
    return np.asarray(label[corners[:, 0]], np.int32)
