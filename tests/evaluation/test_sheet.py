"""The page of an evaluation's best and worst photographs."""

import base64
import csv
import json
import re

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, contact_sheet, evaluate
from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.io import read_image
from curvireg_torch.io.meshes import load_mesh
from curvireg_torch.rendering import make_renderer
from curvireg_torch.visualization.sheet import thumbnail

from ..cli.test_evaluate import evaluate as evaluate_by_command


def figures(page):
    """(kind, number, name, what is said, picture) of each on the page."""
    found = re.findall(
        r'<figure class="(\w+)">(?:<img alt="contours over [^"]*" src="data:image/jpeg;base64,([^"]+)">)?'
        r"<figcaption><b>(\d+)</b> (.*?)<br>(.*?)</figcaption>",
        page.read_text("utf-8"),
    )
    return [(kind, int(number), name, said, picture) for kind, picture, number, name, said in found]


def far_away(T):
    """The same pose, out of the picture."""
    T = T.clone()
    T[0, 3] += 1e6
    return T


def test_best_first_with_the_contours_that_were_found(pascal, tmp_path, capsys):
    evaluate(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", progress=False)
    assert main(["plot", "sheet", str(tmp_path / "out"), "--out", str(tmp_path / "sheet.html"), "--within", "60"]) == 0
    with open(tmp_path / "out" / "predictions.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert f"{len(lines)} objects" in capsys.readouterr().out
    shown = figures(tmp_path / "sheet.html")
    errors = [float(line["error_deg"]) for line in lines]
    finite = sorted(e for e in errors if e != float("inf"))
    assert [said.split()[0] for _, _, _, said, _ in shown[: len(finite)]] == [f"{e:.1f}" for e in finite]
    assert [kind for kind, *_ in shown[: len(finite)]] == ["right" if e < 60 else "wrong" for e in finite]
    # The picture is that of the pose on disk: the same contours, by hand.
    _, number, name, _, picture = shown[0]
    sample = pascal.annotation(number - 1)
    assert name == f"{sample['category']}/{sample['image_id']}/{sample['object_index']}"
    row = PredictionStore(tmp_path / "out" / "predictions").read(name)
    T, K = (torch.tensor(matrix, dtype=torch.float64) for matrix in row["seen_by"])
    assert T[:3, :3].tolist() == row["rotation"], "PASCAL3D+ gives no camera"
    image = read_image(sample["image_path"], dtype=torch.uint8)
    wanted = thumbnail(make_renderer(load_mesh(sample["cad_path"])), (T, K), image, sample["box"].tolist())
    assert base64.b64decode(picture) == wanted
    bare = thumbnail(make_renderer(load_mesh(sample["cad_path"])), (far_away(T), K), image, sample["box"].tolist())
    drawn, plain = (cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1).astype(int) for jpeg in (wanted, bare))
    assert (abs(drawn - plain).max(axis=2) > 60).sum() > 40, "contours are seen"


def test_failed_ones_are_last_and_what_is_gone_has_no_picture(bop, tmp_path):
    evaluate(BOPBenchmark(bop, Protocol(pose="any")), tmp_path / "out", progress=False)
    store = PredictionStore(tmp_path / "out" / "predictions")
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    rows = {item.key: store.read(item.key) for item in benchmark.items}
    first, *rest = [key for key, row in rows.items() if "rotation" in row]
    store.write(first, {**{k: rows[first][k] for k in ("image_size", "seconds", "inputs")}, "failed": "<flat>"})
    older = {key: value for key, value in rows[rest[0]].items() if key != "seen_by"}
    store.write(rest[0], older)
    assert contact_sheet(tmp_path / "out", tmp_path / "a.html", benchmark=benchmark) == len(rest) + 1
    shown = {name: (kind, said, picture) for kind, _, name, said, picture in figures(tmp_path / "a.html")}
    assert list(shown)[-1] == first
    assert shown[first] == ("failed", "&lt;flat&gt;", "")
    assert {name for name, (_, _, picture) in shown.items() if not picture} == {first, rest[0]}
    assert contact_sheet(tmp_path / "out", tmp_path / "b.html", benchmark=benchmark, each=1) == len(rest) + 1
    names = [name for _, _, name, *_ in figures(tmp_path / "b.html")]
    assert len(shown) > 2
    assert names == [next(iter(shown)), first]
    assert "predictions.csv has them all" in (tmp_path / "b.html").read_text()


def test_poses_that_nobody_knows_come_by_their_confidence(web, tmp_path):
    evaluate_by_command("web", web.root, "--out", tmp_path / "out")
    contact_sheet(tmp_path / "out", tmp_path / "sheet.html")
    shown = figures(tmp_path / "sheet.html")
    assert ["pose unknown" in said for _, _, _, said, _ in shown] == [False, False, True, True]
    assert all(kind in ("reliable", "doubtful") for kind, *_ in shown[2:])
    confidence = [float(said.split()[-1]) for _, _, _, said, _ in shown[2:]]
    assert confidence == sorted(confidence, reverse=True)


def test_what_is_no_evaluation(web, tmp_path, capsys):
    words = ["plot", "sheet", str(tmp_path / "none"), "--out", str(tmp_path / "sheet.html")]
    assert main(words) == 2
    assert "settings.json: missing" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "sheet.png")]) == 2
    assert "ends in .html" in capsys.readouterr().err
    folder = tmp_path / "out"
    PredictionStore(folder / "predictions").open({"dataset": "web", "root": str(web.root), "protocol": "pose=any"})
    with pytest.raises(InvalidInputError, match="no object was evaluated"):
        contact_sheet(folder, tmp_path / "sheet.html")
    with pytest.raises(InvalidInputError, match="at least 1"):
        contact_sheet(folder, tmp_path / "sheet.html", each=0)
    for settings in ({"dataset": "shop"}, {"dataset": "web", "root": 3, "protocol": ""}, {"dataset": "web"}):
        (folder / "predictions" / "settings.json").write_text(json.dumps(settings))
        with pytest.raises(InvalidInputError, match="not an evaluation's"):
            contact_sheet(folder, tmp_path / "sheet.html")
