#!/usr/bin/env bash
# Packs what scripts/gpu_day.sh needs on a machine with a GPU that has neither cargo nor a network: the program, the tests and the
# kernel benchmark as release binaries, and photographs. Usage: scripts/gpu_kit.sh [FOLDER]; it is replaced and stays under 60 MB.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

kit=${1:-out/gpu-kit}
data=${TCGS_SHARED:-../shared}/data
max_bytes=55000000
target=${CARGO_TARGET_DIR:-target}

say() { printf 'gpu_kit: %s\n' "$*"; }

# The path of the executable that cargo built for the one target given.
built() { sed -n 's/.*"executable":"\([^"]*\)".*/\1/p' | tail -n 1; }

cargo build --release --locked --quiet
tests=$(cargo test --release --locked --no-run --test it --message-format json 2>/dev/null | built)
kernels=$(cargo bench --locked --no-run --bench kernels --message-format json 2>/dev/null | built)

rm -rf "$kit"
mkdir -p "$kit/data"
cp scripts/gpu_day.sh "$kit/"
for binary in "$target/release/tcgs:tcgs" "$tests:tests" "$kernels:kernels"; do
    strip -o "$kit/${binary##*:}" "${binary%%:*}"
done
tar -C "$kit" -cJf "$kit/binaries.tar.xz" tcgs tests kernels
rm "$kit/tcgs" "$kit/tests" "$kit/kernels"
# In this order, the largest last, so that what does not fit is what matters least.
for set in chair chair_800; do
    if [ ! -d "$data/$set" ]; then
        say "$data has no $set: its runs are left out"
        continue
    fi
    tar -C "$data" -cf "$kit/data/$set.tar" "$set"
    if [ "$(du -sb "$kit" | cut -f 1)" -gt "$max_bytes" ]; then
        rm "$kit/data/$set.tar"
        say "$set does not fit into $max_bytes bytes: its runs are left out"
    fi
done
say "$kit has $(du -sb "$kit" | cut -f 1) bytes; on the machine: $kit/gpu_day.sh"
