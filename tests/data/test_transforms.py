import torch
from torch import nn
from torch.utils.data import DataLoader

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, CropBox, Pascal3DPlus, collate
from tests._support.miniature import write_bop, write_pascal3d


def test_crop_box_makes_samples_that_stack(tmp_path):
    write_pascal3d(tmp_path)
    dataset = Pascal3DPlus(tmp_path, transforms=CropBox(size=32))
    batch = next(iter(DataLoader(dataset, batch_size=2, collate_fn=collate)))
    assert batch["image"].shape == (2, 3, 32, 32)
    describe = nn.Sequential(cr.MultiScaleFocusCurves(), cr.HOG())
    assert describe(batch["image"].mean(dim=1, keepdim=True)).shape == (2, 1764)


def test_crop_box_adapts_the_camera_matrix(tmp_path):
    write_bop(tmp_path)
    plain, cropped = BOPDataset(tmp_path)[0], CropBox(size=64, margin=0.2)(BOPDataset(tmp_path)[0])
    points = torch.randn(20, 3) * 5
    T = torch.eye(4)
    T[:3, :3], T[:3, 3] = plain["rotation"], plain["translation"]
    in_image = cr.project_points(points, T, plain["camera_matrix"])
    A = cropped["crop_transform"]
    torch.testing.assert_close(
        cr.project_points(points, T, cropped["camera_matrix"]), in_image @ A[:2, :2].T + A[:2, 2], rtol=1e-4, atol=1e-2
    )
    box = plain["box"].view(2, 2) @ A[:2, :2].T + A[:2, 2]
    side = 64 / 1.4  # the longer side of the box in the crop
    torch.testing.assert_close((box[1] - box[0]).max(), torch.tensor(side), rtol=1e-4, atol=1e-3)
    assert "image" in plain
    assert plain["image"].shape != cropped["image"].shape
