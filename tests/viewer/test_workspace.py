"""What a page works on outlives it; no page and no browser is needed."""

import asyncio
import threading
import warnings

import pytest

from curvireg_torch.errors import MAX_VIEWER_PAGES, CurviregError, CurviregWarning, InvalidInputError
from curvireg_torch.evaluation.opening import RegisterOptions
from curvireg_torch.viewer import workspace as module
from curvireg_torch.viewer.session import Session
from curvireg_torch.viewer.workspace import Workspace, Workspaces, show_warning
from tests.viewer.test_session import write_scene


@pytest.fixture
def scene(tmp_path):
    write_scene(tmp_path)
    return tmp_path


@pytest.fixture
def workspace(tmp_path):
    return Workspace(Session(RegisterOptions()), tmp_path / "page")


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
    assert session.box == workspace.drawing.box
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


class Search:
    """Stands for ``Session.register``; it runs until it is released or cancelled."""

    def __init__(self, session):
        self.session, self.begun, self.released = session, threading.Event(), threading.Event()

    def __call__(self):
        self.begun.set()
        while not self.released.wait(0.01):
            if self.session.cancelled:
                self.session.cancelled = False
                raise CurviregError("stopped")
        return "pose"


@pytest.fixture
def two(tmp_path, monkeypatch):
    """Two pages and their searches, of which one can run at a time."""
    pool = module.ThreadPoolExecutor(1)
    monkeypatch.setattr(module, "_SEARCHES", pool)
    pages = [Workspace(Session(RegisterOptions()), tmp_path / name) for name in "ab"]
    searches = [Search(page.session) for page in pages]
    for page, search in zip(pages, searches, strict=True):
        monkeypatch.setattr(page.session, "register", search)
    yield pages, searches
    for search in searches:
        search.released.set()
    pool.shutdown()


async def running_and_waiting(first, search, second):
    """Tasks of the first page's search, which has begun, and of the second's, which waits for it."""
    running = asyncio.create_task(first.register())
    await asyncio.to_thread(search.begun.wait, 10)
    waiting = asyncio.create_task(second.register())
    await asyncio.sleep(0.05)
    return running, waiting


def test_a_search_waits_for_others_and_holds_up_no_other_job(two, scene):
    (first, second), (one, other) = two

    async def work():
        running, waiting = await running_and_waiting(first, one, second)
        assert (first.searching, first.waiting_for) == (True, 0)
        assert (second.searching, second.waiting_for) == (True, 1)
        assert not await second.register(), "one search of a page at a time"
        await asyncio.wait_for(upload(first, scene / "truck.ply", "x.txt", b"x"), 10)
        assert "neither" in first.messages["file"]
        assert await asyncio.wait_for(second.run("mesh", lambda: 7), 10) == 7
        one.released.set()
        assert await running
        other.released.set()
        assert await waiting
        assert (second.searching, second.waiting_for) == (False, 0)

    asyncio.run(work())
    assert "pose" not in first.messages


def test_stop_ends_a_running_and_a_waiting_search(two):
    (first, second), (one, other) = two

    async def work():
        running, waiting = await running_and_waiting(first, one, second)
        second.stop()
        assert not await asyncio.wait_for(waiting, 5), "at once, although the other goes on"
        assert first.searching
        first.stop()
        assert not await asyncio.wait_for(running, 5)

    asyncio.run(work())
    assert first.messages["pose"] == second.messages["pose"] == "stopped"
    assert not other.begun.is_set()
    first.stop()
    assert not first.session.cancelled, "nothing that could end the next search"


def test_a_new_photograph_ends_the_search_in_the_former_one(two, scene):
    (first, _), (one, _) = two

    async def work():
        running = asyncio.create_task(first.register())
        await asyncio.to_thread(one.begun.wait, 10)
        await asyncio.wait_for(upload(first, scene / "photo.png"), 10)
        assert running.done() or not first.searching
        one.released.set()
        await running

    asyncio.run(work())
    assert first.session.photo is not None
    assert "pose" not in first.messages


def test_pages_come_back_to_their_work_and_lost_ones_free_their_place(tmp_path):
    spaces = Workspaces(RegisterOptions(), tmp_path / "spaces")
    pages = {f"page-{k}": spaces.join(f"page-{k}") for k in range(MAX_VIEWER_PAGES)}
    assert spaces.join("one-more") is None
    assert spaces.join("page-3") is pages["page-3"], "another window of the same page"
    for name in ("page-5", "page-2", "page-3"):
        spaces.leave(name)
    assert spaces.join("page-2") is pages["page-2"], "loaded again"
    assert spaces.join("one-more") is not None, "in the place of page-5; page-3 is still shown"
    assert "page-5" not in spaces.items
    assert not pages["page-5"].folder.exists()
    assert spaces.join("page-5") is None
    spaces.close()
    assert not (tmp_path / "spaces").exists()


def test_what_is_left_is_kept_for_a_day(tmp_path, monkeypatch):
    spaces = Workspaces(RegisterOptions(), tmp_path / "spaces")
    now, stopped = [1000.0], []
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    page = spaces.join("page")
    monkeypatch.setattr(page, "stop", lambda: stopped.append(now[0]))
    now[0] += 10 * module.KEPT_SECONDS
    spaces.sweep()
    assert "page" in spaces.items, "it is shown"
    spaces.leave("page")
    now[0] += module.GRACE_SECONDS - 1
    spaces.sweep()
    assert stopped == []
    now[0] += 2
    spaces.sweep()
    assert len(stopped) == 1
    now[0] += module.KEPT_SECONDS
    spaces.sweep()
    assert spaces.items == {}
