"""Scores of results that are written by hand, so that every number is known."""

import math
import runpy

import pytest
import torch
import trimesh

from curvireg_torch.data import Pascal3DPlus
from curvireg_torch.errors import CurviregWarning
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, PoseFolderBenchmark, Protocol
from curvireg_torch.evaluation.datasets import report
from curvireg_torch.evaluation.detection import copy_shown, detection_recall
from curvireg_torch.geometry import rotation_from_axis_angle, rotation_from_viewpoint
from curvireg_torch.jobs.store import ResultStore, to_json
from tests._support import double, refused
from tests._support.lists import bop_poses, table
from tests._support.miniature import (
    pascal_object,
    write_image,
    write_json,
    write_mesh,
    write_record,
)
from tests._support.pages import ROOT
from tests._support.tables import check_columns, check_values, text_table

MATS_HERE = pytest.mark.usefixtures("mats_here")
ANY = Protocol(pose="any")

SECONDS = {"bank": 2.0, "register": 0.5}
PICTURE = {"width": 80, "height": 60}
INPUTS = {"picture": PICTURE, "box": [-9.0, -9.0, -8.0, -8.0]}
SKIPPED = {"skipped": "x"}
FAILED = {"verdict": "failed", "message": "?"}


def degrees(value):
    """An angle up to rounding."""
    return pytest.approx(value, abs=1e-3)


def rotated(sample, axis, angle):
    """The true rotation after a rotation of the model by so many degrees about x or z."""
    vector = torch.zeros(3).double()
    vector["xyz".index(axis)] = math.radians(angle)
    return (sample["rotation"].double() @ rotation_from_axis_angle(vector)).tolist()


def posed(sample, angle, offset=(0.0, 0.0, 0.0)):
    """A result whose pose is a rotation about z off, and an offset."""
    rotation = rotated(sample, "z", angle)
    translation = (sample["translation"] + torch.tensor(offset)).tolist()
    return {"rotation": rotation, "translation": translation, "inputs": INPUTS}


def scores_of(benchmark, out, rows):
    """Write results with these rows, and score them."""
    store = ResultStore(out)
    head = {"digests": {"request": ""}, "verdict": "reliable", "message": "", "seconds": SECONDS}
    known = {"score": 0.5, "confidence": 0.5, "reliable": False, "mesh": "CAD/01.off"}
    known["inputs"] = INPUTS
    for entry, row in zip(benchmark.entries, rows, strict=False):
        store.append({**head, "key": entry.key, **(known if "rotation" in row else {}), **row})
    return report(benchmark, store, {"root": "/some/where", "protocol": str(benchmark.protocol)})


@pytest.fixture
def instances(bop):
    """Four instances of a BOP dataset, and their annotations."""
    benchmark = BOPBenchmark(bop, Protocol(pose="any", box=None))
    return benchmark, list(benchmark.samples)


@pytest.fixture
def furniture(tmp_path):
    """Four bottles, a table and four sofas, with flags."""
    root = tmp_path / "pascal"
    flags = [{}, {"truncated": 1}, {"occluded": 1}, {"difficult": 1, "truncated": 1}]
    objects = {name: [pascal_object(name, **f) for f in flags] for name in ("bottle", "sofa")}
    objects["diningtable"] = [pascal_object("diningtable")]
    for name, entries in objects.items():
        write_record(root / "Annotations" / f"{name}_pascal" / "1.mat", entries)
        write_image(root / "Images" / f"{name}_pascal" / "1.jpg")
        write_mesh(root / "CAD" / name / "01.off")
        root.joinpath("Image_sets").mkdir(exist_ok=True)
        root.joinpath("Image_sets", f"{name}_pascal_val.txt").write_text("1\n")
    return Pascal3DBenchmark(Pascal3DPlus(root), Protocol())


