# Sourced by demo.sh and test.sh: a virtual environment with the library in it, made once and brought up to date after.
# Usage: . scripts/_environment.sh EXTRAS     (EXTRAS: empty, or [dev])

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
venv=${CURVIREG_VENV:-$root/.venv}
python=${PYTHON:-python3}
die() { echo "curvireg_torch: $*" >&2; exit 1; }
new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }
quiet=--quiet # but not for the first installation, which takes minutes
pip() { "$venv/bin/python" -m pip $quiet --disable-pip-version-check "$@"; }

if [ ! -x "$venv/bin/python" ]; then
    new_enough "$python" ||
        die "needs Python 3.11 or newer, found $("$python" --version 2>&1 | tail -n 1); name one: PYTHON=python3.12 $0"
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        die "$python cannot make virtual environments; on Debian and Ubuntu: apt-get install python3-venv"
    "$python" -m venv "$venv" || die "cannot make $venv; set CURVIREG_VENV to a folder that can be written"
fi
new_enough "$venv/bin/python" && pip --version >/dev/null 2>&1 ||
    die "$venv holds no Python 3.11 or newer with pip; remove it, or set CURVIREG_VENV to another folder"

if ! "$venv/bin/python" -c 'import torch' 2>/dev/null; then
    index=https://download.pytorch.org/whl/cpu # asked beside the configured ones; no harm where it cannot be reached
    build= reason="a GPU is here"
    echo "preparing $venv: asking the package index for torch" # which may take a while to answer
    if ! nvidia-smi -L >/dev/null 2>&1; then
        build=$(pip index versions torch --retries 0 --timeout 20 --extra-index-url "$index" 2>/dev/null |
            grep -o '[0-9][0-9.]*+cpu' | head -n 1 || true) # the newest; a tenth of a CUDA build and its libraries
        [ "$build" ] && reason="no GPU here" || reason="no GPU here, but no +cpu build in any index either"
    fi
    size="up to 6 GB on disk, for CUDA"
    [ -z "$build" ] || size="1.4 GB on disk"
    echo "installing torch${build:+==$build} ($reason) and what else the library needs into $venv: some minutes, $size"
    quiet=
    pip install ${build:+--extra-index-url "$index"} "torch${build:+==$build}"
fi
pip install -e ".$1"
