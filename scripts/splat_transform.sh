#!/usr/bin/env bash
# Runs PlayCanvas splat-transform, an independent reader and writer of .ply, .spz and .sog, at a fixed version, installed
# through npm into target/tools if missing; --where prints its path. TCGS_SPLAT_TRANSFORM names another one to run instead.
set -euo pipefail
version=2.7.1

if [ -n "${TCGS_SPLAT_TRANSFORM:-}" ]; then
    exec "$TCGS_SPLAT_TRANSFORM" "$@"
fi
root=$(cd "$(dirname "$0")/.." && pwd)
folder=${CARGO_TARGET_DIR:-$root/target}/tools/splat-transform-$version
program=$folder/node_modules/.bin/splat-transform
if [ ! -x "$program" ]; then
    command -v npm >/dev/null || {
        echo "splat_transform: npm is not installed (apt-get install npm), and splat-transform comes through it" >&2
        exit 4
    }
    mkdir -p "$folder"
    npm install --prefix "$folder" --no-audit --no-fund --ignore-scripts --loglevel=error \
        "@playcanvas/splat-transform@$version" >&2
fi
[ "${1:-}" != --where ] || exec echo "$program"
exec "$program" "$@"
