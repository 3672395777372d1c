# Sourced by run_sample.sh and run_tests.sh. Makes .venv in the checkout once and brings it up to date when
# pyproject.toml or the pinned versions change. PYTHON=... chooses the interpreter.

# what another project put on the path (ROS, for one) must not replace the pinned packages
unset PYTHONPATH PYTHONHOME

fail() {
    echo "error: $*" >&2
    exit 2
}

# find_python: prints the first interpreter that is new enough
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    fail "${PYTHON:-python3}: is not Python 3.11 or newer; install it (Debian, Ubuntu: apt install python3 python3-venv)" \
        "or name one with PYTHON=..."
}

# setup_venv [EXTRA]: .venv with this package, editable, and its extra; changes to the root of the checkout
setup_venv() {
    local extra=${1:-} python stamp wanted
    cd "$(dirname "${BASH_SOURCE[0]}")/.."
    # an environment that does not start (moved, made by a Python since removed, cut short) is made anew
    if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
        python=$(find_python)
        "$python" -c 'import venv, ensurepip' 2>/dev/null ||
            fail "$python: has no venv module; install it (Debian, Ubuntu: apt install python3-venv)"
        "$python" -m venv --clear .venv
    fi
    stamp=.venv/torchpose-installed${extra:+-$extra}
    wanted=$(pwd && cat pyproject.toml configs/constraints.txt)
    if [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]; then
        echo "Installing torchpose${extra:+[$extra]} into .venv: some minutes when torch has to be downloaded"
        .venv/bin/python -m pip install -qq --disable-pip-version-check \
            -c configs/constraints.txt -e ".${extra:+[$extra]}"
        echo "$wanted" | tee .venv/torchpose-installed >"$stamp"
    fi
}
