"""What the architecture page adds works; what it lists is there."""

import re
from pathlib import Path
from typing import Any

import torch

import curvireg_torch
from curvireg_torch import Pipeline

ROOT = Path(__file__).parents[2]


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def run(code: list[str], page: str) -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": "page"}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for block in code:
            exec(compile(block, page, "exec"), names)
    return names


def test_a_field_and_a_term_as_the_architecture_page_adds_them():
    page = "docs/architecture.md"
    names = run(blocks(page), page)
    assert names["result"].hypotheses[0].rotation.shape == (3, 3)
    ranking, term = names["ranking"], names["Middle"]()
    assert set(ranking.terms) == {term.name for term in Pipeline().terms} | {"middle"}
    log = term.log_score(ranking.terms["middle"])
    assert float(log.max()) == 0.0
    # It counts, with its weight.
    plain = names["bank"].pipeline.with_term("middle", weight=0.0)
    matcher = names["cr"].ViewMatcher(names["bank"], pipeline=plain)
    without = matcher([names["photograph"]], torch.tensor([names["box"]]))
    torch.testing.assert_close(ranking.scores, without.scores * (0.5 * log).exp())
    # Masks with one pixel each: the middle is that pixel.
    one = torch.zeros(1, 5, 5, dtype=torch.bool)
    one[0, 1, 4] = True
    assert names["middles"](one).tolist() == [[1.0, 0.25]]


def test_the_table_of_parts_names_them_all():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    package = Path(curvireg_torch.__file__).parent
    folders = {path.parent.name for path in package.glob("*/__init__.py")}
    missing = {name for name in folders if f"`{name}`" not in text}
    assert not missing
    for path in re.findall(r"(?<!tests/)\b((?:matching|registration|terms|evaluation|rendering)/\w+)(?:\.py)?\b", text):
        assert (package / f"{path}.py").is_file(), path
