"""Optional packages: one message names all that are missing, and the command that installs them."""

from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from curvireg_torch.cli import main
from curvireg_torch.errors import MissingDependencyError
from curvireg_torch.utils import extras
from curvireg_torch.utils.extras import EXTRAS, PACKAGE_OF_SUFFIX, check_extras, is_installed
from tests._support import refused

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"
HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"


@pytest.fixture
def only(monkeypatch):
    """Let only some packages be installed."""

    def install(*packages):
        monkeypatch.setattr(
            extras, "find_spec", lambda name: ModuleSpec(name, None) if name in packages else None
        )

    return install


def test_one_message_names_all_missing_packages_and_one_command(only, tmp_path, capsys):
    photo = tmp_path / "photo.HEIC"
    photo.write_bytes(HEIC)
    mesh = tmp_path / "part.STEP"
    mesh.write_text("a part")
    only()
    command = (
        r"pip install 'curvireg_torch\[cad,heic\]', in a checkout pip install -e '\.\[cad,heic\]'$"
    )
    match = rf"photo\.HEIC needs pi_heif, .*part\.STEP needs cascadio: {command}"
    with refused(match, MissingDependencyError):
        check_extras([photo, mesh])
    words = [str(photo), str(mesh), "--unit", "mm"]
    out = ["--out", str(tmp_path / "out")]
    for extra, command in (
        ("", ["register", *words, *out]),
        (",viewer", ["view", *words]),
        (",plot", ["plot", "overlay", *words, *out]),
    ):
        assert main(command) == 2
        assert f"in a checkout pip install -e '.[cad,heic{extra}]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    only("cascadio")
    with refused(r"curvireg_torch\[heic\]", MissingDependencyError):
        check_extras([photo, mesh])
    only("cascadio", "pi_heif")
    check_extras([photo, mesh])


def test_a_jpeg_called_heic_needs_no_decoder(only, tmp_path):
    only()
    (tmp_path / "a.heic").write_bytes(b"\xff\xd8\xff\xe0\0\x10JFIF")
    check_extras([tmp_path / "a.heic", tmp_path / "a.jpg", tmp_path / "a.stl"])


def test_the_extras_are_those_of_the_project():
    text = PYPROJECT.read_text(encoding="utf-8")
    assert set(PACKAGE_OF_SUFFIX.values()) <= set(EXTRAS)
    for extra in EXTRAS.values():
        assert f"\n{extra} = [" in text


def test_modules_without_a_specification_count_as_missing(monkeypatch):
    monkeypatch.setitem(extras.find_spec.__globals__["sys"].modules, "pi_heif", None)
    assert not is_installed("pi_heif")
    assert is_installed("json")
