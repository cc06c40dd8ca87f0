"""Fetch real textured meshes for the benchmark, bring them into one frame and catalogue them.

The meshes are those of Debian's package sweethome3d-furniture 1.8-1: 820 OBJ files with materials
and textures; CC0, CC BY 3.0 and, model by model, what the package's ``copyright`` and the
catalogue's ``license`` say. They are not part of this project and stay in OUT. In OUT/meshes every
object has a folder of its own; z is up, the front points along -y, and units are metres.
OUT/meshes.json lists name, kind, licence, and the symmetries of shape and of appearance, of half of
the objects, by a hash of their names.

    python scripts/benchmark/meshes.py --out /data/furniture [--deb FILE]

FILE is the package, which apt-get downloads otherwise.
"""

import hashlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from curvireg_torch.utils.arrays import Array
from scripts._shared import in_processes, read_json, run, write_json
from scripts.scenes.textured import TexturedMesh

PACKAGE = "sweethome3d-furniture"
SHA256 = "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668"
MAX_FACES = 20_000
MIN_FLATNESS = 0.04
LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Reallusion": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}

KINDS = read_json(Path(__file__).with_name("kinds.json"))
"""By a pattern of their names, objects of one kind: they share the direction of the front and the
general build, as checked by eye. Groups for which this does not hold (animals, cups, desks,
motorcycles, bathtubs, pianos, shoes, sitting people) have no kind."""

UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Rotation from the catalogue's frame (y up, front +z) to ours (z up, front -y)."""


def fetch(out: Path, deb: Path | None) -> Path:
    """Download the package if needed, check its digest and unpack it; returns the folder of the
    libraries."""
    source = out / "source"
    source.mkdir(parents=True, exist_ok=True)
    if deb is None:
        if not list(source.glob(f"{PACKAGE}_*.deb")):
            subprocess.run(["apt-get", "download", PACKAGE], cwd=source, check=True)
        deb = next(iter(source.glob(f"{PACKAGE}_*.deb")))
    found = hashlib.sha256(deb.read_bytes()).hexdigest()
    if found != SHA256:
        sys.exit(f"{deb}: sha256 is {found}, expected {SHA256}; the benchmark needs this version")
    unpacked = source / "unpacked"
    if not (unpacked / "done").exists():
        unpacked.mkdir(parents=True, exist_ok=True)
        subprocess.run(["dpkg-deb", "-x", deb.resolve(), unpacked], check=True)
        for archive in unpacked.rglob("*.sh3f"):
            shutil.unpack_archive(archive, unpacked / archive.stem, "zip")
        (unpacked / "done").touch()
    return unpacked


def catalogue(unpacked: Path) -> list[dict]:
    rows = []
    for library in sorted(LICENCES):
        entries = {}
        path = unpacked / library / "PluginFurnitureCatalog.properties"
        text = path.read_text(encoding="latin1")
        for name, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
            plain = value.encode("latin1").decode("unicode_escape").strip()
            entries.setdefault(int(number), {})[name] = plain
        for _, entry in sorted(entries.items()):
            name = re.sub(r"\W+", "-", f"{library}-{Path(entry['model']).stem}").lower()
            rotation = entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()
            rows.append(
                {
                    "id": name,
                    "name": entry["name"],
                    "category": entry["category"],
                    "licence": entry.get("license") or LICENCES[library],
                    "creator": entry.get("creator", library),
                    "source": f"{library}{entry['model']}",
                    "rotation": list(map(float, rotation)),
                    "size": [float(entry[k]) / 100 for k in ("width", "depth", "height")],
                }
            )
    return rows


def kind_of(name: str) -> str | None:
    fitting = (kind for kind, pattern in KINDS.items() if re.fullmatch(pattern, name.lower()))
    return next(fitting, None)


def convert(row: dict, unpacked: Path, folder: Path) -> str | None:
    """Write the object in our frame, keeping all lines but the coordinates; returns why it is left
    out, or None."""
    source = unpacked / row["source"]
    lines = source.read_text(encoding="latin1").splitlines()
    if sum(len(line.split()) - 3 for line in lines if line.startswith("f ")) > MAX_FACES:
        return "many faces"
    points = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
    R = UP @ np.array(row["rotation"]).reshape(3, 3)
    rotated = points @ R.T
    low = rotated.min(axis=0)
    high = rotated.max(axis=0)
    if (high - low).min() < MIN_FLATNESS * (high - low).max():
        return "flat"
    if (folder / "model.obj").exists():
        return None
    scale = max(row["size"]) / (high - low).max()
    x, y, _ = -0.5 * (low + high)
    shift = np.array([x, y, -low[2]])
    moved = iter((rotated + shift) * scale)
    written = []
    folder.mkdir(parents=True, exist_ok=True)
    for line in lines:
        if line.startswith("v "):
            line = "v {:.6g} {:.6g} {:.6g}".format(*next(moved))
        elif line.startswith("vn "):
            normal = R @ np.array(line.split()[1:4], dtype=float)
            line = "vn {:.5g} {:.5g} {:.5g}".format(*normal)
        written.append(line)
    for other in source.parent.iterdir():
        if other.is_file() and other.suffix.lower() != ".obj":
            shutil.copyfile(other, folder / other.name)
    # renamed when complete, so that an interrupted run can be resumed
    part = folder / "model.obj.part"
    part.write_text("\n".join(written) + "\n", encoding="latin1")
    part.replace(folder / "model.obj")
    return None


