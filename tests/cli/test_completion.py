"""``curvireg completion``: the shells complete lines with its scripts."""

import shutil
import subprocess

import pytest

from curvireg_torch.cli import main
from curvireg_torch.utils.choices import PRESET_NAMES, UNITS

COMPLETIONS = [
    ("curvireg reg", {"register"}),
    ("curvireg evaluate ", {"pascal3d", "bop", "web"}),
    ("curvireg plot v", {"viewpoints"}),
    ("curvireg register --preset ", set(PRESET_NAMES)),
    ("curvireg register a.jpg b.stl --unit ", set(UNITS)),
    ("curvireg register a.jpg --no-re", {"--no-refine"}),
    ("curvireg evaluate bop data --preset f", {"fast"}),
    ("curvireg evaluate bop data --spl", {"--split"}),
    ("curvireg bank pa", {"part.stl"}),
    ("curvireg register --field we", {"weights"}),
    ("curvireg completion ", {"bash", "zsh", "fish"}),
    ("curvireg register --ex", set()),  # --exif is internal, users write --camera exif
]


@pytest.mark.parametrize("shell", ["bash", "fish"])
@pytest.mark.parametrize(("line", "words"), COMPLETIONS)
def test_completion_completes(shell, line, words, tmp_path, capsys):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    assert main(["completion", shell]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    for name in ("part.stl", "weights"):
        (tmp_path / name).touch()
    typed = " ".join(f"'{word}'" for word in line.split(" "))
    ask = f"COMP_WORDS=({typed}); COMP_CWORD={line.count(' ')}; _shtab_curvireg; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    options = {"bash": ["-c", f". ./script; {ask}"], "fish": ["--no-config", "-c", f". ./script; complete -C '{line}'"]}
    done = subprocess.run(
        [shell, *options[shell]], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stderr == ""
    assert {found.split("\t")[0].strip() for found in done.stdout.splitlines() if found} == words


def test_completion_zsh(capsys):
    assert main(["completion", "zsh"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("#compdef curvireg\n")
    assert "--no-refine" in out
    assert "--exif" not in out
