import pytest
import torch
from torch.utils.data import DataLoader

from curvireg_torch.data import PoseFolder
from curvireg_torch.errors import MissingFileError
from curvireg_torch.geometry import rotation_from_viewpoint
from tests._support import refused, slow_after
from tests._support.miniature import write_mesh, write_web
from tests._support.tables import check_values


@pytest.fixture
def tree(tmp_path):
    return tmp_path, write_web(tmp_path)


def test_pose_folder_counts_skipped_items_and_returns_documented_samples(tree):
    root, reasons = tree
    dataset = PoseFolder(root)
    assert (len(dataset), dict(dataset.skipped)) == (4, reasons)
    assert dataset.skipped_items["missing_image"] == ["cup/views.csv #3"]
    sample, unknown, level = (dataset[i] for i in range(3))
    names = (
        "image image_path image_id box viewpoint rotation distance category mesh_path object_index"
    )
    assert (set(sample), sample["image"].shape) == (set(names.split()), (3, 60, 80))
    known = {"box": [10, 5, 70, 55], "viewpoint": [30, 10, -5], "distance": 3, "category": "cup"}
    check_values(sample, **known)
    torch.testing.assert_close(
        sample["rotation"], rotation_from_viewpoint(30.0, 10.0, -5.0).float()
    )
    assert sample["mesh_path"].endswith("mesh.off")
    assert unknown["viewpoint"].isnan().all()
    assert unknown["rotation"].isnan().all()
    assert level["viewpoint"].tolist() == [90, 0, 0]
    assert level["rotation"].isfinite().all()
    assert level["distance"] != level["distance"]


def test_pose_folder_refuses_unusable_roots(tree, tmp_path):
    (tmp_path / "empty").mkdir()
    for root in (tmp_path / "nothing", tmp_path / "empty"):
        with refused(r"datasets/web/README\.md", MissingFileError):
            PoseFolder(root)
    write_mesh(tree[0] / "cup" / "mesh.ply")
    with refused(r"one mesh.*mesh\.off, mesh\.ply"):
        PoseFolder(tree[0])


def test_the_ending_of_a_mesh_may_be_in_capitals(tree):
    (tree[0] / "cup" / "mesh.off").rename(tree[0] / "cup" / "mesh.OFF")
    write_mesh(tree[0] / "cup" / "draft.ply")
    assert PoseFolder(tree[0])[0]["mesh_path"].endswith("mesh.OFF")


# Python 3.12 warns of fork beside threads
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("context", slow_after(1, ["fork", "spawn"]))
def test_datasets_work_with_loader_workers(tree, context):
    dataset = PoseFolder(tree[0])
    loader = DataLoader(dataset, 2, num_workers=1, collate_fn=list, multiprocessing_context=context)
    samples = [sample for batch in loader for sample in batch]
    assert torch.equal(samples[2]["image"], dataset[2]["image"])
    assert [sample["image_path"] for sample in samples] == [
        dataset[i]["image_path"] for i in range(4)
    ]