def test_pascal3d_summary(furniture, tmp_path):
    """Of annotations that a program of its own reads, as for users."""
    rotations = [("z", 90), ("z", 40), ("x", 20), None, ("z", 180), ("z", 5), ("z", 20), ("z", 180)]
    samples = furniture.samples
    pairs = zip(samples[:8], rotations, strict=True)
    rows = [{"rotation": rotated(sample, *r)} if r else FAILED for sample, r in pairs]
    summary = scores_of(furniture, tmp_path, [*rows, {"skipped": "unreadable_image"}])
    assert (tmp_path / "summary.json").read_text() == to_json(summary)
    # errors: bottles 90, 40, 20, miss; table 180; sofas 5, 20, 180
    check_values(
        summary,
        n=8,
        failed=1,
        skipped={"unreadable_image": 1},
        acc_pi_6=3 / 8,
        acc_pi_18=1 / 8,
        med_err_deg=degrees(65),
        seconds={"bank": 16.0, "register": 4.0, "register_each": 0.5},
    )
    # with symmetries: bottles 0, 0, 20, miss; table 0
    aware = {"acc_pi_6": 6 / 8, "acc_pi_18": 4 / 8, "med_err_deg": degrees(12.5)}
    assert summary["symmetry_aware"] == aware
    subsets = summary["subsets"]
    sizes = {name: s["n"] for name, s in subsets.items()}
    assert sizes == {"easy": 3, "truncated": 3, "occluded": 2, "difficult": 1}
    check_values(subsets["easy"], acc_pi_6=1 / 3)
    check_values(subsets["difficult"], med_err_deg=math.inf)
    sizes = {name: s["n"] for name, s in summary["per_class"].items()}
    assert sizes == {"bottle": 4, "diningtable": 1, "sofa": 3}
    check_values(summary["per_class"]["sofa"], acc_pi_6=2 / 3)
    # classes: bottles 1/4, table 0, sofas 2/3; with symmetries 3/4, 1, 2/3
    mean = summary["mean_over_classes"]
    check_values(
        mean,
        n_classes=3,
        acc_pi_6=pytest.approx((1 / 4 + 0 + 2 / 3) / 3),
        acc_pi_18=pytest.approx((0 + 0 + 1 / 3) / 3),
        med_err_deg=degrees((65 + 180 + 20) / 3),
    )
    check_values(mean["symmetry_aware"], acc_pi_6=pytest.approx((3 / 4 + 1 + 2 / 3) / 3))
    # easy ones: a bottle that is 90 degrees off, the table, the sofa that is 5 degrees off
    right = {name: s["acc_pi_18"] for name, s in subsets["easy"]["per_class"].items()}
    assert right == {"bottle": 0, "diningtable": 0, "sofa": 1}
    check_values(subsets["easy"]["mean_over_classes"], med_err_deg=degrees((90 + 180 + 5) / 3))
    check_values(summary["settings"], root="where")  # a summary is shared: no paths


@MATS_HERE
def test_pascal3d_table(furniture, tmp_path):
    R = rotation_from_viewpoint(*double([200.0, 10, -5])).tolist()
    scores_of(furniture, tmp_path, [{"rotation": R}, FAILED] + [SKIPPED] * 7)
    first, second = table(tmp_path, "predictions.csv")
    angles = ("azimuth", "elevation", "theta")
    assert [float(first[name]) for name in angles] == degrees([200, 10, -5])
    truth = furniture.dataset.annotation(0)["viewpoint"].tolist()
    assert [float(first["true_" + name]) for name in angles] == truth
    assert float(first["symmetric_error_deg"]) == degrees(0)
    assert 150 < float(first["error_deg"]) <= 170
    # seconds of the registration, without the bank
    known = {"category": "bottle", "image_id": "1", "truncated": "0", "seconds": "0.5"}
    check_values(first, mesh="01.off", **known)
    check_values(second, failed="?", azimuth="", error_deg="inf")


