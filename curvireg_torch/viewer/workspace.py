"""What a page works on: it outlives the page, so that a reload finds everything again. It needs no NiceGUI."""

import asyncio
import os
import shutil
import threading
import time
import traceback
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import MAX_VIEWER_BYTES, MAX_VIEWER_PAGES, MAX_VIEWER_UPLOADS, CurviregError, InvalidInputError
from ..evaluation.opening import RegisterOptions
from ..synthetic import demo_scene
from ..utils.files import write_file
from ..visualization.encoding import png
from ..visualization.overlay import to_uint8
from .drawing import BoxDrawing
from .session import Session
from .uploads import HEAD_BYTES, identify, unpack

__all__ = ["Workspace", "Workspaces", "show_warning"]

KEPT_SECONDS = 24 * 3600.0  # of what a closed page left
GRACE_SECONDS = 30.0  # after which the search of a closed page is stopped; a reload takes less

_JOBS = ThreadPoolExecutor(4, thread_name_prefix="viewer")
_SEARCHES = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // 4), thread_name_prefix="search")
_queue: list[Future[Any]] = []  # searches that have not ended, in order
_thread = threading.local()


def show_warning(message: Any, *_: Any, **__: Any) -> None:
    """Collect the warnings of a job, for its page; replaces ``warnings.showwarning``."""
    getattr(_thread, "warnings", []).append(message)


class Workspace:
    """Photograph, mesh, box, answer and messages of a page.

    Attributes:
        session: inputs and results.
        drawing: the box as the mouse and the keys change it.
        messages: what is wrong with, or remarkable about, a part of the work: "file", "photograph", "mesh" or "pose".
        files: pictures and downloads by name, with their media types.
        receiving: names of files that are being received.
        mesh_facts: the mesh in words.
        loaded: whether the files of the command line were opened.
        pages: browser windows that show it.
        left: when the last of them was closed, in seconds of ``time.monotonic``.
    """

    def __init__(self, session: Session, folder: Path) -> None:
        self.session, self.folder, self.drawing = session, folder, BoxDrawing()
        self.messages: dict[str, str] = {}
        self.files: dict[str, tuple[bytes, str]] = {}
        self.receiving: dict[Path, str] = {}
        self.mesh_facts, self.loaded, self.pages, self.left, self.version = "", False, 0, time.monotonic(), 0
        self._bytes: dict[Path, int] = {}
        self._lock, self._started = asyncio.Lock(), 0.0
        self._search: Future[Any] | None = None
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def searching(self) -> bool:
        """Whether a registration waits or runs."""
        return self._search is not None

    @property
    def waiting_for(self) -> int:
        """Searches of other pages that come before that of this one."""
        search = self._search
        return 0 if search is None or search.running() or search not in _queue else _queue.index(search)

    @property
    def seconds(self) -> float:
        """Since the search began, or was put into the queue."""
        return time.monotonic() - self._started

    async def run(self, part: str, job: Callable[[], Any]) -> Any:
        """Run a short job in a thread; returns its result or True, and None after an error, which becomes a message."""
        async with self._lock:
            caught: list[Any] = []
            return await self._result(part, _JOBS.submit(self._collecting(job, caught)), caught)

    async def register(self) -> bool:
        """Find the pose on a thread for searches, as soon as one is free; returns whether there is a result."""
        if self.searching:
            return False
        self.session.progress, self._started = ("", 0, 1), time.monotonic()
        caught: list[Any] = []
        search = self._search = _SEARCHES.submit(self._collecting(self.session.register, caught))
        _queue.append(search)
        try:
            return await self._result("pose", search, caught) is not None
        finally:
            _queue.remove(search)
            self._search = None

    def stop(self) -> None:
        """End the search at its next step, or take it out of the queue."""
        if self._search is not None and not self._search.cancel():
            self.session.cancel()

    async def _end_search(self) -> None:
        if self._search is not None:
            ended = asyncio.wrap_future(self._search)
            self.stop()
            await asyncio.wait({ended})

    def _collecting(self, job: Callable[[], Any], caught: list[Any]) -> Callable[[], Any]:
        def run() -> Any:
            _thread.warnings = caught
            try:
                return job()
            finally:
                _thread.warnings = []

        return run

    async def _result(self, part: str, future: Future[Any], caught: list[Any]) -> Any:
        self.messages.pop(part, None)
        try:
            result = await asyncio.wrap_future(future)
            if caught:
                self.messages[part] = "; ".join(map(self.session.describe_warning, caught))
            return True if result is None else result
        except (CurviregError, OSError) as error:
            self.messages[part] = str(error)
        except asyncio.CancelledError:
            if not future.cancelled():  # the page, not the search, was ended
                raise
            self.messages[part] = "stopped"
        except Exception as error:  # a defect must not end the page; the terminal has the traceback
            traceback.print_exc()
            self.messages[part] = f"{type(error).__name__}: {error}; see the terminal"
        return None

    async def receive(self, name: str, size: int, blocks: AsyncIterator[bytes]) -> None:
        """Store a file of ``size`` bytes and open it as a photograph or a mesh.

        Raises:
            InvalidInputError: the page has received too much.
        """
        if len(self.receiving) >= MAX_VIEWER_UPLOADS or sum(self._bytes.values()) + size > MAX_VIEWER_BYTES:
            raise InvalidInputError(f"{name}: too many files at a time; wait for the others")
        self.version += 1
        path = self.folder / f"upload-{self.version}"
        self.receiving[path], self._bytes[path] = name, size
        try:
            with path.open("wb") as file:
                async for block in blocks:
                    await asyncio.to_thread(file.write, block)
            await self._open_upload(path, name)
        finally:
            self.receiving.pop(path)
            self._remove_unused()

    async def _open_upload(self, path: Path, name: str) -> None:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        try:
            kind, suffix = identify(name, head, path.stat().st_size)
        except InvalidInputError as error:
            self.messages["file"] = str(error)
            return
        self.messages.pop("file", None)
        target = path.with_name(f"{path.name}-{kind}{suffix}")
        path.rename(target)
        self._bytes[target] = self._bytes.pop(path)
        if kind == "photograph":
            await self.open_photo(target, name)
        elif kind == "mesh":
            await self.open_mesh(target, name)
        else:
            unpacked = target.with_suffix("")
            if mesh := await self.run("mesh", lambda: unpack(target, unpacked, name)):
                await self.open_mesh(mesh, str(mesh.relative_to(unpacked)))
                self._bytes[unpacked] = sum(p.stat().st_size for p in unpacked.rglob("*") if p.is_file())

    def _remove_unused(self) -> None:
        """Remove uploaded files that were replaced or refused."""
        used = [path for path in (self.session.photo_path, self.session.mesh_path) if path is not None]
        for path in [path for path in self._bytes if path not in self.receiving]:
            if not any(path == other or path in other.parents for other in used):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
                self._bytes.pop(path)
                self.session.names.pop(path, None)

    async def open_photo(self, path: Path, name: str) -> None:
        """Replace the photograph; a search in the former one is stopped."""
        await self._end_search()
        if await self.run("photograph", lambda: self.session.open_photo(path, name)):
            self.drawing = BoxDrawing()
            self.messages.pop("pose", None)

    async def open_mesh(self, path: Path, name: str) -> None:
        """Replace the mesh; a search for the former one is stopped."""
        await self._end_search()
        if facts := await self.run("mesh", lambda: self.session.open_mesh(path, name)):
            self.mesh_facts = facts
            self.messages.pop("pose", None)

    async def load(self) -> None:
        """Open the files that the options name."""
        self.loaded = True
        self.mesh_facts = await self.run("file", self.session.load) or ""
        self.drawing = BoxDrawing(self.session.box)

    async def load_sample(self) -> None:
        """Open the scene of ``curvireg demo``, with its box and camera."""
        photo, mesh = self.folder / "sample.png", self.folder / "sample.ply"

        def write() -> Any:
            scene = demo_scene()
            write_file(photo, png(to_uint8(scene.image)))
            write_file(mesh, scene.mesh.export(file_type="ply"))
            return scene

        self.messages.clear()
        if scene := await self.run("file", write):
            self.session.options = replace(self.session.options, unit="m", up=None, pose="upright")
            await self.open_photo(photo, photo.name)
            await self.open_mesh(mesh, mesh.name)
            K = scene.camera_matrix
            self.session.camera = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
            self.set_box(tuple(round(float(v), 1) for v in scene.box))

    def set_box(self, box: Any) -> None:
        """Set the box; None: the object is searched in the whole photograph."""
        self.drawing.set(box)
        self.session.box = self.drawing.box

    def serve(self, name: str, content: bytes, media_type: str) -> str:
        """Put a file on the server; returns its address relative to the page, which is new each time."""
        self.version += 1
        self.files[name] = (content, media_type)
        return f"{self.folder.name}/file/{name}?v={self.version}"


