"""Pages of the documentation say what is there: names, options, files, links, and a text for every picture."""

import argparse
import inspect
import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest
from torch import nn

import curvireg_torch
from curvireg_torch import cli
from curvireg_torch.cli.evaluate import add_datasets

from .._support.pages import DOCS, MADE, PAGES, ROOT, steps, words_of

SOURCES = [*PAGES, *DOCS.glob("gallery/*.py")]

by_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))


def slug(heading: str) -> str:
    """The anchor that GitHub and MyST give a heading."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
    return re.sub(r"[^\w\- ]", "", text.replace("`", "")).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)}


def links(page: Path) -> list[str]:
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.findall(r"\]\(([^)\s]+)\)", text)


@by_page
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{link}: no such file"
        if anchor:
            assert anchor in anchors(target), f"{link}: no such heading"


@by_page
def test_pictures_have_a_text(page: Path) -> None:
    for told in re.findall(r"!\[([^]]*)\]\(", page.read_text(encoding="utf-8")):
        assert len(told.split()) >= 3, f"a picture is described by {told!r}"


def test_every_page_is_in_the_contents() -> None:
    listed = set()
    for page in DOCS.rglob("*.md"):
        for contents in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL):
            entries = [line for line in contents.splitlines() if line and not line.startswith(":")]
            listed |= {(page.parent / f"{entry}.md").resolve() for entry in entries}
    pages = {p.resolve() for p in PAGES if DOCS in p.parents and p != DOCS / "index.md"}
    assert pages <= listed, sorted(p.name for p in pages - listed)
    for path in listed - pages:
        assert path.relative_to(DOCS).parts[0] in MADE, f"{path.name} is in the contents and not there"


def found(dotted: str) -> object:
    """What ``curvireg_torch.a.b`` is, by imports and attributes; None if it is nothing."""
    names = dotted.split(".")
    for count in range(1, len(names) + 1):  # attributes first: a function may bear the name of its module
        try:
            thing: object = import_module(".".join(names[:count]))
        except ImportError:
            return None
        for name in names[count:]:
            thing = getattr(thing, name, None)
        if thing is not None:
            return thing
    return None


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_names_that_are_spelt_out_exist(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    dotted = {f"curvireg_torch.{name}" for name in re.findall(r"(?<![\w.])cr\.([A-Za-z]\w*(?:\.\w+)*)", text)}
    dotted |= set(re.findall(r"(?<![\w/])(curvireg_torch(?:\.[A-Za-z_]\w*)+)(?!\w*/)", text))
    assert not [name for name in dotted if found(name) is None]
    for path in re.findall(
        r"(?<![\w/.])((?:curvireg_torch|scripts|tests|docs|datasets)/[\w./-]*\.(?:py|sh|md|png))\b", text
    ):
        assert (ROOT / path).is_file(), path


def test_the_reference_lists_every_name_of_the_package() -> None:
    page = (DOCS / "api" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"\{py:obj\}`(\w+) <([\w.]+)>`", page)
    assert sorted(name for name, _ in listed) == sorted(curvireg_torch.__all__)
    for name, place in listed:
        assert found(place) is getattr(curvireg_torch, name), place


LAYERS = sorted(
    {
        thing
        for package in ("filters", "descriptors", "detectors", "models")
        for name in import_module(f"curvireg_torch.{package}").__all__
        if inspect.isclass(thing := getattr(import_module(f"curvireg_torch.{package}"), name))
        and issubclass(thing, nn.Module)
    },
    key=lambda layer: layer.__name__,
)


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: layer.__name__)
def test_layers_have_args_shape_and_example_of_their_own(layer: type[nn.Module]) -> None:
    text = inspect.cleandoc(layer.__doc__ or "")
    sections = dict(re.findall(r"^(\w+):\n((?:    .*\n?|\n)+)", text, flags=re.MULTILINE))
    assert {"Args", "Shape", "Example"} <= set(sections)
    described = {
        name
        for line in re.findall(r"^    (\w[\w, ]*):", sections["Args"], flags=re.MULTILINE)
        for name in line.split(", ")
    }
    assert described == set(inspect.signature(layer).parameters)
    assert ">>>" in sections["Example"]


def commands(page: Path) -> list[list[str]]:
    """Those of a page that one of our own programs gets, split into words."""
    lines = [words_of(text) for kind, text in steps(page) if kind == "command"]
    return [words for words in lines if Path(words[0]).name in ("curvireg", "python", "torchrun")]


def parsed(words: list[str]) -> None:
    """Parse a command as its program does.

    Raises:
        SystemExit: it would not.
    """
    if Path(words[0]).name == "curvireg":
        cli._parser().parse_args(words[1:])
    elif "curvireg_torch.evaluation" in words:
        common = argparse.ArgumentParser(add_help=False)
        common.add_argument("--quiet", action="store_true")
        parser = argparse.ArgumentParser()
        add_datasets(parser.add_subparsers(required=True), [common])
        parser.parse_args(words[words.index("curvireg_torch.evaluation") + 1 :])
    elif words[1].endswith(".py"):
        text = (ROOT / words[1]).read_text(encoding="utf-8")
        for option in (word for word in words if word.startswith("--")):
            if f'"{option.split("=")[0]}"' not in text and option not in options():
                raise SystemExit(f"{words[1]} has no {option}")


@by_page
def test_commands_are_understood(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in commands(page):
        try:
            parsed(words)
        except SystemExit as error:
            pytest.fail(f"{shlex.join(words)}: {capsys.readouterr().err.splitlines()[-1:] or error}")


def options() -> set[str]:
    """Every option of the command line."""
    found: set[str] = set()
    waiting = [cli._parser()]
    while waiting:
        for action in waiting.pop()._actions:
            found |= set(action.option_strings)
            if isinstance(action, argparse._SubParsersAction):
                waiting += action.choices.values()
    return found


@by_page
def test_options_that_are_named_exist(page: Path) -> None:
    scripts = "".join(p.read_text(encoding="utf-8") for d in ("scripts", "datasets") for p in (ROOT / d).rglob("*.py"))
    known = options() | set(re.findall(r'"(--[\w-]+)"', scripts)) | {"--nproc-per-node", "--node-rank"}
    for option in re.findall(r"`(--[a-z][\w-]*)", page.read_text(encoding="utf-8")):
        assert option in known, option


def test_what_these_tests_find(tmp_path: Path) -> None:
    """Each of them sees what it is there to see."""
    page = tmp_path / "page.md"
    page.write_text(
        "# A `b` (c)\n[x](gone.md) [y](page.md#a-b-c) [z](#no)\n`[code](not.md)`\n\n```bash\ncurvireg bank\n"
        "torchrun --nproc-per-node 2 \\\n  -m curvireg_torch.evaluation web D --out R --jobs 2\n```\n"
        "`python scripts/results_table.py DATA --out R --no`\n"
    )
    assert links(page) == ["gone.md", "page.md#a-b-c", "#no"]
    assert anchors(page) == {"a-b-c"}
    bank, torchrun, script = commands(page)
    assert torchrun[-1] == "2"
    for words in (bank, script):
        with pytest.raises(SystemExit):
            parsed(words)
    assert found("curvireg_torch.registration.confidence.confidence_model") is not None
    assert found("curvireg_torch.Registar") is None
    assert "--box" in options()
    assert "--bocks" not in options()
