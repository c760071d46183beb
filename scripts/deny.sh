#!/usr/bin/env bash
# Checks licenses, duplicate crates and sources of everything in Cargo.lock by deny.toml, with cargo-deny at a fixed version, built through
# cargo into target/tools if missing (two minutes). Known vulnerabilities are checked where the database of advisories can be fetched, and it
# is said where it cannot.
set -euo pipefail
version=0.20.2

root=$(cd "$(dirname "$0")/.." && pwd)
target=${CARGO_TARGET_DIR:-$root/target}
folder=$target/tools/cargo-deny-$version
# There rust-toolchain.toml names the toolchain.
cd "$root"
if [ ! -x "$folder/bin/cargo-deny" ]; then
    # Without optimization: it builds in two minutes on two cores, and checks in six seconds.
    CARGO_TARGET_DIR=$target/tools/build-deny CARGO_PROFILE_DEV_DEBUG=0 cargo install --quiet --locked --debug --root "$folder" --version "$version" cargo-deny >&2
    rm -rf "$target/tools/build-deny"
fi
deny() { "$folder/bin/cargo-deny" --locked --log-level error "$@"; }

deny check licenses bans sources
echo "licenses, bans and sources of $(grep -c '^name = ' Cargo.lock) packages are as deny.toml says"
if said=$(deny fetch db 2>&1); then
    deny check advisories
    echo "no package has a known vulnerability"
else
    printf '%s\n' "$said" | tail -n 2
    echo "ADVISORIES WERE NOT CHECKED: their database cannot be reached from here"
fi
