#!/usr/bin/env bash
# Registers a photograph to a mesh, both made in code, and writes out/demo/{overlay.png,result.json}. Works offline once
# the packages are installed. Arguments go to `curvireg demo`.
set -euo pipefail
. "$(dirname "$0")/_environment.sh" ""
"$venv/bin/curvireg" demo --out out/demo "$@"
