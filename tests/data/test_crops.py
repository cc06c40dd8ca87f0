"""Crops of datasets in batches of torch's own loader, their targets, and habits of the datasets
that they wrap."""

import math
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from torch.testing import assert_close
from torch.utils.data import DataLoader, Subset

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, Pascal3DPlus, PoseFolder, crops
from curvireg_torch.data.crops import UNKNOWN_CLASS, viewpoint_bins
from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.crops import crop_images
from tests._support import refused
from tests._support.miniature import write_bop, write_pascal3d, write_web
from tests._support.tables import text_table

pytestmark = pytest.mark.usefixtures("mats_here")


@pytest.fixture(params=["pascal", "bop", "web"])
def opened(request, tmp_path):
    """A dataset with the functions that are given."""
    write, make = {
        "pascal": (write_pascal3d, Pascal3DPlus),
        "bop": (write_bop, partial(BOPDataset, targets=False)),
        "web": (write_web, PoseFolder),
    }[request.param]
    write(tmp_path)
    return partial(make, tmp_path)


@pytest.fixture
def dataset(opened):
    return opened()


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_default_collate_takes_the_crops(dataset, workers):
    cropped = cr.data.crops(dataset, 32)
    context = "spawn" if workers else None
    loader = DataLoader(cropped, len(cropped), num_workers=workers, multiprocessing_context=context)
    batch = next(iter(loader))
    assert len(cropped) >= 3
    assert {name: (x.dtype, x.shape[1:]) for name, x in batch.items()} == {
        "image": (torch.float32, (3, 32, 32)),
        "rotation": (torch.float32, (3, 3)),
        "viewpoint_bins": (torch.int64, (3,)),
        "class_id": (torch.int64, ()),
    }
    assert batch["image"].min() >= 0.0
    assert batch["image"].max() <= 1.0


