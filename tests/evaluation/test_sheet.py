"""The page of the best and the worst results of an evaluation."""

import base64
import csv
import json
import re

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.data import read_image
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, WebBenchmark, contact_sheet, evaluate
from curvireg_torch.evaluation.store import ResultStore
from curvireg_torch.mesh import load_mesh
from curvireg_torch.rendering import make_renderer
from curvireg_torch.visualization.sheet import thumbnail


def figures(page):
    """(kind, number, name, caption, picture) of each figure on the page."""
    found = re.findall(
        r'<figure class="(\w+)">(?:<img alt="contours over [^"]*" src="data:image/jpeg;base64,([^"]+)">)?'
        r"<figcaption><b>(\d+)</b> (.*?)<br>(.*?)</figcaption>",
        page.read_text("utf-8"),
    )
    return [(kind, int(number), name, caption, picture) for kind, picture, number, name, caption in found]


def far_away(T):
    """The same pose, outside the image."""
    T = T.clone()
    T[0, 3] += 1e6
    return T


def test_contact_sheet_shows_best_first_with_the_contours_of_the_pose(pascal, tmp_path, capsys):
    evaluate(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", progress=False)
    assert main(["plot", "sheet", str(tmp_path / "out"), "--out", str(tmp_path / "sheet.html"), "--within", "60"]) == 0
    with open(tmp_path / "out" / "predictions.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert f"{len(lines)} objects" in capsys.readouterr().out
    found = figures(tmp_path / "sheet.html")
    errors = [float(line["error_deg"]) for line in lines]
    finite = sorted(e for e in errors if e != float("inf"))
    assert [caption.split()[0] for _, _, _, caption, _ in found[: len(finite)]] == [f"{e:.1f}" for e in finite]
    assert [kind for kind, *_ in found[: len(finite)]] == ["right" if e < 60 else "wrong" for e in finite]
    # The picture shows the contours of the pose on disk.
    _, number, name, _, picture = found[0]
    sample = pascal.annotation(number - 1)
    assert name == f"{sample['category']}/{sample['image_id']}/{sample['object_index']}"
    row = ResultStore(tmp_path / "out").read(name)
    T, K = (torch.tensor(matrix, dtype=torch.float64) for matrix in row["projection"])
    assert T[:3, :3].tolist() == row["rotation"], "PASCAL3D+ gives no camera"
    image = read_image(sample["image_path"], dtype=torch.uint8)
    wanted = thumbnail(make_renderer(load_mesh(sample["cad_path"])), (T, K), image, sample["box"].tolist())
    assert base64.b64decode(picture) == wanted
    bare = thumbnail(make_renderer(load_mesh(sample["cad_path"])), (far_away(T), K), image, sample["box"].tolist())
    drawn, plain = (cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1).astype(int) for jpeg in (wanted, bare))
    assert (abs(drawn - plain).max(axis=2) > 60).sum() > 40, "contours are visible"


def test_contact_sheet_shows_failures_last_and_no_picture_of_missing_files(bop, tmp_path):
    evaluate(BOPBenchmark(bop, Protocol(pose="any")), tmp_path / "out", progress=False)
    store = ResultStore(tmp_path / "out")
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    rows = {item.key: store.read(item.key) for item in benchmark.items}
    first, *rest = [key for key, row in rows.items() if "rotation" in row]
    store.append({"key": first, "digests": {}, "image_size": [60, 80], "failed": "<flat>"})
    store.append({**rows[rest[0]], "mesh": "removed.ply"})
    assert contact_sheet(tmp_path / "out", tmp_path / "a.html", benchmark=benchmark) == len(rest) + 1
    found = {name: (kind, caption, picture) for kind, _, name, caption, picture in figures(tmp_path / "a.html")}
    assert list(found)[-1] == first
    assert found[first] == ("failed", "&lt;flat&gt;", "")
    assert {name for name, (_, _, picture) in found.items() if not picture} == {first, rest[0]}
    assert contact_sheet(tmp_path / "out", tmp_path / "b.html", benchmark=benchmark, each=1) == len(rest) + 1
    names = [name for _, _, name, *_ in figures(tmp_path / "b.html")]
    assert len(found) > 2
    assert names == [next(iter(found)), first]
    assert "predictions.csv has them all" in (tmp_path / "b.html").read_text()


def test_contact_sheet_shows_unknown_poses_last(web, tmp_path):
    evaluate(WebBenchmark(web, Protocol(pose="any")), tmp_path / "out", progress=False)
    contact_sheet(tmp_path / "out", tmp_path / "sheet.html")
    found = figures(tmp_path / "sheet.html")
    assert ["pose unknown" in caption for _, _, _, caption, _ in found] == [False, False, True, True]
    assert all(kind in ("reliable", "doubtful") for kind, *_ in found[2:])


def test_contact_sheet_refuses_other_folders(web, tmp_path, capsys):
    words = ["plot", "sheet", str(tmp_path / "none"), "--out", str(tmp_path / "sheet.html")]
    assert main(words) == 2
    assert "settings.json: missing" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "sheet.png")]) == 2
    assert "ends in .html" in capsys.readouterr().err
    folder = tmp_path / "out"
    ResultStore(folder).open({"dataset": "web", "root": str(web.root), "protocol": "pose=any"})
    with pytest.raises(InvalidInputError, match="no object was evaluated"):
        contact_sheet(folder, tmp_path / "sheet.html")
    with pytest.raises(InvalidInputError, match="at least 1"):
        contact_sheet(folder, tmp_path / "sheet.html", each=0)
    for settings in ({"dataset": "shop"}, {"dataset": "web", "root": 3, "protocol": ""}, {"dataset": "web"}):
        (folder / "settings.json").write_text(json.dumps(settings))
        with pytest.raises(InvalidInputError, match=r"not settings of an evaluation|dataset: expected one of"):
            contact_sheet(folder, tmp_path / "sheet.html")
