#!/usr/bin/env bash
# Runs the suite with the newest and the lowest versions that pyproject.toml admits, and prints one line for each cell.
# Usage: scripts/test_versions.sh [3.12-newest 3.11-lowest ...]     (SELECT: marks for pytest -m, default "not slow")
# "newest" is what pip installs today; "lowest" makes every lower bound of pyproject.toml exact. Each cell has its own
# environment and log in out/versions; the environment is removed afterwards because it takes several GB.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p out/versions
failed=0
[ $# -gt 0 ] || set -- 3.11-newest 3.11-lowest 3.12-newest 3.13-newest 3.14-newest
for cell in "$@"; do
    python=python${cell%-*} venv=out/versions/$cell constraints=out/versions/$cell.txt log=out/versions/$cell.log
    "$python" --version >/dev/null 2>&1 || { echo "$cell: $python is not installed"; continue; }
    : >"$constraints"
    if [ "${cell#*-}" = lowest ]; then
        "$python" -c 'if True:
            import tomllib
            project = tomllib.load(open("pyproject.toml", "rb"))["project"]
            groups = [project["dependencies"], *project["optional-dependencies"].values()]
            print(*sorted({one.replace(">=", "==") for group in groups for one in group if ">=" in one}), sep="\n")' >"$constraints"
    fi
    if "$python" -m venv "$venv" && "$venv/bin/python" -m pip install --quiet -e ".[dev]" -c "$constraints" &&
        "$venv/bin/python" -m pytest -q -n auto --maxprocesses 4 --dist loadfile -p no:cacheprovider -m "${SELECT-not slow}"; then
        result=passed
    else
        result=FAILED failed=1
    fi >"$log" 2>&1
    echo "$cell: $result: $(tail -n 1 "$log"); $("$venv/bin/python" -m pip list 2>/dev/null |
        awk '$1 ~ /^(torch|kornia|numpy|scipy|opencv-python-headless|trimesh|scikit-learn|safetensors)$/ {printf "%s %s, ", $1, $2}')"
    rm -rf "$venv"
done
exit $failed
