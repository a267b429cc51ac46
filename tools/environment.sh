#!/bin/sh
# The environment that every make target runs in. Writes inside the checkout only, caches aside.
#
#   tools/environment.sh venv    makes .venv from requirements.lock; does nothing when it is up to date
#   tools/environment.sh lock    writes requirements.lock anew from pyproject.toml; pins that still fit stay
#                                (to bring all of them up to date, delete requirements.lock first)
set -eu
cd "$(dirname "$0")/.."

stop() {
    echo "jaxform: $1" >&2
    exit 1
}

# --- The interpreter ------------------------------------------------------------------------------------------

# Prints the interpreter behind the command $1 if it really runs (a pyenv shim may not), is new enough and can
# make environments (some Linux packages of Python cannot). "Behind": not that of an environment now active.
probe() {
    "$1" -c '
import sys
if sys.version_info < (3, 12):
    sys.exit(1)
import ensurepip, venv
print(getattr(sys, "_base_executable", None) or sys.executable)
' 2>/dev/null
}

find_python() {
    for candidate in python3 python3.14 python3.13 python3.12 \
        "${HOME:-}"/.pyenv/versions/*/bin/python3 .uv/python/*/bin/python3; do
        probe "$candidate" && return
    done
    return 1
}

# Puts uv into .uv with whatever pip there is, of any Python.
fetch_uv() {
    [ -x .uv/bin/uv ] && return
    mkdir -p .uv
    echo '*' >.uv/.gitignore
    for pip in "python3 -m pip" "python -m pip" pip3 pip "$(find_python || echo false) -m pip"; do
        # shellcheck disable=SC2086  # the command is several words
        $pip install --quiet --disable-pip-version-check --target .uv uv >/dev/null 2>&1 || continue
        [ -x .uv/bin/uv ] && return
    done
    return 1
}

fetch_python() {
    echo "No Python 3.12 or newer runs here: fetching one into .uv" >&2
    fetch_uv && UV_PYTHON_INSTALL_DIR=.uv/python UV_PYTHON_INSTALL_BIN=0 \
        .uv/bin/uv --quiet --no-config python install 3.12 >/dev/null 2>&1
}

need_python() {
    python=$(find_python) || { fetch_python && python=$(find_python); } ||
        stop "no Python 3.12 or newer runs here and none could be fetched: install python3.12 (with its venv package)"
}

# --- .venv ----------------------------------------------------------------------------------------------------

# What .venv was made from is noted inside it, last, so that an interrupted build never looks complete. The place
# counts as well: an environment that was copied along with the checkout still points at the old one.
libraries_now() { { pwd -P; cat requirements.lock; } | cksum; }
project_now() { { pwd -P; cat pyproject.toml; } | cksum; }

libraries_note=.venv/libraries-made-from
project_note=.venv/project-made-from

is_current() { [ "$(cat "$1" 2>/dev/null)" = "$2" ]; }

# Byte code of a folder, also where the environment tells Python to write none, as many containers do: there each
# command would compile all that it imports anew, for three seconds and more. What is up to date is left alone.
precompile() { .venv/bin/python -m compileall -q -j 0 -x '/tests?/|/testing/' "$1" >/dev/null 2>&1 || true; }

install() { .venv/bin/python -m pip install --quiet --disable-pip-version-check "$@"; }

make_libraries() {
    need_python
    echo "Making .venv from requirements.lock with $python (a minute or two)" >&2
    rm -f "$libraries_note" "$project_note"
    rm -rf .venv
    "$python" -m venv .venv || stop "$python could not make .venv"
    # Most of what is installed is never imported: byte code is made of what the command imports, and of the rest when
    # it first is.
    install --no-compile --require-hashes --only-binary :all: -r requirements.lock ||
        stop "requirements.lock could not be installed (the lines above say why)"
    for package in jax jaxlib numpy scipy matplotlib meshio pydantic rich opt_einsum optax PIL; do
        precompile .venv/lib/python*/site-packages/"$package"
    done
    libraries_now >"$libraries_note"
}

make_venv() {
    if ! is_current "$libraries_note" "$(libraries_now)" || ! .venv/bin/python -c 'import pip' 2>/dev/null; then
        make_libraries
    fi
    precompile jaxform
    if ! is_current "$project_note" "$(project_now)"; then
        install --no-deps --no-build-isolation --editable . ||
            stop "the project itself could not be installed (the lines above say why)"
        project_now >"$project_note"
    fi
}

# --- requirements.lock ----------------------------------------------------------------------------------------

make_lock() {
    need_python
    fetch_uv || stop "uv could not be fetched with pip: install pip, or see to the network"
    .uv/bin/uv --quiet pip compile pyproject.toml --extra dev --universal --python "$python" --python-version 3.12 \
        --generate-hashes --no-header --output-file requirements.lock >/dev/null
}

case "${1:-}" in
venv) make_venv ;;
lock) make_lock ;;
*) stop "usage: tools/environment.sh venv | lock" ;;
esac
