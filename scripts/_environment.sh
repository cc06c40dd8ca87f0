# Sourced by demo.sh and test.sh: a virtual environment with the library in it, made once and brought up to date after.
# Usage: . scripts/_environment.sh EXTRAS     (EXTRAS: empty, or [dev])

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
venv=${CURVIREG_VENV:-$root/.venv}
python=${PYTHON:-python3}

if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    echo "curvireg_torch needs Python >= 3.11; set PYTHON to one (found: $("$python" --version 2>&1))" >&2
    exit 1
fi
if [ ! -x "$venv/bin/python" ]; then
    "$python" -m venv "$venv" || {
        echo "cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2
        exit 1
    }
fi
pip() { "$venv/bin/python" -m pip --quiet --disable-pip-version-check "$@"; }

if ! "$venv/bin/python" -c 'import torch' 2>/dev/null; then
    if command -v nvidia-smi >/dev/null 2>&1; then
        pip install "torch>=2.4"
    else
        # The CPU build is a tenth of the size. Where its index cannot be reached, whatever build pip finds will do.
        pip install --retries 0 --timeout 60 --extra-index-url https://download.pytorch.org/whl/cpu "torch==2.13.0+cpu" 2>/dev/null ||
            pip install "torch>=2.4"
    fi
fi
pip install -e ".$1"
