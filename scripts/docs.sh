#!/usr/bin/env bash
# Builds the documentation into docs/_build/html, warnings as errors, and checks its links. Arguments go to sphinx-build.
set -euo pipefail
. "$(dirname "$0")/_environment.sh" "[docs]"
export MPLBACKEND=Agg CURVIREG_CACHE=${CURVIREG_CACHE:-$root/docs/_build/cache}
"$venv/bin/python" -m sphinx --fail-on-warning --keep-going --nitpicky docs docs/_build/html "$@"
"$venv/bin/python" docs/check_site.py docs/_build/html
