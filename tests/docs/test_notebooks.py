"""The notebooks are those of the gallery, and run."""

import json

import pytest

from .._support.pages import DOCS
from .test_docs import module_of_docs

MAKE = module_of_docs("make_notebooks")
NAMES = [source.name for source in MAKE.SOURCES]


def cells(source):
    return json.loads(MAKE.notebook_path(source).read_text(encoding="utf-8"))["cells"]


@pytest.mark.parametrize("source", MAKE.SOURCES, ids=NAMES)
def test_notebooks_are_current(source):
    """``python docs/make_notebooks.py`` writes them."""
    assert MAKE.notebook_path(source).read_text(encoding="utf-8") == MAKE.notebook(source)
    texts = ["".join(cell["source"]) for cell in cells(source) if cell["cell_type"] == "markdown"]
    assert texts[0].startswith("# ")
    assert any(text.startswith("## ") for text in texts)
    whole = "\n".join(texts)
    assert not {"``", ":doc:", "===", "# %%"} & set(whole.split())
    assert "](../" in whole
    code = "\n".join("".join(c["source"]) for c in cells(source) if c["cell_type"] == "code")
    lines = [line for line in source.read_text().split('"""', 2)[2].splitlines() if line.strip()]
    kept = [line for line in lines if line[0] != "#"]
    assert [line for line in code.splitlines() if line.strip()] == kept, "no code is lost"


def test_each_user_has_a_notebook():
    assert sorted(path.name for path in (DOCS / "notebooks").glob("*.ipynb")) == [
        "1_part.ipynb",
        "2_table.ipynb",
        "3_layer.ipynb",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("source", MAKE.SOURCES, ids=NAMES)
def test_notebooks_run(source, monkeypatch, capsys):
    """Cell by cell in one namespace, as Jupyter does; the hosted workflow runs Jupyter itself."""
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is not installed")
    pyplot.switch_backend("agg")
    shown = []
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.gcf()))
    namespace = {"__name__": "__main__"}
    for number, cell in enumerate(cells(source)):
        if cell["cell_type"] == "code":
            code = compile("".join(cell["source"]), f"cell {number}", "exec")
            exec(code, namespace)
    pyplot.close("all")
    assert shown
    assert capsys.readouterr().out.strip()
