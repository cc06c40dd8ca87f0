"""The paper's measurements on rendered photographs, for which the true view must win."""

import math
import re
import subprocess
import sys
from dataclasses import replace
from importlib import util
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from curvireg_torch.geometry import camera_matrix
from curvireg_torch.pipeline import PRESETS, BankSettings, Pipeline, ViewPolicy
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from scripts._shared import RIGHT_DEG, commit, read_json, read_lines
from scripts._shared import run as run_script
from scripts.paper import measure, printed, reproduce_paper, staircase, tables
from scripts.paper.cases import find_cases
from scripts.paper.detectors import DETECTORS
from scripts.paper.measures import Estimate, bootstrap, share_near
from tests._support import seeded, seen_from, write_photo

SETTINGS = BankSettings(image_size=64)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two photographs of one object, at views of the corrected bank."""
    root = tmp_path_factory.mktemp("web")
    folder = root / "thing"
    folder.mkdir()
    mesh = example_mesh()
    mesh.export(folder / "mesh.ply")
    K = camera_matrix(400.0, 400.0, 79.5, 59.5)
    grey = torch.full((3, 120, 160), 0.9)
    lines = ["image,x0,y0,x1,y1,azimuth,elevation,theta,distance"]
    for i, (azimuth, elevation) in enumerate([(60, 30), (210, 0)]):
        T = seen_from(mesh, float(azimuth), float(elevation), 5.0)
        image, box = synthesize_photograph(
            mesh, T, K, (120, 160), seeded(i), background=grey, texture=0.0
        )
        write_photo(folder / f"{i}.png", image)
        lines.append(f"{i}.png,{','.join(f'{v:g}' for v in box.tolist())},{azimuth},{elevation},0,")
    folder.joinpath("views.csv").write_text("\n".join(lines) + "\n")
    return root


def records_of(phase, root):
    return reproduce_paper.measure(phase, SETTINGS, "upright", find_cases("web", root))


@pytest.fixture(scope="module")
def views(root):
    """Records of rankings, of a tenth of the views."""
    with pytest.MonkeyPatch.context() as patch:
        few = {"azimuth_step": 30.0, "elevations": (0.0, 30.0)}
        patch.setattr(measure, "ViewPolicy", lambda pose: ViewPolicy(pose, **few))
        return records_of("views", root)


def test_points_of_the_true_view_are_repeated_most(root):
    records = records_of("points", root)
    assert {name.upper() for name in DETECTORS} == set(records[0]["points"])
    for record in records:
        for name in ("MFC", "MCS", "IG"):
            best = int(np.argmax(record["curve"][name]))
            assert abs(tables.CURVE_OFFSETS[best]) <= 5, name
            assert record["curve"][name][20] == pytest.approx(record["repeatability"][f"CS/{name}"])
        assert record["ip"]["MCS"] > 2 * record["ip"]["chance"]
        assert record["sensitivity"]["MCS 0.04 2"] == pytest.approx(record["ip"]["MCS"])
        of_eps = [record["sensitivity"][f"MCS 0.04 {eps}"] for eps in (1, 2, 3, 4)]
        assert of_eps == sorted(of_eps)
        assert 10 < record["points"]["MCS"] <= 0.04 * 64 * 64 + 1
        assert 0 < record["hausdorff"]["MCS"] < 90


def test_columns_are_of_what_is_measured():
    columns = {name: shown["columns"][1:] for name, shown in tables.SHOWN.items()}
    assert columns["curve"] == list(measure.CURVE_DETECTORS)
    assert columns["sensitivity"] == ["eps", *measure.SENSITIVE]
    assert columns["repeatability"] == list(tables.PHOTOS)
    assert columns["ranks"] == [f"k = {rank}" for rank in tables.RANKS]
    assert columns["precision"][:3] == columns["grids"] == list(tables.NAMES.values())
    texts = " ".join(shown["definition"] for shown in tables.SHOWN.values())
    assert texts.count(f"{RIGHT_DEG:g}°") == 4


def test_tables_rank_by_the_terms_of_the_paper_alone():
    variants = measure.variants("upright")
    assert tuple(variants) == tables.VARIANTS == tuple(tables.NAMES)
    for pipeline, whitening in zip(variants.values(), ("paper", "paper", "none"), strict=True):
        assert [term.name for term in pipeline.terms] == ["hog", "repeatability"]
        assert pipeline.terms[0].whitening == whitening
        assert (pipeline.box_jitter, pipeline.search, pipeline.contours) == (0.0, True, False)
    assert variants["printed"].with_term("hog", whitening="none") == variants["corrected"]
    assert measure.variants("any")["literal"] == PRESETS["paper"]
    assert measure.variants("any")["corrected"].views == ViewPolicy("any")


@pytest.mark.slow
def test_rankings_find_the_true_view(views):
    for record in views:
        assert max(record["corrected"]["limit"][:3]) < 1e-2, "the truth is in the bank"
        assert record["literal"]["limit"][0] > 1.0, "and not in the paper's"
        assert np.isnan(record["corrected"]["limit"][3]), "the distance is unknown"
        assert len(record["literal"]["CS/MFC"]["top"]) == 20
        assert record["corrected"]["CS/MCS"]["top"][0] < 30.0
    records = tables.Records(views, "two photographs")
    for table in tables.rank_tables(records):
        for row in table.rows:
            means = [cell.mean for cell in row[1:]]
            assert means == sorted(means), "precision grows with k"


@pytest.mark.slow
def test_the_search_says_between_how_many_views_it_searches(views):
    for record in views:
        for variant in tables.VARIANTS:
            for pair in tables.PAIRS:
                found = record[variant][pair]
                assert 1 <= found["coherent"] <= 3
                assert ("wider found" in found) == (pair in tables.SEARCHED_PAIRS)
                if found["coherent"] > 1 and pair in tables.SEARCHED_PAIRS:
                    assert found["wider found"] == found["found"]
    (table,) = tables.search_tables(tables.Records(views, "two photographs"))
    assert len(table.rows) == 9


@pytest.mark.slow
def test_chance_and_ceiling_stand_below_precision(views):
    records = tables.Records(views, "two photographs")
    precision = tables.precision_tables(records)[0]
    lot, ceiling = precision.rows[-2:]
    for variant, chance, best in zip(tables.VARIANTS, lot[1:], ceiling[1:], strict=False):
        for record in views:
            least = min(record[variant][pair]["top"][0] for pair in tables.PAIRS)
            assert record[variant]["ceiling"] >= float(least < 30.0)
        assert 0.0 < chance.mean < 0.3
        assert chance.mean <= best.mean
    for table in tables.rank_tables(records):
        means = [cell.mean for cell in table.rows[-2][1:]]
        assert means == sorted(means)


def test_focus_curves_by_threshold_and_precision_by_protocol(root):
    records = records_of("focus", root)
    assert set(records[0]["chance"]) == set(tables.PROTOCOLS.values())
    for record in records:
        # upright views: a half turn is as probable, and 20 draws more so
        chance = record["chance"]
        assert chance["half turn"] == pytest.approx(2 * chance["right"], rel=0.3)
        assert chance["right"] < chance["azimuth"] < chance["top 20"]
        found = record["MCS"]
        assert found["half turn"] <= found["right"]
        assert found["top 20"] <= found["right"]
        assert found["right"] == pytest.approx(0.0, abs=30.0)
        weak = [record[f"MFC {t:.4f}"]["ip"] for t in measure.THRESHOLDS]
        assert weak[0] < max(weak)
    thresholds, protocols = tables.focus_tables(tables.Records(records, "two photographs"))
    assert [row[0] for row in thresholds.rows[:2]] == ["0.0010", "0.0067"]
    assert [row[0] for row in protocols.rows] == list(tables.PROTOCOLS)


def test_bootstrap_resamples_cads():
    values = [0.0] * 10 + [1.0] * 10
    alone = bootstrap(values, [str(i) for i in range(20)])
    together = bootstrap(values, ["a"] * 10 + ["b"] * 10)
    assert (alone.mean, alone.n) == (together.mean, together.n) == (0.5, 20)
    assert 0.2 < alone.low < alone.mean < alone.high < 0.8
    assert (together.low, together.high) == (0.0, 1.0)
    assert bootstrap([np.nan, 2.0], ["a", "b"]).n == 1
    assert bootstrap([np.nan], ["a"]).n == 0
    assert str(bootstrap([16.5] * 3, ["a"] * 3)) == "16.5 (16.5 to 16.5)"


def test_points_within_a_radius():
    photo = torch.zeros(9, 9, dtype=torch.bool)
    view = torch.zeros(9, 9, dtype=torch.bool)
    photo[4, 4] = photo[4, 8] = view[4, 1] = True
    assert [share_near(photo, view, eps_px=eps) for eps in (2.0, 3.0, 7.0)] == [0.0, 0.5, 1.0]
    assert share_near(photo, torch.zeros_like(view), eps_px=9.0) == 0.0
    assert np.isnan(share_near(torch.zeros_like(photo), view, eps_px=9.0))


def test_printed_numbers_are_the_means_of_the_papers_rows():
    assert printed.PRECISION["CS/MFC"] == pytest.approx(0.837)
    assert printed.IP["MFC"] == pytest.approx(0.46)
    assert printed.WEB_IP["PCI"] == pytest.approx(0.449)
    assert printed.HAUSDORFF["FUZZY"] == pytest.approx(98.5)
    assert printed.WEB_HAUSDORFF["MFC"] == pytest.approx(23.8)


def numbers_printed_in(text, label):
    """The rows of numbers of the table with a label in the paper's source."""
    end = text.index(f"\\label{{{label}}}")
    start = text.rindex("\\begin{table}", 0, end)
    rows = []
    for line in text[start:end].splitlines():
        cells = re.sub(r"\\cellcolor\{[^}]*\}|[{}\s$]|\^o|\\\\|\\hline", "", line).split("&")[1:]
        row = [float(cell) for cell in cells if re.fullmatch(r"[\d.]+", cell)]
        rows += [row] if len(row) > 6 else []
    return rows


