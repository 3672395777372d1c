#!/usr/bin/env bash
# The documentation site, into site/ or the folder given: every warning is an error. Needs no network once .venv is there.
# Makes .venv first where there is none; PYTHON=... chooses the interpreter.
set -euo pipefail
out=$(realpath -m "${1:-$(dirname "${BASH_SOURCE[0]}")/../site}")
source "$(dirname "${BASH_SOURCE[0]}")/setup_venv.sh"
setup_venv docs
# what Material prints about the future of MkDocs is no warning about these pages
NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --strict --quiet --site-dir "$out"
echo "Documentation: $out/index.html"
