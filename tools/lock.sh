#!/bin/sh
# make lock: resolve requirements.in into requirements.lock with uv, for all supported Pythons, with
# the hash of every file of every package. Versions in the lock are kept where they still fit:
# make lock ARGS=--upgrade takes the newest versions, ARGS='--upgrade-package numpy' those of one package.
set -u
cd "$(dirname "$0")/.." || exit 1

tool=.lock/bin/uv
if [ ! -x "$tool" ]; then
    .venv/bin/python -m venv .lock && .lock/bin/python -m pip install --quiet uv==0.13.9
    if [ ! -x "$tool" ]; then
        echo "lock: uv cannot be installed from here: run make lock where the package index can be reached." >&2
        exit 2
    fi
fi

# 3.10 is the oldest supported Python.
exec "$tool" pip compile requirements.in --output-file requirements.lock --quiet \
    --universal --python-version 3.10 --generate-hashes --no-annotate --custom-compile-command 'make lock' "$@"
