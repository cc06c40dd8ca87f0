"""What can be known here of Windows and macOS: no module needs what only Unix has, processes start
by "spawn", and paths with drives and backslashes are understood."""

import ast
import os
import pickle
import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path, PureWindowsPath

import pytest
import torch

from curvireg_torch.data.cameras import load_camera
from curvireg_torch.formats.boxes import BoxFile, PictureSize
from curvireg_torch.formats.masks import mask_file
from curvireg_torch.formats.meshes.source import MeshSource
from curvireg_torch.utils.files import split_name
from tests._support import CAMERA, scene, truck_registrar

ROOT = Path(__file__).parents[1]
UNIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
UNIX_NAMES = {"fork", "forkpty", "getuid", "geteuid", "chown", "mkfifo", "setsid", "wait4"}
SOURCES = sorted([*ROOT.glob("curvireg_torch/**/*.py"), *ROOT.glob("scripts/**/*.py")])


def on_import(tree):
    """Statements that an import runs, and does not catch; not those of functions."""
    waiting = list(tree.body)
    found = []
    while waiting:
        statement = waiting.pop()
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.Try):
            continue
        if isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.unparse(statement.test):
            continue
        found.append(statement)
        for name in ("body", "orelse"):
            children = getattr(statement, name, [])
            waiting += children if isinstance(children, list) else []
    return found


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_module_needs_what_only_unix_has(source):
    tree = ast.parse(source.read_text(encoding="utf-8"))
    for statement in on_import(tree):
        names = []
        if isinstance(statement, ast.Import):
            names = [alias.name for alias in statement.names]
        elif isinstance(statement, ast.ImportFrom):
            names = [statement.module or ""]
        assert not UNIX_MODULES & {name.partition(".")[0] for name in names}
    if source.is_relative_to(ROOT / "curvireg_torch"):
        used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not UNIX_NAMES & used


WITHOUT_UNIX = f"""
import importlib, os, pkgutil, signal, sys
import torch, trimesh, cv2, scipy.optimize, kornia  # they look at the system themselves
for name in {sorted(UNIX_MODULES - {"posix"})}:
    sys.modules[name] = None
for name in {sorted(UNIX_NAMES)}:
    vars(os).pop(name, None)
for name in ("SIGHUP", "SIGPIPE", "SIGALRM", "SIGUSR1"):
    vars(signal).pop(name, None)
import curvireg_torch
skipped = (
    "curvireg_torch.formats.meshes.step_parts",
    "curvireg_torch.formats.meshes.usd_parts",
    "curvireg_torch.viewer",
)
for module in pkgutil.walk_packages(curvireg_torch.__path__, "curvireg_torch."):
    if not module.name.startswith(skipped):
        importlib.import_module(module.name)
from curvireg_torch.cli import main
sys.exit(main(["cache"]))
"""


@pytest.mark.slow
def test_the_package_runs_without_the_modules_of_unix(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CURVIREG_CACHE": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_UNIX],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


def registered(registrar):
    """The pose in a generated photograph; a function that a spawned process can find."""
    torch.set_num_threads(1)
    image, box, _ = scene(0)
    (result,) = registrar([image], box[None], CAMERA)
    return result.transform.flatten().tolist()


@pytest.mark.slow
def test_a_spawned_process_gives_the_same_pose():
    """As on Windows and macOS, nothing is inherited: the registrar is sent."""
    registrar = truck_registrar()
    expected = registered(pickle.loads(pickle.dumps(registrar)))
    with get_context("spawn").Pool(1) as pool:
        found = pool.apply(registered, (registrar,))
    assert found == expected


@pytest.mark.parametrize("name", ["C:\\shots\\boxes.json", "D:/shots/boxes.json"])
def test_drives_are_no_names_within_files(tmp_path, monkeypatch, name):
    """FILE:NAME of a path with a drive; there is a file of this name, as there can be here too."""
    monkeypatch.chdir(tmp_path)
    file = Path(name)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(
        '{"left": {"fx": 50, "fy": 50, "cx": 3, "cy": 4},'
        ' "right": {"fx": 60, "fy": 60, "cx": 3, "cy": 4}}'
    )
    assert split_name(name) == (file, "")
    assert split_name(f"{name}:7") == (file, "7")
    assert mask_file(name) == (file, None)
    assert mask_file(f"{name}:2") == (file, 2)
    assert float(load_camera(f"{name}:right").matrix[0, 0]) == 60.0
    file.write_text('[{"image_id": "a", "bbox": [10, 20, 30, 40], "category_id": 3}]')
    assert BoxFile(f"{name}:3").box(Path("a.jpg"), lambda: PictureSize((48, 64))) == (
        9.5,
        19.5,
        39.5,
        59.5,
    )
    assert split_name(f"{name}.txt") == (Path(f"{name}.txt"), ""), "it does not exist"


@pytest.mark.parametrize(
    "name",
    [
        "C:\\art\\print.png",
        "\\\\server\\art\\print.png",
        "..\\..\\print.png",
        "art\\..\\..\\print.png",
    ],
)
def test_textures_with_backslashes_stay_in_the_folder(tmp_path, name):
    """By the rules of Windows these lead out of the folder; of absolute ones the last part
    counts."""
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "print.png").touch()
    source = MeshSource(folder / "a.obj")
    found = source.find(name)
    is_absolute = bool(PureWindowsPath(name).anchor)
    assert found == (folder.resolve() / "print.png" if is_absolute else None)
