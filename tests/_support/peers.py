"""Folders as other tools lay them out, of one photograph and mesh whose pose is known."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from curvireg_torch import render_depth
from tests._support.miniature import write_json


def write_peers(folder, photo, mesh, T, K):
    """Write ``megapose``, ``foundationpose``, ``bop``, detections and masks of a photograph into
    ``folder``.

    Args:
        folder: for the folders.
        photo: the photograph.
        mesh: in m.
        T: (4, 4) float64 pose in m.
        K: (3, 3) camera matrix.
    """
    picture = cv2.imread(str(photo))
    H, W = picture.shape[:2]
    depth = render_depth(mesh, T[None], K[None], (H, W))[0, 0]
    mask = (255 * (depth > 0)).byte().numpy()
    x0, y0, w, h = cv2.boundingRect(mask)
    bbox = [x0, y0, w, h]
    in_mm = mesh.copy().apply_scale(1000.0)
    R = T[:3, :3].numpy()

    megapose = folder / "megapose"
    foundation = folder / "foundationpose"
    bop = folder / "bop"
    for place in (
        megapose / "meshes" / "truck" / "truck.ply",
        foundation / "mesh" / "truck.obj",
        bop / "models" / "obj_000001.ply",
    ):
        place.parent.mkdir(parents=True)
        (mesh if foundation in place.parents else in_mm).export(place)
    for place, pixels in (
        (folder / "mask.png", mask),
        (megapose / "image_rgb.png", picture),
        (foundation / "rgb" / "000000.png", picture),
        (foundation / "masks" / "000000.png", mask),
        (bop / "test" / "000001" / "rgb" / "000003.png", picture),
    ):
        place.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(place), pixels)

    write_json(megapose / "camera_data.json", {"K": K.tolist(), "resolution": [H, W]})
    pose = [Rotation.from_matrix(R).as_quat().tolist(), T[:3, 3].tolist()]
    for part, known in (
        ("inputs", {"bbox_modal": [x0, y0, x0 + w - 1, y0 + h - 1]}),
        ("outputs", {"TWO": pose}),
    ):
        write_json(megapose / part / "object_data.json", [{"label": "truck", **known}])

    (foundation / "ob_in_cam").mkdir()
    np.savetxt(foundation / "cam_K.txt", K.numpy())
    np.savetxt(foundation / "ob_in_cam" / "000000.txt", T.numpy())

    in_mm_pose = {"cam_R_m2c": R.flatten().tolist(), "cam_t_m2c": (1000 * T[:3, 3]).tolist()}
    camera = {"cam_K": K.flatten().tolist(), "depth_scale": 1.0}
    for name, content in (("gt", [{**in_mm_pose, "obj_id": 1}]), ("camera", camera)):
        write_json(bop / "test" / "000001" / f"scene_{name}.json", {"3": content})
    found = {"scene_id": 1, "image_id": 3, "category_id": 1, "bbox": bbox, "score": 0.9}
    other = {**found, "category_id": 2, "bbox": [0, 0, 40, 40]}
    write_json(bop / "detections.json", [found, other])

    in_opengl = np.diag([1.0, -1.0, -1.0, 1.0]) @ T.numpy()
    in_opengl[:3, 3] *= 1000
    np.savetxt(folder / "vuforia.txt", in_opengl.T)  # column by column

    labels = folder / "runs" / "shots" / "labels"
    labels.mkdir(parents=True)
    box = [(x0 + w / 2) / W, (y0 + h / 2) / H, w / W, h / H]
    line = " ".join(f"{value:.6f}" for value in [*box, 0.9])
    found = {"category_id": 1, "bbox": bbox, "score": 0.8}
    for name in ("1", "2"):
        (labels / f"{name}.txt").write_text(f"0 {line}\n")
    write_json(folder / "boxes.json", [{"image_id": name, **found} for name in ("1", "2")])
