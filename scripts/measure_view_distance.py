"""What the unknown distance of an object costs: views at assumed distances against photographs at known ones.

    python scripts/measure_view_distance.py BOP_FOLDER [--out scripts/results/view_distance.json]

BOP_FOLDER holds BOP sets (see datasets/README.md). For each instance the view of the true orientation is rendered at
each assumed distance (in object radii; "true" is the annotated one, "orthographic" is infinity) and compared with the
photograph's crop (cosine of HOG descriptors), beside 150 views of other orientations rendered the same way.
"""

import argparse
import json
import statistics
from pathlib import Path

import torch
from _record import write_json

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.geometry import crop_images, mesh_radius, rotation_towards
from curvireg_torch.matching import BankSettings, ViewDescriber

DISTANCES = (1.8, 2.5, 3.5, 5.0, 8.0, 14.0, 25.0)
DISTRACTORS = 150
SIZE = 128


def instances(root: Path):
    """(photograph, model file, T, K, box) of every instance of a BOP set."""
    for scene in sorted((root / "test").iterdir()):
        poses, infos, cameras = (
            json.loads((scene / f"{n}.json").read_text()) for n in ("scene_gt", "scene_gt_info", "scene_camera")
        )
        for image, objects in poses.items():
            photo = next((scene / "rgb").glob(f"{int(image):06d}.*"))
            K = torch.tensor(cameras[image]["cam_K"], dtype=torch.float64).view(3, 3)
            for pose, info in zip(objects, infos[image], strict=True):
                T = torch.eye(4, dtype=torch.float64)
                T[:3, :3], T[:3, 3] = torch.tensor(pose["cam_R_m2c"]).view(3, 3), torch.tensor(pose["cam_t_m2c"])
                x, y, w, h = info["bbox_obj"]
                yield photo, root / "models" / f"obj_{pose['obj_id']:06d}.ply", T, K, torch.tensor([x, y, x + w, y + h])


def random_rotations(count: int) -> torch.Tensor:
    quaternions = torch.randn(count, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return cr.geometry.rotation_from_quaternion(quaternions)


def describers(model: Path):
    mesh = cr.load_mesh(model, unit="mm")
    cameras = {d: BankSettings(image_size=SIZE) for d in (*DISTANCES, "true")}
    cameras["orthographic"] = BankSettings(image_size=SIZE, camera="orthographic")
    return mesh_radius(mesh), {d: ViewDescriber(mesh, settings) for d, settings in cameras.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, metavar="BOP_FOLDER")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "view_distance.json")
    parser.add_argument("--every", type=int, default=1, help="use every n-th instance")
    arguments = parser.parse_args()
    field, descriptor = cr.MultiScaleFocusCurves(), BankSettings(image_size=SIZE).descriptor()
    models, results = {}, {}
    others = random_rotations(DISTRACTORS)
    for root in sorted(p for p in arguments.root.iterdir() if (p / "test").is_dir()):
        rows = []
        for photo, model, T, _K, box in list(instances(root))[:: arguments.every]:
            if model not in models:
                radius, views = describers(model)
                crowd = {
                    d: views[d](others, torch.full((DISTRACTORS,), (d if isinstance(d, float) else 5.0) * radius))
                    for d in views
                    if d != "true"
                }
                models[model] = radius, views, crowd
            radius, views, crowd = models[model]
            centre = T[:3, :3] @ views["true"].centre + T[:3, 3]
            R = rotation_towards(centre).T @ T[:3, :3]
            true = float(centre.norm()) / radius
            crop, _ = crop_images(read_image(photo)[None], box[None].float(), size=SIZE)
            query = descriptor(field(crop.mean(dim=1, keepdim=True)))[0]
            row = {"true": true}
            far = cr.rotation_error(others, R[None]) > 30
            for d, describe in views.items():
                z = {"true": true, "orthographic": 5.0}.get(d, d) * radius
                own = describe(R[None], torch.tensor([z])).descriptors[0]
                row[f"cosine {d}"] = float(torch.cosine_similarity(query, own, dim=0))
                if d in crowd:
                    rest = torch.cosine_similarity(query[None], crowd[d].descriptors[far], dim=1)
                    row[f"first {d}"] = float((rest < row[f"cosine {d}"]).all())
            rows.append(row)
        distances = sorted(r["true"] for r in rows)
        results[root.name] = {
            "n": len(rows),
            "true_distance_in_radii": {
                "min": distances[0],
                "median": statistics.median(distances),
                "max": distances[-1],
            },
            "mean_cosine": {str(d): sum(r[f"cosine {d}"] for r in rows) / len(rows) for d in views},
            "share_first_of_150": {
                str(d): sum(r[f"first {d}"] for r in rows) / len(rows) for d in views if d != "true"
            },
        }
        print(root.name, json.dumps(results[root.name], indent=2))
    write_json(arguments.out, results)


if __name__ == "__main__":
    main()
