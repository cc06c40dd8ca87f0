"""Who may import whom, read from the source (DESIGN: errors <- geometry <- filters ... <- registration <- cli)."""

import ast
from pathlib import Path

import pytest

import curvireg_torch

PACKAGE = Path(curvireg_torch.__file__).parent

BASE = {"errors", "limits", "_checks", "_choices", "_examples", "_files", "_lazy", "_threads"}
ALLOWED = {
    "errors": set(),
    "limits": set(),
    "_checks": {"errors"},
    "_choices": set(),
    "_examples": set(),
    "_files": {"errors"},
    "_given": {"_choices", "errors"},
    "_lazy": set(),
    "_threads": set(),
    "geometry": BASE,
    "filters": BASE,
    "descriptors": BASE | {"filters"},
    "rendering": BASE | {"geometry"},
    "detectors": BASE | {"filters", "descriptors"},
    "data": BASE | {"geometry"},
    "metrics": BASE | {"geometry"},
    "synthetic": BASE | {"geometry", "filters", "rendering"},
    "terms": BASE | {"geometry", "filters", "descriptors", "learned", "pipeline"},  # pipeline: types alone
    "pipeline": BASE | {"geometry", "filters", "descriptors", "terms", "learned"},
    "matching": BASE | {"geometry", "filters", "descriptors", "rendering", "terms", "pipeline"},
    "location": BASE | {"geometry", "descriptors", "terms", "learned", "pipeline", "matching"},
    "scenes": BASE | {"geometry", "rendering"},
    "learned": BASE | {"geometry", "filters", "matching", "scenes"},
    "registration": BASE
    | {"geometry", "filters", "data", "descriptors", "rendering", "pipeline", "matching", "location"},
    "visualization": BASE | {"geometry", "metrics", "filters", "descriptors", "rendering", "matching", "registration"},
}
FORBIDDEN_LIBRARIES = {
    "filters": {"numpy", "pathlib", "trimesh", "cv2", "scipy", "os"},
    "descriptors": {"numpy", "pathlib", "trimesh", "cv2", "scipy", "os"},
}
TOP = {
    "_completion",
    "batch",
    "document",
    "evaluation",
    "plotting",
    "viewer",
    "cli",
    "commands",
    "__init__",
    "__main__",
}


def parts() -> list[str]:
    return sorted(
        {
            p.stem if p.is_file() else p.name
            for p in PACKAGE.iterdir()
            if p.suffix == ".py" or (p / "__init__.py").exists()
        }
    )


def sources(part: str) -> list[Path]:
    folder = PACKAGE / part
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [PACKAGE / f"{part}.py"]


def imported(path: Path) -> tuple[set[str], set[str]]:
    """Parts of this package, and other top-level modules, that a file imports anywhere."""
    inside, outside = set(), set()
    package = path.relative_to(PACKAGE.parent).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            base += (node.module or "").split(".") if node.module else []
            names = [".".join([*base, alias.name]) for alias in node.names]
        else:
            continue
        for name in names:
            pieces = name.split(".")
            if pieces[0] == "curvireg_torch":
                inside.update(pieces[1:2])
            else:
                outside.add(pieces[0])
    return inside, outside


def test_every_part_has_a_rule():
    assert set(parts()) == set(ALLOWED) | (set(parts()) & TOP)


@pytest.mark.parametrize("part", sorted(ALLOWED))
def test_imports_only_what_lies_below(part):
    for path in sources(part):
        inside, outside = imported(path)
        assert inside - {part} <= ALLOWED[part], f"{path.name} imports {sorted(inside - {part} - ALLOWED[part])}"
        assert not outside & FORBIDDEN_LIBRARIES.get(part, set()), path.name


def test_trimesh_and_pyrender_stay_where_they_belong():
    for part in ("filters", "descriptors", "detectors", "data", "metrics"):
        for path in sources(part):
            assert not imported(path)[1] & {"trimesh", "pyrender", "embreex"}, path
    for path in PACKAGE.rglob("*.py"):
        if path.parent.name != "rendering":
            assert not imported(path)[1] & {"pyrender", "embreex", "OpenGL"}, path


def test_scikit_learn_is_not_imported():
    """It belongs to the extra ``dev``: tests and scripts use it."""
    for path in PACKAGE.rglob("*.py"):
        assert "sklearn" not in imported(path)[1], path


def test_public_names_are_sorted_explicit_and_documented():
    names = curvireg_torch.__all__
    assert names == sorted(names, key=lambda n: (not n.isupper(), n[0].islower(), n))
    for name in names:
        assert getattr(curvireg_torch, name).__doc__, name
