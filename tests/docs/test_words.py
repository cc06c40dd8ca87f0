"""Words of the private dialect that documentation, docstrings and comments must not use."""

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from .._support.pages import PAGES, ROOT

DIALECT = [
    r"anew",
    r"asunder",
    r"at will",
    r"bears? the name",
    r"doubted",
    r"for want of",
    r"heeds?",
    r"hitherto",
    r"judged",
    r"lessons?",
    r"made to harm",
    r"mended",
    r"nobody knows",
    r"nought",
    r"of one's own",
    r"once more",
    r"others'",
    r"reckon(?:ed|s)?",
    r"shares? of",
    r"tells? (?:apart|how|right|what|whether)",
    r"those of others",
    r"thrice",
    r"told",
    r"turns? and shifts?",
    r"wherefore",
    r"whoever",
    r"wholly",
]
"""Words and phrases to replace; docs/glossary.md has the standard terms."""

PATTERN = re.compile(rf"\b(?:{'|'.join(DIALECT)})(?!\w)", flags=re.IGNORECASE)

SCOPE = {
    "pages": PAGES,
    **{
        folder: [path for path in sorted((ROOT / folder).rglob("*.py")) if path != Path(__file__)]
        for folder in ("curvireg_torch", "datasets", "docs/gallery", "scripts", "tests")
    },
}
"""Files without dialect."""


def prose(path: Path) -> Iterator[str]:
    """The prose of a page without code and generated tables, or the docstrings and comments of a module."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        text = re.sub(r"<!-- ([\w ]+):begin -->.*?<!-- \1:end -->", "", text, flags=re.DOTALL)
        yield re.sub(r"```.*?```|`[^`\n]*`|\]\([^)]*\)", "", text, flags=re.DOTALL)
        return
    previous = tokenize.NEWLINE
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        statement = token.type == tokenize.STRING and previous in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
        if token.type == tokenize.COMMENT or statement:
            yield token.string
        if token.type not in (tokenize.NL, tokenize.COMMENT):
            previous = token.type


def dialect(path: Path) -> list[str]:
    return [word for text in prose(path) for word in PATTERN.findall(text)]


@pytest.mark.parametrize("files", SCOPE.values(), ids=SCOPE)
def test_prose_has_no_dialect(files: list[Path]) -> None:
    found = {str(path.relative_to(ROOT)): words for path in files if (words := dialect(path))}
    assert found == {}


def test_dialect_is_found_in_prose_only(tmp_path: Path) -> None:
    page, module = tmp_path / "page.md", tmp_path / "module.py"
    page.write_text("It is nought, but `nought` is code.\n")
    module.write_text('"""Lessons."""\nwholly = "nought"  # asunder\n')
    assert dialect(page) == ["nought"]
    assert dialect(module) == ["Lessons", "asunder"]