def test_crops_show_the_boxes_with_their_poses_and_classes(tmp_path):
    write_pascal3d(tmp_path)
    dataset = Pascal3DPlus(tmp_path)
    cropped = crops(dataset, 24, margin=0.25, bins=(8, 6, 4))
    assert cropped.classes == ["car", "sofa"]
    for index in range(len(dataset)):
        sample = dataset[index]
        crop = cropped[index]
        expected, _ = crop_images(sample["image"][None], sample["box"][None], size=24, margin=0.25)
        assert torch.equal(crop["image"], expected[0])
        assert torch.equal(crop["rotation"], sample["rotation"])
        assert cropped.classes[int(crop["class_id"])] == sample["category"]
        azimuth, elevation, theta = sample["viewpoint"].tolist()
        bins = [azimuth // 45, (elevation + 90) // 30, ((theta + 180) % 360) // 90]
        assert crop["viewpoint_bins"].tolist() == bins


def test_objects_of_bop_sets_are_classes_and_those_without_a_box_are_counted(tmp_path):
    write_bop(tmp_path)
    # One scene has no boxes: they are those of the mesh, if it can be read.
    tmp_path.joinpath("models", "obj_000001.ply").write_text("ply")
    dataset = BOPDataset(tmp_path, targets=False)
    cropped = crops(dataset, 16)
    unknown = sum(bool(dataset.annotation(i)["box"].isnan().any()) for i in range(len(dataset)))
    assert unknown == 1
    hidden = [i for i in range(len(dataset)) if dataset.annotation(i)["visib_fract"] == 0.0]
    assert len(cropped) == len(dataset) - 2
    assert (cropped.skipped["unknown_box"], cropped.skipped["invisible"]) == (1, len(hidden))
    assert cropped.skipped["missing_image"] == dataset.skipped["missing_image"] > 0
    assert cropped.classes == ["1", "2"]
    assert [cropped.classes[int(crop["class_id"])] for crop in cropped] == [
        str(cropped.annotation(i)["obj_id"]) for i in range(len(cropped))
    ]
    # its box may lie outside of the photograph
    assert hidden
    assert not {cropped.annotation(i)["visib_fract"] for i in range(len(cropped))} & {0.0}
    cropped.dataset._items[0]["box"] = (1000.0, 0.0, 1010.0, 10.0)
    with refused(r"000000\.jpg: box \(1000, .*entirely outside"):
        cropped[0]


def test_numbers_of_objects_are_ordered_by_value(bop):
    for item, number in zip(bop._items, (10, 9, 100, 9), strict=False):
        item["obj_id"] = number
    assert crops(bop, 16).classes == ["9", "10", "100"]


def test_unknown_poses_have_no_bin(web):
    known = [bool(web.annotation(i)["rotation"].isfinite().all()) for i in range(len(web))]
    assert known.count(False) == 2
    for crop, pose in zip(crops(web, 16), known, strict=True):
        assert (crop["viewpoint_bins"] >= 0).tolist() == [pose] * 3
    logits = torch.zeros(2, 24)
    ignored = torch.tensor([3, UNKNOWN_CLASS])
    assert float(torch.nn.functional.cross_entropy(logits, ignored)) == pytest.approx(math.log(24))


BINS = """
[0, 0, 0]             | [0, 6, 12]
[14.99, -0.01, -0.01] | [0, 5, 11]
[15, 15, 15]          | [1, 7, 13]
[30, 30, -30]         | [2, 8, 10]
[359.99, 89, 179]     | [23, 11, 23]
[345, -89, -180]      | [23, 0, 0]
[-15, 45, 180]        | [23, 9, 0]
[0, 90, 0]            | [0, 11, 12]
[30, 100, 0]          | [14, 11, 0]
[30, -100, 0]         | [14, 0, 0]
"""


@pytest.mark.parametrize(("viewpoint", "expected"), text_table(BINS))
def test_viewpoint_bins(viewpoint, expected):
    """Borders belong to the upper bin, whatever the rounding of the rotation."""
    rotation = rotation_from_viewpoint(*map(float, viewpoint)).float()  # as samples have it
    assert viewpoint_bins(rotation, (24, 12, 24)).tolist() == expected


def test_crops_transform_and_split(tmp_path):
    write_pascal3d(tmp_path)
    dataset = Pascal3DPlus(tmp_path, transform=lambda image: 0.5 * image)
    plain = crops(Pascal3DPlus(tmp_path), 16)
    assert_close(crops(dataset, 16)[0]["image"], 0.5 * plain[0]["image"])
    grey = crops(Pascal3DPlus(tmp_path), 16, transform=lambda crop: crop.mean(dim=0, keepdim=True))
    assert_close(grey[0]["image"], plain[0]["image"].mean(dim=0, keepdim=True))
    part = Subset(plain, [1, 0])
    assert torch.equal(part[1]["image"], plain[0]["image"])
    assert repr(plain) == f"ObjectCrops({plain.dataset!r}, size=16, {len(plain)} crops)"
    assert len(pickle.loads(pickle.dumps(plain))) == len(plain)


def test_crops_refuse_wrong_options(tmp_path):
    write_pascal3d(tmp_path)
    dataset = Pascal3DPlus(tmp_path)
    for arguments, options, message in (
        (([1, 2],), {}, "dataset: expected one of curvireg_torch.data, got list"),
        ((dataset, 0), {}, "size: expected an integer >= 1"),
        ((dataset, 16), {"margin": -0.1}, "margin"),
        (
            (dataset, 16),
            {"bins": (24, 12)},
            "bins: expected a number for each of azimuth, elevation, theta",
        ),
        ((dataset, 16), {"bins": 24}, "bins: expected a number for each"),
        ((dataset, 16), {"bins": (24, 0, 24)}, "bins of elevation: expected an integer >= 1"),
    ):
        with refused(message):
            crops(*arguments, **options)


def test_datasets_transform_images_and_targets(opened, dataset):
    changed = opened(
        transform=lambda image: image.mean(),
        target_transform=lambda sample: {"pose": sample["rotation"], "had": set(sample)},
    )
    sample = changed[0]
    plain = dataset[0]
    assert set(sample) == {"image", "pose", "had"}
    assert torch.equal(sample["image"], plain["image"].mean())
    assert torch.equal(sample["pose"], plain["rotation"])
    assert sample["had"] == set(plain) - {"image"}
    assert torch.equal(changed.annotation(0)["box"], dataset.annotation(0)["box"]), (
        "annotations are not transformed"
    )


def test_a_transform_of_image_and_labels_may_move_pixels(opened, dataset):
    """A transform of the image alone may not: box, camera and pose would not follow."""
    plain = dataset[0]
    half = opened(transform=lambda image: image[:, ::2, ::2])
    H, W = plain["image"].shape[1:]
    with refused(rf"of a photograph \(3, {H}, {W}\).*transforms="):
        half[0]

    def halve(image, sample):
        return image[:, ::2, ::2], {**sample, "box": sample["box"] / 2}

    together = opened(transform=lambda image: 1 - image, transforms=halve)
    sample = together[0]
    assert torch.equal(sample["image"], 1 - plain["image"][:, ::2, ::2])
    assert torch.equal(sample["box"], plain["box"] / 2)
    assert torch.equal(together.annotation(0)["box"], plain["box"])
    with refused("without transforms="):
        crops(together, 16)


def test_datasets_say_what_they_are(dataset):
    name = type(dataset).__name__
    splits = {"Pascal3DPlus": ", split='val'", "BOPDataset": ", split='test'", "PoseFolder": ""}
    root = f"root={str(dataset.root)!r}{splits[name]}"
    assert repr(dataset) == f"{name}({root}, {len(dataset)} objects)"


def test_datasets_take_whole_numbers_only(dataset):
    count = len(dataset)
    assert dataset[np.int64(-1)]["image_path"] == dataset[count - 1]["image_path"]
    assert dataset.annotation(torch.tensor(0))["image_path"] == dataset[0]["image_path"]
    message = r"expected a whole number, got .*; take several by torch.utils.data.Subset"
    for wrong in (slice(0, 2), 1.0, "0", None, [0, 1]):
        for get in (dataset.__getitem__, dataset.annotation):
            with pytest.raises(TypeError, match=message):
                get(wrong)
    for outside in (count, -count - 1):
        with pytest.raises(IndexError, match=f"has {count} objects, got index {outside}"):
            dataset[outside]
    assert len(list(dataset)) == count, "iteration ends"
