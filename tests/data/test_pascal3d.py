import math

import pytest
import torch

from curvireg_torch.data import Pascal3DPlus
from curvireg_torch.errors import ImageError, InvalidInputError, MissingFileError
from curvireg_torch.geometry import rotation_from_viewpoint
from tests._support.miniature import pascal_object, write_image, write_pascal3d, write_record

pytestmark = pytest.mark.usefixtures("mats_here")


@pytest.fixture
def tree(tmp_path):
    return tmp_path, write_pascal3d(tmp_path)


def test_pascal3d_counts_skipped_items(tree):
    root, reasons = tree
    dataset = Pascal3DPlus(root)
    assert (dataset.categories, len(dataset)) == (["car", "sofa"], 5)
    assert dict(dataset.skipped) == reasons
    assert {k: len(v) for k, v in dataset.skipped_items.items()} == reasons
    assert dataset.skipped_items["missing_image"] == ["car_pascal/2008_000009"]
    assert dataset.skipped_items["coarse_viewpoint"] == [
        "car_pascal/2008_000003 #0",
        "car_pascal/2008_000003 #1",
    ]


def test_pascal3d_reads_the_imagenet_part(tmp_path):
    reasons = write_pascal3d(tmp_path, part="imagenet")
    dataset = Pascal3DPlus(tmp_path, part="imagenet")
    assert (len(dataset), dict(dataset.skipped)) == (5, reasons)
    assert dataset[0]["image_path"].endswith("car_imagenet/2008_000001.JPEG")
    with pytest.raises(MissingFileError, match="no pascal image list"):
        Pascal3DPlus(tmp_path)


def test_pascal3d_returns_documented_samples(tree):
    dataset = Pascal3DPlus(tree[0], categories=["car"])
    sample = dataset[0]
    names = """
        image image_path image_id object_index box viewpoint rotation distance
        translation camera_matrix category cad_index cad_path truncated occluded
        difficult
    """
    assert set(sample) == set(names.split())
    assert sample["image"].shape == (3, 60, 80)
    assert sample["box"].tolist() == [10, 5, 70, 55], "boxes of the release count from 1"
    assert sample["camera_matrix"].tolist() == [[3000, 0, 40], [0, 3000, 30], [0, 0, 1]]
    assert sample["viewpoint"].tolist() == [30, 10, -5]
    torch.testing.assert_close(
        sample["rotation"], rotation_from_viewpoint(30.0, 10.0, -5.0).float()
    )
    assert sample["translation"].tolist() == [0, 0, 40]
    assert (sample["category"], sample["cad_index"], sample["image_id"]) == (
        "car",
        1,
        "2008_000001",
    )
    assert sample["cad_path"].endswith("01.off")
    assert all(v.dtype == torch.float32 for v in sample.values() if isinstance(v, torch.Tensor))
    assert (sample["truncated"], sample["occluded"], sample["difficult"]) == (False, False, False)
    shifted = Pascal3DPlus(tree[0], pixel_origin=0)[0]
    assert (shifted["box"].tolist(), shifted["camera_matrix"][:2, 2].tolist()) == (
        [11, 6, 71, 56],
        [41, 31],
    )


@pytest.mark.parametrize(
    "option", [{"truncated": False}, {"occluded": False}, {"difficult": False}], ids=str
)
def test_pascal3d_skips_flagged_objects(tree, option):
    dataset = Pascal3DPlus(tree[0], categories=["car"], **option)
    assert len(dataset) == 3
    (name,) = option
    assert dataset.skipped[name] == 1
    assert not any(dataset.annotation(i).get(name) for i in range(3))


def test_pascal3d_reads_image_sets_with_invalid_entries(tree):
    root = tree[0]
    lists = root / "Image_sets"
    lists.mkdir()
    lists.joinpath("car_pascal_tiny.txt").write_text(
        "\ufeff2008_000001\n\n../car_pascal/2008_000001\n" + "x" * 5000 + "\n", encoding="utf-8"
    )
    dataset = Pascal3DPlus(root, "tiny")
    assert (len(dataset), dict(dataset.skipped)) == (1, {"missing_annotation": 2})


def test_pascal3d_defaults_of_missing_camera_fields_and_invalid_cad_indices(tree):
    record = tree[0] / "Annotations" / "car_pascal" / "2008_000001.mat"
    write_record(
        record,
        [
            {
                **pascal_object("car"),
                "viewpoint": {"azimuth": 10.0, "elevation": 20.0, "distance": 3.0},
            }
        ],
    )
    sample = Pascal3DPlus(tree[0], categories=["car"])[0]
    assert sample["camera_matrix"].tolist() == [[3000, 0, 40], [0, 3000, 30], [0, 0, 1]]
    assert sample["viewpoint"].tolist() == [10, 20, 0]
    before = Pascal3DPlus(tree[0], categories=["car"]).skipped["missing_mesh"]
    invalid = (-1.0, 0.0, 1e300, math.nan, math.inf, "one")
    write_record(record, [pascal_object("car", cad_index=index) for index in invalid])
    skipped = Pascal3DPlus(tree[0], categories=["car"]).skipped
    assert skipped["missing_mesh"] == before + len(invalid)


def test_photographs_of_another_size_than_annotated_are_left_out(tree):
    resized = tree[0] / "Images" / "car_pascal" / "2008_000002.jpg"
    write_image(resized, (30, 40))
    dataset = Pascal3DPlus(tree[0], categories=["car"])
    assert dataset.skipped_items["bad_image_size"] == ["car_pascal/2008_000002"]
    assert [dataset.annotation(i)["image_id"] for i in range(len(dataset))] == [
        "2008_000001",
        "2008_000003",
    ]
    resized.write_bytes(b"no picture")  # its pixels say so
    assert "bad_image_size" not in Pascal3DPlus(tree[0], categories=["car"]).skipped


def test_pascal3d_reports_missing_files_with_advice_and_refuses_invalid_options(tree, tmp_path):
    with pytest.raises(MissingFileError, match=r"datasets/pascal3d/README\.md"):
        Pascal3DPlus(tmp_path / "nothing")
    with pytest.raises(MissingFileError, match=r"train.*README"):
        Pascal3DPlus(tree[0], "train")
    with pytest.raises(MissingFileError, match=r"boat_val\.txt"):
        Pascal3DPlus(tree[0], categories=["boat"])
    wrong = [
        ({"part": "voc"}, "part"),
        ({"pixel_origin": 2}, "pixel_origin"),
        ({"categories": "car"}, "list of names"),
    ]
    wrong += [
        ({"categories": ["../car"]}, "plain names"),
        ({"split": "../val", "categories": []}, "plain names"),
    ]
    for options, message in wrong:
        with pytest.raises(InvalidInputError, match=message):
            Pascal3DPlus(tree[0], **options)


def test_annotation_has_no_image(pascal):
    dataset = pascal
    assert set(dataset[0]) - set(dataset.annotation(0)) == {"image"}
    dataset.annotation(0)["box"].zero_()
    assert dataset.annotation(0)["box"].sum() > 0, "a sample is a copy"
    with pytest.raises(IndexError):
        dataset[len(dataset)]
    with pytest.raises(ImageError, match="2008_000003"):
        [dataset[i] for i in range(len(dataset))]
