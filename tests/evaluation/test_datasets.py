import json
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
import trimesh

from curvireg_torch import Camera
from curvireg_torch.cli import main, parse
from curvireg_torch.errors import MeshError, RenderingError
from curvireg_torch.evaluation import DATASETS, BOPBenchmark, Pascal3DBenchmark, Protocol
from curvireg_torch.jobs import runner
from curvireg_torch.jobs.outputs import MARKER
from curvireg_torch.registration import Registrar
from tests._support import double, eye, refused
from tests._support.lists import bop_poses, lines, table
from tests._support.small import SMALL, rows_of, run
from tests._support.spies import spied
from tests._support.tables import check_columns, check_values

ANY = Protocol(pose="any")


def summary_in(folder):
    """The summary of the run in a folder."""
    return json.loads((folder / "summary.json").read_text())


def test_evaluate_pascal3d(pascal, out):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    assert [benchmark.selection(count) for count in (2, 9)] == [[0, 2], [0, 1, 2, 3, 4]], "spread"
    summary = run(benchmark, out)
    check_values(summary, n=3, failed=0)
    skipped = summary["skipped"]
    # those that the dataset leaves out are counted too
    check_values(skipped, unreadable_image=1, unreadable_mesh=1, missing_image=1)
    assert "other_class" not in skipped, "objects of other classes are not"
    rows = rows_of(benchmark, out)
    assert {key: (row.get("skipped"), row["verdict"]) for key, row in rows.items()} == {
        "car/2008_000001/0": (None, "unsure"),
        "car/2008_000002/1": (None, "unsure"),
        "car/2008_000002/2": (None, "unsure"),
        "car/2008_000003/8": ("unreadable_image", "failed"),
        "sofa/2008_000002/0": ("unreadable_mesh", "failed"),
    }
    good = rows["car/2008_000001/0"]
    assert good["translation"] is None, "no camera was given"
    assert good["mesh"].endswith("car/01.off")
    assert {"probabilities", "none", "top", "reliable", "confidence"} <= set(good)
    assert good["seconds"]["register"] > 0
    R = double(good["rotation"])
    torch.testing.assert_close(R @ R.T, eye(3), atol=1e-6, rtol=0)
    files = {p.name for p in out.iterdir()} - {MARKER}
    expected = "results.jsonl predictions.csv errors.csv summary.json index.html thumbnails"
    assert files == {*expected.split()}
    assert (out / "index.html").read_text().count("<img") == 3
    assert summary_in(out)["protocol"] == str(Protocol())


def test_evaluate_bop(bop, tmp_path, out):
    benchmark = BOPBenchmark(bop, ANY)
    summary = run(benchmark, out)
    check_values(summary, n=4, failed=1)  # one photograph is of one colour
    nowhere = {**benchmark.samples[3], "box": torch.full((4,), torch.nan)}
    benchmark.entries[3] = benchmark._entry(nowhere)
    assert run(benchmark, tmp_path / "unknown")["skipped"]["unknown_box"] == 1
    assert not BOPBenchmark(bop, Protocol(pose="any", box=None))._entry(nowhere).error
    poses = bop_poses(out / "predictions.csv")
    assert len(poses) == 3
    assert all(row["t"][2] > 0 for row in poses)


def test_boxes_of_visible_parts_reach_the_registrar_with_what_they_are(bop, tmp_path):
    protocol = Protocol(pose="any", box_is="visible")
    benchmark = BOPBenchmark(bop, protocol)
    seen = torch.tensor([1.0, 2.0, 30.0, 40.0])
    known = {**benchmark.samples[0], "box_visible": seen}
    assert benchmark._entry(known).box == (1, 2, 30, 40)
    assert BOPBenchmark(bop, ANY)._entry(known).box != (1, 2, 30, 40)
    del known["box_visible"]
    assert benchmark._entry(known).error == "unknown_box"
    summary = run(benchmark, tmp_path, limit=1)
    assert summary["settings"]["pipeline"]["box_is"] == "visible"


def test_objects_fail_alone(bop, out):
    benchmark = BOPBenchmark(bop, ANY)
    first, second, third = benchmark.entries[:3]
    oblong = Camera(torch.diag(torch.tensor([400.0, 300.0, 1.0])))
    benchmark.entries[0] = replace(first, camera=oblong)
    benchmark.entries[1] = replace(second, box=tuple(v + 5000.0 for v in second.box))
    summary = run(benchmark, out)
    rows = rows_of(benchmark, out)
    assert "square pixels" in rows[first.key]["message"]
    assert "entirely outside" in rows[second.key]["message"]
    assert "rotation" in rows[third.key]
    assert summary["failed"] == 3, "and a photograph of one colour"


@pytest.mark.slow
def test_results_are_the_same_bits_on_other_threads_and_resumed(pascal, tmp_path, threads):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    threads(1)
    run(benchmark, tmp_path / "one")
    threads(2)
    run(benchmark, tmp_path / "two")
    run(benchmark, tmp_path / "resumed", limit=2)
    first = rows_of(benchmark, tmp_path / "resumed")
    run(benchmark, tmp_path / "resumed")
    folders = (tmp_path / name for name in ("one", "two", "resumed"))
    one, two, resumed = (rows_of(benchmark, folder) for folder in folders)
    timeless = [{key: {**row, "seconds": None} for key, row in rows.items()} for rows in (one, two)]
    assert timeless[0] == timeless[1]
    assert len(first) == 2
    assert first.items() <= resumed.items(), "seconds included: nothing was registered twice"
    assert list(resumed) == list(one)


