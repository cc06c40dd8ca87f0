"""Links, names, options and commands on the documentation's pages exist, and the page of messages
is made."""

import importlib.util
import inspect
import json
import re
from importlib import import_module

import pytest

import curvireg_torch

from .._support.pages import DOCS, PAGES, ROOT

SOURCES = [*PAGES, *DOCS.rglob("gallery/**/*.py")]
PATHS = (
    r"(?<![\w/.])((?:curvireg_torch|scripts|tests|docs|datasets)/[\w./-]*\.(?:py|sh|md|png|csv))\b"
)
GENERATED = r"<!-- ([\w ]+):begin -->.*?<!-- \1:end -->"


def without_code(page):
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def anchor(heading):
    """The anchor that GitHub and MyST derive from a heading."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
    return re.sub(r"[^\w\- ]", "", text.replace("`", "")).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_resolve(page):
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


def resolve(dotted):
    """The object that ``curvireg_torch.a.b`` names; None if there is none."""
    names = dotted.split(".")
    # attributes first: a function may have the name of its module
    for count in range(1, len(names) + 1):
        try:
            found = import_module(".".join(names[:count]))
        except ImportError:
            return None
        for name in names[count:]:
            found = getattr(found, name, None)
        if found is not None:
            return found
    return None


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_dotted_names_and_paths_exist(source):
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


def test_reference_lists_every_public_name():
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


def module_of_docs(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_commands_is_current():
    """``python docs/command_reference.py`` writes it."""
    page = module_of_docs("command_reference").page()
    assert (DOCS / "commands.md").read_text(encoding="utf-8") == page
    for heading in ("register", "evaluate bop", "plot overlay", "cache"):
        assert f"\n## curvireg {heading}\n" in page
    for option in ("--hypotheses HYPOTHESES", "--no-refine", "--every N", "--quiet", "--out DIR"):
        assert f"| `{option}` |" in page


def test_the_method_in_pictures_is_current():
    """``python docs/make_pictures.py`` writes the page and its pictures."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    module = module_of_docs("make_pictures")
    page = (DOCS / "method-pictures.md").read_text(encoding="utf-8")
    assert page == module.page()
    pictures = re.findall(r"\]\((images/[\w-]+\.webp)\)", page)
    assert len(pictures) == 6
    assert all((DOCS / picture).is_file() for picture in pictures)
    for _, _, _, file in module.STEPS.values():
        assert (ROOT / "curvireg_torch" / file).is_file(), (
            f"the picture of the architecture: {file}"
        )


CHECK_SITE = module_of_docs("check_site")


@pytest.mark.parametrize(("word", "page"), CHECK_SITE.SEARCHED.items())
def test_what_people_search_for_is_on_its_page(word, page):
    assert word in (DOCS / f"{page}.md").read_text(encoding="utf-8")


def test_the_check_of_the_site_finds_faults(tmp_path):
    """Words that the index lacks, and what a browser would fetch; ``scripts/docs.sh`` runs it."""
    pytest.importorskip("sphinx", reason="Sphinx is not installed")
    pages = sorted(set(CHECK_SITE.SEARCHED.values()))
    stems = {"Unity": "uniti"}
    terms = {}
    for words, page in CHECK_SITE.SEARCHED.items():
        for word in words.split():
            terms[stems.get(word, word.lower())] = [pages.index(page)]
    number = terms.pop("step")[0]  # one page is a number instead of a list
    index = {"docnames": pages, "terms": {**terms, "heic": []}, "titleterms": {"step": number}}
    (tmp_path / "searchindex.js").write_text(f"Search.setIndex({json.dumps(index)})")
    head = '<link rel="canonical" href="https://a.org/"><link href="#a"><a id="a" href="https://a.org/">'
    (tmp_path / "index.html").write_text(head)
    assert not list(CHECK_SITE.find_faults(tmp_path))
    missing = list(CHECK_SITE.search_faults(tmp_path))
    assert [fault.split("'")[1] for fault in missing] == ["HEIC"]
    (tmp_path / "index.html").write_text(head + '<p>give \u2013azimuth</p><a href="/a.html">x</a>')
    assert [fault.split(": ")[1] for fault in CHECK_SITE.find_faults(tmp_path)] == [
        "\u2013azimuth begins with a dash that cannot be typed",
        "/a.html is absolute",
    ]
    (tmp_path / "index.html").write_text(head + '<script src="https://cdn.org/a.js"></script>')
    (fault,) = CHECK_SITE.find_faults(tmp_path)
    assert fault.endswith("https://cdn.org/a.js is fetched from elsewhere")


def test_formulas_need_no_script():
    pytest.importorskip("latex2mathml", reason="latex2mathml is not installed")
    formula = module_of_docs("mathml").formula(r"\sqrt{a < b}", display="inline")
    assert "<msqrt>" in formula
    assert formula.startswith('<math title="\\sqrt{a &lt; b}" xmlns=')


def test_messages_are_listed_with_what_to_do():
    module = module_of_docs("messages")
    photographs, meshes = module.page(ROOT / "curvireg_torch").split("## Meshes")
    assert "| frame … cannot be read | save the video again |" in photographs  # an f-string
    assert "| every face is degenerate (area 0) | repair the mesh |" in meshes
    assert "give --camera FX FY CX CY, --camera FILE (a calibration)" in meshes, (
        "a constant of another module"
    )
