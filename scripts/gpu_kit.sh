#!/usr/bin/env bash
# Packs what scripts/gpu_day.sh needs on a machine with a GPU that has neither cargo nor a network: the program and the kernel
# benchmark as release binaries, and photographs. The kit stays under 48 MB: if it must, chair_800 keeps half of its test views, then
# chair is left out.
#
#   gpu_kit.sh [--tests] [FOLDER]    replaces FOLDER, by default out/gpu-kit; --tests adds the tests, two large binaries
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

kit=out/gpu-kit
data=${TCGS_SHARED:-../shared}/data
max_bytes=48000000
target=${CARGO_TARGET_DIR:-target}
binaries=(tcgs kernels)
for argument in "$@"; do
    case $argument in
    --tests) binaries+=(tests render_tests) ;;
    -*) echo "gpu_kit: there is no flag $argument" >&2; exit 2 ;;
    *) kit=$argument ;;
    esac
done

say() { printf 'gpu_kit: %s\n' "$*"; }

# The path of the executable that cargo built for the one target given.
built() { sed -n 's/.*"executable":"\([^"]*\)".*/\1/p' | tail -n 1; }

# The path of a release binary, built if need be. GPU_KIT_BINARIES names a folder of binaries that are built already.
binary() {
    if [ -n "${GPU_KIT_BINARIES:-}" ]; then
        echo "$GPU_KIT_BINARIES/$1"
        return
    fi
    case $1 in
    tcgs) cargo build --release --locked --quiet && echo "$target/release/tcgs" ;;
    tests) cargo test --release --locked --no-run --test it --message-format json 2>/dev/null | built ;;
    render_tests)
        cargo test --release --locked --no-run --package tcgs-render --test it --message-format json 2>/dev/null | built
        ;;
    kernels) cargo bench --locked --no-run --bench kernels --message-format json 2>/dev/null | built ;;
    esac
}

size() { du -sb "$kit" | cut -f 1; }

fits() { [ "$(size)" -le "$max_bytes" ]; }

# pack SET TEST_STRIDE: a Blender set with every TEST_STRIDE-th test view, and without validation views, which no run reads.
pack() {
    python3 - "$data/$1" "$kit/data/$1.tar" "$2" <<'PYTHON'
import io, json, sys, tarfile
from pathlib import Path

source, target, stride = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
transforms = json.loads((source / "transforms_test.json").read_text())
names = [Path(frame["file_path"]).stem for frame in transforms["frames"]]
left_out = set(names) - set(names[::stride])
transforms["frames"] = transforms["frames"][::stride]

def is_packed(path):
    inside = path.relative_to(source)
    if inside.parts[0] == "test":
        return path.stem not in left_out
    return inside.parts[0] not in ("val", "transforms_val.json", "transforms_test.json")

with tarfile.open(target, "w") as archive:
    for path in sorted(path for path in source.rglob("*") if path.is_file() and is_packed(path)):
        archive.add(path, source.name / path.relative_to(source))
    text = json.dumps(transforms).encode()
    entry = tarfile.TarInfo(f"{source.name}/transforms_test.json")
    entry.size = len(text)
    archive.addfile(entry, io.BytesIO(text))
PYTHON
}

rm -rf "$kit"
mkdir -p "$kit/data"
cp scripts/gpu_day.sh scripts/gpu_day.py "$kit/"
git describe --always --dirty >"$kit/revision"
for name in "${binaries[@]}"; do
    path=$(binary "$name")
    strip -o "$kit/$name" "$path"
done
tar -C "$kit" -cJf "$kit/binaries.tar.xz" --remove-files "${binaries[@]}"
for set in chair_800 chair; do
    if [ -d "$data/$set" ]; then
        pack "$set" 1
    else
        say "$data has no $set: its runs are left out"
    fi
done
if ! fits && [ -f "$kit/data/chair_800.tar" ]; then
    pack chair_800 2
    say "chair_800 keeps every second test view: with all of them the kit exceeds $max_bytes bytes"
fi
if ! fits && [ -f "$kit/data/chair.tar" ]; then
    rm "$kit/data/chair.tar"
    say "chair does not fit into $max_bytes bytes: its runs are left out"
fi
if ! fits; then
    say "$kit has $(size) bytes, more than $max_bytes: pack it without --tests" >&2
    exit 1
fi
say "$kit has $(size) bytes; on the machine: $kit/gpu_day.sh"
