#!/bin/sh
# Print the path of the newest Python on this machine that can run delucax, or with the
# argument `oldest` that of the oldest one.
#
# A candidate counts only once it has been run: a pyenv shim may sit on PATH and fail for
# a version that is not selected, and some systems ship a Python without `venv`. Every
# directory of PATH is searched, then pyenv's own versions, so that a broken shim does not
# hide the real interpreter behind it.

set -u

MINIMUM=11 # 3.11, as requires-python in pyproject.toml
order=${1:-newest}
NEWEST=14  # 3.14, the newest version with wheels of every dependency

# Print the minor version of a usable CPython 3, or nothing.
minor_version() {
    "$1" -I -c '
import ensurepip, sys, venv
v = sys.version_info
if sys.implementation.name == "cpython" and v[0] == 3 and v.releaselevel == "final":
    print(v[1])
' 2>/dev/null </dev/null
}

best=
best_rank=-1

consider() {
    [ -f "$1" ] && [ -x "$1" ] || return 0
    minor=$(minor_version "$1") || return 0
    case $minor in '' | *[!0-9]*) return 0 ;; esac
    [ "$minor" -ge "$MINIMUM" ] || return 0
    # Known versions first; a newer one only where there is nothing else.
    if [ "$minor" -gt "$NEWEST" ]; then
        rank=0
    elif [ "$order" = oldest ]; then
        rank=$((100 - minor))
    else
        rank=$minor
    fi
    if [ "$rank" -gt "$best_rank" ]; then
        best=$1
        best_rank=$rank
    fi
}

old_ifs=$IFS
IFS=:
set -f
for directory in $PATH; do
    for name in python3.14 python3.13 python3.12 python3.11 python3 python; do
        consider "${directory:-.}/$name"
    done
done
set +f
IFS=$old_ifs

for python in "${PYENV_ROOT:-${HOME:-}/.pyenv}"/versions/*/bin/python3; do
    consider "$python"
done

if [ -z "$best" ]; then
    echo "delucax needs Python 3.$MINIMUM or newer with venv and pip; none was found." >&2
    echo "Install one, or name it: make PYTHON=/path/to/python3 ..." >&2
    exit 1
fi
echo "$best"