def candidate_rotations() -> Array:
    """(32, 3, 3) possible symmetries: the 24 rotations of a cube, identity first, and steps of 30
    degrees about z."""
    cube = sorted(Rotation.create_group("O").as_matrix().round(), key=lambda R: -np.trace(R))
    steps = [30 * k for k in range(1, 12) if k % 3]
    about_z = Rotation.from_euler("z", np.array(steps)[:, None], degrees=True)
    return np.concatenate([cube, about_z.as_matrix()])


def sample_points(model: TexturedMesh) -> tuple[Array, Array]:
    """20,000 points of the surface relative to the centre of its box, in radii, and their colours
    in [0, 1]."""
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(model.triangles), process=False)
    points, face = trimesh.sample.sample_surface(mesh, 20_000, seed=0)
    weights = trimesh.triangles.points_to_barycentric(model.triangles[face], points)
    uv = np.einsum("ij,ijk->ik", weights, model.uv[face])
    colours = np.empty((len(points), 3))
    for number, paint in enumerate(model.paints):
        here = model.paint[face] == number
        colours[here] = paint.colours(points[here], uv[here]) ** (1 / 2.2)
    return (points - model.centre) / model.radius, colours


def lie_on(points: Array, tree: cKDTree) -> bool:
    """Whether 90 % of points (N, 3) lie within 4 % of the radius of those of the tree."""
    distances, _ = tree.query(points, distance_upper_bound=0.04)
    return bool(np.isfinite(distances).mean() >= 0.9)


def symmetries(points: Array, colours: Array) -> tuple[list[int], list[int]]:
    """Candidate rotations that map the shape to itself, and those that preserve its colours too.

    90 % of the points have the colour of the others, blurred over 48 neighbours.
    """
    tree = cKDTree(points)
    some = slice(None, None, 16)

    def fits(R: Array, part: slice) -> bool:
        return lie_on(points[part] @ R.T, tree)

    def blurred(R: Array) -> Array:
        _, near = tree.query(points[some] @ R.T, k=48)
        return colours[near].mean(axis=1)

    def has_other_colours(R: Array) -> bool:
        gaps = np.abs(blurred(R) - own).max(axis=1)
        return bool((gaps > 0.12).mean() >= 0.1)

    rotations = candidate_rotations()
    own = blurred(np.eye(3))
    few = slice(None, None, 400)
    shape = [k for k, R in enumerate(rotations) if fits(R, few) and fits(R, some)]
    return shape, [k for k in shape if not has_other_colours(rotations[k])]


def copy_of(cloud: Array, others: dict[str, tuple[Array, cKDTree]]) -> str | None:
    """Name of the first of the others with the same shape."""
    span = np.ptp(cloud, axis=0)
    for name, (extents, tree) in others.items():
        if np.abs(extents - span).max() < 0.03 and lie_on(cloud[::16], tree):
            return name
    return None


def is_used(name: str) -> bool:
    """Half of the objects, by a hash of their names; the others are for learning from."""
    return hashlib.sha256(name.encode()).digest()[0] % 2 == 0


def examine(task: tuple[dict, Path, Path]) -> tuple[dict, str | None, Array | None]:
    """Convert one object; returns its row, why it is left out (or None), and points of its
    surface."""
    row, unpacked, out = task
    folder = out / "meshes" / row["id"]
    reason = convert(row, unpacked, folder)
    if reason is not None:
        return row, reason, None
    try:
        model = TexturedMesh.load(folder / "model.obj")
    except Exception as error:  # a malformed file may raise anything
        return row, f"unreadable ({type(error).__name__})", None
    cloud, colours = sample_points(model)
    shape_symmetries, look_symmetries = symmetries(cloud, colours)
    row = {
        **{k: row[k] for k in ("id", "name", "category", "licence", "creator", "source")},
        "kind": kind_of(row["name"]),
        "path": f"meshes/{row['id']}/model.obj",
        "faces": len(model.triangles),
        "extents": np.ptp(model.hull, axis=0).round(4).tolist(),
        "shape_symmetries": shape_symmetries,
        "look_symmetries": look_symmetries,
    }
    return row, None, cloud


def main(*, out: Path, deb: Path | None = None, jobs: int = 1) -> None:
    unpacked = fetch(out, deb)
    once = {row["id"]: row for row in reversed(catalogue(unpacked))}  # removes duplicates
    tasks = [(row, unpacked, out) for name, row in sorted(once.items()) if is_used(name)]
    meshes = []
    left_out = {}
    clouds = {}
    examined = [found for _, found in in_processes(examine, tasks, jobs, "meshes")]
    for row, why, cloud in sorted(examined, key=lambda found: found[0]["id"]):
        if why is not None:
            left_out[row["id"]] = why
            continue
        like = copy_of(cloud, clouds) or row["id"]
        clouds[row["id"]] = np.ptp(cloud, axis=0), cKDTree(cloud)
        meshes.append({**row, "like": like})
    listing = {"package": PACKAGE, "sha256": SHA256, "turns": candidate_rotations().tolist()}
    write_json(out / "meshes.json", listing | {"meshes": meshes, "left_out": left_out})
    print(f"{len(meshes)} meshes; left out {len(left_out)}")


if __name__ == "__main__":
    run(main)
