"""The experiments on rendered photographs, for which the true view must win."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
import torch
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import paper
from curvireg_torch.geometry import camera_matrix, rotation_error, rotation_from_viewpoint, sample_views
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support.miniature import write_bop, write_pascal3d, write_web

SETTINGS = BankSettings(image_size=64)
VIEWS = sample_views(azimuth_step=30, elevations=[0, 30])
REPOSITORY = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
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
        pixels = (image.permute(1, 2, 0).flip(-1) * 255).byte().numpy()
        assert cv2.imwrite(str(folder / f"{i}.png"), pixels)
        lines.append(f"{i}.png,{','.join(f'{v:g}' for v in box.tolist())},{azimuth},{elevation},0,")
    folder.joinpath("views.csv").write_text("\n".join(lines) + "\n")
    return root


@pytest.fixture(scope="module")
def cases(collection):
    return paper.find_cases("web", collection)


def test_curve_table_peaks_at_the_true_view(cases):
    table = paper.curve_table(cases, SETTINGS, 1.5, progress=False)
    assert [row[0] for row in table.rows] == list(range(-100, 100, 5))
    assert len(table.rows) == 40
    for k, name in enumerate(table.columns):
        if name in ("MFC", "MCS", "IG"):
            best = max(table.rows, key=lambda row: row[k])
            assert abs(best[0]) <= 5, name
            assert best[k] > 0.5, name


def test_rank_tables_find_the_true_view(cases):
    rankings = paper.rank_views(cases, VIEWS, SETTINGS, progress=False)
    assert rankings.errors.shape == (2, len(VIEWS))
    assert rankings.errors.amin(1).max() < 0.1, "the truth is in the bank"
    precision = paper.precision_table(rankings)
    assert [row[0] for row in precision.rows] == ["thing", "all"]
    column = precision.columns.index("CS/MFC")
    assert precision.rows[1][column] == 1.0
    for table in paper.rank_tables(rankings):
        assert [row[0] for row in table.rows] == [1, 3, 5, 10, 20]
        for column_of_values in list(zip(*table.rows, strict=True))[1:]:
            assert list(column_of_values) == sorted(column_of_values), "precision grows with k"
    angles = paper.angle_table(rankings)
    row = dict(zip(angles.columns, angles.rows[0], strict=True))
    assert row["azimuth Clo."] == row["elevation Clo."] == pytest.approx(0, abs=1e-3)
    best = rankings.orders["CS/MFC"][:, 0]
    expected = (VIEWS.azimuth[best] - rankings.truth[:, 0]).abs().mean()
    assert row["azimuth Est."] == pytest.approx(float(expected), abs=1e-3)


def test_detector_and_repeatability_tables(cases):
    ip, hausdorff, robust, points = paper.detector_tables(cases, SETTINGS, 2.0, progress=False)
    column = ip.columns.index("MFC")
    assert [row[0] for row in ip.rows] == ["thing", "all"]
    assert 0.5 < ip.rows[1][column] <= 1
    assert ip.rows[1][column] > 2 * ip.rows[1][ip.columns.index("chance")]
    assert 10 < points.rows[1][column] <= 0.04 * 64 * 64 + 1
    assert 0 < robust.rows[1][column] <= hausdorff.rows[1][column] < 64
    table = paper.repeatability_table(cases, SETTINGS, 2.0, progress=False)
    assert 0.5 < table.rows[1][table.columns.index("CS/MFC")] <= 1


def test_find_cases_omits_occluded_objects_and_unknown_poses(tmp_path):
    write_pascal3d(tmp_path / "pascal")
    found = paper.find_cases("pascal3d", tmp_path / "pascal")
    assert [case.category for case in found] == ["car", "car", "sofa"], "neither truncated nor occluded"
    write_web(tmp_path / "web")
    assert [case.category for case in paper.find_cases("web", tmp_path / "web")] == ["cup", "cup"], "poses are known"
    assert len(paper.find_cases("pascal3d", tmp_path / "pascal", limit=2)) == 2
    write_bop(tmp_path / "bop")
    with pytest.raises(InvalidInputError, match="no whole object"):
        paper.find_cases("bop", tmp_path / "bop")
    with pytest.raises(InvalidInputError, match="dataset: expected one of"):
        paper.find_cases("coco", tmp_path)


def test_case_view_of_an_object_off_the_axis():
    """The rotation is relative to a camera that looks at the object: it differs by the angle of the ray."""
    pose = torch.cat([torch.eye(3), torch.tensor([[3.0], [0.0], [4.0]])], dim=1).double()
    case = paper.Case("x", "", "", "m", torch.zeros(4), pose)
    R, distance = case.view(trimesh.creation.box())
    assert distance == pytest.approx(5.0)
    assert float(rotation_error(R, torch.eye(3).double())) == pytest.approx(36.87, abs=0.01)
    z_axis = R @ torch.tensor([0.0, 0.0, 1.0]).double()
    assert z_axis[0] < 0


@pytest.mark.slow
def test_reproduce_paper_command(collection, tmp_path):
    words = ["curve", "web", str(collection), "--out", str(tmp_path / "out"), "--image-size", "64", "--quiet"]
    done = subprocess.run(
        [sys.executable, str(REPOSITORY / "scripts" / "paper" / "reproduce_paper.py"), *words],
        capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with open(tmp_path / "out" / "curve.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 40
    assert "N = 2" in done.stdout
