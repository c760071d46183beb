#!/usr/bin/env bash
# Builds the viewer for browsers into target/web: worker.js and viewer.wasm.gz, which the service embeds when it is compiled after them.
# Without a compiler for WebAssembly it builds nothing, and pages show pictures of the service instead.
#   scripts/web.sh            builds
#   scripts/web.sh --check    lints the code that only browsers compile; a warning is a failure
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

target=${CARGO_TARGET_DIR:-$PWD/target}
web=$target/web

scripts/wasm_cargo.sh --has || {
    printf 'web: no compiler for WebAssembly (scripts/setup.sh installs one through rustup): pages show pictures of the service\n' >&2
    [ "${1:-}" != --check ] || [ "${CI:-}" != true ]
    exit
}
if [ "${1:-}" = --check ]; then
    # The folder and profile of the build, so that its programs that run while building are not built again.
    exec scripts/wasm_cargo.sh clippy --locked --quiet --package tcgs-web --profile web --target-dir "$target/web-build" -- --deny warnings
fi
scripts/wasm_cargo.sh build --locked --quiet --package tcgs-web --profile web --target-dir "$target/web-build"
module=$target/web-build/wasm32-unknown-unknown/web/tcgs_web.wasm
if [ "$web/worker.js" -nt "$module" ] && [ "$web/worker.js" -nt crates/tcgs-web/worker.js ]; then exit 0; fi
cargo build --locked --quiet --manifest-path scripts/bindgen/Cargo.toml --target-dir "$target/bindgen"
mkdir -p "$web"
"$target/bindgen/debug/bindgen" "$module" "$web/generated"
cat "$web/generated/tcgs_web.js" crates/tcgs-web/worker.js >"$web/worker.js"
gzip --best --no-name --stdout "$web/generated/tcgs_web_bg.wasm" >"$web/viewer.wasm.gz"
rm -r "$web/generated"