ERRORS = [[float(x.rstrip("°cm")) for x in row] for row in printed.POSE_ERRORS.values()]


@pytest.mark.parametrize(
    ("label", "found"),
    [
        ("DTLSampleIP", printed.TABLES["web_ip"]),
        ("IPPASCAL3D", list(printed.TABLES["ip"].values())),
        ("DTLSampleHD", printed.TABLES["web_hausdorff"]),
        ("HDPASCAL3D", list(printed.TABLES["hausdorff"].values())),
        ("HDPASCAL3D2", list(printed.TABLES["precision"].values())),
        ("AErrorAngles", ERRORS),
    ],
)
def test_printed_numbers_are_those_of_the_paper(label, found):
    source = Path(__file__).parents[3] / "shared" / "paper"
    files = list(source.glob("*.tex"))
    if not files:
        pytest.skip("needs the paper's source in ../shared/paper")
    text = files[0].read_text(encoding="utf-8")
    assert numbers_printed_in(text, label) == found


def test_classes_stand_beside_the_papers():
    pairs = {pair: {"top": [10.0 if pair == "CS/MFC" else 90.0]} for pair in tables.PAIRS}
    known = {key: {**pairs, "chance": 0.1, "ceiling": 1.0} for key in tables.VARIANTS}
    record = {"cad": "a", "category": "boat", **known}
    (table,) = [
        each
        for each in tables.precision_tables(tables.Records([record], "one"))
        if each.name == "precision_classes"
    ]
    rows = {row[0]: row for row in table.rows}
    assert table.columns[:3] == ["class", "N", "CS/MFC"]
    assert rows["boat"][1:4] == ["1", "1.00 / 1.00 / 1.00 / 0.78", "0.00 / 0.00 / 0.00 / 0.71"]
    assert rows["sofa"][1:3] == ["0", "- / - / - / 0.85"]
    assert "literal / corrected, S_hog as printed / corrected / the paper" in table.definition


