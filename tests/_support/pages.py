"""The documentation's pages, and the commands and Python blocks in them."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
BUILT = ("_build", "auto_gallery", "project")
"""Folders that the build of the site creates."""
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *ROOT.glob("datasets/*/README.md"),
        *(p for p in DOCS.rglob("*.md") if p.relative_to(DOCS).parts[0] not in BUILT),
    ]
)

PROGRAM = r" *(?:\S*/)?(?:curvireg|python|pip|git|apt-get|\w+\.sh) "
STEP = re.compile(
    r"^(?P<indent> *)```(?P<kind>\w*)\n(?P<code>.*?)^ *```"
    r"|`(?P<inline>(?:curvireg (?=[^`\n|]* --out )|python )[^`\n|]+)`",
    flags=re.DOTALL | re.MULTILINE,
)


def steps(page):
    """The steps of a page in order: ("python", a block) and ("command", a line): lines of bash
    blocks, lines of plain blocks that start with a program, and inline commands that have an
    ``--out`` or run a script."""
    found = []
    for block in STEP.finditer(page.read_text(encoding="utf-8")):
        kind = block["kind"]
        code = block["code"]
        if kind == "python":
            found.append(("python", re.sub(rf"^{block['indent']}", "", code, flags=re.MULTILINE)))
        elif kind in ("bash", "", None):
            lines = (code or block["inline"]).replace("\\\n", " ").splitlines()
            found += [
                ("command", s.strip())
                for s in lines
                if split_command(s) and (kind or re.match(PROGRAM, s))
            ]
    return found


def split_command(line):
    """The words of a command without its comment."""
    return shlex.split(line, comments=True)
