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
.venv/bin/python -m mypy >"$types" 2>&1 & # beside the tests
mypy=$!
status=0
# two processes of one thread each: quicker than one whose threads wait for each other
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
.venv/bin/python -m pytest -n "${TEST_PROCESSES:-2}" --dist worksteal "$@" || status=$?
wait "$mypy" || status=$?
cat "$types"
exit "$status"