class Workspaces:
    """The workspaces of a server, at most :data:`~curvireg_torch.errors.MAX_VIEWER_PAGES`, and their folder."""

    def __init__(self, options: RegisterOptions, folder: Path) -> None:
        self.options, self.folder, self.items = options, folder, dict[str, Workspace]()

    def join(self, name: str) -> Workspace | None:
        """The workspace of a page that was opened, loaded again or left within a day; None if there is no place."""
        self.sweep()
        if name not in self.items:
            if len(self.items) >= MAX_VIEWER_PAGES and not self._drop_the_first_left():
                return None
            self.items[name] = Workspace(Session(self.options), self.folder / name)
        self.items[name].pages += 1
        return self.items[name]

    def leave(self, name: str) -> None:
        """A page was closed; its workspace waits for it, but gives up its place if another page needs it."""
        workspace = self.items[name]
        workspace.pages, workspace.left = workspace.pages - 1, time.monotonic()

    def sweep(self) -> None:
        """Stop the searches of pages that do not come back, and remove what was left a day ago."""
        for name, workspace in list(self.items.items()):
            away = time.monotonic() - workspace.left if workspace.pages == 0 else 0.0
            if away > GRACE_SECONDS:
                workspace.stop()
            if away > KEPT_SECONDS:
                self._remove(name)

    def close(self) -> None:
        """Stop all searches and remove the folder."""
        for name in list(self.items):
            self._remove(name)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _drop_the_first_left(self) -> bool:
        left = [name for name, workspace in self.items.items() if workspace.pages == 0]
        if left:
            self._remove(min(left, key=lambda name: self.items[name].left))
        return bool(left)

    def _remove(self, name: str) -> None:
        workspace = self.items.pop(name)
        workspace.stop()
        shutil.rmtree(workspace.folder, ignore_errors=True)
