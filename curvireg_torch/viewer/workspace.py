"""What a page works on: it outlives the page, so that a reload finds everything again. It needs no NiceGUI."""

import asyncio
import os
import re
import shutil
import struct
import time
import traceback
import zipfile
from collections.abc import AsyncIterator, Callable
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import (
    MAX_ARCHIVE_FILES,
    MAX_MESH_BYTES,
    MAX_VIEWER_BYTES,
    MAX_VIEWER_PAGES,
    MAX_VIEWER_UPLOADS,
    CurviregError,
    InvalidInputError,
)
from ..evaluation.opening import RegisterOptions
from ..synthetic import demo_scene
from ..utils.choices import IMAGES, MESHES, MESHES_AND_BANKS
from ..utils.files import write_file
from ..visualization.encoding import png
from ..visualization.overlay import to_uint8
from .session import Session

__all__ = ["Workspace", "Workspaces", "file_name", "identify", "show_warning", "unpack"]

GRACE_SECONDS = 30.0  # after which the search of a closed page is stopped; a reload takes less
MAX_NAME = 120  # characters of the name of an uploaded file
HEAD_BYTES = 16  # from the start of a file, which tell what it is
DIRECTORY_BYTES = 1024  # largest mean size of an entry in the directory of a zip archive

_IMAGE_STARTS = (
    *(b"\xff\xd8", b"\x89PNG", b"II*\0", b"MM\0*", b"RIFF", b"BM", b"P2", b"P3", b"P5", b"P6"),
    *(b"GIF8", b"\xff\x0a", b"\0\0\0\x0cJXL", b"\0\0\0\x0cjP"),
)
_MESH_STARTS = {b"glTF": ".glb", b"ply": ".ply", b"OFF": ".off", b"COFF": ".off", b"solid": ".stl"}
_caught: ContextVar[list[Any]] = ContextVar("caught")


def show_warning(message: Any, *_: Any, **__: Any) -> None:
    """Collect the warnings of a job, for its page; replaces ``warnings.showwarning``."""
    _caught.get([]).append(message)


