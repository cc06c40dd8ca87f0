#!/usr/bin/env bash
# Tests the newest and the lowest versions that pyproject.toml admits and writes the table of docs/versions.md: see
# versions.py. Arguments are cells, for instance 3.12-newest; none: every one that was not tested yet at this commit.
exec "${PYTHON:-python3}" "$(dirname "$0")/versions.py" "$@"