def run(monkeypatch, script, *words):
    monkeypatch.setattr(sys, "argv", [script.__name__, *map(str, words)])
    run_script(script.main)


def test_a_run_writes_its_tables_and_is_resumed(root, tmp_path, monkeypatch):
    page = tmp_path / "paper.md"
    page.write_text("# Page\n\n<!-- paper:begin -->\n<!-- paper:end -->\n")
    words = ["web", root, "--out", tmp_path, "--image-size", "64", "--page", page]
    run(monkeypatch, reproduce_paper, "repeatability", *words)
    text = (tmp_path / "repeatability.md").read_text()
    assert "N = 2 (1 CADs)" in text
    assert text in page.read_text()
    assert f"Measured at commit {commit()}." in page.read_text()
    (entry,) = read_lines(tmp_path / reproduce_paper.RECORDS)
    assert len(entry["rows"]) == 2
    monkeypatch.setattr(
        reproduce_paper, "measure", Mock(side_effect=AssertionError("measured again"))
    )
    run(monkeypatch, reproduce_paper, "repeatability", *words)
    run(monkeypatch, reproduce_paper, "curve", *words)
    assert (tmp_path / reproduce_paper.CURVE).stat().st_size > 1000
    assert "(images/paper-curve.webp)" in page.read_text()
    assert (tmp_path / "images" / "paper-curve.webp").stat().st_size > 1000
    with pytest.raises(AssertionError, match="measured again"):
        run(monkeypatch, reproduce_paper, "precision", *words)


