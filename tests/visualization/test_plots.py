"""The pictures hold the numbers: read back from the axes, not from the pixels."""

import numpy as np
import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.visualization import plots
from tests.viewer.test_session import write_scene

PREDICTIONS = """category,azimuth,true_azimuth,error_deg,confidence
car,10,0,12,0.9
car,175,0,172,0.7
sofa,90,100,9,0.95
sofa,,200,inf,
car,271,265,31,0.4
"""


def test_confusion_counts_and_shares_by_true_bin():
    truth = torch.tensor([0.0, 0.0, 0.0, 90.0, 359.0, torch.nan])
    figure = plots.azimuth_confusion(torch.tensor([1.0, 181.0, -3.0, 90.0, torch.nan, 4.0]), truth, bins=4)
    axes = figure.axes[0]
    expected = np.array([[2 / 3, 0, 1 / 3, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_allclose(axes.images[0].get_array(), expected, atol=1e-6)
    assert {(t.get_position(), t.get_text()) for t in axes.texts} == {((0, 0), "2"), ((2, 0), "1"), ((1, 1), "1")}
    with pytest.raises(InvalidInputError, match="at least one pair"):
        plots.azimuth_confusion(torch.tensor([torch.nan]), torch.tensor([0.0]))


def test_reliability_bins_by_confidence():
    confidence = torch.tensor([0.05, 0.62, 0.68, 0.61, 1.0, 0.98], dtype=torch.float64)
    right = torch.tensor([False, True, False, True, True, True])
    points = plots.reliability(confidence, right, bins=10).axes[0].collections[0]
    expected = [[0.05, 0.0], [(0.62 + 0.68 + 0.61) / 3, 2 / 3], [0.99, 1.0]]
    np.testing.assert_allclose(points.get_offsets(), expected, atol=1e-6)
    sizes = points.get_sizes()
    np.testing.assert_allclose((sizes[1] - 20) / (sizes[0] - 20), 3, rtol=1e-5)
    with pytest.raises(InvalidInputError, match=r"\[0, 1\]"):
        plots.reliability(torch.tensor([1.2]), torch.tensor([True]))
    with pytest.raises(InvalidInputError, match="correct"):
        plots.risk_coverage(torch.tensor([0.2]), torch.tensor([True, False]))


def test_risk_falls_where_confidence_knows():
    confidence = torch.tensor([0.1, 0.9, 0.5, 0.8])
    axes = plots.risk_coverage(confidence, torch.tensor([False, True, False, True])).axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [0, 0, 1 / 3, 0.5], atol=1e-6)
    assert axes.lines[1].get_ydata()[0] == 0.5
    # Answers of one confidence come together: whichever of them stands first says nothing.
    for right in ([True, False, False], [False, True, False]):
        line = plots.risk_coverage(torch.tensor([0.9, 0.9, 0.1]), torch.tensor(right)).axes[0].lines[0]
        np.testing.assert_allclose(line.get_xydata(), [[2 / 3, 0.5], [1, 2 / 3]], atol=1e-6)


def test_classes_are_sorted_by_their_median_and_misses_stand_aside():
    errors = torch.tensor([100.0, 5.0, 20.0, torch.inf, 40.0])
    axes = plots.errors_by_class(["car", "sofa", "sofa", "car", "car"], errors).axes[0]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["sofa  1.00 of 2", "car  0.00 of 3"]
    assert sorted(axes.lines[2].get_xdata()) == [40, 100, 200]
    assert [axes.lines[1].get_xdata()[0], axes.lines[3].get_xdata()[0]] == [12.5, 100]


def test_curves_are_the_columns():
    axes = plots.curves(["offset", "mfc", "ig"], [[-10, 0.1, 0.2], [0, 0.5, 0.4], [10, 0.3, 0.1]]).axes[0]
    assert [line.get_label() for line in axes.lines] == ["mfc", "ig"]
    assert axes.lines[1].get_xdata().tolist() == [-10, 0, 10]
    assert axes.lines[1].get_ydata().tolist() == [0.2, 0.4, 0.1]
    axes = plots.bars(["class", "mfc", "ig"], [["car", 0.1, 0.2], ["sofa", 0.5, 0.4]], title="Precision").axes[0]
    assert [[bar.get_height() for bar in group] for group in axes.containers] == [[0.1, 0.5], [0.2, 0.4]]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["car", "sofa"]
    assert [round(bar.get_x(), 6) for bar in axes.containers[1]] == [0.0, 1.0], "beside the first, from the middle on"
    for draw in (plots.curves, plots.bars):
        with pytest.raises(InvalidInputError, match="row of 2"):
            draw(["k", "a"], [[1, 2, 3]])


@pytest.fixture
def drawn(monkeypatch):
    """What the command line draws with: name and arguments."""
    calls = []

    def spy(name):
        plain = getattr(plots, name)
        monkeypatch.setattr(plots, name, lambda *a, **k: calls.append((name, a, k)) or plain(*a, **k))

    for name in plots.__all__:
        spy(name)
    return calls


def test_the_command_draws_predictions(tmp_path, drawn, capsys):
    (tmp_path / "predictions.csv").write_text(PREDICTIONS)
    for kind, start in (
        ("confusion", b"\x89PNG"),
        ("reliability", b"<?xml"),
        ("risk", b"%PDF"),
        ("classes", b"\x89PNG"),
    ):
        out = tmp_path / f"{kind}.{ {b'<?xml': 'svg', b'%PDF': 'pdf'}.get(start, 'png') }"
        assert main(["plot", kind, str(tmp_path), "--out", str(out)]) == 0
        assert out.read_bytes().startswith(start)
    names, arguments, options = zip(*drawn, strict=True)
    assert names == ("azimuth_confusion", "reliability", "risk_coverage", "errors_by_class")
    assert options[0] == {"bins": 8}
    assert arguments[0][0].isnan().tolist() == [False, False, False, True, False]
    assert arguments[1][0].tolist() == [0.9, 0.7, 0.95, 0.0, 0.4]
    assert arguments[2][1].tolist() == [True, False, True, False, False]
    assert arguments[3][0] == ["car", "car", "sofa", "sofa", "car"]
    capsys.readouterr()
    assert main(["plot", "risk", str(tmp_path / "none"), "--out", str(tmp_path / "a.png")]) == 2
    assert main(["plot", "risk", str(tmp_path), "--out", str(tmp_path / "a.txt")]) == 2
    (tmp_path / "predictions.csv").write_text("a,b\n1,2\n")
    assert main(["plot", "risk", str(tmp_path), "--out", str(tmp_path / "a.png")]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3
    assert "no column 'error_deg'" in errors[2]


def test_the_command_draws_curves_and_registrations(tmp_path, drawn, monkeypatch):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    (tmp_path / "ranks.csv").write_text("k,CS/MFC\n1,0.5\n3,0.75\n")
    assert main(["plot", "curves", str(tmp_path / "ranks.csv"), "--out", str(tmp_path / "ranks.png")]) == 0
    assert drawn[0][1] == (["k", "CS/MFC"], [[1.0, 0.5], [3.0, 0.75]])
    (tmp_path / "precision.csv").write_text("category,CS/MFC\ncar,0.5\n")
    assert main(["plot", "bars", str(tmp_path / "precision.csv"), "--out", str(tmp_path / "bars.png")]) == 0
    assert drawn.pop()[1] == (["category", "CS/MFC"], [["car", 0.5]])
    box, _ = write_scene(tmp_path)
    words = [str(tmp_path / "photo.png"), str(tmp_path / "truck.ply"), "--pipeline", str(tmp_path / "small.json")]
    words += ["--quiet", "--box", *map(str, box)]
    for kind in ("sphere", "fields"):
        assert main(["plot", kind, *words, "--out", str(tmp_path / f"{kind}.png")]) == 0
        assert (tmp_path / f"{kind}.png").stat().st_size > 10_000
    assert [name for name, *_ in drawn] == ["curves", "view_sphere", "fields"]
    registrar, result, image, _ = drawn[2][1]
    figure = plots.fields(registrar, result, image, torch.tensor(box))
    assert [axes.get_title() for axes in figure.axes] == ["photograph", "photograph field", "pose", "view field"]
    pose = np.asarray(figure.axes[2].images[0].get_array())
    assert 0.1 < (pose > 0).any(axis=2).mean() < 0.9
