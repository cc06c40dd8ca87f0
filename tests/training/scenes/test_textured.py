"""The benchmark's renderer: what a ray meets has the colour that the file gives it, and the truth is the picture's."""

import importlib

import cv2
import numpy as np
import pytest
import torch

import curvireg_torch as cr


@pytest.fixture(scope="module")
def scripts():
    names = {"_textured": "textured", "benchmark_meshes": "meshes", "make_benchmark": "make"}
    return {name: importlib.import_module(f"scripts.benchmark.{module}") for name, module in names.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A die of 2 x 1 x 1 m, one colour of its texture's four quarters on each of its sides."""
    folder = tmp_path_factory.mktemp("die")
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32], picture[:32, 32:], picture[32:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    cv2.imwrite(str(folder / "print.png"), picture[..., ::-1])
    (folder / "model.mtl").write_text("newmtl paper\nKd 1 1 1\nmap_Kd print.png\nnewmtl grey\nKd 0.5 0.5 0.5\n")
    lines = ["mtllib model.mtl"]
    lines += [f"v {x} {y} {z}" for x in (-1, 1) for y in (-0.5, 0.5) for z in (0, 1)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += ["usemtl paper", "f 1/1 5/2 6/3 2/4"]  # the front, y = -0.5
    lines += ["usemtl grey", "f 3 4 8 7", "f 1 2 4 3", "f 5 7 8 6", "f 2 6 8 4", "f 1 3 7 5"]
    (folder / "model.obj").write_text("\n".join(lines) + "\n")
    return folder


def test_texture_and_colour_are_where_the_file_puts_them(scripts, folder):
    model = scripts["_textured"].Textured.load(folder / "model.obj")
    starts = np.array([(-0.5, -3, 0.8), (0.5, -3, 0.8), (-0.5, -3, 0.2), (0.5, -3, 0.2), (0.5, 3, 0.2)])
    directions = np.array([(0, 1.0, 0)] * 4 + [(0, -1.0, 0)])
    distance, triangle, _ = model.rays().hits(starts, directions)
    assert np.allclose(distance, 2.5)
    colour, normal, _ = model.surface(triangle, starts + distance[:, None] * directions)
    expected = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0), [(127 / 255) ** 2.2] * 3]
    assert np.allclose(colour, expected, atol=0.01)
    assert np.allclose(np.abs(normal), [(0, 1, 0)] * 5)


def test_symmetries_of_shape_and_of_look(scripts, folder):
    """The shape of a 2 x 1 x 1 box survives eight turns; its print leaves the identity alone."""
    turns = scripts["benchmark_meshes"].turns()
    assert turns.shape == (32, 3, 3)
    assert np.allclose(turns[0], np.eye(3))
    assert np.allclose(np.linalg.det(turns), 1)
    model = scripts["_textured"].Textured.load(folder / "model.obj")
    found = scripts["benchmark_meshes"].symmetries(scripts["benchmark_meshes"].samples(model))
    assert len(found) == 8
    assert all(np.allclose(np.abs(turns[k][:, 0]), (1, 0, 0)) for k in found)
    assert scripts["_textured"].look_symmetries(model, found, turns) == [0]
    bare = model.painted(np.full(3, 0.5))
    assert scripts["_textured"].look_symmetries(bare, found, turns) == found


class OneMesh:
    """As ``Meshes``, with the die for everything."""

    def __init__(self, scripts, folder):
        self.turns = scripts["benchmark_meshes"].turns()
        row = {
            "id": "die",
            "name": "die",
            "kind": None,
            "path": "model.obj",
            "like": "die",
            "faces": 12,
            "extents": [2, 1, 1],
        }
        self.good = self.clutter = [{**row, "shape_symmetries": [0, 3], "look_symmetries": [0]}]
        self.kinds = {"die": [self.good[0], {**self.good[0], "like": "other", "shape_symmetries": [0, 5]}]}
        self._model = scripts["_textured"].Textured.load(folder / "model.obj")

    def load(self, _path):
        return self._model

    def texture(self, _rng):
        return np.full((8, 8, 3), 0.2, np.float32)


@pytest.mark.parametrize("index", range(4))
def test_truth_is_that_of_the_picture(scripts, folder, index):
    """Independent oracle: the library's own depth of the object in the pose that the item states."""
    meshes = OneMesh(scripts, folder)
    image, item = scripts["make_benchmark"].make(meshes, 3, index)
    assert image.shape == (*item["size"], 3)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = torch.tensor(item["R"]), torch.tensor(item["t"])
    K = torch.tensor(item["K"], dtype=torch.float64)
    depth = cr.render_depth(cr.load_mesh(folder / "model.obj"), T, K, tuple(item["size"]))[0, 0]
    rendered = scripts["make_benchmark"].outline(depth.numpy() > 0)
    assert np.abs(np.array(rendered) - item["box_exact"]).max() <= 1.0
    assert np.abs(np.array(item["box"]) - item["box_exact"]).max() < 20
    assert item["visible"] >= 0.35
    again, same = scripts["make_benchmark"].make(meshes, 3, index)
    assert np.array_equal(image, again)
    assert item == same


def test_a_sibling_has_the_objects_proportions_where_there_is_one(scripts, folder):
    make, meshes = scripts["make_benchmark"], OneMesh(scripts, folder)
    assert make.proportions_apart([2, 1, 1], [4, 2, 2]) == pytest.approx(1.0)
    assert make.proportions_apart([1, 1, 1], [1, 1, 2]) == pytest.approx(np.sqrt(2))
    box = meshes.good[0]
    near, far = ({**box, "like": name, "extents": e} for name, e in (("near", [2, 1, 1.2]), ("far", [1, 1, 9])))
    meshes.kinds = {"box": [box, near, far]}
    pairs = {(p["shown"]["like"], p["wanted"]["like"]) for i in range(2, 200, 4) for p in [make.plan(meshes, 1, i)]}
    assert {("die", "near"), ("near", "die")} < pairs
    assert not {("die", "far"), ("near", "far")} & pairs
    assert {shown for shown, _ in pairs} == {"die", "near", "far"}
