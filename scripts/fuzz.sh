#!/usr/bin/env bash
# Fuzzes each target of fuzz/ in turn: scripts/fuzz.sh [SECONDS a target] [TARGET...]. New inputs go into a folder beside
# the committed corpus; inputs that fail are kept in fuzz/artifacts.
#
# The program has no unsafe code, so there is no sanitizer, and any toolchain will do.
set -euo pipefail
cd "$(dirname "$0")/../fuzz"
# shellcheck source=scripts/env.sh
. ../scripts/env.sh

seconds=${1:-600}
shift || true
targets=("$@")
codec=(decode decode_header roundtrip)
readers=(ingest_zip colmap_binary colmap_text camera transforms_json masks ply spz view_query upload_headers)
[ ${#targets[@]} -gt 0 ] || targets=("${codec[@]}" "${readers[@]}")

if ! cargo fuzz --version >/dev/null 2>&1; then
    cargo install cargo-fuzz --locked
fi

# One thread, so that a run costs what its input costs.
export RAYON_NUM_THREADS=1
for target in "${targets[@]}"; do
    found="artifacts/corpus/$target"
    mkdir -p "$found"
    features=()
    # The codec's targets need the library without the service.
    [[ " ${codec[*]} " == *" $target "* ]] || features=(--features service)
    words=()
    [ ! -f "dictionaries/$target.dict" ] || words=(-dict="dictionaries/$target.dict")
    cargo fuzz run --sanitizer none "${features[@]}" "$target" "$found" "corpus/$target" -- "${words[@]}" \
        -max_total_time="$seconds" -timeout=10 -rss_limit_mb=1024 -malloc_limit_mb=96 -max_len=16384 -print_final_stats=1
done
