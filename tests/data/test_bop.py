import json
from collections import Counter
from operator import setitem

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.data import BOPDataset
from curvireg_torch.errors import MissingFileError
from tests._support import refused
from tests._support.miniature import write_bop, write_json, write_mesh
from tests._support.tables import check_values, text_table


@pytest.fixture
def reasons(tmp_path):
    """How often each reason is counted in the set of ``root``."""
    return write_bop(tmp_path)


@pytest.fixture
def root(tmp_path, reasons):
    """A set with two usable scenes."""
    assert reasons
    return tmp_path


ALL = [(1, 0, 1, 0), (1, 0, 2, 1), (1, 0, 1, 2), (2, 7, 1, 0)]


def opened(root):
    """All instances of a set."""
    return BOPDataset(root, targets=False)


def edit(root, name, change):
    path = root / "test" / "000001" / name
    content = json.loads(path.read_text())
    change(content)
    write_json(path, content)


def ids(dataset):
    samples = [dataset.annotation(i) for i in range(len(dataset))]
    return [(s["scene_id"], s["image_id"], s["obj_id"], s["instance_index"]) for s in samples]


def test_bop_dataset_counts_skipped_items_and_returns_documented_samples(root, reasons):
    dataset = opened(root)
    assert ids(dataset) == ALL
    assert dict(dataset.skipped) == reasons
    assert dataset.skipped_items["missing_image"] == ["test/000001/4 #0"]
    sample = dataset[0]
    names = """
        image image_path box box_visible camera_matrix rotation translation
        T_cam_from_world obj_id scene_id image_id instance_index visib_fract
        model_path model_info
    """
    assert set(sample) == set(names.split())
    assert sample["image"].shape == (3, 60, 80)
    check_values(
        sample,
        box=[-5, 4, 25, 24],  # corners, which may lie outside of the image
        box_visible=[0, 4, 25, 24],
        camera_matrix=[[300, 0, 40], [0, 310, 30], [0, 0, 1]],
        rotation=[[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # row by row
        translation=[1, 2, 400],
        visib_fract=0.8,
        model_info=dataset.models_info[1],
    )
    assert sample["model_path"].endswith("models/obj_000001.ply")
    assert "symmetries_discrete" in sample["model_info"]


def test_bop_dataset_reads_hidden_instances_and_grey_images_without_scene_gt_info(root):
    dataset = opened(root)
    hidden = dataset[1]
    sample = dataset[3]
    assert hidden["visib_fract"] == 0
    assert hidden["box"].isfinite().all()
    assert hidden["box_visible"].isnan().all()
    assert_close(sample["image"], torch.full((3, 60, 80), 0.2))
    # Of the cube of 50 mm, 375 to 425 mm away: its near face is the wider one.
    near = [40 - 24 * 0.8, 30 - 23 * 310 / 375, 40 + 26 * 0.8, 30 + 27 * 310 / 375]
    assert sample["box"].tolist() == pytest.approx(near)
    assert sample["box_visible"].isnan().all()
    assert sample["visib_fract"] != sample["visib_fract"]


def test_targets_select_the_most_visible_instances(root):
    for targets in (None, True):
        dataset = BOPDataset(root, targets=targets)
        assert ids(dataset) == ALL[2:]
        assert dataset.skipped["no_target"] == 10
        assert "test/000001/000006 object 1" in dataset.skipped_items["missing_annotation"]
        assert dict(dataset.skipped - Counter(no_target=10)) == {
            "corrupt_annotation": 3,  # of no object, no number, and a file
            "missing_annotation": 2,
        }
    (root / "test_targets_bop19.json").unlink()
    assert len(BOPDataset(root)) == 4
    with refused("test_targets_bop19", MissingFileError):
        BOPDataset(root, targets=True)


def test_each_target_that_cannot_be_used_is_counted_once(root):
    """3: an object without a mesh; 4: no photograph; 5: no camera; 0: three of five are missing."""
    objects = {(0, 1): 5, (3, 8): 1, (4, 1): 1, (5, 1): 1, (6, 1): 2}
    names = ("scene_id", "im_id", "obj_id", "inst_count")
    targets = [(1, *key, count) for key, count in objects.items()]
    content = [dict(zip(names, target, strict=True)) for target in targets]
    write_json(root / "test_targets_bop19.json", content)
    dataset = BOPDataset(root)
    assert ids(dataset) == ALL[:3:2]
    skipped = dataset.skipped_items
    check_values(skipped, missing_mesh=["test/000001/3 #3"], missing_image=["test/000001/4 #0"])
    assert Counter(skipped["missing_annotation"]) == {
        "test/000001/000000 object 1": 3,
        "test/000001/000006 object 1": 2,
        "test/000001/5 #0": 1,
        "test/000004/scene_gt.json": 1,
    }


def test_scenes_of_one_number_are_refused(root):
    (root / "test" / "1").mkdir()
    with refused("test/1: has the number of the scene 000001"):
        BOPDataset(root)


@pytest.mark.parametrize(("split", "found"), [("test_primesense", ALL[2:]), ("train_pbr", ALL)])
def test_splits_of_tests_alone_have_targets_by_default(root, split, found):
    (root / "test").rename(root / split)
    assert ids(BOPDataset(root, split)) == found


def test_a_missing_split_names_those_that_are_there(tmp_path):
    folder = tmp_path / "sets" / "one"
    folder.mkdir(parents=True)
    write_bop(folder)
    (folder / "test").rename(folder / "train_pbr")
    with refused("the set has train_pbr: choose it as split", MissingFileError):
        BOPDataset(folder)
    with refused(r"give the folder of one set: .*", MissingFileError) as error:
        BOPDataset(folder.parent)
    assert str(folder) in str(error.value)


def test_scenes_of_several_cameras_are_named(root):
    for scene in (root / "test").iterdir():
        if (scene / "scene_gt.json").is_file():
            for camera in ("cam2", "cam1"):
                for name in ("scene_gt", "scene_gt_info"):
                    (scene / f"{name}_{camera}.json").write_text("{}")
            (scene / "scene_gt_coco_cam3.json").write_text("{}")
    assert len(opened(root)) == 4, "files without a camera go first"
    for file in (root / "test").glob("*/scene_gt.json"):
        file.unlink()
    with refused("several cameras: cam1, cam2; copy the files of"):
        BOPDataset(root)
    for file in (root / "test").glob("*/scene_gt_cam*.json"):
        file.unlink()
    assert BOPDataset(root).skipped["missing_annotation"], "not those of boxes alone"


def test_bop_dataset_refuses_missing_files_with_advice_and_damaged_target_lists(root):
    for folder, split in ((root / "nothing", "test"), (root, "train"), (root, "../test")):
        with refused(r"datasets/bop/README\.md", MissingFileError):
            BOPDataset(folder, split)
    many = '[{"scene_id": 1, "im_id": 0, "obj_id": 1, "inst_count": 1001}]'
    for content in ("[", "[" * 100000, "[1]", '[{"scene_id": 1}]', "{}", many):
        (root / "test_targets_bop19.json").write_text(content)
        with refused("test_targets_bop19"):
            BOPDataset(root)
    (root / "test_targets_bop19.json").unlink()
    for path in (root / "models").iterdir():
        path.unlink()
    with refused("models_info", MissingFileError):
        BOPDataset(root)


ENTRIES = """
{}                                                                                  | entry '1': expected a diameter > 0
{"diameter": "100"}                                                                 | diameter
{"diameter": 0}                                                                     | diameter
"text"                                                                              | entry '1'
{"diameter": 9, "symmetries_discrete": null}                                        | symmetries_discrete: expected a list
{"diameter": 9, "symmetries_discrete": [[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]} | expected rigid
{"diameter": 9, "symmetries_continuous": [{}]}                                      | axis: expected
{"diameter": 9, "symmetries_continuous": [7]}                                       | symmetries_continuous
{"diameter": 9}                                                                     | entry '11111111111111111111'
"""  # noqa: E501


@pytest.mark.parametrize(("entry", "match"), text_table(ENTRIES))
def test_damaged_models_info_is_refused_when_the_dataset_is_opened(root, entry, match):
    number = "1" * 5000 if entry == {"diameter": 9} else "1"
    edit(root, "../../models/models_info.json", lambda info: info.update({number: entry}))
    with refused(rf"models_info\.json: .*{match}") as caught:
        BOPDataset(root)
    assert len(str(caught.value)) < 500


ROTATIONS = [
    *(None, "x", {"a": 1}, [1, 2], ["1"] * 9, [True] * 9, [1e400] * 9, [10**400] * 9),
    [-1, 0, 0, 0, 0, -1, 0, 1, 0],  # mirrored
]
BOXES = [[4, 4, 0, 20], [4, 4, 30, 0], [-1, -1, -1, -1]]


@pytest.mark.parametrize(
    ("name", "key", "value", "reason"),
    [
        *(("scene_gt.json", "cam_R_m2c", R, "corrupt_annotation") for R in ROTATIONS),
        *(("scene_gt_info.json", "bbox_obj", box, "bad_box") for box in BOXES),
    ],
)
def test_bop_dataset_counts_invalid_rotations_and_boxes(root, reasons, name, key, value, reason):
    edit(root, name, lambda content: content["0"][0].update({key: value}))
    dataset = opened(root)
    assert dataset.skipped[reason] == reasons[reason] + 1
    assert len(dataset) == 3


@pytest.mark.parametrize(("place", "value"), [(0, 0.0), (4, -500.0), (1, 2.0), (8, 2.0)])
def test_bop_dataset_skips_invalid_cameras(root, place, value):
    before = opened(root)
    edit(root, "scene_camera.json", lambda cameras: setitem(cameras["0"]["cam_K"], place, value))
    after = opened(root)
    lost = len(before) - len(after)
    assert lost > 0
    assert after.skipped["corrupt_annotation"] == before.skipped["corrupt_annotation"] + lost


def test_bop_dataset_prefers_colour_to_grey_and_instances_of_known_visibility(root):
    scene = root / "test" / "000001"
    (scene / "gray").mkdir()
    (scene / "gray" / "000000.tif").write_bytes(b"")
    assert "/rgb/" in opened(root).annotation(0)["image_path"]
    edit(root, "scene_gt_info.json", lambda content: content["0"][2].pop("visib_fract"))
    # of two instances, the one that is 0.8 visible
    assert ids(BOPDataset(root))[0] == (1, 0, 1, 0)


def test_bop_dataset_measures_models_without_models_info(root):
    (root / "models" / "models_info.json").unlink()
    dataset = opened(root)
    assert dataset.models_info[1]["diameter"] == pytest.approx(50 * 3**0.5)
    assert [dataset.models_info[1][key] for key in ("min_x", "size_z")] == pytest.approx(
        [-25.0, 50.0]
    )
    assert ids(dataset) == [*ALL[:3], (1, 3, 9, 4), ALL[3]]


def test_bop_dataset_reads_names_with_fewer_digits_and_other_folders_of_models(root):
    models = (root / "models").rename(root / "models_cad")
    for path in models.glob("obj_*.ply"):
        path.rename(path.with_name(f"obj_{path.stem[-2:]}.ply"))
    scene = root / "test" / "000001"
    for path in (scene / "rgb").iterdir():
        path.rename(path.with_name(path.name[2:]))  # 0000.jpg
    scene.rename(scene.with_name("01"))
    dataset = BOPDataset(root, targets=False, models="models_cad")
    assert sorted(ids(dataset)) == sorted(ALL)
    assert dataset[0]["model_path"].endswith("obj_01.ply")
    with refused("models_info", MissingFileError):
        BOPDataset(root)
    with refused("no such folder", MissingFileError):
        BOPDataset(root, models="../models_cad")


def scale_models(root, factor):
    for number in (1, 2, 9):
        write_mesh(root / "models" / f"obj_{number:06d}.ply", half=25.0 * factor)


@pytest.mark.parametrize("factor", [1e-3, 0.1, 25.4])
def test_bop_dataset_refuses_models_in_another_unit_than_models_info(root, factor):
    scale_models(root, factor)
    with refused(r"across, models_info\.json says 86\.6: .*scale the models to mm") as error:
        BOPDataset(root)
    assert ("in metres?" in str(error.value)) == (factor == 1e-3)


def test_bop_dataset_refuses_models_in_metres_without_models_info(root):
    (root / "models" / "models_info.json").unlink()
    scale_models(root, 1e-3)
    with refused(r"the mesh is 0\.065 px wide: in metres\? scale it to mm"):
        BOPDataset(root)


def test_bop_dataset_refuses_poses_in_metres(root):
    def in_metres(content):
        content["0"][0]["cam_t_m2c"] = [value / 1000 for value in content["0"][0]["cam_t_m2c"]]

    edit(root, "scene_gt.json", in_metres)
    with refused(r"image 0 the mesh is 86\.6 across and 0\.4 away: cam_t_m2c in metres"):
        opened(root)


def nest(root):
    """Matrices in rows, and zeros before numbers."""

    def nested(content):
        for name, value in list(content.items()):
            for entry in value if isinstance(value, list) else [value]:
                for key in {"cam_K", "cam_R_m2c"} & set(entry):
                    rows = entry[key]
                    entry[key] = [rows[:3], rows[3:6], rows[6:]]
            content[name.zfill(6)] = content.pop(name)

    edit(root, "scene_camera.json", nested)
    edit(root, "scene_gt.json", nested)


def mark(root):
    """A byte order mark in front of each file."""
    for path in root.rglob("*.json"):
        path.write_text("\ufeff" + path.read_text(), encoding="utf-8")


def capitalise(root):
    for path in (root / "test").glob("*/rgb/*"):
        path.rename(path.with_suffix(path.suffix.title()))


@pytest.mark.parametrize("rewrite", [nest, mark, capitalise])
def test_the_same_set_written_in_another_way_is_read_alike(root, rewrite):
    before = BOPDataset(root)
    rewrite(root)
    after = BOPDataset(root)
    assert (ids(after), after.skipped) == (ids(before), before.skipped)
    for name in ("camera_matrix", "rotation", "box"):
        assert_close(after.annotation(0)[name], before.annotation(0)[name])


def test_bop_dataset_names_folders_that_are_no_scenes(root):
    for scene in (root / "test").iterdir():
        scene.rename(scene.with_name(f"scene_{scene.name}"))
    with refused("no scene, which is a folder with a number", MissingFileError):
        BOPDataset(root)


def test_bop_dataset_without_scene_gt_info_skips_what_is_behind_the_camera(root):
    scene = root / "test" / "000002" / "scene_gt.json"
    scene.write_text(scene.read_text().replace("400.0", "-400.0"))
    assert opened(root).skipped["behind_camera"] == 1