def test_bop_summary(instances, tmp_path):
    benchmark, samples = instances
    assert [entry.key for entry in benchmark.entries] == ["1/0/0", "1/0/1", "1/0/2", "2/7/0"]
    check_columns(samples, obj_id=[1, 2, 1, 1])
    # half a rotation is a symmetry of object 1, not of object 2; y is along the object's z
    first = posed(samples[0], 180, (3.5, 0.0, 0.0))
    last = posed(samples[3], 20, (0.0, 0.04 * 86.6, 0.0))
    rows = [first, posed(samples[1], 180), FAILED, last]
    summary = scores_of(benchmark, tmp_path, rows)
    # errors 0, 180, miss, 20
    known = {"n": 4, "failed": 1, "acc_15_deg": 1 / 4, "acc_30_deg": 2 / 4}
    check_values(summary, med_err_deg=degrees(100), **known)
    check_values(summary["per_object"]["2"], acc_30_deg=0)
    check_values(summary["per_object"]["1"], n=3)
    # MSSD in diameters: 0.04, then twice 35.4 / 86.6, miss, then hypot(2 * 35.4 sin 10 deg / 86.6,
    # 0.04) = 0.147
    assert summary["mssd_ar"] == pytest.approx((1.0 + 0.0 + 0.0 + 0.8) / 4)
    # ADD(-S): 0.04, 0.816, miss, 0.147
    assert summary["add_recall_0.1d"] == 1 / 4
    # MSPD: 300 / 375 * 3.5 = 2.8 px of 80, which are 22.4 of 640: six of the thresholds 5, 10, ...,
    # 50 px (relative to the height of 60 px, five); about 100 px, miss, about 9 px
    assert summary["mspd_ar"] == pytest.approx(0.6 / 4)
    check_values(summary["subsets"]["unoccluded"], n=0)


def test_bop_table(instances, tmp_path):
    benchmark, samples = instances
    rows = [posed(s, 0) for s in samples]
    rows[1] = FAILED
    scores_of(benchmark, tmp_path, rows)
    table = bop_poses(tmp_path / "predictions.csv")
    # BOP counts the seconds of the whole image
    ids = {"scene_id": [1, 1, 2], "im_id": [0, 0, 7], "obj_id": [1, 1, 1]}
    check_columns(table, time=[1.5, 1.5, 0.5], **ids)
    t = samples[0]["translation"].tolist()
    line = (tmp_path / "predictions.csv").read_text().splitlines()[1]
    assert line.endswith(f"{' '.join(map(str, t))},1.5"), "all digits"


def test_cad_any_is_refused_for_objects_with_one_mesh_and_views_without_cameras(bop, web, pascal):
    for benchmark, dataset in ((BOPBenchmark, bop), (PoseFolderBenchmark, web)):
        with refused("cad=annotated; got cad=any"):
            benchmark(dataset, Protocol(cad="any"))
    with refused("views needs a dataset with cameras"):
        Pascal3DBenchmark(pascal, Protocol(views=2))


def test_pose_folders_score_known_poses(web):
    benchmark = PoseFolderBenchmark(web, ANY)
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    first, _, third, _ = (sample["rotation"] for sample in benchmark.samples)
    poses = [(first, 0.75), (half, 0.25), (third @ half, 0.5)]
    rows = [{"rotation": R.tolist(), "confidence": c, "reliable": c > 0.7} for R, c in poses] + [
        FAILED
    ]
    errors = benchmark.errors(benchmark.samples, rows)
    assert errors["error_deg"][[0, 2]].tolist() == pytest.approx([0, 180], abs=0.1)
    assert errors["error_deg"].isnan().tolist() == [False, True, False, True]
    summary = benchmark.summary(benchmark.samples, rows, errors)
    check_values(summary, n=4, n_posed=2, reliable=1, acc_30_deg=0.5, mean_confidence=0.375)
    check_values(summary["per_object"]["cup"], mean_confidence=0.5)
    unposed = {"n": 1, "n_posed": 0, "reliable": 0, "mean_confidence": 0.0}
    unposed |= dict.fromkeys(("acc_15_deg", "acc_30_deg", "med_err_deg"))
    assert summary["per_object"]["shoe"] == unposed
    assert benchmark.errors(benchmark.samples[:1], [FAILED])["error_deg"].tolist() == [torch.inf]
    unknown = [*rows[:2], {**rows[2], "confidence": None}, FAILED]
    assert benchmark.summary(benchmark.samples, unknown, errors)["mean_confidence"] is None


