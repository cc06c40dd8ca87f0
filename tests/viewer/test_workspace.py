"""What a page works on outlives it, and what files it receives; no page and no browser is needed."""

import asyncio
import gc
import struct
import threading
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from curvireg_torch.errors import (
    MAX_MESH_BYTES,
    MAX_VIEWER_PAGES,
    CurviregError,
    CurviregWarning,
    InvalidInputError,
)
from curvireg_torch.evaluation.opening import RegisterOptions
from curvireg_torch.viewer import workspace as module
from curvireg_torch.viewer.session import Session
from curvireg_torch.viewer.workspace import (
    Workspace,
    Workspaces,
    file_name,
    identify,
    show_warning,
    unpack,
)
from tests.viewer.test_session import write_scene


@pytest.fixture
def scene(tmp_path):
    write_scene(tmp_path)
    return tmp_path


@pytest.fixture
def workspace(tmp_path):
    return Workspace(Session(RegisterOptions()), tmp_path / "page", asyncio.Semaphore(1))


async def upload(workspace, path, name=None, content=None):
    content = path.read_bytes() if content is None else content

    async def blocks():
        for start in range(0, len(content), 1000):
            yield content[start : start + 1000]

    await workspace.receive(name or path.name, len(content), blocks())


def stored(workspace):
    return sorted(path.name for path in workspace.folder.iterdir())


def test_uploads_find_their_place_and_replace_one_another(workspace, scene):
    session = workspace.session
    asyncio.run(upload(workspace, scene / "truck.ply", "part"))
    assert "968 faces" in workspace.mesh_facts
    for name in ("a.png", "b.png", "a.png"):  # the same file again is as good as any
        asyncio.run(upload(workspace, scene / "photo.png", name))
        assert session.names[session.photo_path] == name
        assert session.photo.image.shape == (3, 180, 240)
    assert session.names[session.mesh_path] == "part"
    assert workspace.messages == {}
    assert len(stored(workspace)) == 2, "files that were replaced are removed"
    assert workspace.receiving == {}


def test_messages_are_about_one_file_and_go_when_their_cause_is_gone(workspace, scene):
    session = workspace.session
    asyncio.run(upload(workspace, scene / "photo.png", "good.png"))
    asyncio.run(upload(workspace, scene / "photo.png", "half.png", (scene / "photo.png").read_bytes()[:2000]))
    asyncio.run(upload(workspace, scene / "truck.ply", "bad.ply", b"ply\nnonsense"))
    asyncio.run(upload(workspace, scene / "truck.ply", "notes.txt", b"dear diary"))
    for part, name in (("photograph", "half.png"), ("mesh", "bad.ply"), ("file", "notes.txt")):
        assert workspace.messages[part].startswith(f"{name}: ")
        assert str(workspace.folder) not in workspace.messages[part]
    assert session.names[session.photo_path] == "good.png", "the former photograph stays"
    assert len(stored(workspace)) == 1
    asyncio.run(upload(workspace, scene / "photo.png"))
    assert set(workspace.messages) == {"mesh"}
    asyncio.run(upload(workspace, scene / "truck.ply"))
    assert workspace.messages == {}


def test_uploads_of_a_page_are_bounded(workspace, scene, monkeypatch):
    size = (scene / "photo.png").stat().st_size
    monkeypatch.setattr(module, "MAX_VIEWER_BYTES", 2 * size)
    asyncio.run(upload(workspace, scene / "photo.png"))
    asyncio.run(upload(workspace, scene / "photo.png"))
    with pytest.raises(InvalidInputError, match=r"^x\.png: too many files"):
        asyncio.run(upload(workspace, scene / "photo.png", "x.png", b"0" * (size + 1)))
    monkeypatch.setattr(module, "MAX_VIEWER_UPLOADS", 0)
    with pytest.raises(InvalidInputError, match="too many files"):
        asyncio.run(upload(workspace, scene / "photo.png"))


def test_the_sample_fills_the_page(workspace):
    asyncio.run(workspace.load_sample())
    session = workspace.session
    assert session.photo.image.shape == (3, 720, 960)
    assert session.names[session.photo_path] == "sample.png"
    assert "faces" in workspace.mesh_facts
    assert session.box[0] < session.box[2]
    assert session.camera[:2] == (1040.0, 1040.0)
    assert workspace.messages == {}