class Workspace:
    """Photograph, mesh, box, answer and messages of a page.

    Attributes:
        session: inputs and results.
        messages: what is wrong with, or remarkable about, a part of the work: "file", "photograph", "mesh", "pose" or
            the "page" itself.
        files: pictures and downloads by name, with their media types.
        receiving: names of files that are being received.
        mesh_facts: the mesh in words.
        loaded: whether the files of the command line were opened.
        started: when the search began or was put into the queue, in seconds of ``time.monotonic``.
        waiting: whether a search waits for those of other pages.
        pages: browser windows that show it.
        left: when one of them was closed last, in seconds of ``time.monotonic``.
    """

    def __init__(self, session: Session, folder: Path, searches: asyncio.Semaphore) -> None:
        self.session, self.folder = session, folder
        self.messages: dict[str, str] = {}
        self.files: dict[str, tuple[bytes, str]] = {}
        self.receiving: dict[Path, str] = {}
        self.mesh_facts, self.loaded, self.waiting, self.pages, self.left = "", False, False, 0, time.monotonic()
        self._version, self.started = 0, 0.0
        self._bytes: dict[Path, int] = {}
        self._lock, self._searches = asyncio.Lock(), searches
        self._search: asyncio.Task[None] | None = None
        self._before_sample: RegisterOptions | None = None
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def searching(self) -> bool:
        """Whether a registration waits or runs."""
        return self._search is not None

    async def run(self, part: str, job: Callable[[], Any]) -> Any:
        """Run a short job in a thread; returns its result or True, and None after an error, which becomes a message."""
        async with self._lock:
            return await self._attempt(part, job)

    async def _attempt(self, part: str, job: Callable[[], Any]) -> Any:
        self.messages.pop(part, None)
        caught: list[Any] = []
        _caught.set(caught)
        try:
            result = await asyncio.to_thread(job)
            if caught:
                self.messages[part] = "; ".join(map(self.session.describe_warning, caught))
            return True if result is None else result
        except (CurviregError, OSError) as error:
            self.messages[part] = str(error)
        except Exception as error:  # a defect must not end the page; the terminal has the traceback
            traceback.print_exc()
            self.messages[part] = f"{type(error).__name__}: {error}; see the terminal"
        return None

    def start_search(self) -> asyncio.Task[None]:
        """Find the pose as soon as files are open and no other page searches; one search of a page at a time."""
        if self._search is None:
            self.session.progress, self.session.cancelled = ("", 0, 1), False
            self.started, self.waiting = time.monotonic(), True
            self._search = asyncio.create_task(self._find())
        return self._search

    async def _find(self) -> None:
        try:
            async with self._lock:  # a photograph or a mesh may be opening
                pass
            async with self._searches:
                self.waiting = False
                await self._attempt("pose", self.session.register)
        except asyncio.CancelledError:
            self.messages["pose"] = "stopped"
        finally:
            self._search, self.waiting = None, False

    def stop(self) -> None:
        """End the search at its next step, or take it out of the queue."""
        if self._search is not None and self.waiting:
            self._search.cancel()
        elif self._search is not None:
            self.session.cancelled = True

    def stop_if_left(self) -> None:
        """End the search if no window shows the page any more."""
        if self.pages == 0:
            self.stop()

    async def receive(self, name: str, size: int, blocks: AsyncIterator[bytes]) -> None:
        """Store a file of ``size`` bytes and open it as a photograph or a mesh.

        Raises:
            InvalidInputError: the page has received too much.
        """
        if len(self.receiving) >= MAX_VIEWER_UPLOADS or sum(self._bytes.values()) + size > MAX_VIEWER_BYTES:
            raise InvalidInputError(f"{name}: too many files at a time; wait for the others")
        self._version += 1
        folder = self.folder / f"upload-{self._version}"
        folder.mkdir()
        self.receiving[folder], self._bytes[folder] = name, size
        try:
            with (folder / "file").open("wb") as file:
                async for block in blocks:
                    await asyncio.to_thread(file.write, block)
            await self._open_upload(folder / "file", name)
        finally:
            self.receiving.pop(folder)
            self._remove_unused()

    async def _open_upload(self, path: Path, name: str) -> None:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        try:
            kind, suffix = identify(name, head)
        except InvalidInputError as error:
            self.messages["file"] = str(error)
            return
        self.messages.pop("file", None)
        path = path.rename(path.with_suffix(suffix))
        self._leave_sample()
        if kind == "photograph":
            await self.open_photo(path, name)
        elif kind == "mesh":
            await self.open_mesh(path, name)
        elif mesh := await self.run("mesh", lambda: unpack(path, path.with_name("parts"), name)):
            await self.open_mesh(mesh, str(mesh.relative_to(path.with_name("parts"))))
            self._bytes[path.parent] = sum(p.stat().st_size for p in path.parent.rglob("*") if p.is_file())

    def _remove_unused(self) -> None:
        """Remove uploaded files that were replaced or refused."""
        used = [path for path in (self.session.photo_path, self.session.mesh_path) if path is not None]
        for folder in self._bytes.keys() - self.receiving.keys():
            if not any(folder in path.parents for path in used):
                shutil.rmtree(folder)
                self._bytes.pop(folder)
                names = self.session.names
                self.session.names = {path: name for path, name in names.items() if folder not in path.parents}

    async def open_photo(self, path: Path, name: str) -> None:
        """Replace the photograph; a search in the former one is stopped."""
        await self._open("photograph", lambda: self.session.open_photo(path, name))

    async def open_mesh(self, path: Path, name: str) -> None:
        """Replace the mesh; a search for the former one is stopped."""
        self.mesh_facts = await self._open("mesh", lambda: self.session.open_mesh(path, name)) or self.mesh_facts

    async def set_option(self, name: str, value: Any) -> None:
        """Change an option; the mesh is opened again if it depends on it."""
        self.session.options = replace(self.session.options, **{name: value})
        path = self.session.mesh_path
        if name in ("unit", "up") and path is not None:
            await self.open_mesh(path, self.session.names[path])

    async def _open(self, part: str, job: Callable[[], Any]) -> Any:
        async with self._lock:  # no search begins before it is open
            if self._search is not None and not self.waiting:
                self.stop()
                await asyncio.wait({self._search})
            if opened := await self._attempt(part, job):
                self.messages.pop("pose", None)
            return opened

    def _leave_sample(self) -> None:
        """Close the sample and bring back the options of before it, as one's own files replace it."""
        if self._before_sample is not None:
            self.session.close()
            self.session.options, self._before_sample = self._before_sample, None

    async def load(self) -> None:
        """Open the files that the options name."""
        self.loaded = True
        self.mesh_facts = await self.run("file", self.session.load) or ""

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
            self._before_sample = self._before_sample or self.session.options
            self.session.options = replace(self.session.options, unit="m", up=None, pose="upright", limits=None)
            await self.open_photo(photo, photo.name)
            await self.open_mesh(mesh, mesh.name)
            K = scene.camera_matrix
            self.session.camera = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
            x0, y0, x1, y1 = (round(float(v), 1) for v in scene.box)
            self.session.box, self.session.guess = (x0, y0, x1, y1), None

    def serve(self, name: str, content: bytes, media_type: str) -> str:
        """Put a file on the server; returns its address relative to the page, which is new each time."""
        self._version += 1
        self.files[name] = (content, media_type)
        return f"{self.folder.name}/file/{name}?v={self._version}"


