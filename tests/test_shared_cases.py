"""Files that people have, and what is right for each: the cases of tests/data/cases, whose README
states it. Registrations are left to the tests of the modules, which generate such files."""

import json
import shutil
import warnings

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch.cli import main
from curvireg_torch.data.images import read_photo
from curvireg_torch.errors import CurviregError, CurviregWarning, InvalidInputError, MeshError
from curvireg_torch.geometry import projected_boxes
from curvireg_torch.jobs.lists import find_photographs, read_list
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.mesh import mesh_symmetries
from curvireg_torch.registration.photograph import FRACTIONS, as_photographs
from curvireg_torch.registration.refinement import why_outside
from curvireg_torch.utils.extras import is_installed
from tests._support import double, eye, refused

from ._support.cans import can
from ._support.real_data import real_case, real_data
from ._support.tables import text_table

FOCAL = (520.5, 522.0)
CENTRE = (321.25, 238.5)
VGA = (480, 640)
LENS = (-0.31, 0.12, 0.001, -0.002)
K3 = 0.03
DINO_CAMERA = cr.camera_matrix(3310.4, 3325.5, 316.73, 200.55)

CAMERAS = {
    "c01-megapose-camera-data/camera_data.json": ((), VGA),
    "c02-cam-K-txt/cam_K.txt": ((), None),
    "c04-dist-coeff-json/calibration.json": ((*LENS, K3), None),
    "c05-camodocal/cam0_pinhole.yaml": (LENS, VGA),
    "c06-euroc-radial-tangential/sensor.yaml": (LENS, VGA),
    "c07-open3d-column-major/intrinsic.json": ((), VGA),
    "c08-nerfstudio-transforms/transforms.json": (LENS, VGA),
    "c09-flat-k1-k2/camera.json": ((*LENS, K3), VGA),
    "c11-npz/B.npz": ((*LENS, K3), None),
    "c14-colmap-full-opencv/cameras.txt:1": ((*LENS, K3, 0.0, 0.0, 0.0), VGA),
    "c16-own-result-as-camera/camera.json": (LENS, VGA),
    "c16-own-result-as-camera/result.json": (LENS, VGA),
    "c18-ros-rectified/info.yaml": ((*LENS, K3), VGA),
}


def file_of(name):
    """A file of a case, as FOLDER/FILE."""
    folder, _, file = name.partition("/")
    return real_case(folder) / file


@pytest.mark.parametrize(("name", "expected"), CAMERAS.items(), ids=CAMERAS)
def test_calibrations_are_read_with_their_distortion(name, expected):
    camera = cr.load_camera(file_of(name))
    assert_close(camera.matrix, cr.camera_matrix(*FOCAL, *CENTRE).double())
    assert (camera.distortion, camera.size, camera.model) == (*expected, "radial-tangential")


def test_calibrations_that_need_a_choice():
    bop = real_case("c12-bop-scene-camera") / "scene_camera.json"
    for name in (str(bop), f"{bop}:6", f"{bop}:000006"):
        assert_close(cr.load_camera(name).matrix, DINO_CAMERA.double())
    with refused("no camera '5'; choose one as FILE:NAME from 2, 6"):
        cr.load_camera(f"{bop}:5")
    with pytest.warns(CurviregWarning, match="read as k1, k2, p1, p2; write distortion_model"):
        camera = cr.load_camera(real_case("c17-fisheye-without-flag") / "fisheye.json")
    assert camera.distortion == (0.02, -0.01, 0.003, -0.001)
    rectified = cr.load_camera(f"{real_case('c18-ros-rectified')}/info.yaml:P")
    assert_close(rectified.matrix, cr.camera_matrix(480, 500, 322, 239).double())
    assert (rectified.size, rectified.distorts) == (VGA, False)
    square = cr.load_camera(real_case("c19-crop-as-scale") / "quest.json")
    with refused("another aspect ratio; give one of uncropped"):
        square.at((960, 1280))


def test_boxes_in_fractions_are_named():
    photo = real_case("b01-yolo-normalised") / "photo.jpg"
    item = as_photographs([photo], [[0.3, 0.2, 0.7, 0.9]], DINO_CAMERA)[0]
    assert isinstance(item, InvalidInputError)
    assert item.message == FRACTIONS


def dino():
    folder = real_data("bop/dino")
    return trimesh.load_mesh(folder / "models" / "obj_000001.ply", process=False)


