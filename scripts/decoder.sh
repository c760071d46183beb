#!/usr/bin/env bash
# Checks that the decoder stands without the service: builds a program of it alone, for this machine and for WebAssembly, and decodes
# the golden files with both. Packages this crate and that of the renderer, as a registry would have them, and builds the renderer for
# WebAssembly too.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

target=wasm32-unknown-unknown
build=${CARGO_TARGET_DIR:-$PWD/target}/decoder

crates=$(cargo tree --locked --package tcgs-codec --edges normal --prefix none --format '{p}' | cut -d ' ' -f 1 | sort -u)
count=$(($(wc -l <<<"$crates") - 1))
printf 'the decoder depends on %s crates, indirect ones included; at most 60 are accepted\n' "$count"
[ "$count" -le 60 ]
if grep -xE 'axum|hyper|reqwest|sqlx|tokio|wgpu' <<<"$crates"; then
    printf 'these are dependencies of the service\n' >&2
    exit 1
fi

# Builds the crates from what their packages contain.
cargo package --locked --package tcgs-codec --package tcgs-render --allow-dirty --quiet

# A package of its own, since `cargo run --example decode` would also build the dependencies of the tests.
embed() { cargo build --locked --quiet --manifest-path examples/embed/Cargo.toml --target-dir "$build" "$@"; }
embed --bin decode
"$build/debug/decode" tests/golden/*.tcgs

if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$target" ]; then
    printf 'SKIPPED: no WebAssembly check, since Rust has no target %s here (rustup target add %s)\n' "$target" "$target"
    exit 0
fi
cargo check --locked --quiet --package tcgs-render --target "$target" --target-dir "$build"
embed --lib --target "$target"
if ! command -v node >/dev/null; then
    printf 'SKIPPED: built for WebAssembly but not run, since node is not installed\n'
    exit 0
fi
node examples/embed/decode.mjs "$build/$target/debug/tcgs_wasm.wasm" tests/golden/*.tcgs
