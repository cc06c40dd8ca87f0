"""Rendered silhouettes of annotated poses have the boxes that real BOP sets give."""

import json

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.geometry import projected_boxes
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.rendering import make_renderer

from .._support.real_data import real_data


@pytest.mark.data
@pytest.mark.parametrize(("name", "expected"), [("dino", 105), ("hope", 80), ("lm", 8)])
def test_render_depth_reproduces_annotated_boxes(name: str, expected: int) -> None:
    root = real_data("bop") / name
    meshes, renderers, count = {}, {}, 0
    for scene in sorted((root / "test").iterdir()):
        poses, infos, cameras = (
            json.loads((scene / f"{file}.json").read_text()) for file in ("scene_gt", "scene_gt_info", "scene_camera")
        )
        for image, instances in poses.items():
            K = torch.tensor(cameras[image]["cam_K"], dtype=torch.float64).view(3, 3)
            for instance, info in zip(instances, infos[image], strict=True):
                model = instance["obj_id"]
                if model not in meshes:
                    meshes[model] = cr.load_mesh(root / "models" / f"obj_{model:06d}.ply", unit="mm")
                    renderers[model] = make_renderer(meshes[model])
                T = torch.eye(4, dtype=torch.float64)
                T[:3, :3] = torch.tensor(instance["cam_R_m2c"]).view(3, 3)
                T[:3, 3] = torch.tensor(instance["cam_t_m2c"])
                # An image that contains the whole object, even where it leaves the photograph.
                box = projected_boxes(extreme_points(meshes[model]), T, K)
                corner = box[:2].floor() - 3
                width, height = (int(n) for n in (box[2:] - corner).ceil() + 3)
                shifted = K.clone()
                shifted[:2, 2] -= corner
                depth = cr.render_depth(meshes[model], T, shifted, (height, width), renderer=renderers[model])[0, 0]
                rows, columns = (depth > 0).any(dim=1).nonzero(), (depth > 0).any(dim=0).nonzero()
                found = torch.stack([columns[0], rows[0], columns[-1], rows[-1]])[:, 0] + corner.repeat(2)
                x, y, w, h = info["bbox_obj"]
                difference = (found - torch.tensor([x, y, x + w, y + h])).abs().max()
                assert float(difference) <= 2.0, f"{name} {scene.name}/{image}: {found.tolist()} for {info}"
                count += 1
    assert count == expected
