"""The page "What does this message mean?", from the messages in the source; ``conf.py`` writes
it."""

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

HEAD = """# What does this message mean?

Messages begin with the file, option or argument that they are about. They are listed without it,
by the words that follow; … stands for a name or a number. Search this page for the words that do
not change.
"""

SECTIONS = {
    "ImageError": "Photographs",
    "MeshError": "Meshes",
    "BankError": "Banks",
    "MissingFileError": "Missing files",
    "OutputError": "Files that cannot be written",
    "MissingDependencyError": "Missing packages",
    "LostObjectError": "Lost objects",
    "CurviregWarning": "Warnings: the result stands, but look",
    "InvalidInputError": "Options, arguments and values",
}
"""Headings of the page by kind of error; others are among the last."""


def messages(package: Path) -> Iterator[tuple[str, str, str]]:
    """Kind of error, what is wrong, and what to do, of each message that tells it after a
    semicolon."""
    modules = [
        ast.parse(file.read_text(encoding="utf-8")) for file in sorted(package.rglob("*.py"))
    ]
    constants = {
        name: text
        for module in modules
        for name, text in assigned(module.body, {}).items()
        if name.isupper()
    }
    for module in modules:
        for function in ast.walk(module):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            nodes = list(ast.walk(function))
            texts = assigned(nodes, constants)
            for node in nodes:
                if isinstance(node, ast.Call) and node.args and isinstance(node.func, ast.Name):
                    wrong, semicolon, advice = template(node.args[0], texts).partition("; ")
                    told = semicolon and wrong.strip("… :") and advice.strip("… .")
                    if told and node.func.id.endswith(("Error", "Warning")):
                        yield node.func.id, wrong.removeprefix("…: "), advice


def assigned(nodes: Iterable[ast.AST], known: dict[str, str]) -> dict[str, str]:
    """The texts of variables, beside those that are known."""
    texts = dict(known)
    for node in nodes:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            texts[node.targets[0].id] = template(node.value, texts)
    return texts


def template(node: ast.expr, texts: dict[str, str]) -> str:
    """The text of an expression, with … for what is not known."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(template(part, texts) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return template(node.value, texts) if isinstance(node.value, ast.Name) else "…"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return template(node.left, texts) + template(node.right, texts)
    return texts.get(node.id, "…") if isinstance(node, ast.Name) else "…"


def page(package: Path) -> str:
    """The page as Markdown."""
    found: dict[str, set[tuple[str, str]]] = {heading: set() for heading in SECTIONS.values()}
    for kind, wrong, advice in messages(package):
        found[SECTIONS.get(kind, SECTIONS["InvalidInputError"])].add((wrong, advice))
    parts = [HEAD]
    for heading, rows in found.items():
        if rows:
            table = [
                f"| {cell(wrong)} | {cell(advice)} |"
                for wrong, advice in sorted(rows, key=sort_key)
            ]
            parts.append(
                "\n".join([f"## {heading}\n", "| message | what to do |", "|---|---|", *table, ""])
            )
    return "\n".join(parts)


def sort_key(row: tuple[str, str]) -> str:
    return row[0].lstrip("…-: ").lower()


def cell(text: str) -> str:
    return text.translate({ord(c): f"\\{c}" for c in "|*_<[`$"}).replace("\n", " ")
