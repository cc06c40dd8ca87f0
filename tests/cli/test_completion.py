"""``curvireg completion``: the shells complete lines with its scripts."""

import shutil
import subprocess

import pytest

from curvireg_torch.cli import main
from curvireg_torch.utils.choices import PRESET_NAMES, UNITS

COMPLETIONS = [
    ("curvireg reg", {"register"}),
    ("curvireg evaluate ", {"pascal3d", "bop", "web"}),
    ("curvireg plot s", {"sphere", "sheet"}),
    ("curvireg register --preset ", set(PRESET_NAMES)),
    ("curvireg register a.jpg b.stl --unit ", set(UNITS)),
    ("curvireg register a.jpg --no-re", {"--no-refine"}),
    ("curvireg evaluate bop data --preset f", {"fast"}),
    ("curvireg evaluate bop data --spl", {"--split"}),
    ("curvireg bank --ad", {"--adapt"}),
    ("curvireg bank pa", {"part.stl"}),
    ("curvireg register --field we", {"weights"}),
    ("curvireg completion ", {"bash", "zsh", "fish"}),
    ("curvireg register --ex", set()),  # --exif is internal, users write --camera exif
]


def script(shell, tmp_path, capsys):
    assert main(["completion", shell]) == 0
    path = tmp_path / "script"
    path.write_text(capsys.readouterr().out)
    for name in ("part.stl", "weights"):
        (tmp_path / name).touch()
    return path


def completions(folder, *command):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=60)
    assert done.stderr == ""
    return {line.split("\t")[0].strip() for line in done.stdout.splitlines() if line}


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(("line", "words"), COMPLETIONS)
def test_completion_bash(line, words, tmp_path, capsys):
    typed = " ".join(f"'{word}'" for word in line.split(" "))
    ask = f"COMP_WORDS=({typed}); COMP_CWORD={line.count(' ')}; _shtab_curvireg; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    assert completions(tmp_path, "bash", "-c", f". {script('bash', tmp_path, capsys)}; {ask}") == words


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
@pytest.mark.parametrize(("line", "words"), COMPLETIONS)
def test_completion_fish(line, words, tmp_path, capsys):
    path = script("fish", tmp_path, capsys)
    assert completions(tmp_path, "fish", "--no-config", "-c", f"source {path}; complete -C '{line}'") == words


def test_completion_zsh(capsys):
    assert main(["completion", "zsh"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("#compdef curvireg\n")
    assert "--no-refine" in out
    assert "--exif" not in out