class Workspaces:
    """The workspaces of a server, at most :data:`~curvireg_torch.errors.MAX_VIEWER_PAGES`, and their folder."""

    def __init__(self, options: RegisterOptions, folder: Path) -> None:
        self.options, self.folder, self.items = options, folder, dict[str, Workspace]()
        self.searches = asyncio.Semaphore(max(1, (os.cpu_count() or 1) // 4))

    def join(self, name: str) -> Workspace | None:
        """The workspace of a page that was opened or loaded again; None if there is no place for it."""
        if name not in self.items:
            left = [other for other, workspace in self.items.items() if workspace.pages == 0]
            if len(self.items) >= MAX_VIEWER_PAGES and not left:
                return None
            if len(self.items) >= MAX_VIEWER_PAGES:
                self._remove(min(left, key=lambda other: self.items[other].left))
            self.items[name] = Workspace(Session(self.options), self.folder / name, self.searches)
        self.items[name].pages += 1
        return self.items[name]

    def leave(self, name: str) -> None:
        """A page was closed; its workspace waits for it, but gives up its place if another page needs it."""
        workspace = self.items[name]
        workspace.pages, workspace.left = workspace.pages - 1, time.monotonic()
        asyncio.get_running_loop().call_later(GRACE_SECONDS, workspace.stop_if_left)

    def close(self) -> None:
        """Stop all searches and remove the folder."""
        for name in list(self.items):
            self._remove(name)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _remove(self, name: str) -> None:
        workspace = self.items.pop(name)
        workspace.stop()
        shutil.rmtree(workspace.folder, ignore_errors=True)


def file_name(text: str) -> str:
    """Return the name of an uploaded file without folders and control characters."""
    name = "".join(c for c in re.split(r"[/\\]", text)[-1] if c.isprintable()).strip()
    return name[-MAX_NAME:] or "file"


def identify(name: str, head: bytes) -> tuple[str, str]:
    """Return whether a file is a "photograph", a "mesh" or an "archive", and the suffix of its format.

    Its first bytes decide, then its name: a part that is called ``wheel.jpg`` by mistake is still a mesh.

    Raises:
        InvalidInputError: it is none of them.
    """
    suffix = Path(name).suffix.lower()
    if head.startswith(b"PK\3\4"):
        return "archive", ".zip"
    for start, format_suffix in _MESH_STARTS.items():
        if head.startswith(start):
            return "mesh", format_suffix
    if head.startswith(_IMAGE_STARTS) or head[4:8] == b"ftyp":
        return "photograph", ""
    if suffix in MESHES_AND_BANKS:
        return "mesh", suffix
    if suffix in IMAGES:
        return "photograph", ""
    raise InvalidInputError(
        f"{name}: neither a photograph (JPEG, PNG, TIFF, WebP, BMP, PGM or PPM) nor a mesh "
        f"({', '.join(MESHES)}, or a zip archive of one with its materials, pictures and buffers)"
    )


def unpack(archive: Path, folder: Path, name: str) -> Path:
    """Unpack a zip archive into a new folder; returns the path of the only mesh in it.

    Names that lead outside stay inside, as ``zipfile`` removes ``..`` and drives. Messages call the archive ``name``.

    Raises:
        InvalidInputError: it is damaged, too large, encrypted, or does not hold one mesh.
    """
    try:
        with archive.open("rb") as file:
            file.seek(-min(archive.stat().st_size, 1 << 16), os.SEEK_END)
            end = file.read()
        at = end.rfind(b"PK\5\6")  # before zipfile reads the whole directory
        if at >= 0 and struct.unpack_from("<I", end, at + 12)[0] > MAX_ARCHIVE_FILES * DIRECTORY_BYTES:
            raise InvalidInputError(f"{name}: more than {MAX_ARCHIVE_FILES:,} files")
        with zipfile.ZipFile(archive) as content:
            members = content.infolist()
            if len(members) > MAX_ARCHIVE_FILES:
                raise InvalidInputError(f"{name}: {len(members):,} files, more than {MAX_ARCHIVE_FILES:,}")
            total = sum(member.file_size for member in members)
            if total > MAX_MESH_BYTES:
                raise InvalidInputError(f"{name}: {total:,} bytes when unpacked, more than {MAX_MESH_BYTES:,}")
            content.extractall(folder)  # at most the bytes that the headers claim
    except (
        zipfile.BadZipFile,
        struct.error,
        EOFError,
        NotImplementedError,
        RuntimeError,
        ValueError,
        OSError,
    ) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{name}: the archive cannot be unpacked; pack it again, without a password") from None
    meshes = [p for p in folder.rglob("*") if p.suffix.lower() in MESHES and not p.name.startswith("._")]
    if len(meshes) != 1:
        found = "no mesh" if not meshes else "several meshes: " + ", ".join(p.name for p in meshes[:4])
        raise InvalidInputError(f"{name}: {found}; put one of {', '.join(MESHES)} with its parts into it")
    return meshes[0]
