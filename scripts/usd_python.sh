#!/usr/bin/env bash
# Prints the path of a Python with usd-core, an independent reader of .usda, at a fixed version; installed through PyPI into
# target/tools if missing.
set -euo pipefail
version=26.11

root=$(cd "$(dirname "$0")/.." && pwd)
folder=${CARGO_TARGET_DIR:-$root/target}/tools/usd-core-$version
if [ ! -x "$folder/bin/python3" ] || ! "$folder/bin/python3" -c 'import pxr' 2>/dev/null; then
    python3 -m venv "$folder" || {
        echo "usd_python: Python has no venv (apt-get install python3-venv), and usd-core comes through it" >&2
        exit 4
    }
    "$folder/bin/python3" -m pip install --quiet "usd-core==$version" >&2
fi
echo "$folder/bin/python3"
