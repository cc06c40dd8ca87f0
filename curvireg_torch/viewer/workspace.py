"""The work that the windows of the page show, and the files that it receives. It needs no
NiceGUI."""

import asyncio
import errno
import shutil
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import AsyncIterator, Callable, Sequence
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

from ..data import load_camera
from ..errors import (
    MAX_ARCHIVE_FILES,
    MAX_MESH_BYTES,
    MAX_VIEWER_BYTES,
    CurviregError,
    InvalidInputError,
    OutputError,
)
from ..jobs.options import RegisterOptions
from ..utils.choices import IMAGES, MESHES, MESHES_AND_BANKS, VIDEOS
from .examination import Examination
from .parts import PARTS, WAITING, place_part
from .session import STATIC, UNPACKED, Session

CALIBRATIONS = (".yaml", ".yml", ".xml", ".json", ".txt")
STALL_SECONDS = 60.0  # without a byte, after which an upload has failed
MAX_ARCHIVE_DEPTH = 32  # folders around a file in a zip archive
DIRECTORY_BYTES = 1024  # largest mean size of an entry in the directory of a zip archive
RIG_PARTS = ("cameras.txt", "scene_gt.json", "scene_gt_info.json")
SAMPLE_CREDIT = (
    "photograph by Rachel Michetti, courtesy of Pikolo Espresso Bar (CC0); the mesh was modelled "
    "after it"
)
SAMPLE_BOX = (172.0, 18.0, 409.0, 308.0)  # of the cup, in px
SAMPLE_OPTIONS: dict[str, Any] = {
    "unit": "mm",
    "up": None,
    "pose": "upright",
    "limits": {},
    "mesh_is": None,
    "camera": 30.0,  # estimated from the ellipses in the photograph
}

_caught: ContextVar[list[Any]] = ContextVar("caught")


def show_warning(message: Any, *_: Any, **__: Any) -> None:
    """Collect the warnings of a job, for its page; replaces ``warnings.showwarning``."""
    _caught.get([]).append(message)


