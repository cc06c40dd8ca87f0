"""Digests of the package's own code."""

import grimp
import pytest

from curvireg_torch.matching import cache
from curvireg_torch.utils import sources
from curvireg_torch.utils.sources import import_digest, imported_files, package_digest

FILES = {
    "a/__init__.py": "",
    "a/one.py": "from .two import x\nfrom ..b import y\nfrom ..c.deep.four import z\n",
    "a/two.py": "def f():\n    from ..d import lazy\n",
    "a/weights.safetensors": "a",
    "a/unused.py": "",
    "b/__init__.py": "",
    "b/three.py": "import os\n",
    "b/numbers.json": "b",
    "c/deep/four.py": "",
    "c/five.py": "from ..a.one import x\n",
    "d.py": "",
}
IMPORTED = (
    *("a/one.py", "a/two.py", "a/weights.safetensors", "b/__init__.py", "b/three.py"),
    *("b/numbers.json", "c/deep/four.py", "d.py"),
)


@pytest.fixture
def package(tmp_path, monkeypatch):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(sources, "PACKAGE", tmp_path)
    yield tmp_path
    forget()


def forget():
    package_digest.cache_clear()
    import_digest.cache_clear()


def digests():
    forget()
    return package_digest(without=("c", "d.py")), import_digest("a/one.py")


@pytest.mark.parametrize("name", FILES)
def test_digests_depend_on_the_files_that_they_are_of(name, package):
    before = digests()
    with (package / name).open("a") as file:
        file.write("# changed")
    after = digests()
    in_package = not name.startswith(("c/", "d"))
    assert (before[0] != after[0], before[1] != after[1]) == (in_package, name in IMPORTED)


def test_digests_depend_on_names(package):
    before = digests()
    (package / "b" / "three.py").rename(package / "b" / "other.py")
    after = digests()
    assert before[0] != after[0]
    assert before[1] != after[1]


def test_what_does_not_exist_is_refused(package):
    with pytest.raises(FileNotFoundError, match="viewer"):
        package_digest(without=("viewer",))
    with pytest.raises(FileNotFoundError, match="six"):
        import_digest("a/six.py")
    (package / "d.py").write_text("from .gone import x\n")
    with pytest.raises(FileNotFoundError, match="gone"):
        imported_files("a/one.py")


def test_a_bank_depends_on_all_that_its_file_imports_and_on_no_more():
    files = {
        path.relative_to(sources.PACKAGE).as_posix() for path in imported_files(cache._BUILDER)
    }
    graph = grimp.build_graph("curvireg_torch")
    modules = graph.find_upstream_modules("curvireg_torch.matching.bank")
    for module in modules - {"curvireg_torch"}:
        path = module.removeprefix("curvireg_torch.").replace(".", "/")
        is_package = (sources.PACKAGE / path).is_dir()
        assert f"{path}/__init__.py" in files if is_package else f"{path}.py" in files
    assert {"matching/bank.py", "features/learned_field.safetensors", "terms.py"} <= files
    rooms = {name.partition("/")[0] for name in files}
    assert not rooms & {"cli", "data", "evaluation", "jobs", "registration", "viewer"}
    assert "matching/matcher.py" not in files
