import math

import pytest
import torch

from curvireg_torch.data import Pascal3DPlus
from curvireg_torch.errors import ImageError, MissingFileError
from curvireg_torch.geometry import rotation_from_viewpoint
from tests._support import refused
from tests._support.exif import exif, with_exif
from tests._support.miniature import pascal_object, write_image, write_pascal3d, write_record
from tests._support.tables import check_values, text_table

pytestmark = pytest.mark.usefixtures("mats_here")


@pytest.fixture
def root(tmp_path):
    write_pascal3d(tmp_path)
    return tmp_path


def cars(root, **options):
    return Pascal3DPlus(root, categories=["car"], **options)


@pytest.mark.parametrize(("part", "other"), [("pascal", "imagenet"), ("imagenet", "pascal")])
def test_pascal3d_counts_skipped_items_of_both_parts(tmp_path, part, other):
    reasons = write_pascal3d(tmp_path, part=part)
    dataset = Pascal3DPlus(tmp_path, part=part)
    assert (dataset.categories, len(dataset)) == (["car", "sofa"], 5)
    assert dict(dataset.skipped) == reasons
    assert dataset.skipped_items["missing_image"] == [f"car_{part}/2008_000009"]
    assert dataset.skipped_items["coarse_viewpoint"] == [
        f"car_{part}/2008_000003 #0",
        f"car_{part}/2008_000003 #1",
    ]
    assert f"/car_{part}/2008_000001." in dataset[0]["image_path"]
    with refused(f"no {other} image list", MissingFileError):
        Pascal3DPlus(tmp_path, part=other)


def test_pascal3d_returns_documented_samples(root):
    dataset = cars(root)
    sample = dataset[0]
    names = """
        image image_path image_id object_index box viewpoint rotation distance
        translation camera_matrix category cad_index cad_path truncated occluded
        difficult
    """
    assert set(sample) == set(names.split())
    assert sample["image"].shape == (3, 60, 80)
    check_values(
        sample,
        box=[10, 5, 70, 55],  # those of the release count from 1
        camera_matrix=[[3000, 0, 40], [0, 3000, 30], [0, 0, 1]],
        viewpoint=[30, 10, -5],
        translation=[0, 0, 40],
        category="car",
        cad_index=1,
        image_id="2008_000001",
        truncated=False,
        occluded=False,
        difficult=False,
    )
    torch.testing.assert_close(
        sample["rotation"], rotation_from_viewpoint(30.0, 10.0, -5.0).float()
    )
    assert sample["cad_path"].endswith("01.off")
    assert all(v.dtype == torch.float32 for v in sample.values() if isinstance(v, torch.Tensor))
    shifted = Pascal3DPlus(root, pixel_origin=0)[0]
    K = [[3000, 0, 41], [0, 3000, 31], [0, 0, 1]]
    check_values(shifted, box=[11, 6, 71, 56], camera_matrix=K)


@pytest.mark.parametrize("name", ["truncated", "occluded", "difficult"])
def test_pascal3d_skips_flagged_objects(root, name):
    dataset = cars(root, **{name: False})
    assert len(dataset) == 3
    assert dataset.skipped[name] == 1
    assert not any(dataset.annotation(i).get(name) for i in range(3))


def test_pascal3d_reads_image_sets_with_invalid_entries(root):
    lists = root / "Image_sets"
    lists.mkdir()
    lists.joinpath("car_pascal_tiny.txt").write_text(
        "\ufeff2008_000001\n2008_000001 1\n\n../car_pascal/2008_000001\n" + "x" * 5000 + "\n",
        encoding="utf-8",
    )
    dataset = Pascal3DPlus(root, "tiny")
    assert (len(dataset), dict(dataset.skipped)) == (1, {"missing_annotation": 2})


def test_pascal3d_defaults_of_missing_camera_fields_and_invalid_cad_indices(root):
    record = root / "Annotations" / "car_pascal" / "2008_000001.mat"
    viewpoint = {"azimuth": 10.0, "elevation": 20.0, "distance": 3.0}
    write_record(record, [{**pascal_object("car"), "viewpoint": viewpoint}])
    sample = cars(root)[0]
    K = [[3000, 0, 40], [0, 3000, 30], [0, 0, 1]]
    check_values(sample, camera_matrix=K, viewpoint=[10, 20, 0])
    before = cars(root).skipped["missing_mesh"]
    invalid = (-1.0, 0.0, 1e300, math.nan, math.inf, "one")
    write_record(record, [pascal_object("car", cad_index=index) for index in invalid])
    skipped = cars(root).skipped
    assert skipped["missing_mesh"] == before + len(invalid)


def test_flags_may_be_texts_and_objects_without_a_class_are_corrupt(root):
    record = root / "Annotations" / "car_pascal" / "2008_000001.mat"
    flagged = [pascal_object("car", occluded=flag) for flag in ("1", "0", "yes")]
    nameless = pascal_object("car")
    del nameless["class"]
    before = cars(root).skipped
    write_record(record, [*flagged, nameless])
    dataset = cars(root)
    assert [dataset.annotation(i)["occluded"] for i in range(2)] == [True, False]
    assert dataset.skipped - before == {"corrupt_annotation": 2}


def test_photographs_of_another_size_than_annotated_are_left_out(root):
    resized = root / "Images" / "car_pascal" / "2008_000002.jpg"
    write_image(resized, (30, 40))
    dataset = cars(root)
    assert dataset.skipped_items["bad_image_size"] == ["car_pascal/2008_000002"]
    assert [dataset.annotation(i)["image_id"] for i in range(len(dataset))] == [
        "2008_000001",
        "2008_000003",
    ]
    resized.write_bytes(b"no picture")  # its pixels say so
    assert "bad_image_size" not in cars(root).skipped


def test_annotated_sizes_are_of_stored_pixels(root):
    photograph = root / "Images" / "car_pascal" / "2008_000001.jpg"
    with_exif(photograph, exif(6))
    assert cars(root)[0]["image"].shape == (3, 60, 80)
    record = root / "Annotations" / "car_pascal" / "2008_000001.mat"
    for size, count in (((60, 80, 3), 1), ((), 0)):  # as shown, and not stated
        write_record(record, [pascal_object("car")], size)
        assert cars(root).skipped["bad_image_size"] == count


def test_pascal3d_reports_missing_files_with_advice(root):
    with refused(r"datasets/pascal3d/README\.md", MissingFileError):
        Pascal3DPlus(root / "nothing")
    with refused(r"train.*README", MissingFileError):
        Pascal3DPlus(root, "train")
    with refused(r"boat_val\.txt", MissingFileError):
        Pascal3DPlus(root, categories=["boat"])


OPTIONS = """
{"part": "voc"}                        | part
{"pixel_origin": 2}                    | pixel_origin
{"categories": "car"}                  | list of names
{"categories": ["../car"]}             | plain names
{"split": "../val", "categories": []}  | plain names
"""


@pytest.mark.parametrize(("options", "words"), text_table(OPTIONS))
def test_pascal3d_refuses_invalid_options(root, options, words):
    with refused(words):
        Pascal3DPlus(root, **options)


def test_annotation_has_no_image(pascal):
    assert set(pascal[0]) - set(pascal.annotation(0)) == {"image"}
    pascal.annotation(0)["box"].zero_()
    assert pascal.annotation(0)["box"].sum() > 0, "a sample is a copy"
    with pytest.raises(IndexError):
        pascal[len(pascal)]
    with refused("2008_000003", ImageError):
        list(pascal)