class Workspace:
    """Photographs, mesh, boxes, answers and messages; a reload finds them again.

    Attributes:
        session: inputs and results.
        examination: of the mesh.
        errors: about a part of the work: "file", "photograph", "rig", "mesh", "camera", "pose", or
            the "page" itself.
        files: pictures and downloads by name, with their media types.
        receiving: folders and names of files that are being received, and the bytes to come.
        started: when the search began, in seconds of ``time.monotonic``.
    """

    def __init__(self, options: RegisterOptions, folder: Path) -> None:
        self.session = Session(options, folder)
        self.examination = Examination(self.session)
        self.folder = folder
        self.errors: dict[str, str] = {}
        self.asks_for_unit = False
        self.refused_mesh: Path | None = None  # it may lack parts that come after it
        self._warnings: dict[str, str] = {}  # about what is open; they outlive an error
        self._pose_inputs: Any = None  # of the job whose message ``pose_message`` tells
        self.files: dict[str, tuple[bytes, str]] = {}
        self.receiving = dict[Path, tuple[str, int]]()
        self.started = 0.0
        self._version = 0
        self._lock = asyncio.Lock()
        self._search: asyncio.Task[None] | None = None
        self._begun = False  # whether the search has waited for the jobs before it
        self._before_sample: RegisterOptions | None = None

    @property
    def messages(self) -> dict[str, str]:
        """What is said about parts of the work: warnings, and errors below them."""
        both = self._warnings.keys() & self.errors.keys()
        joined = {part: f"{self._warnings[part]}\n{self.errors[part]}" for part in both}
        return {**self._warnings, **self.errors, **joined}

    @property
    def searching(self) -> bool:
        """Whether a registration runs."""
        return self._search is not None

    async def run(
        self, part: str, job: Callable[[], Any], *, stop: bool = False, keep: bool = False
    ) -> Any:
        """Run a short job in a thread, perhaps after the search has stopped.

        Returns its result or True, and None after an error, which becomes a message; errors of the
        jobs before it go, unless ``keep``.
        """
        async with self._lock:  # no search begins before it is done
            if stop and self._search is not None and self._begun:  # else it waits for this job
                self.stop()
                await asyncio.wait({self._search})
            if not keep:
                self.forget_errors(part)
            result = await self._attempt(part, job)
            self._remove_unused()
            return result

    def forget_errors(self, *parts: str) -> None:
        """Show only the warnings about parts of the work, by default about all of it."""
        for part in parts or tuple(self.errors):
            self.errors.pop(part, None)

    def pose_message(self) -> str:
        """What the last search, or job of its answer, has to say, where the inputs are its own."""
        is_of_these = self._pose_inputs == self.session.inputs()
        return self.messages.get("pose", "") if is_of_these else ""

    async def _attempt(self, part: str, job: Callable[[], Any]) -> Any:
        caught: list[Any] = []
        _caught.set(caught)
        inputs = self.session.inputs()
        try:
            result = await asyncio.to_thread(job)
            if part in ("photograph", "mesh", "rig"):  # what the search said is outdated
                self.errors.pop("pose", None)
                self._warnings.pop("pose", None)
            self._keep_warnings(part, caught)
            return True if result is None else result
        except CurviregError as error:
            self._show(part, str(error))
        except OSError as error:
            self._show(part, _of_this_machine(error))
        except Exception as error:  # a defect must not end the page; the terminal has the traceback
            traceback.print_exc()
            self._show(part, f"{type(error).__name__}: {error}; see the terminal")
        finally:
            if part == "pose":
                self._pose_inputs = inputs
        return None

    def _keep_warnings(self, part: str, caught: Sequence[Any]) -> None:
        """Show the warnings about what has been opened in place of those about what was open."""
        if part == "mesh":
            self.asks_for_unit = any(getattr(each, "kind", "") == "unit" for each in caught)
        self._warnings.pop(part, None)
        if caught:
            self._warnings[part] = self.session.without_folders("; ".join(map(str, caught)))

    def _show(self, part: str, message: str) -> None:
        """Show an error below those that stand there; uploaded files have their names alone."""
        shown = self.errors.get(part, "").splitlines()
        lines = [*shown, *self.session.without_folders(message).splitlines()]
        self.errors[part] = "\n".join(dict.fromkeys(lines))

    def start_search(self) -> asyncio.Task[None]:
        """Find the pose in the photograph that is shown, as soon as files are open; one search at a
        time."""
        if self._search is None:
            self.session.progress = ("", 0, 1)
            self.session.cancelled = False
            self.started = time.monotonic()
            self._begun = False
            self.examination.waits = True
            self._search = asyncio.create_task(self._find())
        return self._search

    async def _find(self) -> None:
        try:
            async with self._lock:  # a photograph or a mesh may be opening
                self._begun = True
            self.forget_errors("pose")
            await self._attempt("pose", self.session.register)
        finally:
            self._search = None

    def stop(self) -> None:
        """End the search at its next step."""
        self.session.cancelled = self.searching

    def close(self) -> None:
        """End the search, and remove the uploaded files."""
        self.stop()
        self.examination.close()
        for folder in self.folder.glob("upload-*"):
            shutil.rmtree(folder, ignore_errors=True)

    async def receive(
        self, name: str, size: int, blocks: AsyncIterator[bytes], *, is_first: bool = True
    ) -> None:
        """Store a file of ``size`` bytes, if there is room, and open it as a photograph, a mesh, a
        part of one or a calibration. ``is_first`` of those that come together, it lets the errors
        of former ones go."""
        if is_first:
            self.forget_errors()
        if not self._has_room(size):
            self.session.removed = None
            self._remove_unused()
        if not self._has_room(size):
            raise InvalidInputError(
                f"{name}: all files have more than {MAX_VIEWER_BYTES:,} bytes; remove photographs"
            )
        path = self._new_place(name)
        self.receiving[path.parent] = name, size
        try:
            await self._store(path, size, blocks)
            await self._open_upload(path)
        except OutputError:
            raise
        except OSError as error:
            self._show("file", f"{name}: {_of_this_machine(error)}")
        finally:
            del self.receiving[path.parent]
            self._remove_unused()

    def _has_room(self, size: int) -> bool:
        stored = sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())
        coming = sum(each for _, each in self.receiving.values())
        return stored + coming + size <= MAX_VIEWER_BYTES

    def _new_place(self, name: str) -> Path:
        """The path of an upload, in a folder of its own."""
        try:
            return Path(tempfile.mkdtemp(prefix="upload-", dir=self.folder), name)
        except OSError as error:
            raise _cannot_store(name, error) from error

    async def _store(self, path: Path, size: int, blocks: AsyncIterator[bytes]) -> None:
        received = 0
        try:
            with path.open("wb") as file:
                while block := await asyncio.wait_for(anext(blocks, b""), STALL_SECONDS):
                    received += len(block)
                    if received > size:  # in chunks, a request may send more than it has announced
                        raise InvalidInputError(
                            f"{path.name}: larger than announced; send it again"
                        )
                    await asyncio.to_thread(file.write, block)
                    self.receiving[path.parent] = path.name, size - received
        except TimeoutError:
            raise InvalidInputError(f"{path.name}: it did not arrive; send it again") from None
        except OSError as error:
            raise _cannot_store(path.name, error) from error

    async def _open_upload(self, path: Path) -> None:
        suffix = path.suffix.lower()
        session = self.session
        kinds = (*IMAGES, *MESHES_AND_BANKS, *CALIBRATIONS, ".csv", ".zip")
        if await self._add_to_mesh(path):
            return
        if suffix in kinds and self._before_sample is not None:
            await self.run("file", self._leave_sample, stop=True, keep=True)
        if suffix in VIDEOS:
            self._show("file", f"{path.name}: a video; curvireg follow {path.name} MESH follows it")
        elif suffix in PARTS:
            self._show("file", f"{path.name}: no open mesh names it; drop it with its mesh")
        elif suffix not in kinds:
            self._show(
                "file",
                f"{path.name}: neither a photograph (.jpg, .png, .heic, ...) nor a mesh (.obj, "
                f".stl, .glb, .zip, ...), a calibration (.yaml, .json, ...) or a rig (.csv, ...)",
            )
        elif suffix == ".csv" or path.name in ("images.txt", "scene_camera.json"):
            if path.name == "scene_camera.json" and session.options.unit in (None, "m"):
                await self.set_option("unit", "mm", is_given=False)  # of BOP sets
            await self.open_rig(path.parent if path.name == "scene_camera.json" else path)
        elif (
            (rig := session.rig_path) is not None
            and (not session.rig or path.name in RIG_PARTS)
            and suffix in CALIBRATIONS
        ):
            path.replace((rig if rig.is_dir() else rig.parent) / path.name)
            await self.run("rig", lambda: session.open_rig(session.rig_path), stop=True)
        elif suffix in CALIBRATIONS:
            await self.run(
                "camera", lambda: session.set_camera(load_camera(path)), stop=True, keep=True
            )
        elif suffix == ".zip":
            unpacked = partial(unpack, path, path.parent / UNPACKED)
            if mesh := await self.run("mesh", unpacked, keep=True):
                path.unlink()  # only its content counts
                await self.open_mesh(mesh, keep=True)
        elif suffix in MESHES_AND_BANKS:
            await self.open_mesh(path, keep=True)
        else:
            await self.open_photo(path, keep=True)

    async def _add_to_mesh(self, path: Path) -> bool:
        """Put a material, a picture or a buffer beside the mesh that names it, and open this again;
        False for any other file."""
        for mesh in (self.refused_mesh, self.session.mesh_path):
            if mesh is None or self.folder not in mesh.parents or path.suffix == mesh.suffix:
                continue
            if await asyncio.to_thread(place_part, path, mesh):
                self.forget_errors("mesh")
                await self.open_mesh(mesh)
                return True
        return False

    def _remove_unused(self) -> None:
        """Remove uploaded files that were replaced or refused."""
        session = self.session
        used = [
            path
            for path in (
                session.mesh_path,
                self.refused_mesh,
                session.rig_path,
                *(shot.path for shot in session.shots),
                *([session.removed[1].path] if session.removed else []),
            )
            if path
        ]
        for folder in set(self.folder.glob("upload-*")) - self.receiving.keys():
            if not any(folder in (path, *path.parents) for path in used):
                shutil.rmtree(folder)

    async def open_rig(self, path: Path | None) -> None:
        """Replace the rig; None: each photograph is registered alone."""
        await self.run("rig", lambda: self.session.open_rig(path), stop=True)

    async def open_photo(self, path: Path, *, keep: bool = False) -> None:
        """Add a photograph, and show it."""
        await self.run("photograph", lambda: self.session.open_photo(path), keep=keep)

    async def open_mesh(self, path: Path, *, keep: bool = False) -> None:
        """Replace the mesh; a search for the former one is stopped."""
        self.refused_mesh = path if path.suffix.lower() in WAITING else None
        opened = await self.run("mesh", lambda: self.session.open_mesh(path), stop=True, keep=keep)
        if opened is not None:
            self.refused_mesh = None
            self._remove_unused()

    async def remove_photo(self) -> None:
        """Close the photograph that is shown; a search in it is stopped."""
        shot = self.session.shot
        await self.run(
            "photograph",
            lambda: self.session.remove_photo(shot),
            stop=shot in self.session.searched,
        )

    async def restore_photo(self) -> None:
        """Open the photograph again that was removed last."""
        await self.run("photograph", self.session.restore_photo)

    async def set_option(self, name: str, value: Any, *, is_given: bool = True) -> None:
        """Change an option; the mesh is opened again if it depends on it. A unit ``is_given`` by
        the user, who means banks too, or follows from other files."""
        changes = {name: value}
        if name == "unit":
            changes["unit_is_given"] = is_given
        self.session.options = replace(self.session.options, **changes)
        if name in ("unit", "up") and self.session.mesh_path is not None:
            await self.open_mesh(self.session.mesh_path)

    def _leave_sample(self) -> None:
        """Close the sample and bring back the options of before it, as one's own files replace
        it."""
        if self._before_sample is not None:
            self.session.close()
            self.session.options = self._before_sample
            self._before_sample = None

    def load(self) -> None:
        """Open the files that the options name; their warnings become messages."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            self.session.load()
        self._keep_warnings("mesh", [warning.message for warning in caught])

    async def load_sample(self) -> None:
        """Open the photograph of the sample, its mesh and its box."""
        self.errors.clear()
        self._warnings.clear()
        self.asks_for_unit = False
        await self.run("file", self._open_sample, stop=True)

    def _open_sample(self) -> None:
        session = self.session
        self._before_sample = self._before_sample or session.options
        session.close()
        session.options = replace(session.options, **SAMPLE_OPTIONS)
        shot = session.open_photo(STATIC / "coffee.jpg", SAMPLE_BOX)
        assert shot.photo is not None
        shot.photo = replace(shot.photo, notes=(SAMPLE_CREDIT,))
        session.open_mesh(STATIC / "cup.ply")

    def serve(self, name: str, content: bytes, media_type: str) -> str:
        """Put a file on the server; returns its address relative to the page, which is new each
        time."""
        self._version += 1
        self.files[name] = (content, media_type)
        return f"file/{name}?v={self._version}"


def _of_this_machine(error: OSError) -> str:
    """What is said of an error of the system; its own text has paths of the machine."""
    return f"{error.strerror or error}; check the machine on which the page runs"


def _cannot_store(name: str, error: OSError) -> OutputError:
    """The error of a file for which there is no place."""
    advice = "make room on the machine on which the page runs, and send it again"
    return OutputError(f"{name}: cannot be stored ({error.strerror or error}); {advice}")


class _Archive(FileIO):
    """A zip archive of which no more than ``most`` bytes are read at a time, while ``zipfile``
    reads its directory: several records tell its size, and it becomes many times as large in
    memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.path = path
        self.most: int | None = MAX_ARCHIVE_FILES * DIRECTORY_BYTES

    def read(self, size: int | None = -1) -> bytes:
        """As of any file."""
        if self.most is None:
            return super().read(size) or b""
        wanted = self.most + 1 if size is None or size < 0 else min(size, self.most + 1)
        content = super().read(wanted) or b""
        if len(content) > self.most:
            message = f"more than {MAX_ARCHIVE_FILES:,} files; pack only the mesh and its parts"
            raise InvalidInputError(f"{self.path.name}: {message}")
        return content


