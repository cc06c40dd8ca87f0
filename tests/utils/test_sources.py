"""Digests of the package's own code."""

import grimp
import pytest

from curvireg_torch.matching import cache
from curvireg_torch.utils import sources
from curvireg_torch.utils.sources import package_digest

FILES = ("a/__init__.py", "a/weights.safetensors", "b/numbers.json", "b/more/two.py", "c/one.py")


@pytest.fixture
def package(tmp_path, monkeypatch):
    for name in (*FILES, "d.py", "a/notes.txt"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    monkeypatch.setattr(sources, "PACKAGE", tmp_path)
    yield tmp_path
    package_digest.cache_clear()


def digest():
    package_digest.cache_clear()
    return package_digest(without=("c", "d.py"))


@pytest.mark.parametrize("name", [*FILES, "d.py", "a/notes.txt"])
def test_the_digest_depends_on_the_files_that_it_is_of(name, package):
    before = digest()
    with (package / name).open("a") as file:
        file.write("# changed")
    assert (before != digest()) == (not name.startswith(("c/", "d")) and not name.endswith("txt"))


def test_the_digest_depends_on_names(package):
    before = digest()
    (package / "b" / "numbers.json").rename(package / "b" / "other.json")
    assert before != digest()


@pytest.mark.usefixtures("package")
def test_what_does_not_exist_is_refused():
    with pytest.raises(FileNotFoundError, match="viewer"):
        package_digest(without=("viewer",))


def test_a_bank_depends_on_all_that_its_file_imports():
    graph = grimp.build_graph("curvireg_torch")
    modules = graph.find_upstream_modules("curvireg_torch.matching.bank")
    rooms = {name.split(".")[1] for name in modules if "." in name}
    assert {"matching", "features", "terms"} <= rooms
    assert rooms.isdisjoint(cache.NOT_IN_BANKS)
