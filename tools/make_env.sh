#!/bin/sh
# Builds .venv from the lock, or leaves it alone when it is up to date. Safe to interrupt: the stamp
# is written last, and without it the next call starts over from what pip and uv have cached.
set -eu
cd "$(dirname "$0")/.."

wanted=$(cat requirements/all.txt requirements/uv.txt pyproject.toml tools/make_env.sh | cksum)
stamp=.venv/fitact-ready
if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted $(pwd)" ] && .venv/bin/python -c '' 2>/dev/null; then
    exit 0
fi

python=${PYTHON:-}
if [ -z "$python" ]; then
    for candidate in python3 python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null 2>&1 &&
            "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            python=$candidate
            break
        fi
    done
fi
if [ -z "$python" ]; then
    echo "set-up: no Python 3.11 or later was found; install one, or name it: make PYTHON=/path/to/python3" >&2
    exit 1
fi

echo "set-up: building .venv with $("$python" --version) (once; a minute or less)" >&2
rm -rf .venv
if ! "$python" -m venv .venv >/dev/null; then
    echo "set-up: $python cannot make virtual environments; on Debian or Ubuntu: apt-get install python3-venv" >&2
    exit 1
fi
# uv installs several times faster; where it is not to be had, pip installs the same lock
# (bytecode at once, as pip does: where Python may not write any, each start would take seconds more)
locked() {
    .venv/bin/uv pip install --quiet --compile-bytecode "$@" --python .venv/bin/python --require-hashes -r requirements/all.txt
}
if .venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/uv.txt &&
    { locked || locked --system-certs; }; then # the latter behind a proxy with a certificate of its own
    .venv/bin/uv pip install --quiet --python .venv/bin/python --no-deps --no-build-isolation --editable .
else
    echo "set-up: uv did not succeed; installing the same with pip, which takes some minutes" >&2
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/all.txt
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
fi
echo "$wanted $(pwd)" >"$stamp"
echo "set-up: done, .venv/bin/fitact" >&2
