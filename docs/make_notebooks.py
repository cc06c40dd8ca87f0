"""Notebooks of the three users, from the pages of the gallery.

python docs/make_notebooks.py

writes ``docs/notebooks/*.ipynb``, without outputs; a test compares them with the gallery and runs
them.
"""

import ast
import json
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
SOURCES = sorted((DOCS / "gallery" / "notebooks").glob("plot_*.py"))
INSTALL = (
    "In a checkout: `pip install -e '.[plot]' notebook`, then `jupyter notebook docs/notebooks`."
)
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
Cell = dict[str, Any]


def notebook_path(source: Path) -> Path:
    """Where the notebook of a page of the gallery is."""
    return DOCS / "notebooks" / f"{source.stem.removeprefix('plot_')}.ipynb"


def notebook(source: Path) -> str:
    """The notebook of a page of the gallery, as JSON."""
    text = source.read_text(encoding="utf-8")
    head = ast.get_docstring(ast.parse(text)) or ""
    rest = text.split('"""', 2)[2]
    texts = [("markdown", f"{markdown(head)}\n\n{INSTALL}")]
    for block in re.split(r"^# %%\n", rest, flags=re.MULTILINE):
        comment, code = divided(block)
        texts += [("markdown", markdown(comment)), ("code", code)]
    cells = [cell(kind, text, k) for k, (kind, text) in enumerate(texts) if text]
    content = {"cells": cells, "metadata": METADATA, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def divided(block: str) -> tuple[str, str]:
    """The comment that a block begins with, without its marks, and the code below it."""
    lines = block.strip("\n").splitlines()
    count = 0
    if block.startswith("#"):
        count = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    comment = [line.removeprefix("#").removeprefix(" ") for line in lines[:count]]
    return "\n".join(comment), "\n".join(lines[count:]).strip("\n")


def markdown(text: str) -> str:
    """Text of the gallery as Markdown: headings, code and links to pages."""
    text = re.sub(r"^(.+)\n=+$", r"# \1", text, flags=re.MULTILINE)
    text = re.sub(r"^(.+)\n-+$", r"## \1", text, flags=re.MULTILINE)
    text = re.sub(r":doc:`/([\w/-]+)`", r"[docs/\1.md](../\1.md)", text)
    return re.sub(r"``([^`]+)``", r"`\1`", text)


def cell(kind: str, text: str, number: int) -> Cell:
    lines = text.splitlines(keepends=True)
    common = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": lines}
    return common if kind == "markdown" else {**common, "execution_count": None, "outputs": []}


def main() -> None:
    for source in SOURCES:
        notebook_path(source).write_text(notebook(source), encoding="utf-8")


if __name__ == "__main__":
    main()
