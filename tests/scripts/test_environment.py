"""``scripts/_environment.sh`` with a fake Python: what it installs, and its error messages."""

import os
import subprocess

import pytest

from tests._support.scripts import SCRIPTS


def source(tmp_path, python, *, venv=True, gpu=False):
    """Exit code, output and pip calls of the script; ``python`` is the shell body of the fake Python."""
    fake = tmp_path / "venv" / "bin" / "python" if venv else tmp_path / "python"
    for path, body in ((fake, python), (tmp_path / "bin" / "nvidia-smi", f"exit {int(not gpu)}")):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'#!/bin/sh\necho "$*" >> {tmp_path}/calls\n{body}\n')
        path.chmod(0o755)
    environment = {"PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    environment |= {"CURVIREG_VENV": str(tmp_path / "venv"), "PYTHON": str(tmp_path / "python")}
    script = f"set -euo pipefail; . '{SCRIPTS}/_environment.sh' '[dev]'"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=environment, timeout=60)
    calls = (tmp_path / "calls").read_text().splitlines()
    return done.returncode, done.stdout + done.stderr, [call.split("check ")[-1] for call in calls if "-m pip" in call]


NO_TORCH = 'case "$*" in *"import torch"*) exit 1;; *versions*) echo "{versions}";; esac'


@pytest.mark.parametrize(
    ("versions", "gpu", "installed"),
    [
        ("2.15.0, 2.14.1+cpu, 2.14.1, 2.13.0+cpu, 2.13.0", False, "==2.14.1+cpu"),
        ("2.15.0, 2.14.1", False, ""),
        ("2.15.0, 2.14.1+cpu", True, ""),
    ],
)
def test_environment_installs_the_cpu_build_without_a_gpu(tmp_path, versions, gpu, installed):
    listing = f"torch (2.15.0)\nAvailable versions: {versions}"
    code, output, calls = source(tmp_path, NO_TORCH.format(versions=listing), gpu=gpu)
    assert code == 0
    assert output.startswith(f"installing torch{installed} (")
    assert output.strip().endswith("some minutes, 1.4 GB on disk" if installed else "up to 6 GB on disk, for CUDA")
    assert len(output.splitlines()) == 1
    torch, library = [call for call in calls if call.startswith("install")]
    assert torch.split()[-1] == f"torch{installed}"
    assert library == "install -e .[dev]"
    quiet = [" install" in call and "--quiet" in call for call in (tmp_path / "calls").read_text().splitlines()]
    assert not any(quiet)  # pip shows its progress


def test_environment_does_not_reinstall_torch(tmp_path):
    assert source(tmp_path, "exit 0") == (0, "", ["--version", "install -e .[dev]"])


@pytest.mark.parametrize(
    ("cases", "venv", "message"),
    [
        ("--version) echo Python 3.9.1;; *) exit 1;;", False, "needs Python 3.11 or newer, found Python 3"),
        ("*ensurepip*) exit 1;;", False, "apt-get install python3-venv"),
        ('"-m venv"*) exit 1;;', False, "set CURVIREG_VENV to a folder that can be written"),
        ("*pip*) exit 1;;", True, "remove it"),
    ],
)
def test_environment_rejects_unsuitable_pythons(tmp_path, cases, venv, message):
    code, output, _ = source(tmp_path, f'case "$*" in {cases} esac', venv=venv)
    assert code == 1
    assert message in output
    assert len(output.splitlines()) == 1
    assert (tmp_path / "venv").exists() == venv
