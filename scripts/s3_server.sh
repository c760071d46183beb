#!/usr/bin/env bash
# Prints the path of s3s-fs, a small S3 server over a folder that tests start, at a fixed version, built through cargo into
# target/tools if missing. TCGS_S3_SERVER names another one, also Garage's `garage`.
set -euo pipefail
version=0.14.1

if [ -n "${TCGS_S3_SERVER:-}" ]; then
    exec echo "$TCGS_S3_SERVER"
fi
root=$(cd "$(dirname "$0")/.." && pwd)
target=${CARGO_TARGET_DIR:-$root/target}
folder=$target/tools/s3s-fs-$version
if [ ! -x "$folder/bin/s3s-fs" ]; then
    # There rust-toolchain.toml names the toolchain.
    cd "$root"
    # Little optimization: it builds in half the time, and tests send it small files.
    CARGO_TARGET_DIR=$target/tools/build CARGO_PROFILE_DEV_OPT_LEVEL=1 CARGO_PROFILE_DEV_DEBUG=0 \
        cargo install --quiet --locked --debug --root "$folder" --features binary --version "$version" s3s-fs >&2
    rm -rf "$target/tools/build"
fi
echo "$folder/bin/s3s-fs"
