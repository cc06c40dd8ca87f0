"""scripts/benchmark: textured meshes, their symmetries, photographs with known poses, wrong meshes."""

import json

import cv2
import numpy as np
import pytest
import torch

import curvireg_torch as cr
from scripts.benchmark import make, meshes, printed
from scripts.benchmark.run import wrong_meshes
from scripts.benchmark.textured import TexturedMesh, appearance_symmetries


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box of 2 x 1 x 1 m whose front has a texture with four colours."""
    folder = tmp_path_factory.mktemp("box")
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32], picture[:32, 32:], picture[32:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    cv2.imwrite(str(folder / "print.png"), picture[..., ::-1])
    (folder / "model.mtl").write_text("newmtl paper\nKd 1 1 1\nmap_Kd print.png\nnewmtl grey\nKd 0.5 0.5 0.5\n")
    lines = ["mtllib model.mtl", *(f"v {x} {y} {z}" for x in (-1, 1) for y in (-0.5, 0.5) for z in (0, 1))]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl paper", "f 1/1 5/2 6/3 2/4"]  # the front, y = -0.5
    lines += ["usemtl grey", "f 3 4 8 7", "f 1 2 4 3", "f 5 7 8 6", "f 2 6 8 4", "f 1 3 7 5"]
    (folder / "model.obj").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def model(folder):
    return TexturedMesh.load(folder / "model.obj")


def test_surface_has_the_texture_and_colour_of_the_file(model):
    starts = np.array([(-0.5, -3, 0.8), (0.5, -3, 0.8), (-0.5, -3, 0.2), (0.5, -3, 0.2), (0.5, 3, 0.2)])
    directions = np.array([(0, 1.0, 0)] * 4 + [(0, -1.0, 0)])
    distance, triangle, _ = model.rays().hits(starts, directions)
    assert np.allclose(distance, 2.5)
    colour, normal, _ = model.surface(triangle, starts + distance[:, None] * directions)
    expected = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0), [(127 / 255) ** 2.2] * 3]
    assert np.allclose(colour, expected, atol=0.01)
    assert np.allclose(np.abs(normal), [(0, 1, 0)] * 5)


def test_symmetries_of_shape_and_appearance(model):
    """The shape of a 2 x 1 x 1 box has eight symmetries; with its texture only the identity is left."""
    rotations = meshes.candidate_rotations()
    assert rotations.shape == (32, 3, 3)
    assert np.allclose(rotations[0], np.eye(3))
    assert np.allclose(np.linalg.det(rotations), 1)
    found = meshes.symmetries(meshes.sample_points(model))
    assert len(found) == 8
    assert all(np.allclose(np.abs(rotations[k][:, 0]), (1, 0, 0)) for k in found)
    assert appearance_symmetries(model, found, rotations) == [0]
    assert appearance_symmetries(model.with_colour(np.full(3, 0.5)), found, rotations) == found


class OneMesh:
    """Stands for ``make.Meshes``, with the box as every mesh."""

    def __init__(self, model):
        self.rotations = meshes.candidate_rotations()
        row = {"id": "box", "name": "box", "kind": None, "path": "model.obj", "like": "box", "faces": 12}
        row |= {"extents": [2, 1, 1], "shape_symmetries": [0, 3], "look_symmetries": [0]}
        self.good = self.clutter = [row]
        self.kinds = {"box": [row, {**row, "like": "other", "shape_symmetries": [0, 5]}]}
        self._model = model

    def load(self, _path):
        return self._model

    def texture(self, _rng):
        return np.full((8, 8, 3), 0.2, np.float32)


@pytest.mark.parametrize("index", range(4))
def test_make_states_the_pose_of_the_picture(model, folder, index):
    """Independent oracle: the library's depth rendering of the object in the stated pose."""
    image, item = make.make(OneMesh(model), 3, index)
    assert image.shape == (*item["size"], 3)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = torch.tensor(item["R"]), torch.tensor(item["t"])
    K = torch.tensor(item["K"], dtype=torch.float64)
    depth = cr.render_depth(cr.load_mesh(folder / "model.obj"), T, K, tuple(item["size"]))[0, 0]
    rendered = make.outline(depth.numpy() > 0)
    assert np.abs(np.array(rendered) - item["box_exact"]).max() <= 1.0
    assert np.abs(np.array(item["box"]) - item["box_exact"]).max() < 20
    assert item["visible"] >= 0.35
    again, same = make.make(OneMesh(model), 3, index)
    assert np.array_equal(image, again)
    assert item == same


def test_plan_prefers_siblings_of_similar_proportions(model):
    assert make.proportion_gap([2, 1, 1], [4, 2, 2]) == pytest.approx(1.0)
    assert make.proportion_gap([1, 1, 1], [1, 1, 2]) == pytest.approx(np.sqrt(2))
    catalogue = OneMesh(model)
    box = catalogue.good[0]
    near, far = ({**box, "like": name, "extents": e} for name, e in (("near", [2, 1, 1.2]), ("far", [1, 1, 9])))
    catalogue.kinds = {"box": [box, near, far]}
    pairs = {(p["shown"]["like"], p["wanted"]["like"]) for i in range(2, 200, 4) for p in [make.plan(catalogue, 1, i)]}
    assert {("box", "near"), ("near", "box")} < pairs
    assert not {("box", "far"), ("near", "far")} & pairs
    assert {shown for shown, _ in pairs} == {"box", "near", "far"}


def test_wrong_meshes_are_no_copies_and_of_the_kind_on_request():
    kinds = {"a": "chair", "b": "chair", "c": "car", "d": "chair", "e": None, "f": None}
    items = [{"mesh": mesh, "kind": kind} for mesh, kind in kinds.items()]
    like = {**{mesh: mesh for mesh in kinds}, "b": "a"}
    assert wrong_meshes(None, items, like) == dict.fromkeys(kinds)
    assert wrong_meshes("any", items, like) == dict(zip("abcdef", "ccdefa", strict=True))
    assert wrong_meshes("kind", items, like) == {"a": "d", "b": "d", "d": "a"}, "there is no second car"


def test_printed_packages_are_exact_and_textured(tmp_path):
    rows = [printed.make_package(tmp_path, f"printed-{k:03d}", np.random.default_rng((29, k))) for k in range(4)]
    assert printed.make_package(tmp_path / "again", "printed-000", np.random.default_rng((29, 0))) == rows[0]
    turns = [np.eye(3).tolist()]
    (tmp_path / "meshes.json").write_text(json.dumps({"turns": turns, "meshes": rows}))
    for row in rows:
        assert cr.mesh.has_colours(cr.load_mesh(tmp_path / row["path"]))
        assert TexturedMesh.load(tmp_path / row["path"]).pictures[0] is not None
    catalogue = make.Meshes(tmp_path, "printed")
    assert len(catalogue.good) == 4
    image, item = make.make(catalogue, 15, 2)  # its form would be that of a sibling
    assert item["form"] == "exact"
    assert item["mesh"] == item["shown"]
    assert image.shape == (*item["size"], 3)