@pytest.mark.filterwarnings("ignore:views=2")
def test_detection_is_scored_in_single_photographs(bop, tmp_path):
    benchmark = BOPBenchmark(bop, Protocol(pose="any", box=None, views=2))
    assert "detection" not in scores_of(benchmark, tmp_path, [FAILED] * 4)


def test_without_a_box_any_copy_of_the_object_is_right(instances, tmp_path):
    benchmark, (first, other, second, _) = instances
    second["box"] = torch.tensor([50.0, 30.0, 70.0, 50.0])
    second["rotation"] = first["rotation"][[1, 2, 0]]
    assert benchmark.copies([second, other]) == [[second, first], [other]]
    around = [49.0, 29.0, 71.0, 51.0]
    found = {**posed(second, 0), **located(AWAY, around)}
    found["inputs"] = {"picture": PICTURE, "box": around}
    summary = scores_of(benchmark, tmp_path, [found, FAILED, found, FAILED])
    recall = {"n": 4, "recall_1": 0.0, "recall_5": 0.5, "recall_20": 0.5}
    check_values(summary, acc_15_deg=0.5, mssd_ar=0.5, mspd_ar=0.5, detection=recall)
    assert copy_shown([first, second], FAILED) is first
    beside = {**found, "inputs": {"box": [75.0, 0.0, 79.0, 4.0]}}
    assert copy_shown([first, second], beside) is first


BOX = (10.0, 10.0, 30.0, 30.0)
AWAY = (150, 50, 160, 60)


def sample(*box):
    return {"box": torch.tensor(box)}


def located(*boxes):
    proposals = [{"box": list(map(float, box)), "score": 0.5} for box in boxes]
    return {
        "detection": {"proposals": proposals},
        "inputs": {"picture": {"width": 200, "height": 100}},
    }


def test_detection_recall_counts_the_first_right_proposal():
    half = (10, 10, 30, 20)
    less = (10, 10, 30, 19.9)
    rows = [
        located(BOX),
        located(AWAY, half),
        located(*[AWAY] * 5, BOX),
        located(less),
        located(*[AWAY] * 20, BOX),
    ]
    recall = detection_recall([[sample(*BOX)]] * 5, rows)
    assert recall == {"n": 5, "recall_1": 0.2, "recall_5": 0.4, "recall_20": 0.6}
    unknown = sample(*[math.nan] * 4)
    copies = [[sample(*BOX)], [unknown], [unknown, sample(*BOX)]]
    recall = detection_recall(copies, [located(BOX), located(AWAY), FAILED])
    assert (recall["n"], recall["recall_1"]) == (2, 0.5)
    nothing = dict.fromkeys(("recall_1", "recall_5", "recall_20"))
    assert detection_recall([], []) == {"n": 0, **nothing}


@MATS_HERE
def test_the_page_marks_by_the_error_up_to_symmetries(furniture, bop, tmp_path):
    for benchmark, angle in ((furniture, 90), (BOPBenchmark(bop, ANY), 180)):
        first = benchmark.samples[0]
        pose = {"rotation": rotated(first, "z", angle), "translation": [0.0, 0.0, 500.0]}
        out = tmp_path / str(angle)
        scores_of(benchmark, out, [pose, *[SKIPPED] * (len(benchmark.entries) - 1)])
        page = (out / "index.html").read_text()
        assert '<figure class="right">' in page
        assert "0.0 degrees off" in page
        assert "1 of 1 within 30 degrees" in page


