#!/usr/bin/env bash
# Installs everything, then checks style, spelling and types, and tests. Arguments go to pytest, for instance -m "not slow".
set -euo pipefail
. "$(dirname "$0")/_environment.sh" "[dev]"
"$venv/bin/ruff" check .
"$venv/bin/ruff" format --check .
"$venv/bin/codespell"
"$venv/bin/lint-imports"
"$venv/bin/mypy"
"$venv/bin/python" -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile "$@"