def test_warnings_and_defects_become_messages(workspace, capsys):
    def warn():
        warnings.warn(CurviregWarning("small", subject="a.obj"), stacklevel=1)

    def fail():
        raise KeyError("x")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show_warning
        assert asyncio.run(workspace.run("mesh", warn)) is True
    assert workspace.messages == {"mesh": "a.obj: small"}
    assert asyncio.run(workspace.run("mesh", lambda: 5)) == 5
    assert workspace.messages == {}
    assert asyncio.run(workspace.run("pose", fail)) is None
    assert workspace.messages["pose"].startswith("KeyError: 'x'")
    assert "Traceback" in capsys.readouterr().err


def test_a_photograph_dropped_while_a_mesh_loads_stays(workspace, scene, monkeypatch):
    session, begun, released = workspace.session, threading.Event(), threading.Event()
    open_mesh = session.open_mesh

    def slow(*arguments):
        begun.set()
        assert released.wait(10)
        return open_mesh(*arguments)

    monkeypatch.setattr(session, "open_mesh", slow)

    async def work():
        mesh = asyncio.create_task(upload(workspace, scene / "truck.ply"))
        await asyncio.to_thread(begun.wait, 10)
        photo = asyncio.create_task(upload(workspace, scene / "photo.png"))
        await upload(workspace, scene / "photo.png", "notes.txt", b"x")  # what it leaves is removed
        released.set()
        await mesh
        await photo

    asyncio.run(work())
    assert session.photo_path.is_file()
    assert session.mesh_path.is_file()
    assert session.names == {session.photo_path: "photo.png", session.mesh_path: "truck.ply"}


def test_options_of_the_sample_do_not_stay_for_ones_own_object(workspace, scene):
    session = workspace.session
    session.options = replace(session.options, unit="ft", pose="any")
    asyncio.run(workspace.load_sample())
    assert (session.options.unit, session.options.pose) == ("m", "upright")
    asyncio.run(upload(workspace, scene / "photo.png"))
    assert (session.options.unit, session.options.pose, session.box, session.camera) == ("m", "any", None, None)
    asyncio.run(upload(workspace, scene / "truck.ply", "bad.ply", b"ply\nnonsense"))
    assert session.options.unit == "m", "the truck of the sample is still there"
    asyncio.run(upload(workspace, scene / "truck.ply"))
    assert session.options == replace(RegisterOptions(), unit="ft", pose="any")
    assert workspace.mesh_facts.endswith(" ft, rendered in grey")
    asyncio.run(workspace.load_sample())
    session.options = replace(session.options, pose=None)  # the user's choice
    asyncio.run(upload(workspace, scene / "truck.ply"))
    assert session.options.pose is None


class Search:
    """Stands for ``Session.register``; it runs until it is released or cancelled."""

    def __init__(self, session):
        self.session, self.begun, self.released, self.photos = session, threading.Event(), threading.Event(), []

    def __call__(self):
        self.photos.append(self.session.photo_path and self.session.names[self.session.photo_path])
        self.begun.set()
        while not self.released.wait(0.01):
            if self.session.cancelled:
                self.session.cancelled = False
                raise CurviregError("stopped")
        return "pose"


@pytest.fixture
def two(tmp_path, monkeypatch):
    """Two pages and their searches, of which one can run at a time."""
    searches = asyncio.Semaphore(1)
    pages = [Workspace(Session(RegisterOptions()), tmp_path / name, searches) for name in "ab"]
    searches = [Search(page.session) for page in pages]
    for page, search in zip(pages, searches, strict=True):
        monkeypatch.setattr(page.session, "register", search)
    yield pages, searches
    for search in searches:
        search.released.set()


async def running_and_waiting(first, search, second):
    """The first page's search, which has begun, and the second's, which waits for it."""
    running = first.start_search()
    await asyncio.to_thread(search.begun.wait, 10)
    waiting = second.start_search()
    await asyncio.sleep(0.05)
    return running, waiting