def start(name):
    (file,) = real_case(name).glob("*.json")
    values = json.loads(file.read_text())
    T = eye(4)
    T[:3, :3] = torch.tensor(values["rotation"])
    T[:3, 3] = torch.tensor(values["translation"])
    return T


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("s02-start-opengl", "lies behind the camera: a pose of OpenGL's camera"),
        ("s03-start-metres", "1000 times too small, as metres beside a mesh in mm"),
    ],
)
def test_starts_of_another_convention_or_unit_are_named(name, words):
    hull = torch.from_numpy(dino().convex_hull.vertices.copy())
    error = why_outside(hull, start(name), DINO_CAMERA.double(), VGA)
    assert words in error.message


def test_the_used_bits_of_16_are_stretched():
    folder = real_case("p01-12-bit-in-16")
    expected = read_photo(folder / "mono8.png").image
    for bits in (10, 12):
        photo = read_photo(folder / f"mono{bits}.png")
        assert_close(photo.image, expected, atol=1, rtol=0)
        assert f"16 bits, of which the lower {bits} are used: stretched" in photo.notes


def test_photographs_of_phones_are_listed_and_named():
    folder = real_case("p02-folder-of-heic")
    shots = find_photographs(folder / "shots")
    assert [path.name for path in shots] == ["IMG_1.JPG", "IMG_2.HEIC", "IMG_3.heic"]
    # the two .HEIC are no more than the start of one
    for path in [*shots[1:], *find_photographs(folder / "only")]:
        with refused(path.name, CurviregError):
            read_photo(path)


def loaded(path, **options):
    """A mesh, and its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CurviregWarning)
        mesh = cr.load_mesh(path, **options)
    return mesh, "; ".join(warning.text for warning in mesh.warnings)


def colours_of(mesh):
    colours = mesh.colours
    return set() if colours is None else set(map(tuple, colours.corners.reshape(-1, 3).tolist()))


RED = (255, 0, 0)
BLUE = (0, 0, 255)
PLAIN = """
    m01-obj-bom/plain.obj m01-obj-bom/bom-v.obj m01-obj-bom/bom-comment.obj
    m03-obj-empty-usemtl/a.obj m05-stl-solid-header/sw.stl m06-stl-length/tail.stl
    m07-stl-ascii-variants/latin1.stl m07-stl-ascii-variants/named.stl
    m07-stl-ascii-variants/tabs.stl m07-stl-ascii-variants/upper.stl
"""
PAINTED = """
    m12-two-mtllib/lines.obj m12-two-mtllib/words.obj
    m13-glb-vertex-colours-and-material/with.gltf m13-glb-vertex-colours-and-material/without.gltf
