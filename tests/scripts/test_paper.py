"""The paper's measurements on rendered photographs, for which the true view must win."""

import pytest
import torch

from curvireg_torch.geometry import camera_matrix, rotation_from_viewpoint, sample_views
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from scripts.paper import tables
from scripts.paper.detectors import DETECTORS
from tests._support.scenes import write_photo

SETTINGS = BankSettings(image_size=64)
VIEWS = sample_views(azimuth_step=30, elevations=[0, 30])


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """Two photographs of one object, at views of the bank."""
    root = tmp_path_factory.mktemp("web")
    folder = root / "thing"
    folder.mkdir()
    mesh = example_mesh()
    mesh.export(folder / "mesh.ply")
    K = camera_matrix(400.0, 400.0, 79.5, 59.5, dtype=torch.float64)
    lines = ["image,x0,y0,x1,y1,azimuth,elevation,theta,distance"]
    for i, (azimuth, elevation) in enumerate([(60, 30), (210, 0)]):
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = rotation_from_viewpoint(float(azimuth), float(elevation)).double()
        T[:3, 3] = -T[:3, :3] @ torch.from_numpy(mesh.bounds.mean(axis=0))
        T[2, 3] += 5.0 * 0.5 * float(torch.tensor(mesh.extents).norm())
        generator, background = torch.Generator().manual_seed(i), torch.full((3, 120, 160), 0.9)
        image, box = synthesize_photograph(mesh, T, K, (120, 160), generator, background=background, texture=0.0)
        write_photo(folder / f"{i}.png", image)
        lines.append(f"{i}.png,{','.join(f'{v:g}' for v in box.tolist())},{azimuth},{elevation},0,")
    folder.joinpath("views.csv").write_text("\n".join(lines) + "\n")
    return tables.find_cases("web", root)


def test_curve_table_peaks_at_the_true_view(cases, tmp_path):
    table = tables.curve_table(cases, SETTINGS, 1.5, progress=False)
    assert [row[0] for row in table.rows] == list(range(-100, 100, 5))
    for k, name in enumerate(table.columns):
        if name in ("MFC", "MCS", "IG"):
            best = max(table.rows, key=lambda row: row[k])
            assert abs(best[0]) <= 5, name
            assert best[k] > 0.5, name
    names = {path.name for path in tables.write_table(table, tmp_path)}
    assert {"curve.csv", "curve.md"} == names
    assert "N = 2" in (tmp_path / "curve.md").read_text()


def test_rank_tables_find_the_true_view(cases):
    rankings = tables.rank_views(cases, VIEWS, SETTINGS, progress=False)
    assert rankings.errors.amin(1).max() < 0.1, "the truth is in the bank"
    precision = tables.precision_table(rankings)
    assert precision.rows[1][precision.columns.index("CS/MFC")] == 1.0
    table = tables.rank_table(rankings)
    assert [row[0] for row in table.rows] == [1, 3, 5, 10, 20]
    for column in list(zip(*table.rows, strict=True))[1:]:
        assert list(column) == sorted(column), "precision grows with k"
    angles = tables.angle_table(rankings)
    row = dict(zip(angles.columns, angles.rows[0], strict=True))
    assert row["azimuth Clo."] == row["elevation Clo."] == pytest.approx(0, abs=1e-3)


def test_detector_tables(cases):
    ip, hausdorff, points = tables.detector_tables(cases, SETTINGS, 2.0, progress=False)
    assert set(DETECTORS) <= {name.lower() for name in ip.columns}
    column = ip.columns.index("MFC")
    assert ip.rows[1][column] > 2 * ip.rows[1][ip.columns.index("chance")]
    assert 10 < points.rows[1][column] <= 0.04 * 64 * 64 + 1
    assert 0 < hausdorff.rows[1][column] < 64
