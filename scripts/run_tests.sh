#!/usr/bin/env bash
# Style, types and tests. Arguments go to pytest: `bash scripts/run_tests.sh -m slow`, `... tests/cli -x`.
# Makes .venv first where there is none; PYTHON=... chooses the interpreter.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup_venv.sh"
setup_venv dev

.venv/bin/python -m ruff check
.venv/bin/python -m ruff format --check
types=$(mktemp)
trap 'rm -f "$types"' EXIT
.venv/bin/python -m mypy >"$types" 2>&1 & # on the second core, which the tests leave free most of the time
mypy=$!
status=0
.venv/bin/python -m pytest "$@" || status=$?
wait "$mypy" || status=$?
cat "$types"
exit "$status"
