"""What packages and modules export: no name is public by accident."""

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "curvireg_torch"
INITS = sorted(PACKAGE.rglob("__init__.py"))


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def dotted(path):
    """The name of a module, or of a package by its ``__init__.py``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imported(tree, module, *, is_package):
    """The (module, name) pairs of ``from module import name``, relative ones made absolute."""
    here = module.split(".")
    pairs = []
    nodes = [tree]
    for node in nodes:  # statements alone: expressions, which are more, import nothing
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            nodes += getattr(node, part, [])
        if isinstance(node, ast.ImportFrom):
            above = here[: len(here) - node.level + is_package] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            pairs += [(source, alias.name) for alias in node.names]
    return pairs


@pytest.mark.parametrize("path", INITS, ids=dotted)
def test_packages_list_what_they_export(path):
    tree = tree_of(path)
    package = importlib.import_module(dotted(path))
    public = {
        name
        for source, name in imported(tree, dotted(path), is_package=True)
        if source.startswith("curvireg_torch") and not (path.parent / f"{name}.py").exists()
    }
    exported = getattr(package, "__all__", [])
    assert not public - set(exported) - {"__version__"} or path.parent.name == "cli"
    assert [name for name in exported if not hasattr(package, name)] == []


def test_names_of_packages_are_those_that_they_export():
    exports = {dotted(path): importlib.import_module(dotted(path)) for path in INITS}
    wrong = []
    for folder in ("curvireg_torch", "tests", "scripts"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            tree = tree_of(path)
            is_package = path.name == "__init__.py"
            for source, name in imported(tree, dotted(path), is_package=is_package):
                if source not in exports or name in getattr(exports[source], "__all__", ()):
                    continue
                beside = ROOT.joinpath(*source.split("."), name)
                if not (beside.is_dir() or beside.with_suffix(".py").exists()):
                    wrong.append(f"{path.relative_to(ROOT)}: {source}.{name}")
    assert wrong == []


def test_private_names_stay_in_their_modules():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = tree_of(path)
        pairs = imported(tree, dotted(path), is_package=path.name == "__init__.py")
        wrong += [
            f"{path.relative_to(ROOT)}: {source}.{name}"
            for source, name in pairs
            if source.startswith("curvireg_torch") and re.match("_[^_]", name)
        ]
    assert wrong == []


def test_public_functions_are_used_outside_their_modules():
    names = ("curvireg_torch", "tests", "scripts", "docs", "datasets")
    folders = [ROOT / name for name in names]
    sources = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    texts = {
        path: path.read_text(encoding="utf-8")
        for path in sources
        if path.suffix in (".py", ".pyi", ".md")
    }
    files_of = {}
    for path, text in texts.items():
        for word in set(re.findall(r"\w+", text)):
            files_of.setdefault(word, set()).add(path)
    wrong = [
        f"{path.relative_to(ROOT)}: {node.name}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in tree_of(path).body
        if isinstance(node, ast.FunctionDef)
        and not node.name.startswith("_")
        and files_of[node.name] == {path}
    ]
    assert wrong == [], "used in one module alone: begin their names with an underscore"