def test_defects_end_the_run(pascal, out, monkeypatch):
    broken = Mock(side_effect=RenderingError("no renderer"))
    monkeypatch.setattr("curvireg_torch.evaluation.datasets.cached_bank", broken)
    with pytest.raises(RenderingError):
        run(Pascal3DBenchmark(pascal, Protocol()), out)


def test_protocol_and_pipeline_reach_the_registrar(pascal, tmp_path, monkeypatch):
    # a second CAD of a car
    trimesh.creation.box((0.2, 0.9, 0.2)).export(pascal.root / "CAD" / "car" / "02.off")
    made = spied(monkeypatch, Registrar, "__init__")
    benchmark = Pascal3DBenchmark(pascal, Protocol(cad="any"))
    run(benchmark, tmp_path, pipeline=replace(SMALL, box_jitter=0.05), limit=1)
    registrars = [given[0] for given in made]
    assert len(registrars[0].others or registrars[-1].others) == 1
    for registrar in registrars:
        assert (registrar.pipeline.box_jitter, registrar.pipeline.views.pose) == (0.05, "upright")


def test_evaluate_web_tells_known_from_unknown_poses(web, tmp_path, capsys):
    words = ["evaluate", "web", str(web.root), "--out", str(tmp_path), "--quiet"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "4 objects, 0 failed" in out
    assert "acc_15_deg" in out
    assert "the true pose of 2 is known" in out
    assert "pose=any" in out
    rows = table(tmp_path, "predictions.csv")
    known = ["30", "", "90", ""]
    check_columns(rows, category=["cup", "cup", "cup", "shoe"], true_azimuth=known)
    assert [bool(row["error_deg"]) for row in rows] == [True, False, True, False]
    assert all(row["azimuth"] for row in rows)
    for name in ("no_mesh", "no_table", "other_table", "cup"):
        for path in (web.root / name).iterdir():
            path.unlink()
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "the true pose of 0 is known" in out
    assert "acc_" not in out


def test_objects_are_grouped_by_class_or_number(pascal, bop, web):
    for kind, dataset, group in (
        ("pascal3d", pascal, "car"),
        ("bop", bop, "object 1"),
        ("web", web, "cup"),
    ):
        assert DATASETS[kind].category.format_map(dataset.annotation(0)) == group


@pytest.fixture
def evaluate(out):
    """Run ``curvireg evaluate``; returns the summary."""

    def run(*words):
        arguments = parse(["evaluate", *map(str, words), "--out", str(out), "--quiet"])
        arguments.run(arguments)
        return summary_in(out)

    return run


def test_evaluate_prints_the_headline_of_some_categories_and_takes_a_pipeline_file(
    pascal, evaluate, capsys, tmp_path
):
    words = ("pascal3d", pascal.root, "--categories", "car")
    assert evaluate(*words, "--limit", "2")["limit"] == 2
    summary = evaluate(*words)
    assert list(summary["per_class"]) == ["car"]
    check_values(summary, n=3, protocol="cad=annotated pose=upright box=annotated")
    printed = capsys.readouterr().out.splitlines()
    assert printed[-3].startswith("3 objects, 0 failed, ")
    numbers = f"acc_pi_6 {summary['acc_pi_6']:.3f}   acc_pi_18 {summary['acc_pi_18']:.3f}   "
    assert printed[-2].startswith(numbers)
    (tmp_path / "pipeline.json").write_text(replace(SMALL, box_jitter=0.0).to_json())
    summary = evaluate("pascal3d", pascal.root, "--pipeline", tmp_path / "pipeline.json")
    settings = summary["settings"]
    assert (settings["preset"], settings["pipeline"]["box_jitter"]) == ("custom", 0.0)


def test_evaluate_keeps_the_views_of_the_preset_paper(pascal, evaluate, out, monkeypatch):
    """Which take seconds to render: no mesh is read here."""
    broken = Mock(side_effect=MeshError("broken"))
    monkeypatch.setattr("curvireg_torch.evaluation.datasets.cached_bank", broken)
    with refused(r"nothing was scored .*unreadable_mesh"):
        evaluate("pascal3d", pascal.root, "--preset", "paper")
    summary = summary_in(out)
    settings = summary["settings"]
    assert summary["n"] == 0
    assert (settings["preset"], settings["protocol"].split()[1]) == ("paper", "pose=upright")
    views = settings["pipeline"]["views"]
    check_values(views, pose="paper", frame="principal")


def test_evaluate_bop_assumes_any_pose(bop, evaluate):
    summary = evaluate("bop", bop.root, "--protocol", "box=0.1", "seed=3")
    settings = summary["settings"]
    protocol = "cad=annotated pose=any box=0.1 seed=3"
    check_values(settings, dataset="bop", models="models", protocol=protocol)
    check_values(settings["pipeline"]["views"], pose="any", directions=18, theta_step=360.0)


def test_evaluate_without_boxes_reports_detection(pascal, evaluate, out, capsys, monkeypatch):
    """The summary has the recall of boxes; thumbnails show the found box."""
    drawn = spied(monkeypatch, runner, "thumbnail")
    summary = evaluate("pascal3d", pascal.root, "--limit", "2", "--protocol", "box=none")
    assert summary["detection"]["n"] == 2
    assert f"recall_1 {summary['detection']['recall_1']:.3f}   recall_5" in capsys.readouterr().out
    row = next(row for row in lines(out) if "detection" in row)
    assert row["detection"]["proposals"][0]["box"] in [box for _, _, _, box, _ in drawn]
