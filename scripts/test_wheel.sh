#!/usr/bin/env bash
# Builds the wheel, installs it into an environment of its own, and runs it outside the checkout: weights, calibration and
# the page's static files must be inside. Set CURVIREG_WHEEL_SITE=1 to let the new environment see the packages of .venv.
set -euo pipefail
. "$(dirname "$0")/_environment.sh" ""
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
pip wheel --quiet --no-deps --wheel-dir "$work/wheels" .
"$venv/bin/python" -m venv "$work/venv"
if [ -n "${CURVIREG_WHEEL_SITE:-}" ]; then
    site=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    inside=$("$work/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    echo "$site" >"$inside/packages_of_the_checkout.pth" # read after the wheel's own folder, so that the wheel wins
    "$work/venv/bin/python" -m pip install --quiet --no-deps --disable-pip-version-check "$work"/wheels/*.whl
else
    "$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$work"/wheels/*.whl
fi
cd "$work"
"$work/venv/bin/python" - "$work/venv" <<'PYTHON'
import sys
from importlib.resources import files
from pathlib import Path

import curvireg_torch

package = Path(curvireg_torch.__file__).parent
assert package.is_relative_to(Path(sys.argv[1]).resolve()), f"imported from {package}, not from the wheel"
for name in ("py.typed", "calibration/calibration.json"):
    assert (files("curvireg_torch") / name).is_file(), f"the wheel lacks {name}"
PYTHON
"$work/venv/bin/curvireg" --version
"$work/venv/bin/curvireg" demo --out "$work/demo"
for name in overlay.png result.json; do
    [ -s "$work/demo/$name" ] || { echo "curvireg_torch: the wheel's demo wrote no $name" >&2; exit 1; }
done
echo "the wheel works outside the checkout"