"""
BOXES = {name: set() for name in PLAIN.split()} | {name: {RED, BLUE} for name in PAINTED.split()}
BOXES["m01-obj-bom/bom-mtllib.obj"] = {(204, 26, 26)}


@pytest.mark.parametrize(("name", "colours"), BOXES.items(), ids=BOXES)
def test_meshes_have_all_their_faces_and_colours(name, colours):
    mesh, texts = loaded(file_of(name))
    assert (sorted(mesh.extents.tolist()), len(mesh.faces)) == ([1.0, 2.0, 3.0], 12)
    assert abs(mesh.surface.volume) == pytest.approx(6.0)
    assert colours_of(mesh) == colours
    assert texts == ""


# of a box of 1 x 2 x 3 beside a polygon of 16 sides in 16 triangles, and beside a square in two
FANS = {"fan": (12 + 16, 22 + 8 * np.sin(np.pi / 8)), "strip": (12 + 2, 22 + 1)}


@pytest.mark.parametrize(("name", "expected"), FANS.items(), ids=FANS)
def test_fans_and_strips_have_all_their_faces(name, expected):
    mesh, texts = loaded(real_case("m08-gltf-triangle-fan") / f"{name}.gltf")
    count, area = expected
    assert (len(mesh.faces), texts) == (count, "")
    assert mesh.surface.area == pytest.approx(area)


def test_three_boxes_in_one_obj():
    mesh, texts = loaded(real_case("m02-obj-interleaved-negative") / "a.obj")
    assert (len(mesh.vertices), len(mesh.faces), texts) == (24, 36, "")
    assert len(mesh.surface.split(only_watertight=True)) == 3


REFUSED = """
m06-stl-length/cut.stl           | it says 12 faces and holds 9: it was cut
m06-stl-length/zero.stl          | it says 0 faces and holds 12: it was cut
m07-stl-ascii-variants/comma.stl | decimal commas; export it with decimal points
n45-no-faces/lines.obj           | no faces: a cloud of points, splats or lines
n45-no-faces/points.obj          | 400 points and no faces: a cloud of points
n45-no-faces/points.ply          | reconstruct its surface
n45-no-faces/splats.ply          | reconstruct its surface
n45-no-faces/strips.ply          | strips of triangles, which are not read; export triangles
"""


@pytest.mark.parametrize(("name", "words"), text_table(REFUSED))
def test_meshes_that_are_cut_in_another_notation_or_without_faces_are_refused(name, words):
    with refused(words, MeshError):
        cr.load_mesh(file_of(name))


def write_can(folder, library):
    """An OBJ of a can with texture coordinates and a material of a library."""
    mesh = can()
    lines = [f"mtllib {library}", "usemtl label"]
    lines += [f"v {x} {y} {z}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u} {v}" for u, v in np.asarray(mesh.visual.uv).tolist()]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (mesh.faces + 1).tolist()]
    path = folder / "can.obj"
    path.write_text("\n".join(lines))
    return path


def test_textures_behind_options_and_in_other_folders(tmp_path):
    behind = shutil.copytree(real_case("m09-mtl-options"), tmp_path / "options")
    mesh, texts = loaded(write_can(behind, "can.mtl"))
    assert (mesh.has_colours, texts) == (True, "")
    beside = shutil.copytree(real_case("m11-mtl-parent-folder"), tmp_path / "parent")
    mesh, texts = loaded(write_can(beside / "models", "image.mtl"))
    assert not mesh.has_colours
    assert (
        "../images/label.png lies outside of its folder and is left out; name its folder" in texts
    )
    mesh, texts = loaded(beside / "models" / "can.obj", textures=beside / "images")
    assert (mesh.has_colours, texts) == (True, "")
    for library, lost in (("../can.mtl", "can.mtl lies outside"), ("image.mtl", "label.png")):
        assert lost in loaded(write_can(beside / "models", library))[1]


def test_plain_materials_and_coordinates_without_a_texture_are_no_print():
    folder = real_case("m18-plain-material-symmetry")
    bare, plain = (loaded(folder / name, unit="mm")[0] for name in ("bare.stl", "plain.gltf"))
    assert len(mesh_symmetries(plain)) == len(mesh_symmetries(bare)) == 72
    for name, is_lost in (("kd", False), ("lost", True), ("uv", False)):
        mesh, texts = loaded(real_case("m23-uv-without-material") / f"{name}.obj", unit="mm")
        assert not mesh.has_colours
        assert ("missing beside it" in texts) == is_lost
    assert not plain.has_colours


def bop_set(tmp_path, name, scale=1.0):
    """The set of a case, with the model that was left out of it."""
    root = shutil.copytree(real_case(name) / "set", tmp_path / "set")
    mesh = dino()
    mesh.apply_scale(scale)
    (root / "models").mkdir(exist_ok=True)
    mesh.export(root / "models" / "obj_000001.ply")
    return root


def test_sets_without_models_info_or_boxes_are_measured(tmp_path):
    bare = cr.BOPDataset(bop_set(tmp_path / "a", "d01-no-models-info"))
    assert bare.models_info[1]["diameter"] == pytest.approx(101.7, abs=0.5)
    boxless = cr.BOPDataset(bop_set(tmp_path / "b", "d02-no-gt-info"))
    assert len(bare) == len(boxless) > 0
    expected = bare[0]["box"]
    assert_close(boxless[0]["box"], expected, atol=3.0, rtol=0)


def test_sets_in_another_unit_and_without_objects_are_refused(tmp_path, capsys):
    root = bop_set(tmp_path / "a", "d05-models-in-metres", 0.001)
    with refused("scale the models to mm"):
        cr.BOPDataset(root)
    empty = bop_set(tmp_path / "b", "d06-empty-ground-truth")
    assert len(cr.BOPDataset(empty)) == 0
    assert main(["evaluate", "bop", str(empty), "--out", str(tmp_path / "out"), "--quiet"]) != 0
    assert "nothing was scored (no object is annotated)" in capsys.readouterr().err


def test_a_photograph_of_a_phone_and_a_step_file_know_camera_and_unit():
    folder = real_case("step-heic")
    if not is_installed("cascadio") or not is_installed("pi_heif"):
        pytest.skip("cascadio or pi-heif is not installed")
    mesh, _ = loaded(folder / "flange.step")
    assert mesh.unit == "mm"
    photo = read_photo(folder / "photo.heic")
    camera = photo.camera()
    assert camera.source == "exif"
    truth = json.loads((folder / "truth.json").read_text())
    points = torch.from_numpy(mesh.vertices.copy())
    box = projected_boxes(points, double(truth["T"]), camera.matrix)
    # EXIF rounds the focal length to mm: to 1.3 % here
    assert_close(box, double(truth["box"]), atol=10.0, rtol=0)


def test_a_matrix_of_the_picture_at_half_size_is_named():
    camera = cr.load_camera(real_case("n73-camera-of-half-the-size") / "cam_K.txt")
    folder = real_case("lamp")
    item = as_photographs([folder / "photo.jpg"], [[334, 146, 711, 573.5]], [camera])[0]
    assert any("seems to be of a picture of 480 x 360" in text for text in item.warnings)
    of_photograph = cr.camera_matrix(1100, 1100, 479.5, 359.5)
    item = as_photographs([folder / "photo.jpg"], [[334, 146, 711, 573.5]], [of_photograph])[0]
    assert not item.warnings


def test_concave_faces_have_the_area_of_their_polygons():
    mesh, texts = loaded(real_case("n40-concave-faces") / "plate.obj", unit="mm")
    assert texts == ""
    assert mesh.surface.area == pytest.approx(7600.0)  # of the polygons


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_colours_of_which_one_is_above_one(suffix):
    mesh, texts = loaded(real_case("n41-colours-above-one") / f"lamp.{suffix}", unit="mm")
    expected, _ = loaded(real_case("lamp") / "lamp_colours.obj", unit="mm")
    assert texts == ""
    assert mesh.has_colours
    assert len(colours_of(mesh)) > 1
    assert colours_of(mesh) >= {(60, 60, 70)}
    assert_allclose(mesh.extents, expected.extents, atol=1e-3)


def test_meshes_of_a_ros_package_are_found():
    package = real_case("n48-urdf-of-a-package") / "lamp_description"
    mesh, texts = loaded(package / "urdf" / "lamp.urdf")
    expected, _ = loaded(real_case("lamp") / "lamp.stl", unit="mm")
    assert (mesh.unit, texts) == ("m", "")
    assert_allclose(mesh.bounds, 1e-3 * expected.bounds, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "given", "likely"),
    [("lamp/lamp.stl", None, "mm"), ("n72-unit-forgotten/lamp.glb", "mm", "m")],
)
def test_the_forgotten_unit_is_proposed(name, given, likely):
    with pytest.warns(CurviregWarning, match=rf"if that is wrong, give the unit \({likely}\?\)"):
        cr.load_mesh(file_of(name), unit=given)


def test_a_calibration_of_the_turned_phone_is_refused():
    camera = cr.load_camera(real_case("n61-calibration-of-the-turned-phone") / "portrait.json")
    photo = read_photo(real_case("lamp") / "photo.jpg")
    with refused("turn the photograph by 90 degrees"):
        camera.at(tuple(photo.image.shape[-2:]))


def test_a_cmyk_photograph_is_not_inverted():
    photo = read_photo(real_case("n30-cmyk-jpeg") / "photo.jpg")
    plain = read_photo(real_case("lamp") / "photo.jpg")
    assert "CMYK converted to RGB without a colour profile" in photo.notes
    assert (photo.image.int() - plain.image.int()).abs().float().mean() < 4


def test_animations_are_named():
    folder = real_case("n32-animated")
    assert "one of several pictures" in read_photo(folder / "photo.webp").notes
    with refused("not an image that is read", CurviregError):
        read_photo(folder / "photo.gif")


def test_a_digital_zoom_is_a_note_and_a_larger_deviation():
    """Of 20 mm without the zoom of 2; 39.7 mm are right."""
    photo = read_photo(real_case("n35-digital-zoom") / "photo.jpg")
    camera = photo.camera()
    assert any("digital zoom 2" in note for note in photo.notes)
    right = 1100.0 / float(camera.matrix[0, 0])
    assert abs(np.log(right)) <= camera.focal_deviation


@pytest.mark.parametrize(
    ("name", "camera"), [("list.csv", (1100.0, 1100.0, 479.5, 359.5)), ("list_tab.csv", None)]
)
def test_lists_of_spreadsheets_are_read(name, camera):
    options = RegisterOptions(meshes=(real_case("lamp") / "lamp.stl",))
    (entry,) = read_list(real_case("n56-semicolon-list") / name, options)
    assert (entry.error, entry.box) == ("", (334.0, 146.0, 711.0, 573.5))
    assert entry.camera == camera


def test_sets_of_blenderproc_are_read_and_their_splits_named():
    folder = real_case("n67-bop-of-blenderproc") / "bop_data"
    with refused("the set has train_pbr: choose it as split", CurviregError):
        cr.data.BOPDataset(folder)
    (sample,) = cr.data.BOPDataset(folder, "train_pbr")
    assert_close(sample["box"], torch.tensor([334.0, 146.0, 711.0, 573.5]), atol=1.5, rtol=0)