def unpack(archive: Path, folder: Path) -> Path:
    """Unpack a zip archive into a new folder, which ``zipfile`` does not leave; return the path of
    the only mesh."""
    name = archive.name
    try:
        with _Archive(archive) as file, zipfile.ZipFile(file) as content:
            file.most = None
            members = content.infolist()
            if (
                len(members) > MAX_ARCHIVE_FILES
                or sum(member.file_size for member in members) > MAX_MESH_BYTES
                or any(member.filename.count("/") > MAX_ARCHIVE_DEPTH for member in members)
            ):
                raise InvalidInputError(
                    f"{name}: more than {MAX_ARCHIVE_FILES:,} files, {MAX_MESH_BYTES:,} bytes when "
                    f"unpacked, or {MAX_ARCHIVE_DEPTH} folders in one another; pack only the mesh "
                    f"and its parts"
                )
            content.extractall(folder)  # at most the bytes that the headers claim
    except InvalidInputError:
        raise
    except Exception as error:  # zipfile raises many kinds
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _cannot_store(name, error) from None
        raise InvalidInputError(
            f"{name}: the archive cannot be unpacked; pack it again, without a password"
        ) from None
    meshes = [
        p for p in folder.rglob("*") if p.suffix.lower() in MESHES and not p.name.startswith("._")
    ]
    robots = [path for path in meshes if path.suffix.lower() == ".urdf"]
    meshes = robots if len(robots) == 1 else meshes  # the others are those of its links
    if len(meshes) != 1:
        found = (
            "no mesh" if not meshes else "several meshes: " + ", ".join(p.name for p in meshes[:4])
        )
        raise InvalidInputError(
            f"{name}: {found}; put one of {', '.join(MESHES)} with its parts into it"
        )
    return meshes[0]
