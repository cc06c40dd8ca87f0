"""What the page works on outlives it, and what files it receives; no browser is needed."""

import asyncio
import errno
import re
import secrets
import shutil
import struct
import threading
import warnings
import zipfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.errors import CurviregError, CurviregWarning, InvalidInputError, OutputError
from curvireg_torch.geometry import Camera
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.viewer import workspace as module
from curvireg_torch.viewer.parts import place_part
from curvireg_torch.viewer.workspace import show_warning, unpack
from curvireg_torch.visualization.encoding import png
from tests._support import refused
from tests._support.calibrations import calibration


async def upload(workspace, path, name=None, content=None, is_first=True):
    content = path.read_bytes() if content is None else content

    async def blocks():
        for start in range(0, len(content), 1000):
            yield content[start : start + 1000]

    await workspace.receive(name or path.name, len(content), blocks(), is_first=is_first)


@contextmanager
def shown_warnings():
    """Warnings become messages of the page, as in its process."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show_warning
        yield


def send(*given, **how):
    with shown_warnings():
        asyncio.run(upload(*given, **how))


def names(workspace):
    return [shot.path.name for shot in workspace.session.shots]


def fail(workspace, error):
    """The message of a job that fails."""
    assert asyncio.run(workspace.run("mesh", Mock(side_effect=error))) is None
    return workspace.messages["mesh"]


PICTURE = png(np.arange(192, dtype=np.uint8).reshape(8, 8, 3))
TEXTURED = b"""mtllib a.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0 1
usemtl m
f 1/1 2/2 3/3
f 1/1 2/2 4/3
f 1/1 3/2 4/3
f 2/1 3/2 4/3
"""
"""A tetrahedron with a material of the library a.mtl."""


def stored(workspace):
    return [path.name for path in workspace.folder.rglob("*") if path.is_file()]


def test_uploads_find_their_place(workspace, scene):
    session = workspace.session
    for name in ("truck.ply", "part.PLY"):
        send(workspace, scene / "truck.ply", name)
        assert "968 faces" in workspace.session.mesh_facts
    for name in ("a.png", "b.png"):
        send(workspace, scene / "photo.png", name)
    assert (names(workspace), session.shot.path.name) == (["a.png", "b.png"], "b.png")
    assert (session.shot.photo.image.shape, workspace.messages) == ((3, 180, 240), {})
    assert sorted(stored(workspace)) == ["a.png", "b.png", "part.PLY"], "the former mesh is removed"
    session.shot = session.shots[0]
    asyncio.run(workspace.remove_photo())
    assert names(workspace) == ["b.png"]
    content = calibration(300.0, 119.5, 89.5, dist=[0.1, 0, 0, 0, 0])
    send(workspace, scene, "cam.json", content.encode())
    assert session.shot.photo.notes == ("undistorted",)
    asyncio.run(workspace.remove_photo())
    assert (names(workspace), session.shot.photo) == ([], None)
    assert sorted(stored(workspace)) == ["b.png", "part.PLY"], "the last one can be brought back"


def test_messages_are_about_one_file_and_go_with_the_next_files(workspace, scene):
    photo = (scene / "photo.png").read_bytes()
    wrong = {
        "half.png": ("photograph", photo[:2000], ""),
        "half2.png": ("photograph", photo[:2000], ""),
        "bad.ply": ("mesh", b"ply\nnonsense", ""),
        "notes.pdf": ("file", b"x: 1", "neither a photograph .* nor a mesh .*zip"),
        "clip.mp4": ("file", b"x", "a video; curvireg follow clip.mp4 MESH follows it"),
        "lost.mtl": ("file", b"x", "no open mesh names it; drop it with its mesh"),
        "cam.yaml": ("camera", b"x: 1", "no camera matrix"),
    }
    send(workspace, scene / "photo.png", "good.png")
    for name, (_, content, _) in wrong.items():
        send(workspace, scene, name, content, is_first=name == "half.png")
    send(workspace, scene / "photo.png", is_first=False)
    for name, (part, _, words) in wrong.items():
        (line,) = [v for v in workspace.messages[part].splitlines() if v.startswith(f"{name}: ")]
        assert re.match(f"{name}: {words}", line)
        assert str(workspace.folder) not in line
    assert names(workspace) == ["good.png", "photo.png"]
    assert sorted(stored(workspace)) == ["good.png", "photo.png"]
    send(workspace, scene / "truck.ply")
    assert workspace.messages == {}


def test_a_mesh_of_a_doubtful_size_asks_for_its_unit_until_another_is_open(workspace, tmp_path):
    """Whatever the words of the warning are; a mesh that is refused leaves it."""
    trimesh.creation.box((0.3, 0.2, 0.1)).export(tmp_path / "small.stl")
    trimesh.creation.box((300.0, 200.0, 100.0)).export(tmp_path / "large.stl")
    for name, asks in (("large.stl", True), ("small.stl", False)):
        send(workspace, tmp_path / name)
        assert workspace.asks_for_unit == asks
    send(workspace, tmp_path / "large.stl")
    warning = workspace.messages["mesh"]
    send(workspace, tmp_path, "bad.ply", b"ply\nnonsense")
    first, second = workspace.messages["mesh"].splitlines()
    assert (first, second.split(": ")[0]) == (warning, "bad.ply")
    assert workspace.asks_for_unit
    send(workspace, tmp_path / "small.stl", is_first=False)
    assert workspace.messages["mesh"] == second
    send(workspace, tmp_path / "large.stl")
    asyncio.run(workspace.set_option("unit", "mm"))
    assert (workspace.messages, workspace.asks_for_unit) == ({}, False)
    assert workspace.session.options.unit_is_given, "for banks, too"


@pytest.mark.parametrize("distortion", [(), (0.1, 0.0, 0.0, 0.0)])
def test_a_removed_photograph_can_be_brought_back(workspace, scene, monkeypatch, distortion):
    session = workspace.session
    session.set_camera(Camera([[300.0, 0, 119.5], [0, 300, 89.5], [0, 0, 1]], distortion))
    for name in ("a.png", "b.png"):
        send(workspace, scene / "photo.png", name)
    session.shot = session.shots[0]
    session.shot.set_box((1.0, 2.0, 30.0, 40.0))
    session.shot.result = result = Mock()
    asyncio.run(workspace.remove_photo())
    assert names(workspace) == ["b.png"]
    asyncio.run(workspace.restore_photo())
    assert session.shot.result is result
    assert (names(workspace), session.shot.path.name) == (["a.png", "b.png"], "a.png")
    assert (session.shot.box, session.removed) == ((1.0, 2.0, 30.0, 40.0), None)
    asyncio.run(workspace.restore_photo())
    assert names(workspace) == ["a.png", "b.png"], "once"
    asyncio.run(workspace.remove_photo())
    size = (scene / "photo.png").stat().st_size
    monkeypatch.setattr(module, "MAX_VIEWER_BYTES", 2 * size)
    send(workspace, scene / "photo.png", "c.png")
    assert (names(workspace), session.removed) == (["b.png", "c.png"], None), "for want of room"


async def started(workspace):
    await workspace.start_search()


def test_the_error_of_a_search_stands_where_its_inputs_are(workspace, scene, monkeypatch):
    session = workspace.session

    def register():
        session.shot = first  # in another window
        raise InvalidInputError("box: too small")

    send(workspace, scene / "photo.png")
    send(workspace, scene / "photo.png")
    first, second = session.shots
    monkeypatch.setattr(session, "register", register)
    asyncio.run(started(workspace))
    assert workspace.pose_message() == ""
    session.shot = second
    assert workspace.pose_message() == "box: too small"
    second.set_box((1.0, 2.0, 90.0, 80.0))
    assert workspace.pose_message() == ""


def test_what_a_mesh_names_is_part_of_it_and_no_photograph(workspace, scene):
    material = b"newmtl m\nmap_Kd maps/wood.png\n"
    files = {"a.obj": TEXTURED, "a.mtl": material, "wood.png": PICTURE}
    for name, content in files.items():
        send(workspace, scene, name, content, is_first=name == "a.obj")
    assert (names(workspace), workspace.messages) == ([], {})
    assert workspace.session.mesh_facts.endswith("rendered in its colours")
    send(workspace, scene / "photo.png", "plywood.png")
    assert names(workspace) == ["plywood.png"], "only a whole name counts"
    send(workspace, scene / "photo.png", "wood.png")
    assert names(workspace) == ["plywood.png", "wood.png"], "its picture has come already"
    assert (workspace.session.mesh_path.parent / "maps" / "wood.png").read_bytes() == PICTURE


def test_a_part_without_a_place_is_a_message(workspace, scene):
    """A folder has the name of a material, and a file that of a folder."""
    send(workspace, pack(scene / "a.zip", {"a.obj": TEXTURED, "old.mtl/a.txt": b""}))
    send(workspace, scene / "photo.png")
    assert names(workspace) == ["photo.png"]
    send(workspace, scene, "a.obj", TEXTURED.replace(b"a.mtl", b"a.obj/a.mtl"))
    send(workspace, scene, "a.mtl", b"newmtl m\n")
    assert workspace.messages["file"].startswith("a.mtl: File exists; check the machine")


def test_a_gltf_waits_for_its_buffer(workspace, tmp_path):
    scene = trimesh.Scene(trimesh.creation.box())
    parts = trimesh.exchange.gltf.export_gltf(scene, merge_buffers=True)
    (buffer,) = set(parts) - {"model.gltf"}
    model = parts["model.gltf"].replace(buffer.encode(), b"my%20data.bin")
    send(workspace, tmp_path, "box.gltf", model)
    assert "names 'my data.bin', which is no file" in workspace.messages["mesh"]
    assert workspace.session.mesh is None
    send(workspace, tmp_path, "my data.bin", parts[buffer], is_first=False)
    assert (workspace.messages, workspace.session.mesh_path.name) == ({}, "box.gltf")
    assert sorted(stored(workspace)) == ["box.gltf", "my data.bin"]


def test_a_part_is_put_where_its_mesh_names_it_but_never_outside_its_folder(tmp_path):
    mesh = tmp_path / "upload-a" / "a.gltf"
    mesh.parent.mkdir()
    places = {"maps/a.png": "maps", "../../a.png": ".", "/etc/a.png": "etc", "x\\a.png": "x"}
    for named, folder in places.items():
        mesh.write_text(f'{{"uri": "{named}"}}')
        part = tmp_path / "a.png"
        part.write_bytes(b"x")
        assert place_part(part, mesh)
        assert (mesh.parent / folder / "a.png").is_file(), named
        shutil.rmtree(mesh.parent)
        mesh.parent.mkdir()


def test_a_calibration_of_another_size_is_refused_beside_the_camera(workspace, scene, monkeypatch):
    """The page, which looks several times a second, never sees a camera that does not fit."""
    send(workspace, scene / "photo.png")
    session = workspace.session
    session.set_camera((300.0, 300.0, 119.5, 89.5))
    seen = []
    opened = session._opened
    monkeypatch.setattr(
        session, "_opened", lambda *given: (seen.append(session.request().camera), opened(*given))
    )
    content = calibration(300.0, 319.5, 89.5, image_size=[640, 180])
    send(workspace, scene, "cam.json", content.encode())
    assert workspace.messages["camera"].startswith("photo.png: camera: calibrated for 640 x 180")
    assert session.request().camera == (300.0, 300.0, 119.5, 89.5)
    assert seen == [(300.0, 300.0, 119.5, 89.5)]


def test_uploads_are_bounded_and_not_larger_than_announced(workspace, scene, monkeypatch):
    async def blocks():
        for _ in range(3):
            yield b"12"

    with refused(r"^x\.png: larger than announced"):
        asyncio.run(workspace.receive("x.png", 5, blocks()))

    async def stalled():
        yield b"12"
        await asyncio.Event().wait()

    with monkeypatch.context() as patch, refused(r"^x\.png: it did not arrive; send it again"):
        patch.setattr(module, "STALL_SECONDS", 0.01)
        asyncio.run(workspace.receive("x.png", 5, stalled()))
    assert (stored(workspace), workspace.receiving) == ([], {})
    size = (scene / "photo.png").stat().st_size
    monkeypatch.setattr(module, "MAX_VIEWER_BYTES", 2 * size)
    send(workspace, scene / "photo.png")
    send(workspace, scene / "photo.png")
    with refused(r"^x\.png: all files have more than"):
        send(workspace, scene, "x.png", b"0")


def test_a_mesh_without_its_texture_is_not_called_coloured(workspace, tmp_path):
    material = b"newmtl m\nKd 0.8 0.1 0.1\nmap_Kd a.png\n"
    facts = (
        "rendered in grey: materials or textures are missing; send it with them in a zip archive"
    )
    parts = {"a.obj": TEXTURED, "a.mtl": material}
    pack(tmp_path / "a.zip", parts)
    for path, content in (("a.obj", TEXTURED), ("a.zip", None)):
        send(workspace, tmp_path / path, content=content)
        assert workspace.session.mesh_facts.endswith(facts)
        assert "missing" in workspace.messages["mesh"]
        assert str(tmp_path) not in workspace.messages["mesh"]
    send(workspace, pack(tmp_path / "a.zip", {**parts, "a.png": PICTURE}))
    assert workspace.session.mesh_facts.endswith("rendered in its colours")
    assert workspace.messages == {}
    assert sorted(stored(workspace)) == ["a.mtl", "a.obj", "a.png"], "without the archive"
    send(workspace, pack(tmp_path / "a.zip", {**parts, "a.png": b"%!PS-Adobe-3.0 EPSF-3.0\n"}))
    assert workspace.session.mesh_facts.endswith(facts)


def test_the_sample_fills_the_page_and_its_options_go_with_it(workspace, scene):
    limits = {"theta": (-10.0, 10.0)}
    camera = (9.0, 9.0, 5.0, 5.0)
    own = replace(
        RegisterOptions(), unit="ft", pose="any", limits=limits, camera=camera, mesh_is="similar"
    )
    session = workspace.session
    session.options = own
    for _ in range(2):
        asyncio.run(workspace.load_sample())
        options = session.options
        assert (options.unit, options.pose) == ("mm", "upright")
        assert (options.limits, options.mesh_is) == ({}, None)
        assert (options.camera, names(workspace)) == (30.0, ["coffee.jpg"])
    assert session.shot.photo.image.shape == (3, 400, 600)
    assert "CC0" in session.shot.photo.notes[0]
    assert workspace.session.mesh_facts.endswith("mm, rendered in its colours")
    assert workspace.messages == {}
    send(workspace, scene, "notes.pdf", b"x")
    assert session.options.pose == "upright", "it replaces nothing"
    send(workspace, scene / "photo.png")
    assert session.options == own
    assert (names(workspace), session.mesh_path, session.shot.box) == (["photo.png"], None, None)
    assert session.request().camera == camera
    send(workspace, scene / "truck.ply")
    assert workspace.session.mesh_facts.endswith(" ft, rendered in grey")


@pytest.mark.slow
def test_the_pose_of_the_sample_is_right(workspace, tmp_path, monkeypatch):
    """Outline of the cup and its handle, marked by eye in the photograph, in px."""
    sides = [(173, 116), (177, 163), (183, 193), (200, 220), (409, 117), (400, 166), (380, 214)]
    foot = [(280, 286), (302, 283)]
    handle = [(208, 254), (199, 274), (197, 288), (202, 300), (215, 308)]
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    asyncio.run(workspace.load_sample())
    result = workspace.session.register()
    # The photograph hardly tells where the handle is: the best rival, turned by 72 degrees about
    # the cup's axis, is 0.9 points behind; of 220 reliable answers none had one within 1.47.
    assert result.verdict in ("reliable", "unsure")
    assert workspace.session.shot.found_box.tolist() == list(module.SAMPLE_BOX)
    T, K = workspace.session.shot.projection
    vertices = torch.tensor(workspace.session.mesh.vertices) @ T[:3, :3].mT + T[:3, 3]
    seen = (vertices @ K.mT)[:, :2] / vertices[:, 2:]
    distances = torch.cdist(torch.tensor([*sides, *foot, *handle]).double(), seen).amin(dim=1)
    assert distances.mean() < 4
    assert distances[-len(handle) :].max() < 8, "the handle is at the handle"


def test_warnings_and_defects_become_messages(workspace, capsys):
    def warn():
        warnings.warn(CurviregWarning("small", subject="a.obj"), stacklevel=1)

    with shown_warnings():
        assert asyncio.run(workspace.run("mesh", warn)) is True
    assert workspace.messages == {"mesh": "a.obj: small"}
    assert asyncio.run(workspace.run("mesh", lambda: 5)) == 5
    assert workspace.messages == {}
    assert fail(workspace, KeyError("x")).startswith("KeyError: 'x'")
    assert "Traceback" in capsys.readouterr().err


class Search:
    """Stands for ``Session.register``; it runs until it is released or cancelled."""

    def __init__(self, session):
        self.session = session
        self.begun = threading.Event()
        self.released = threading.Event()
        self.shots = []

    def __call__(self):
        self.shots.append(self.session.shot)
        self.begun.set()
        while not self.released.wait(0.01):
            if self.session.cancelled:
                self.session.cancelled = False
                raise CurviregError("stopped")


@pytest.fixture
def search(workspace, monkeypatch):
    search = Search(workspace.session)
    monkeypatch.setattr(workspace.session, "register", search)
    yield search
    search.released.set()


async def begin(workspace, search):
    """Start a search, and wait until it runs."""
    search.begun.clear()
    running = workspace.start_search()
    assert workspace.start_search() is running, "one search at a time"
    await asyncio.to_thread(search.begun.wait, 10)
    return running


def test_photographs_are_added_while_a_search_runs_but_stop_and_another_mesh_end_it(
    workspace, scene, search
):
    async def work():
        await begin(workspace, search)
        await asyncio.wait_for(upload(workspace, scene / "photo.png"), 10)
        assert workspace.searching
        await asyncio.wait_for(upload(workspace, scene / "truck.ply"), 10)
        assert not workspace.searching
        assert workspace.messages == {}
        running = await begin(workspace, search)
        workspace.stop()
        await asyncio.wait_for(running, 5)
        assert workspace.messages == {"pose": "stopped"}
        workspace.stop()  # nothing that could end the next search
        search.released.set()
        await (await begin(workspace, search))
        assert workspace.messages == {}

    asyncio.run(work())


def test_a_search_that_waits_for_a_mesh_searches_with_it(workspace, scene, search):
    """The mesh waits for a job; the search was started later."""
    released = threading.Event()

    async def work():
        await upload(workspace, scene / "photo.png")
        job = asyncio.create_task(workspace.run("page", lambda: released.wait(10)))
        await asyncio.sleep(0)
        opening = asyncio.create_task(workspace.open_mesh(scene / "truck.ply"))
        await asyncio.sleep(0)
        running = workspace.start_search()
        await asyncio.sleep(0)
        released.set()
        search.released.set()
        await asyncio.wait_for(asyncio.gather(job, opening, running), 10)

    asyncio.run(work())
    assert len(search.shots) == 1
    assert (workspace.session.mesh_path, workspace.messages) == (scene / "truck.ply", {})


def test_closing_the_sample_or_the_photograph_ends_the_search_in_it(workspace, scene, search):
    ended = []

    async def work():
        for close in (lambda: upload(workspace, scene / "photo.png"), workspace.remove_photo):
            running = await begin(workspace, search)
            workspace.session.searched = (workspace.session.shot,)  # as ``register`` sets it
            try:
                await close()
                ended.append(running.done())
            finally:
                search.released.set()
            await running
            search.released.clear()
        await workspace.remove_photo()  # in a window that has not noticed yet

    asyncio.run(workspace.load_sample())
    asyncio.run(work())
    assert (ended, names(workspace)) == ([True, True], [])
    assert workspace.messages == {}


def test_find_while_a_photograph_opens_searches_in_the_new_one(
    workspace, scene, search, monkeypatch
):
    begun = threading.Event()
    released = threading.Event()
    open_photo = workspace.session.open_photo

    def slow(*arguments):
        begun.set()
        assert released.wait(10)
        return open_photo(*arguments)

    async def work():
        await upload(workspace, scene / "photo.png", "old.png")
        monkeypatch.setattr(workspace.session, "open_photo", slow)
        opening = asyncio.create_task(upload(workspace, scene / "photo.png", "new.png"))
        await asyncio.to_thread(begun.wait, 10)
        running = workspace.start_search()
        await upload(workspace, scene, "notes.pdf", b"x")  # what it leaves is removed
        released.set()
        await opening
        search.released.set()
        await running

    asyncio.run(work())
    assert [shot.path.name for shot in search.shots] == ["new.png"]
    assert all(shot.path.is_file() for shot in workspace.session.shots)


def pack(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_unpack_finds_the_mesh_among_its_parts_and_keeps_everything_inside(tmp_path):
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box()))
    parts = {f"part/{name}": content for name, content in files.items()}
    outside = {
        "../../a.png": b"x",
        "/etc/b.png": b"x",
        "..\\c.png": b"x",
        "__MACOSX/part/._model.gltf": b"x",
    }
    archive = pack(tmp_path / "a.zip", {**parts, **outside})
    folder = tmp_path / "upload" / "parts"
    mesh = unpack(archive, folder)
    assert mesh == folder / "part" / "model.gltf"
    assert np.allclose(trimesh.load(mesh).extents, 1)
    assert all(
        folder in path.parents for path in tmp_path.rglob("*") if path.is_file() and path != archive
    )
    assert len([path for path in folder.rglob("*") if path.is_file()]) == len(parts) + 4


def test_unpack_refuses_what_is_too_large_damaged_or_not_one_mesh(tmp_path, monkeypatch):
    def check(content, message):
        archive = tmp_path / "a.zip"
        pack(archive, content) if isinstance(content, dict) else archive.write_bytes(content)
        with refused(rf"^a\.zip: .*{message}"):
            unpack(archive, tmp_path / secrets.token_hex(4))

    content = pack(tmp_path / "good.zip", {"a.ply": b"0" * 5000}).read_bytes()
    check({"a.txt": b""}, "no mesh")
    check({"a.ply": b"", "b.stl": b""}, r"several meshes: .*b\.stl")
    for damaged in (content[:40], b""):
        check(damaged, "cannot be unpacked")
    # a header that lies
    check(content.replace(struct.pack("<I", 5000), struct.pack("<I", 10)), "cannot be unpacked")
    monkeypatch.setattr(module, "MAX_MESH_BYTES", 4999)
    check(content, "4,999 bytes when unpacked")
    monkeypatch.setattr(module, "MAX_ARCHIVE_FILES", 2)
    check({f"{k}.txt": b"" for k in range(3)}, "more than 2 files")
    monkeypatch.setattr(zipfile.ZipFile, "infolist", None)  # the directory is not even read
    check({f"{k:0200}.txt": b"" for k in range(20)}, "more than 2 files")


def test_a_full_disk_is_said_and_leaves_nothing(workspace, scene, monkeypatch):
    message = r"^a\.png: cannot be stored \(No space left on device\); make room on the machine"
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    file = MagicMock()
    file.__enter__.return_value.write = full
    for owner, name, fails in (
        (Path, "open", Mock(return_value=file)),
        (module.tempfile, "mkdtemp", full),
    ):
        with monkeypatch.context() as patch, refused(message, OutputError):
            patch.setattr(owner, name, fails)
            send(workspace, scene, "a.png", b"1")
    assert (list(workspace.folder.iterdir()), workspace.receiving) == ([], {})
    monkeypatch.setattr(zipfile.ZipFile, "extractall", full)
    pack(scene / "a.zip", {"a.ply": b""})
    send(workspace, scene / "a.zip")
    assert workspace.messages["mesh"].startswith(
        "a.zip: cannot be stored (No space left on device); make room"
    )
    assert stored(workspace) == []


def test_messages_have_no_temporary_folders(workspace):
    inside = workspace.folder / "upload-ab_c1"
    for text, shown in (
        (f"{inside}/rig.csv: row 1: {inside}/parts/b/a.mtl", "rig.csv: row 1: b/a.mtl"),
        (f"{workspace.folder}/other", "other"),
        (f"[Errno 36] File name too long: '{inside}/x'", "[Errno 36] File name too long: 'x'"),
        (f"{inside}", ""),
        (f"{workspace.folder}-not/x", f"{workspace.folder}-not/x"),
        ("a/parts/b", "a/parts/b"),
    ):
        assert fail(workspace, InvalidInputError(text)) == shown
        assert f"{workspace.folder}/" not in fail(workspace, KeyError(text))
    message = "File name too long; check the machine on which the page runs"
    assert fail(workspace, OSError(36, "File name too long", f"{inside}/x")) == message


def test_closing_ends_the_search_and_removes_the_uploads(workspace, scene, search):
    async def work():
        await upload(workspace, scene / "photo.png")
        running = await begin(workspace, search)
        workspace.close()
        await asyncio.wait_for(running, 5)

    asyncio.run(work())
    assert (stored(workspace), workspace.messages) == ([], {"pose": "stopped"})


@pytest.mark.parametrize("blocks", [(0, 60_000), (30_000, 30_000), (60_000, 0)])
def test_files_on_their_way_count_once_with_what_they_announced(workspace, monkeypatch, blocks):
    monkeypatch.setattr(module, "MAX_VIEWER_BYTES", 100_000)

    async def work():
        begun = asyncio.Event()
        released = asyncio.Event()

        async def slow():
            if blocks[0]:
                yield b"x" * blocks[0]
            begun.set()
            await released.wait()
            yield b"x" * blocks[1]

        first = asyncio.create_task(workspace.receive("a.pdf", 60_000, slow()))
        await begun.wait()
        with refused(r"^b\.pdf: all files have more than 100,000 bytes"):
            await upload(workspace, None, "b.pdf", b"x" * 40_001)
        await upload(workspace, None, "c.pdf", b"x" * 40_000)
        released.set()
        await first

    asyncio.run(work())
    assert (stored(workspace), workspace.receiving) == ([], {})


def test_unpack_reads_no_directory_that_is_larger_than_it_says(tmp_path, monkeypatch):
    """Two records at the end of an archive tell the size of its directory, and a third one may lie
    in the last."""
    monkeypatch.setattr(zipfile.ZipFile, "infolist", None)  # it would be read by then
    content = pack(tmp_path / "a.zip", {f"{k:0200}.txt": b"" for k in range(6000)}).read_bytes()
    end = content.rindex(b"PK\5\6")
    size, start = struct.unpack_from("<II", content, end + 12)
    assert size > 1000 * module.DIRECTORY_BYTES
    record = struct.pack("<IQHHIIQQQQ", 0x06064B50, 44, 45, 45, 0, 0, 6000, 6000, size, start)
    record += struct.pack("<IIQI", 0x07064B50, 0, end, 1)
    small = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 6000, 6000, 100, start, 0)
    inner = struct.pack(
        "<4sHHHHIIH", b"PK\5\6", *struct.unpack("<HH", b"PK\5\6"), 6000, 6000, size, 100, 0
    )
    for ends in (content[end:], record + small, inner):
        (tmp_path / "a.zip").write_bytes(content[:end] + ends)
        with refused(r"^a\.zip: more than 1,000 files"):
            unpack(tmp_path / "a.zip", tmp_path / "parts")


def test_unpack_refuses_folders_that_are_nested_deeply(tmp_path):
    mesh = trimesh.creation.box().export(file_type="ply")
    deep = "a/" * module.MAX_ARCHIVE_DEPTH
    assert unpack(pack(tmp_path / "a.zip", {f"{deep}a.ply": mesh}), tmp_path / "parts").is_file()
    with refused(r"^a\.zip: more than .* 32 folders in one another; pack only"):
        unpack(pack(tmp_path / "a.zip", {f"{deep}a/a.ply": mesh}), tmp_path / "more")
    assert not (tmp_path / "more").exists()