def test_errors_are_written_with_all_digits(instances, tmp_path):
    benchmark, samples = instances
    rows = [posed(s, 7) for s in samples]
    rows[2] = FAILED
    summary = scores_of(benchmark, tmp_path, rows)
    found = table(tmp_path, "errors.csv")
    keys = [entry.key for entry in benchmark.entries]
    check_columns(found, key=keys, group=["1", "2", "1", "1"])
    errors = benchmark.errors(samples, rows)
    for name, values in errors.items():
        assert [float(row[name]) for row in found] == values.tolist(), name
    assert found[2]["add"] == "inf"
    assert summary["ar_rgb"] == pytest.approx((summary["mssd_ar"] + summary["mspd_ar"]) / 2)
    assert "VSD needs depth" in summary["vsd"]
    web = {"error_deg": double([1 / 3, torch.nan])}
    groups = [{"obj_id": 1}, {"obj_id": 2}]
    benchmark.write_errors(tmp_path / "web.csv", ["a", "b"], groups, web)
    check_columns(table(tmp_path, "web.csv"), error_deg=[repr(1 / 3), ""])


def test_bop_errors_are_of_the_models_of_the_challenge(instances, tmp_path):
    """Of cubes that are three times as large, whose diameter is twice that of the models, and that
    have no symmetry."""
    benchmark, samples = instances
    root = benchmark.dataset.root
    rows = [posed(s, 20) for s in samples]
    plain = benchmark.errors(samples, rows)
    assert scores_of(benchmark, tmp_path / "models", rows)["models"] == {"models": [1, 2]}
    cube = trimesh.load(root / "models" / "obj_000001.ply")
    (root / "models_eval").mkdir()
    cube.apply_scale(3.0).export(root / "models_eval" / "obj_1.ply")  # of whatever number of digits
    enlarged = BOPBenchmark(benchmark.dataset, benchmark.protocol)
    first = [i for i, s in enumerate(samples) if s["obj_id"] == 1]
    found = enlarged.errors(samples, rows)
    for name in ("add", "mssd", "mspd"):
        assert (found[name][first] > 2 * plain[name][first]).all(), name
        assert found[name][1] == plain[name][1], "of the second object"
    models = scores_of(enlarged, tmp_path / "some", rows)["models"]
    assert models == {"models_eval": [1], "models": [2]}
    info = {"1": {"diameter": 2 * samples[0]["model_info"]["diameter"]}}
    write_json(root / "models_eval" / "models_info.json", info)
    doubled = BOPBenchmark(benchmark.dataset, benchmark.protocol).errors(samples, rows)
    torch.testing.assert_close(doubled["mssd"][first], found["mssd"][first] / 2)
    half = [posed(s, 180) for s in samples]
    errors = BOPBenchmark(benchmark.dataset, benchmark.protocol).errors(samples, half)
    assert errors["rotation"][first].tolist() == pytest.approx([180] * 3)


