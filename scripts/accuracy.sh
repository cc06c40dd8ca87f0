#!/usr/bin/env bash
# Measures every accuracy table again: each data set below DATA is evaluated with the defaults, and compared with the
# stored results. An interrupted run resumes.
#     scripts/accuracy.sh DATA [OUT]
# DATA holds BOP sets in DATA/bop/NAME and PASCAL3D+ trees in DATA/pascal3d*; OUT (default out/accuracy) gets a folder of
# each run, and comparison.md. With RECORD=1 the new results replace the stored ones and the README's table.
set -euo pipefail
data=$(cd "${1:?usage: scripts/accuracy.sh DATA [OUT]}" && pwd)
out=${2:-out/accuracy}
. "$(dirname "$0")/_environment.sh" ""
mkdir -p "$out"
runs=()
evaluate() { # kind, folder
    local name
    name=$(basename "$2")
    "$venv/bin/curvireg" evaluate "$1" "$2" --out "$out/$name"
    runs+=("$out/$name/summary.json")
}
for folder in "$data"/pascal3d*/; do
    [ -d "$folder" ] && evaluate pascal3d "${folder%/}"
done
for folder in "$data"/bop/*/; do
    [ -f "$folder/test_targets_bop19.json" ] && evaluate bop "${folder%/}"
done
[ ${#runs[@]} -gt 0 ] || die "$data holds neither bop/NAME/test_targets_bop19.json nor pascal3d*"
if [ "${RECORD:-0}" = 1 ]; then
    for run in "${runs[@]}"; do
        "$venv/bin/python" scripts/results_table.py --record "$run" "$(basename "$(dirname "$run")")"
    done
    "$venv/bin/python" scripts/results_table.py
else
    "$venv/bin/python" scripts/results_table.py --compare "${runs[@]}" | tee "$out/comparison.md"
fi
