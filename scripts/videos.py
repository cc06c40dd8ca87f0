"""Follow the object of each video, and store how exact its poses are.

    python scripts/videos.py FOLDER ... [--record]

A folder holds frames/NAME.jpg, mesh.ply, camera.json (fx, fy, cx, cy) and truth.json: by NAME, R
and t in the mesh's unit, mm. --record stores the result for the README's table. The box of the
first frame is that of the true pose. Errors are up to the symmetries of the shape.
"""

import json
from pathlib import Path

import torch

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.evaluation.metrics import symmetric_rotation_error
from curvireg_torch.geometry import projected_boxes, transform
from curvireg_torch.registration import Follower
from scripts._shared import RESULTS, Record, read_json, run, stamp, write_json


def main(folders: list[Path], *, record: bool = False) -> None:
    videos = [followed(folder) for folder in folders]
    print(json.dumps(videos, indent=2))
    if record:
        write_json(RESULTS / "videos.json", stamp() | {"videos": videos})


def followed(folder: Path) -> Record:
    """Name of a video; of its frames errors in degrees, inf without a pose, and verdicts."""
    values = read_json(folder / "camera.json")
    K = cr.camera_matrix(*(values[name] for name in ("fx", "fy", "cx", "cy")))
    registrar = cr.Registrar(cr.load_mesh(folder / "mesh.ply", unit="mm"))
    symmetries = registrar.symmetries_of(exact=True)[:, :3, :3]
    follow = Follower(registrar, K)
    box = None
    errors = []
    verdicts = []
    for name, pose in read_json(folder / "truth.json").items():
        T = transform(*(torch.tensor(pose[key]).double() for key in ("R", "t")))
        is_first = not errors
        box = projected_boxes(registrar.describer.hull, T[None], K)[0] if is_first else None
        result = follow(read_image(folder / "frames" / f"{name}.jpg"), box)
        verdicts.append(result.verdict)
        error = torch.tensor([torch.inf])
        if result.ok:
            error = symmetric_rotation_error(result.rotation[None], T[None, :3, :3], symmetries)
        errors.append(round(float(error), 2))
    return {"name": folder.name, "errors_deg": errors, "verdicts": verdicts}


if __name__ == "__main__":
    run(main)
