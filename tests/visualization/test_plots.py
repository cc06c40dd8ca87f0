"""Figures contain the numbers: they are read back from the axes."""

import numpy as np
import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.visualization import plots


def test_azimuth_confusion_has_counts_and_fractions_of_true_bins():
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
    correct = torch.tensor([False, True, False, True, True, True])
    points = plots.reliability(confidence, correct, bins=10).axes[0].collections[0]
    expected = [[0.05, 0.0], [(0.62 + 0.68 + 0.61) / 3, 2 / 3], [0.99, 1.0]]
    np.testing.assert_allclose(points.get_offsets(), expected, atol=1e-6)
    sizes = points.get_sizes()
    np.testing.assert_allclose((sizes[1] - 20) / (sizes[0] - 20), 3, rtol=1e-5)
    with pytest.raises(InvalidInputError, match=r"\[0, 1\]"):
        plots.reliability(torch.tensor([1.2]), torch.tensor([True]))
    with pytest.raises(InvalidInputError, match="correct"):
        plots.risk_coverage(torch.tensor([0.2]), torch.tensor([True, False]))


def test_risk_coverage_sorts_by_confidence():
    confidence = torch.tensor([0.1, 0.9, 0.5, 0.8])
    axes = plots.risk_coverage(confidence, torch.tensor([False, True, False, True])).axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [0, 0, 1 / 3, 0.5], atol=1e-6)
    assert axes.lines[1].get_ydata()[0] == 0.5
    # Results of equal confidence are added together, as they have no order.
    for correct in ([True, False, False], [False, True, False]):
        line = plots.risk_coverage(torch.tensor([0.9, 0.9, 0.1]), torch.tensor(correct)).axes[0].lines[0]
        np.testing.assert_allclose(line.get_xydata(), [[2 / 3, 0.5], [1, 2 / 3]], atol=1e-6)


def test_errors_by_class_sorts_by_median_and_separates_misses():
    errors = torch.tensor([100.0, 5.0, 20.0, torch.inf, 40.0])
    axes = plots.errors_by_class(["car", "sofa", "sofa", "car", "car"], errors).axes[0]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["sofa  1.00 of 2", "car  0.00 of 3"]
    assert sorted(axes.lines[2].get_xdata()) == [40, 100, 200]
    assert [axes.lines[1].get_xdata()[0], axes.lines[3].get_xdata()[0]] == [12.5, 100]


def test_support_over_frames_marks_frames_without_a_pose():
    nan = torch.nan
    axes = plots.support_over_frames(torch.tensor([0.6, 0.5, nan, nan]), torch.tensor([0.9, 0.4, nan, nan])).axes[0]
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    np.testing.assert_allclose(lines["confidence"], [0.9, 0.4, nan, nan])
    np.testing.assert_allclose(lines["edge support"], [0.6, 0.5, nan, nan])
    assert axes.lines[-1].get_xydata().tolist() == [[2.0, 0.0], [3.0, 0.0]]
    with pytest.raises(InvalidInputError, match="edge_support"):
        plots.support_over_frames(torch.tensor([0.6]), torch.tensor([0.9, 0.4]))


def test_curves_and_bars_draw_the_columns():
    axes = plots.curves(["offset", "mfc", "ig"], [[-10, 0.1, 0.2], [0, 0.5, 0.4], [10, 0.3, 0.1]]).axes[0]
    assert [line.get_label() for line in axes.lines] == ["mfc", "ig"]
    assert axes.lines[1].get_xdata().tolist() == [-10, 0, 10]
    assert axes.lines[1].get_ydata().tolist() == [0.2, 0.4, 0.1]
    axes = plots.bars(["class", "mfc", "ig"], [["car", 0.1, 0.2], ["sofa", 0.5, 0.4]]).axes[0]
    assert [[bar.get_height() for bar in group] for group in axes.containers] == [[0.1, 0.5], [0.2, 0.4]]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["car", "sofa"]
    assert [round(bar.get_x(), 6) for bar in axes.containers[1]] == [0.0, 1.0]
    for draw in (plots.curves, plots.bars):
        with pytest.raises(InvalidInputError, match="row of 2"):
            draw(["k", "a"], [[1, 2, 3]])