@pytest.mark.parametrize(
    ("module", "package"), [("skimage", "scikit-image"), ("matplotlib", "matplotlib")]
)
def test_a_missing_package_is_named(root, tmp_path, monkeypatch, capsys, module, package):
    find_spec = util.find_spec
    monkeypatch.setattr(util, "find_spec", lambda name: None if name == module else find_spec(name))
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, reproduce_paper, "curve", "web", root, "--out", tmp_path)
    assert (
        f"{package} is not installed; pip install 'curvireg_torch[paper]'"
        in capsys.readouterr().err
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reproduce_paper", "staircase"])
def test_scripts_run_beside_an_installed_package(name, tmp_path):
    script = Path(reproduce_paper.__file__).with_name(f"{name}.py")
    done = subprocess.run(
        [sys.executable, "-I", str(script), "--help"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "--out OUT" in done.stdout


@pytest.mark.parametrize("pose", ["any", "upright"])
def test_the_staircase_leads_from_the_paper_to_the_default_one_change_at_a_time(pose):
    steps = list(staircase.pipelines(pose))
    assert steps[0][1] == PRESETS["paper"]
    assert steps[-1][1] == Pipeline().with_pose_prior(pose)
    for (_, before), (name, after) in pairwise(steps):
        assert before != after, name
        names = ("views", "bank", "field", "terms", "box_jitter", "search")
        parts = [part for part in names if getattr(before, part) != getattr(after, part)]
        assert len(parts) <= 1, name
    assert replace(steps[-2][1], hypotheses=5, contours=True) == steps[-1][1]


def test_the_staircase_shows_intervals_of_three_cads_and_what_is_known():
    share = Estimate(0.625, 0.5, 0.75, 8)
    scores = {2: staircase.Score(share, 2, 12.3), 0: staircase.Score(share, 3, 12.3)}
    text = staircase.table({"lm": scores})
    assert "| change | `lm`, N 8 |" in text
    assert "| 2. S_rep monotone | 0.62, 12° |" in text
    assert "| 0. the paper to the letter | 0.62 (0.50 to 0.75), 12° |" in text
    assert "| 14. contour fit of five hypotheses: the default | - |" in text


def test_steps_are_evaluated_once(pascal, tmp_path, monkeypatch, capsys):
    words = [f"mini={pascal.root}", "--steps", "0", "--out", tmp_path]
    run(monkeypatch, staircase, *words)
    output = capsys.readouterr()
    assert "unreadable_image" in output.err
    summary = read_json(tmp_path / "mini" / "0" / "summary.json")
    assert summary["settings"]["preset"] == "paper"
    aware = summary["symmetry_aware"]
    assert "| change | `mini`, N 3 |" in output.out
    row = f"{aware['acc_pi_6']:.2f}, {aware['med_err_deg']:.0f}°"
    line = f"| 0. the paper to the letter | {row} |"
    assert line in output.out
    fail = Mock(side_effect=AssertionError("registered again"))
    with monkeypatch.context() as patch:
        patch.setattr("curvireg_torch.evaluation.datasets.cached_bank", fail)
        run(monkeypatch, staircase, *words)
    assert line in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, staircase, "nothing", "--out", tmp_path)


def test_objects_without_a_pose_count_as_wrong(pascal, tmp_path, monkeypatch, capsys):
    errors = [
        {"symmetric_error_deg": math.inf, "error_deg": 5.0},
        {"symmetric_error_deg": 29.0, "error_deg": 90.0},
        {"symmetric_error_deg": math.nan, "error_deg": 5.0},
    ]
    keys = [entry.key for entry in staircase.benchmark_of(pascal.root).entries]
    found = SimpleNamespace(errors=dict(zip(keys, errors, strict=False)))
    monkeypatch.setattr(staircase, "evaluate", lambda *_, **__: {"skipped": {}})
    monkeypatch.setattr(staircase, "read_run", lambda _: found)
    run(monkeypatch, staircase, f"mini={pascal.root}", "--steps", "3", "--out", tmp_path)
    text = capsys.readouterr().out
    assert "`mini`, N 2" in text
    assert "| 0.50, 104° |" in text
