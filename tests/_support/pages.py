"""The pages of the documentation, and what they tell to type."""

import re
import shlex
from pathlib import Path

__all__ = ["DOCS", "MADE", "PAGES", "ROOT", "steps", "words_of"]

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
MADE = ("_build", "auto_gallery", "project")
"""Folders that the build of the site makes."""
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *ROOT.glob("datasets/*/README.md"),
        *(p for p in DOCS.rglob("*.md") if p.relative_to(DOCS).parts[0] not in MADE),
    ]
)

PROGRAMS = r"(?:\S*/)?(?:curvireg|python|torchrun|pip|git|apt-get|\w+\.sh)"


def steps(page: Path) -> list[tuple[str, str]]:
    """What a page tells to type, in its order: ("python", a block) and ("command", a line).

    Commands are all lines of bash, those of plain blocks that begin with a program, and whole ones within the text:
    with an ``--out``, or of a script. Others there name a command, or a part of one.
    """
    text = page.read_text(encoding="utf-8")
    found: list[tuple[str, str]] = []
    for block in re.finditer(
        r"^(?P<indent> *)```(?P<kind>\w*)\n(?P<code>.*?)^ *```"
        r"|`(?P<inline>(?:(?:curvireg|torchrun) (?=[^`\n|]* --out )|python )[^`\n|]+)`",
        text,
        flags=re.DOTALL | re.MULTILINE,
    ):
        kind, code = block["kind"], block["code"]
        if kind == "python":
            found.append(("python", re.sub(rf"^{block['indent']}", "", code, flags=re.MULTILINE)))
        elif kind in ("bash", "", None):
            lines = (code or block["inline"]).replace("\\\n", " ").splitlines()
            shell = kind == "bash"
            found += [("command", line.strip()) for line in lines if words_of(line) and (shell or typed(line))]
    return found


def typed(line: str) -> bool:
    return re.match(rf" *{PROGRAMS} ", line) is not None


def words_of(line: str) -> list[str]:
    """A command's words; a comment has none."""
    return shlex.split(line, comments=True)
