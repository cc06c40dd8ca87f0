"""Links, names, options and commands on the documentation's pages exist, and the page of messages
is made."""

import importlib.util
import inspect
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import curvireg_torch

from .._support.pages import DOCS, PAGES, ROOT

SOURCES = [*PAGES, *DOCS.rglob("gallery/**/*.py")]
PATHS = (
    r"(?<![\w/.])((?:curvireg_torch|scripts|tests|docs|datasets)/[\w./-]*\.(?:py|sh|md|png|csv))\b"
)
GENERATED = r"<!-- ([\w ]+):begin -->.*?<!-- \1:end -->"


def without_code(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def anchor(heading: str) -> str:
    """The anchor that GitHub and MyST derive from a heading."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
    return re.sub(r"[^\w\- ]", "", text.replace("`", "")).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_resolve(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", without_code(page))):
        if re.match(r"\w+:", link):
            continue
        path, _, name = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{link}: no such file"
        headings = (
            re.findall(r"^#+ (.*)$", without_code(target), flags=re.MULTILINE) if name else []
        )
        assert not name or name in map(anchor, headings), f"{link}: no such heading"


def resolve(dotted: str) -> object:
    """The object that ``curvireg_torch.a.b`` names; None if there is none."""
    names = dotted.split(".")
    # attributes first: a function may have the name of its module
    for count in range(1, len(names) + 1):
        try:
            found: object = import_module(".".join(names[:count]))
        except ImportError:
            return None
        for name in names[count:]:
            found = getattr(found, name, None)
        if found is not None:
            return found
    return None


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_dotted_names_and_paths_exist(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    dotted = {
        f"curvireg_torch.{name}"
        for name in re.findall(r"(?<![\w.])cr\.([A-Za-z]\w*(?:\.\w+)*)", text)
    }
    dotted |= set(re.findall(r"(?<![\w/])(curvireg_torch(?:\.[A-Za-z_]\w*)+)(?!\w*/)", text))
    assert not [name for name in dotted if resolve(name) is None]
    # records keep the paths of their commit
    written_by_hand = re.sub(GENERATED, "", text, flags=re.DOTALL)
    assert not [path for path in re.findall(PATHS, written_by_hand) if not (ROOT / path).is_file()]


def test_reference_lists_every_public_name() -> None:
    page = (DOCS / "api" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"\{py:obj\}`(\w+) <([\w.]+)>`", page)
    public = {
        name
        for name in curvireg_torch.__all__
        if not inspect.ismodule(getattr(curvireg_torch, name))
    }
    assert {name for name, _ in listed} == public - {"__version__"}
    for name, dotted in listed:
        assert resolve(dotted) is getattr(curvireg_torch, name), dotted


def module_of_docs(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_commands_is_current():
    """``python docs/command_reference.py`` writes it."""
    page = module_of_docs("command_reference").page()
    assert (DOCS / "commands.md").read_text(encoding="utf-8") == page
    for heading in ("register", "evaluate bop", "plot overlay", "cache"):
        assert f"\n## curvireg {heading}\n" in page
    for option in ("--top TOP", "--no-refine", "--every N", "--quiet", "--out DIR"):
        assert f"| `{option}` |" in page


SEARCHED = {
    "STEP": "guides/unit-and-up.md",
    "HEIC": "guides/photographs.md",
    "URDF": "guides/unit-and-up.md",
    "Unity": "guides/blender-unity.md",
    "Blender": "guides/blender-unity.md",
    "ONNX": "guides/layers.md",
    "unknown focal length": "guides/no-camera.md",
}


@pytest.mark.parametrize(("word", "page"), SEARCHED.items())
def test_what_people_search_for_is_on_its_page(word: str, page: str) -> None:
    assert word in (DOCS / page).read_text(encoding="utf-8")


def test_messages_are_listed_with_what_to_do():
    module = module_of_docs("messages")
    photographs, meshes = module.page(ROOT / "curvireg_torch").split("## Meshes")
    assert "| frame … cannot be read | save the video again |" in photographs  # an f-string
    assert "| every face is degenerate (area 0) | repair the mesh |" in meshes
    assert "give --camera FX FY CX CY, --camera FILE (a calibration)" in meshes, (
        "a constant of another module"
    )
