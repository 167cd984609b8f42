#!/bin/sh
# make setup: choose a Python, then let tools/setup_env.py do the work.
# PYTHON=python3.12 make setup selects one; without it, an existing .venv keeps its Python.
set -u
cd "$(dirname "$0")/.." || exit 1

supported="3.10 3.11 3.12 3.13"

version_of() {  # prints 3.12, or nothing if this is not a Python that runs
    "$1" -c 'import sys; sys.stdout.write("%d.%d" % sys.version_info[:2])' 2>/dev/null
}

is_supported() {
    case " $supported " in *" $1 "*) return 0 ;; *) return 1 ;; esac
}

python=${PYTHON:-}
if [ -n "$python" ]; then
    version=$(version_of "$python")
    if [ -z "$version" ]; then
        echo "setup: PYTHON=$python is not a Python that runs here: name one of version $supported." >&2
        exit 1
    fi
    if ! is_supported "$version"; then
        echo "setup: PYTHON=$python is Python $version, but ROS and the pinned packages are there for $supported only: name one of these." >&2
        exit 1
    fi
else
    seen=""
    for candidate in "$(cat .venv/.setup/python 2>/dev/null)" python3 python3.12 python3.11 python3.13 python3.10; do
        [ -n "$candidate" ] || continue
        version=$(version_of "$candidate")
        [ -n "$version" ] || continue
        if is_supported "$version"; then
            python=$candidate
            break
        fi
        seen="${seen:+$seen, }$candidate is $version"
    done
    if [ -z "$python" ]; then
        echo "setup: no Python of version $supported was found (found: ${seen:-none}): install one, e.g. 'sudo apt install python3.12 python3.12-venv python3.12-dev', or name it with PYTHON=/path/to/python3 make setup." >&2
        exit 1
    fi
fi

exec "$python" tools/setup_env.py