def test_a_search_waits_for_others_and_holds_up_no_other_job(two, scene):
    (first, second), (one, other) = two

    async def work():
        running, waiting = await running_and_waiting(first, one, second)
        assert (first.searching, first.waiting) == (True, False)
        assert (second.searching, second.waiting) == (True, True)
        assert second.start_search() is waiting, "one search of a page at a time"
        await asyncio.wait_for(upload(first, scene / "truck.ply", "x.txt", b"x"), 10)
        assert "neither" in first.messages["file"]
        assert await asyncio.wait_for(second.run("mesh", lambda: 7), 10) == 7
        one.released.set()
        await running
        other.released.set()
        await waiting
        assert (second.searching, second.waiting) == (False, False)

    asyncio.run(work())
    assert "pose" not in first.messages


def test_stop_ends_a_running_and_a_waiting_search(two):
    (first, second), (one, other) = two

    async def work():
        running, waiting = await running_and_waiting(first, one, second)
        second.stop()
        await asyncio.wait_for(waiting, 5)  # at once, although the other goes on
        assert first.searching
        first.stop()
        await asyncio.wait_for(running, 5)
        first.stop()  # nothing that could end the next search
        one.released.set()
        await first.start_search()

    asyncio.run(work())
    assert "pose" not in first.messages
    assert second.messages["pose"] == "stopped"
    assert not other.begun.is_set()


def test_a_new_photograph_ends_the_search_in_the_former_one(two, scene):
    (first, _), (one, _) = two
    unhandled = []

    async def work():
        asyncio.get_running_loop().set_exception_handler(lambda _, context: unhandled.append(context["message"]))
        first.start_search()
        await asyncio.to_thread(one.begun.wait, 10)
        await asyncio.wait_for(upload(first, scene / "photo.png"), 10)
        assert not first.searching
        gc.collect()

    asyncio.run(work())
    assert first.session.photo is not None
    assert "pose" not in first.messages
    assert unhandled == []


def test_find_while_a_photograph_opens_searches_in_the_new_one(two, scene, monkeypatch):
    (first, _), (one, _) = two
    begun, released = threading.Event(), threading.Event()
    open_photo = first.session.open_photo

    def slow(*arguments):
        begun.set()
        assert released.wait(10)
        return open_photo(*arguments)

    async def work():
        await upload(first, scene / "photo.png", "old.png")
        monkeypatch.setattr(first.session, "open_photo", slow)
        opening = asyncio.create_task(upload(first, scene / "photo.png", "new.png"))
        await asyncio.to_thread(begun.wait, 10)
        search = first.start_search()
        await asyncio.sleep(0.1)
        released.set()
        await opening
        one.released.set()
        await search

    asyncio.run(work())
    assert one.photos == ["new.png"]


def test_pages_come_back_to_their_work_and_lost_ones_free_their_place(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "GRACE_SECONDS", 0.05)
    stopped = []

    async def work():
        spaces = Workspaces(RegisterOptions(), tmp_path / "spaces")
        pages = {f"page-{k}": spaces.join(f"page-{k}") for k in range(MAX_VIEWER_PAGES)}
        for name, page in pages.items():
            monkeypatch.setattr(page, "stop", lambda name=name: stopped.append(name))
        assert spaces.join("one-more") is None
        assert spaces.join("page-3") is pages["page-3"], "another window of the same page"
        for name in ("page-5", "page-2", "page-3"):
            spaces.leave(name)
        assert spaces.join("page-2") is pages["page-2"], "loaded again"
        await asyncio.sleep(0.2)
        assert stopped == ["page-5"], "its search; page-2 and page-3 are still shown"
        assert spaces.join("one-more") is not None, "in the place of page-5"
        assert "page-5" not in spaces.items
        assert not pages["page-5"].folder.exists()
        assert spaces.join("page-5") is None
        spaces.close()

    asyncio.run(work())
    assert not (tmp_path / "spaces").exists()


@pytest.mark.parametrize(
    ("name", "head", "expected"),
    [
        ("a.stl", b"\x89PNG\r\n", ("photograph", "")),  # the content decides
        ("a.heic", b"\0\0\0\x18ftypheic", ("photograph", "")),  # whose reader says what to do
        ("a.jpg", b"ply\nformat ascii 1.0", ("mesh", ".ply")),
        ("part", b"glTF\2\0\0\0", ("mesh", ".glb")),
        ("A.OBJ", b"mtllib a.mtl", ("mesh", ".obj")),
        ("a.safetensors", b"\x10\0\0\0\0\0\0\0{}", ("mesh", ".safetensors")),
        ("a.jpg", b"", ("photograph", "")),
        ("a.stl", b"PK\3\4", ("archive", ".zip")),
    ],
)
def test_identify(name, head, expected):
    assert identify(name, head) == expected


