"""Folders as other tools lay them out, of one photograph and mesh whose pose is known."""

import shutil

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
    rows, columns = (depth > 0).nonzero().unbind(1)
    x0, y0, x1, y1 = (int(v) for v in (columns.min(), rows.min(), columns.max(), rows.max()))
    mask = (255 * (depth > 0)).byte().numpy()
    cv2.imwrite(str(folder / "mask.png"), mask)
    in_mm = mesh.copy()
    in_mm.apply_scale(1000.0)
    bbox = [x0, y0, x1 - x0 + 1, y1 - y0 + 1]
    quaternion = Rotation.from_matrix(T[:3, :3].numpy()).as_quat().tolist()

    megapose = folder / "megapose"
    (megapose / "meshes" / "truck").mkdir(parents=True)
    in_mm.export(megapose / "meshes" / "truck" / "truck.ply")
    cv2.imwrite(str(megapose / "image_rgb.png"), picture)
    write_json(megapose / "camera_data.json", {"K": K.tolist(), "resolution": [H, W]})
    write_json(
        megapose / "inputs" / "object_data.json",
        [{"label": "truck", "bbox_modal": [x0, y0, x1, y1]}],
    )
    pose = [quaternion, T[:3, 3].tolist()]
    write_json(megapose / "outputs" / "object_data.json", [{"label": "truck", "TWO": pose}])

    foundation = folder / "foundationpose"
    for name in ("rgb", "masks", "mesh", "ob_in_cam"):
        (foundation / name).mkdir(parents=True)
    mesh.export(foundation / "mesh" / "truck.obj")
    cv2.imwrite(str(foundation / "rgb" / "000000.png"), picture)
    cv2.imwrite(str(foundation / "masks" / "000000.png"), mask)
    np.savetxt(foundation / "cam_K.txt", K.numpy())
    np.savetxt(foundation / "ob_in_cam" / "000000.txt", T.numpy())

    scene = folder / "bop" / "test" / "000001"
    (scene / "rgb").mkdir(parents=True)
    (folder / "bop" / "models").mkdir()
    shutil.copy(
        megapose / "meshes" / "truck" / "truck.ply", folder / "bop" / "models" / "obj_000001.ply"
    )
    cv2.imwrite(str(scene / "rgb" / "000003.png"), picture)
    entry = {
        "cam_R_m2c": T[:3, :3].flatten().tolist(),
        "cam_t_m2c": (1000 * T[:3, 3]).tolist(),
        "obj_id": 1,
    }
    write_json(scene / "scene_gt.json", {"3": [entry]})
    write_json(
        scene / "scene_camera.json", {"3": {"cam_K": K.flatten().tolist(), "depth_scale": 1.0}}
    )
    found = {"scene_id": 1, "image_id": 3, "category_id": 1, "bbox": bbox, "score": 0.9}
    write_json(
        folder / "bop" / "detections.json",
        [found, {**found, "category_id": 2, "bbox": [0, 0, 40, 40]}],
    )

    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    in_opengl = flip @ T.numpy()
    in_opengl[:3, 3] *= 1000
    np.savetxt(folder / "vuforia.txt", in_opengl.T)  # column by column

    labels = folder / "runs" / "shots" / "labels"
    labels.mkdir(parents=True)
    centre = [(x0 + x1 + 1) / 2 / W, (y0 + y1 + 1) / 2 / H, (x1 - x0 + 1) / W, (y1 - y0 + 1) / H]
    line = " ".join(f"{value:.6f}" for value in [*centre, 0.9])
    names = ("1", "2")
    for name in names:
        (labels / f"{name}.txt").write_text(f"0 {line}\n")
    write_json(
        folder / "boxes.json",
        [{"image_id": name, "category_id": 1, "bbox": bbox, "score": 0.8} for name in names],
    )
