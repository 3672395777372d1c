#!/usr/bin/env bash
# Style, types and tests. Arguments go to pytest: `bash scripts/run_tests.sh -m slow`, `... tests/cli -x`.
# Makes .venv first where there is none; PYTHON=... chooses the interpreter.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup_venv.sh"
setup_venv dev

.venv/bin/python -m ruff check
.venv/bin/python -m ruff format --check
.venv/bin/python -m mypy
.venv/bin/python -m pytest "$@"