def test_identify_names_the_file_that_is_neither():
    for name, head in (("a.pdf", b"%PDF-1.7"), ("a", b""), ("part.mtl", b"newmtl red")):
        with pytest.raises(InvalidInputError, match=rf"^{name}: neither a photograph .* nor a mesh .*zip"):
            identify(name, head)


def test_file_name_has_no_folders():
    assert file_name("../../etc/passwd") == "passwd"
    assert file_name("C:\\a\\b.png") == "b.png"
    assert file_name("a\nb\x1b.png") == "ab.png"
    assert file_name("") == file_name("a/") == "file"
    assert file_name("x" * 500 + ".png").endswith("x.png")
    assert len(file_name("x" * 500)) == 120


def pack(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_unpack_finds_the_mesh_among_its_parts(tmp_path):
    scene = trimesh.Scene(trimesh.creation.box())
    files = trimesh.exchange.gltf.export_gltf(scene)
    parts = {f"part/{name}": content for name, content in files.items()}
    archive = pack(tmp_path / "a.zip", {**parts, "__MACOSX/part/._model.gltf": b"x"})
    mesh = unpack(archive, tmp_path / "unpacked", "a.zip")
    assert mesh == tmp_path / "unpacked" / "part" / "model.gltf"
    assert np.allclose(trimesh.load(mesh).extents, 1)


def test_unpack_refuses_several_meshes_and_keeps_everything_inside(tmp_path):
    for members, match in (({"a.txt": b""}, "no mesh"), ({"a.ply": b"", "b.stl": b""}, r"several meshes: .*b\.stl")):
        with pytest.raises(InvalidInputError, match=rf"^a\.zip: {match}"):
            unpack(pack(tmp_path / "a.zip", members), tmp_path / members.popitem()[0], "a.zip")
    (tmp_path / "upload").mkdir()
    archive = pack(tmp_path / "upload" / "a.zip", {"../../a.ply": b"x", "/etc/b.png": b"x", "..\\c.png": b"x"})
    before = {path for path in tmp_path.rglob("*") if path.is_file()}
    mesh = unpack(archive, tmp_path / "upload" / "parts", "a.zip")
    assert mesh.parent == tmp_path / "upload" / "parts"
    new = {path for path in tmp_path.rglob("*") if path.is_file()} - before
    assert all(tmp_path / "upload" / "parts" in path.parents for path in new)
    assert len(new) == 3


def test_unpack_refuses_what_is_too_large_or_damaged(tmp_path, monkeypatch):
    archive = pack(tmp_path / "a.zip", {"a.ply": b"0" * 5000})
    content = archive.read_bytes()
    archive.write_bytes(content[:40])
    with pytest.raises(InvalidInputError, match=r"^a\.zip: the archive cannot be unpacked"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    archive.write_bytes(content.replace(struct.pack("<I", 5000), struct.pack("<I", 10)))  # a header that lies
    with pytest.raises(InvalidInputError, match="cannot be unpacked"):
        unpack(archive, tmp_path / "lies", "a.zip")
    archive.write_bytes(content)
    monkeypatch.setattr(module, "MAX_MESH_BYTES", 4999)
    with pytest.raises(InvalidInputError, match="5,000 bytes when unpacked"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    monkeypatch.setattr(module, "MAX_MESH_BYTES", MAX_MESH_BYTES)
    monkeypatch.setattr(module, "MAX_ARCHIVE_FILES", 2)
    pack(archive, {f"{k}.txt": b"" for k in range(3)})
    with pytest.raises(InvalidInputError, match="3 files, more than 2"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    pack(archive, {f"{k:0200}.txt": b"" for k in range(20)})
    monkeypatch.setattr(zipfile, "ZipFile", None)  # the directory is not even read
    with pytest.raises(InvalidInputError, match="more than 2 files"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    assert not (tmp_path / "unpacked").exists()