def test_a_damaged_model_of_the_challenge_costs_its_objects_alone(bop, tmp_path, capsys):
    write_mesh(bop.root / "models_eval" / "obj_000001.ply", half=25.0)
    (bop.root / "models_eval" / "obj_000002.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    with pytest.warns(CurviregWarning, match=r"obj_000002\.ply: .*; object 2 is left out"):
        benchmark = BOPBenchmark(bop, ANY)
    rows = [posed(sample, 0) for sample in benchmark.samples]
    summary = scores_of(benchmark, tmp_path / "out", rows)
    check_values(summary, n=3, mssd_ar=1.0)
    check_values(summary["skipped"], unreadable_mesh=1)
    verify = runpy.run_path(str(ROOT / "datasets" / "verify.py"))
    assert verify["main"](["bop", str(bop.root)]) == 1
    assert "corrupt_mesh: 1\n" in capsys.readouterr().out


def test_vertices_that_no_face_uses_are_scored(instances):
    """One that is ten times as far from the axis of the rotation as the corners of the cube."""
    benchmark, samples = instances
    rows = [posed(sample, 20) for sample in samples]
    plain = benchmark.errors(samples, rows)
    path = benchmark.dataset.root / "models" / "obj_000002.ply"
    cube = trimesh.load(path)
    cube.vertices = [*cube.vertices, [250.0, 250.0, 0.0], [math.nan] * 3]
    cube.export(path)
    found = benchmark.errors(samples, rows)
    assert found["mssd"][1] == pytest.approx(10 * plain["mssd"][1])
    assert found["add"][1] == pytest.approx((8 + 10) / 9 * plain["add"][1])


@pytest.mark.parametrize(("folder", "name"), [("lm", "lm"), ("my-own_set", "myownset")])
def test_results_have_the_name_that_the_toolkit_takes_apart(bop, tmp_path, out, folder, name):
    benchmark = BOPBenchmark(bop, ANY)
    bop.root.rename(tmp_path / "stored")
    (tmp_path / folder).symlink_to("stored")
    bop.root = tmp_path / folder
    bop.split = "test_primesense"
    out.mkdir()
    store = ResultStore(out)
    report(benchmark, store, {"root": "x", "protocol": "", "preset": "fast"}, 0)
    (file,) = out.glob("*_*.csv")
    assert file.name == f"curvireg-fast_{name}-test-primesense.csv"
    assert file.read_bytes() == (out / "predictions.csv").read_bytes()


def test_an_object_that_is_visible_by_95_per_cent_is_unoccluded(instances):
    benchmark, _ = instances
    samples = [{"visib_fract": fraction} for fraction in (0.949, 0.95, 0.951, math.nan)]
    assert benchmark.subsets(samples) == {"unoccluded": [False, True, True, False]}


CLIPPED = """
[10.0, 79.5, 30.0, 159.5]  | [10.0, 89.5, 30.0, 99.5]
[179.5, 10.0, 259.5, 30.0] | [189.5, 10.0, 199.5, 30.0]
[10.0, -80.5, 30.0, 19.5]  | [10.0, -0.5, 30.0, 9.5]
[-80.5, 10.0, 19.5, 30.0]  | [-0.5, 10.0, 9.5, 30.0]
"""


@pytest.mark.parametrize(("annotated", "proposed"), text_table(CLIPPED))
def test_boxes_are_clipped_where_the_outermost_pixels_end(annotated, proposed):
    """At -0.5, and 99.5 of 100 rows: half of what is then left of the annotated box is proposed."""
    assert detection_recall([[sample(*annotated)]], [located(proposed)])["recall_1"] == 1.0


@MATS_HERE
def test_another_cad_of_the_class_is_drawn_by_the_seed(furniture):
    folder = furniture.dataset.root / "CAD" / "sofa"
    names = [f"{k:02d}.off" for k in range(1, 9)]
    for name in names[1:]:
        write_mesh(folder / name)
    drawn = []
    for seed in range(6):
        benchmark = Pascal3DBenchmark(furniture.dataset, Protocol(cad="other", seed=seed))
        again = Pascal3DBenchmark(furniture.dataset, Protocol(cad="other", seed=seed))
        meshes = [entry.meshes for entry in benchmark.entries]
        assert [entry.meshes for entry in again.entries] == meshes
        assert {entry.error for entry in benchmark.entries[:5]} == {"no_other_cad"}
        drawn.append([mesh.name for (mesh,) in meshes[5:]])
    assert len(set(map(tuple, drawn))) == 6
    assert {name for some in drawn for name in some} == set(names[1:]), (
        "all, but not the annotated one"
    )
    assert str(Protocol(cad="other", seed=3)) == "cad=other pose=upright box=annotated seed=3"
