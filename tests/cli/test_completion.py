"""Completion of the command line, asked of the shells themselves."""

import os
import pty
import select
import shutil
import subprocess
import time

import pytest

from curvireg_torch.cli import main
from curvireg_torch.utils.choices import PRESET_NAMES, UNITS

ASKED = [
    ("curvireg reg", {"register"}),
    ("curvireg evaluate ", {"pascal3d", "bop", "web", "--help", "-h"}),
    ("curvireg plot s", {"sphere", "sheet"}),
    ("curvireg register --preset ", set(PRESET_NAMES)),
    ("curvireg register a.jpg b.stl --unit ", set(UNITS)),
    ("curvireg register a.jpg --no-re", {"--no-refine"}),
    ("curvireg evaluate bop data --preset f", {"fast"}),
    ("curvireg evaluate bop data --spl", {"--split"}),
    ("curvireg bank --ad", {"--adapt"}),
    ("curvireg completion ", {"bash", "zsh", "fish"}),
    ("curvireg register --ex", set()),  # spelled --camera exif
]


def script(shell, tmp_path, capsys):
    assert main(["completion", shell]) == 0
    path = tmp_path / "script"
    path.write_text(capsys.readouterr().out)
    return path


def answer(*command):
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert done.stderr == ""
    return {line.split("\t")[0] for line in done.stdout.splitlines() if line}


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(("line", "words"), ASKED)
def test_bash(line, words, tmp_path, capsys):
    typed = " ".join(f"'{word}'" for word in line.split(" "))
    ask = f"COMP_WORDS=({typed}); COMP_CWORD={line.count(' ')}; _curvireg; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    assert answer("bash", "-c", f". {script('bash', tmp_path, capsys)}; {ask}") == words


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_leaves_files_to_itself(tmp_path, capsys):
    """No words of ours where a path belongs: ``complete -o default`` then offers files."""
    path = script("bash", tmp_path, capsys)
    assert "complete -o default" in path.read_text()
    ask = 'COMP_WORDS=(curvireg register pho); COMP_CWORD=2; _curvireg; echo "${COMPREPLY[@]}"'
    assert answer("bash", "-c", f". {path}; {ask}") == set()


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
@pytest.mark.parametrize(("line", "words"), [a for a in ASKED if a[0] != "curvireg evaluate "])
def test_fish(line, words, tmp_path, capsys):
    path = script("fish", tmp_path, capsys)
    assert answer("fish", "--no-config", "-c", f"source {path}; complete -C '{line}'") == words


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
@pytest.mark.parametrize(("line", "words"), ASKED)
def test_zsh(line, words, tmp_path, capsys):
    """Typed into a terminal, with the tab; what zsh would offer is written down."""
    (tmp_path / "setup").write_text(
        f"autoload -U compinit && compinit -D -u; . {script('zsh', tmp_path, capsys)}; cd {tmp_path}\n"
        'compadd() { local -a found; builtin compadd -O found "$@"; print -rl -- $found >> offered; }\n'
        "zstyle ':completion:*' insert-tab false\ntouch offered\n"
        "zle-line-init() { touch ready; }; zle -N zle-line-init\n"
    )
    keyboard, screen = pty.openpty()
    environment = {"PATH": os.environ["PATH"], "TERM": "dumb", "HOME": str(tmp_path)}
    shell = subprocess.Popen(
        ["zsh", "-f", "-i"], stdin=screen, stdout=screen, stderr=screen, env=environment, start_new_session=True
    )
    try:
        for keys, sign in ((f". {tmp_path}/setup\n", "ready"), (f"{line}\t\x15touch done\n", "done")):
            os.write(keyboard, keys.encode())
            deadline = time.monotonic() + 30
            while not (tmp_path / sign).exists():
                assert time.monotonic() < deadline, sign
                if select.select([keyboard], [], [], 0.05)[0]:
                    os.read(keyboard, 4096)  # what it draws
    finally:
        shell.kill()
        shell.wait()
        os.close(keyboard)
        os.close(screen)
    offered = set((tmp_path / "offered").read_text().split())
    assert offered == words
