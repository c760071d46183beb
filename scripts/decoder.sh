#!/usr/bin/env bash
# Checks that the decoder stands without the service: builds a program of it alone, for this machine and for WebAssembly, and decodes
# the golden files with both. Packages this crate and that of the renderer, as a registry would have them. scripts/web.sh builds the
# renderer for WebAssembly.
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

# Builds the decoder from what its package contains. The renderer's package is only made: it depends on the decoder's, which is in no
# registry, and has the shaders through a link.
cargo package --locked --package tcgs-codec --allow-dirty --quiet
cargo package --locked --package tcgs-render --allow-dirty --quiet --no-verify \
    --config 'patch.crates-io.tcgs-codec.path="crates/tcgs-codec"'
shaders=$(find shaders -name '*.wgsl' | wc -l)
packed=$(tar -tzf "${CARGO_TARGET_DIR:-target}"/package/tcgs-render-*.crate | grep -c '/shaders/.*\.wgsl$')
[ "$packed" -eq "$shaders" ] || { printf 'the package of tcgs-render has %s of %s shaders\n' "$packed" "$shaders" >&2; exit 1; }

# A package of its own, since `cargo run --example decode` would also build the dependencies of the tests.
embed() { cargo build --locked --quiet --manifest-path examples/embed/Cargo.toml --target-dir "$build" "$@"; }
embed --bin decode
"$build/debug/decode" tests/golden/*.tcgs

# Without what a check needs it is skipped, in CI it fails.
lacks() {
    printf 'SKIPPED: no WebAssembly check, since %s\n' "$1" >&2
    [ "${CI:-}" != true ] || exit 1
    exit 0
}

scripts/wasm_cargo.sh --has || lacks 'there is no compiler for it (scripts/setup.sh --for-tests installs one)'
wasm() { scripts/wasm_cargo.sh "$@" --locked --quiet --target-dir "$build"; }
wasm build --lib --manifest-path examples/embed/Cargo.toml
command -v node >/dev/null || lacks 'node is not installed'
node examples/embed/decode.mjs "$build/$target/debug/tcgs_wasm.wasm" tests/golden/*.tcgs
