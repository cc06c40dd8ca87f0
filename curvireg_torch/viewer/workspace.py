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

GRACE_SECONDS = 30.0
"""Seconds after which the search of a closed page is stopped; a reload takes less."""

MAX_NAME = 120
"""Characters of the name of an uploaded file."""

HEAD_BYTES = 16
"""Bytes from the start of a file that tell what it is."""

DIRECTORY_BYTES = 1024
"""Largest mean size of an entry in the directory of a zip archive."""

_SAMPLE_OPTIONS: dict[str, Any] = {"unit": "m", "up": None, "pose": "upright"}
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
        messages: what is wrong with, or remarkable about, a part of the work: "file", "photograph", "mesh" or "pose".
        files: pictures and downloads by name, with their media types.
        receiving: names of files that are being received.
        mesh_facts: the mesh in words.
        loaded: whether the files of the command line were opened.
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
        self._version, self._started = 0, 0.0
        self._bytes: dict[Path, int] = {}
        self._lock, self._searches = asyncio.Lock(), searches
        self._search: asyncio.Task[None] | None = None
        self._before_sample: dict[str, Any] = {}  # options that the sample changed
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def searching(self) -> bool:
        """Whether a registration waits or runs."""
        return self._search is not None

    @property
    def seconds(self) -> float:
        """Since the search began, or was put into the queue."""
        return time.monotonic() - self._started

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
            self._started, self.waiting = time.monotonic(), True
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
            self.session.cancel()

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
        if kind == "photograph":
            if await self.open_photo(path, name):
                self._leave_sample("pose")
            return
        if kind == "archive":
            parts = path.with_name("parts")
            path = await self.run("mesh", lambda: unpack(path, parts, name))
            self._bytes[parts.parent] = sum(p.stat().st_size for p in parts.parent.rglob("*") if p.is_file())
            if not path:
                return
            name = str(path.relative_to(parts))
        before = self.session.options, dict(self._before_sample)
        self._leave_sample("unit", "up", "pose")
        if not await self.open_mesh(path, name):
            self.session.options, self._before_sample = before

    def _remove_unused(self) -> None:
        """Remove uploaded files that were replaced or refused."""
        used = [path for path in (self.session.photo_path, self.session.mesh_path) if path is not None]
        for folder in self._bytes.keys() - self.receiving.keys():
            if not any(folder in path.parents for path in used):
                shutil.rmtree(folder)
                self._bytes.pop(folder)
                names = self.session.names
                self.session.names = {path: name for path, name in names.items() if folder not in path.parents}

    async def open_photo(self, path: Path, name: str) -> bool:
        """Replace the photograph; a search in the former one is stopped. Returns whether it could be read."""
        return bool(await self._open("photograph", lambda: self.session.open_photo(path, name)))

    async def open_mesh(self, path: Path, name: str) -> bool:
        """Replace the mesh; a search for the former one is stopped. Returns whether it could be read."""
        facts = await self._open("mesh", lambda: self.session.open_mesh(path, name))
        self.mesh_facts = facts or self.mesh_facts
        return bool(facts)

    async def _open(self, part: str, job: Callable[[], Any]) -> Any:
        async with self._lock:  # no search begins before it is open
            if self._search is not None and not self.waiting:
                self.stop()
                await asyncio.wait({self._search})
            if opened := await self._attempt(part, job):
                self.messages.pop("pose", None)
            return opened

    def _leave_sample(self, *names: str) -> None:
        """Bring back options that the sample has changed, unless the user did since."""
        for name in names:
            if name in self._before_sample:
                own = self._before_sample.pop(name)
                if getattr(self.session.options, name) == _SAMPLE_OPTIONS[name]:
                    self.session.options = replace(self.session.options, **{name: own})

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
            for option in _SAMPLE_OPTIONS:
                self._before_sample.setdefault(option, getattr(self.session.options, option))
            self.session.options = replace(self.session.options, **_SAMPLE_OPTIONS)
            await self.open_photo(photo, photo.name)
            await self.open_mesh(mesh, mesh.name)
            K = scene.camera_matrix
            self.session.camera = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
            x0, y0, x1, y1 = (round(float(v), 1) for v in scene.box)
            self.session.box, self.session.fov = (x0, y0, x1, y1), None

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
    """The name of an uploaded file without folders and control characters.

    Example:
        >>> file_name("C:\\\\parts\\\\wheel.stl")
        'wheel.stl'
    """
    name = "".join(c for c in re.split(r"[/\\]", text)[-1] if c.isprintable()).strip()
    return name[-MAX_NAME:] or "file"


def identify(name: str, head: bytes) -> tuple[str, str]:
    """Whether a file is a "photograph", a "mesh" or an "archive", and the suffix of its format ("" of photographs).

    The content decides, then the name: a part that is called ``wheel.jpg`` by mistake is still a mesh.

    Args:
        name: of the file.
        head: its first :data:`HEAD_BYTES` bytes.

    Raises:
        InvalidInputError: it is none of them.

    Example:
        >>> identify("part", b"ply\\nformat ascii 1.0")
        ('mesh', '.ply')
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

    Names that lead outside stay inside, as ``zipfile`` removes ``..`` and drives.

    Args:
        archive: the file.
        folder: that is created.
        name: what the user calls the archive, for messages.

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
