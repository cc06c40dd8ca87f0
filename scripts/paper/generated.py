"""Render photographs of plain meshes in BOP's layout, for scripts/paper/staircase.py.

    python scripts/paper/generated.py MESH ... --count 300 --out DIR [--up y]

Photograph i shows mesh i modulo their number, upright, under random light, with a random pattern,
in front of random clutter out of focus (:func:`curvireg_torch.synthetic.synthesize_photograph`),
and depends only on i and the meshes. Meshes are scaled to a radius of 100 mm.
"""

import argparse
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
# with an installed wheel, scripts is not a package that Python finds
sys.path.insert(0, str(REPOSITORY))

import cv2
import torch
import trimesh
from tqdm import tqdm

from curvireg_torch.geometry import camera_matrix, up_rotation
from curvireg_torch.mesh import load_mesh, mesh_centre, mesh_radius
from curvireg_torch.synthetic import random_pose, synthesize_photograph
from scripts._shared import write_json

# px, mm
SIZE = (240, 320)
RADIUS = 100.0


def upright(path: Path, up: str) -> trimesh.Trimesh:
    """A mesh with z up, its centre at the origin, in mm."""
    mesh = load_mesh(path, up=up)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = up_rotation(up) * RADIUS / mesh_radius(mesh)
    T[:3, 3] = -T[:3, :3] @ mesh_centre(mesh)
    vertices = trimesh.transform_points(mesh.vertices, T.numpy())
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def write_scene(mesh: trimesh.Trimesh, number: int, indices: range, out: Path) -> None:
    """Write a mesh and all photographs of it."""
    (out / "models").mkdir(parents=True, exist_ok=True)
    mesh.export(out / "models" / f"obj_{number:06d}.ply")
    folder = out / "test" / f"{number:06d}"
    (folder / "rgb").mkdir(parents=True, exist_ok=True)
    K = camera_matrix(400.0, 400.0, 159.5, 119.5, dtype=torch.float64)
    truths = {}
    cameras = {}
    infos = {}
    for index in tqdm(indices, desc=f"mesh {number}"):
        generator = torch.Generator().manual_seed(index)
        T = random_pose(mesh, K, SIZE, generator, elevations=(0.0, 60.0))
        image, box = synthesize_photograph(mesh, T, K, SIZE, generator)
        picture = (255.0 * image.permute(1, 2, 0).flip(-1)).round().byte().numpy()
        cv2.imwrite(str(folder / "rgb" / f"{index:06d}.png"), picture)
        x0, y0, x1, y1 = box.round().int().tolist()
        pose = {
            "cam_R_m2c": T[:3, :3].flatten().tolist(),
            "cam_t_m2c": T[:3, 3].tolist(),
            "obj_id": number,
        }
        truths[index] = [pose]
        cameras[index] = {"cam_K": K.flatten().tolist(), "depth_scale": 1.0}
        sides = [x0, y0, x1 - x0, y1 - y0]
        infos[index] = [{"bbox_obj": sides, "bbox_visib": sides, "visib_fract": 1.0}]
    for name, content in (("gt", truths), ("camera", cameras), ("gt_info", infos)):
        write_json(folder / f"scene_{name}.json", content)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("meshes", nargs="+", type=Path, metavar="MESH")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--up", default="y", help="axis of the meshes that points up (default: y)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    info = {}
    targets = []
    for k, path in enumerate(options.meshes):
        mesh = upright(path, options.up)
        number = k + 1
        indices = range(k, options.count, len(options.meshes))
        write_scene(mesh, number, indices, options.out)
        low = mesh.bounds[0]
        sides = mesh.extents
        row = {f"min_{c}": float(x) for c, x in zip("xyz", low, strict=True)}
        row |= {f"size_{c}": float(x) for c, x in zip("xyz", sides, strict=True)}
        info[str(number)] = {"diameter": 2.0 * RADIUS, **row}
        targets += [
            {"scene_id": number, "im_id": i, "obj_id": number, "inst_count": 1} for i in indices
        ]
    write_json(options.out / "models" / "models_info.json", info)
    write_json(options.out / "test_targets_bop19.json", targets)


if __name__ == "__main__":
    main()
