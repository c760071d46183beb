#!/usr/bin/env bash
# Runs cargo for the target wasm32-unknown-unknown: with rustup's target if it is installed, otherwise with Debian's compiler, which builds
# the standard library too.
#   scripts/wasm_cargo.sh COMMAND [ARGUMENT...]    cargo COMMAND --target wasm32-unknown-unknown ARGUMENT...
#   scripts/wasm_cargo.sh --install                installs Debian's compiler if neither is there
#   scripts/wasm_cargo.sh --has                    succeeds if one is there
set -euo pipefail
# shellcheck source=scripts/env.sh
. "$(dirname "$0")/env.sh"

target=wasm32-unknown-unknown
packages=(rustc-web cargo-web rust-web-src lld-19)
linker=/usr/bin/wasm-ld-19

has_rustup_target() { [ -d "$(rustc --print sysroot 2>/dev/null)/lib/rustlib/$target" ]; }
has_debian_compiler() { [ -x /usr/bin/cargo ] && [ -x $linker ] && dpkg --status "${packages[@]}" >/dev/null 2>&1; }

case ${1:?a command of cargo} in
--has) has_rustup_target || has_debian_compiler ;;
--install)
    if has_rustup_target || has_debian_compiler; then exit 0; fi
    if command -v rustup >/dev/null && rustup target add "$target" >&2; then exit 0; fi
    sudo=()
    [ "$(id -u)" -eq 0 ] || sudo=(sudo)
    "${sudo[@]}" apt-get update -q >&2
    DEBIAN_FRONTEND=noninteractive "${sudo[@]}" apt-get install -y -q --no-install-recommends "${packages[@]}" >&2
    ;;
*)
    command=$1
    shift
    if has_rustup_target; then
        exec cargo "$command" --target "$target" "$@"
    fi
    # An unstable option of a stable compiler, which has no standard library for the target.
    export RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1 RUSTFLAGS=-Clinker-flavor=wasm-ld
    export CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_LINKER=$linker
    exec /usr/bin/cargo "$command" -Zbuild-std=std,panic_abort --target "$target" "$@"
    ;;
esac
