"""``curvireg plot``."""

import numpy as np
import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.visualization import plots
from tests.viewer.test_session import write_scene

PREDICTIONS = """category,azimuth,true_azimuth,error_deg,confidence
car,10,0,12,0.9
car,175,0,172,0.7
sofa,90,100,9,0.95
sofa,,200,inf,
car,271,265,31,0.4
"""


@pytest.fixture
def calls(monkeypatch):
    """Calls of the functions of ``plots``: name, arguments and options."""
    out = []

    def record(name):
        function = getattr(plots, name)
        monkeypatch.setattr(plots, name, lambda *a, **k: out.append((name, a, k)) or function(*a, **k))

    for name in plots.__all__:
        record(name)
    return out


def plot(kind, source, out, *words):
    return main(["plot", kind, *map(str, source), "--out", str(out), *words])


def test_plot_evaluations(tmp_path, calls, refused):
    (tmp_path / "predictions.csv").write_text(PREDICTIONS)
    starts = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    for kind, suffix in {"confusion": "png", "reliability": "svg", "risk": "pdf", "classes": "png"}.items():
        assert plot(kind, [tmp_path], tmp_path / f"{kind}.{suffix}") == 0
        assert (tmp_path / f"{kind}.{suffix}").read_bytes().startswith(starts[suffix])
    names, arguments, options = zip(*calls, strict=True)
    assert names == ("azimuth_confusion", "reliability", "risk_coverage", "errors_by_class")
    assert options[0] == {"bins": 8}
    assert arguments[0][0].isnan().tolist() == [False, False, False, True, False]
    assert arguments[1][0].tolist() == [0.9, 0.7, 0.95, 0.0, 0.4]
    assert arguments[2][1].tolist() == [True, False, True, False, False]
    assert arguments[3][0] == ["car", "car", "sofa", "sofa", "car"]
    refused(plot("risk", [tmp_path / "none"], tmp_path / "a.png"), "no such table")
    refused(plot("risk", [tmp_path], tmp_path / "a.txt"), "expected a name")
    for content, message in {
        "a,b\n1,2\n": "no column 'error_deg'",
        "a,b\n1\n": "rows",
        "a\n": "rows",
        "error_deg,confidence\nx,1\n": "expected a number, got 'x'",
    }.items():
        (tmp_path / "predictions.csv").write_text(content)
        refused(plot("risk", [tmp_path], tmp_path / "a.png"), message)


def test_plot_tables(tmp_path, calls):
    (tmp_path / "ranks.csv").write_text("k,CS/MFC\n1,0.5\n3,0.75\n")
    (tmp_path / "precision.csv").write_text("category,CS/MFC\ncar,0.5\n")
    assert plot("curves", [tmp_path / "ranks.csv"], tmp_path / "ranks.png") == 0
    assert plot("bars", [tmp_path / "precision.csv"], tmp_path / "bars.png") == 0
    assert calls[0][:2] == ("curves", (["k", "CS/MFC"], [[1.0, 0.5], [3.0, 0.75]]))
    assert calls[1][:2] == ("bars", (["category", "CS/MFC"], [["car", 0.5]]))


def test_plot_registrations(tmp_path, calls, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    box, _ = write_scene(tmp_path)
    words = ["--pipeline", str(tmp_path / "small.json"), "--quiet", "--box", *map(str, box)]
    for kind in ("sphere", "fields"):
        out = tmp_path / f"{kind}.png"
        assert plot(kind, [tmp_path / "photo.png", tmp_path / "truck.ply"], out, *words) == 0
        assert out.stat().st_size > 10_000
    assert [name for name, *_ in calls] == ["view_sphere", "fields"]
    registrar, result, image, used_box = calls[1][1]
    torch.testing.assert_close(used_box, torch.tensor(box), atol=20, rtol=0)
    figure = plots.fields(registrar, result, image, torch.tensor(box))
    assert [axes.get_title() for axes in figure.axes] == ["photograph", "photograph field", "pose", "view field"]
    pose = np.asarray(figure.axes[2].images[0].get_array())
    assert 0.1 < (pose < 255).any(axis=2).mean() < 0.9
