#!/usr/bin/env bash
# Runs one short job under the Khronos validation layer, from Debian's vulkan-validationlayers package: trains the bundled scene
# long enough for every stage, encodes, decodes and measures it, and renders a view. Fails on any message of the layer.
#   scripts/validation.sh [STEPS]    training steps, 60 if not given
# The program is target/debug/tcgs unless TCGS names another. The messages are in target/validation.log.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

steps=${1:-60}
target=${CARGO_TARGET_DIR:-target}
program=${TCGS:-$target/debug/tcgs}
log=$target/validation.log

folder=$(scripts/debian_package.sh vulkan-validationlayers)
library=$(find "$folder" -name libVkLayer_khronos_validation.so | head -n 1)
[ -n "$library" ] || { echo "validation: $folder holds no validation layer" >&2; exit 4; }
export VK_LAYER_PATH=$folder/usr/share/vulkan/explicit_layer.d
export LD_LIBRARY_PATH=$(dirname "$library")${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
# wgpu enables the layer and logs its messages.
export WGPU_VALIDATION=1 WGPU_DEBUG=1 RUST_LOG=warn

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"$program" sample "$scratch/scene.zip" --side 32 >/dev/null
adapter=${TCGS_ADAPTER:-lavapipe}
pose='{"camera_to_world":[[1,0,0,0],[0,1,0,0],[0,0,1,-3],[0,0,0,1]],"fx":30,"width":32,"height":32}'
render() { "$program" render "$scratch/scene.tcgs" --adapter "$adapter" --pose "$pose" -o "$scratch/view.png"; }
status=0
{
    "$program" train "$scratch/scene.zip" -o "$scratch/scene.tcgs" --adapter "$adapter" --iterations "$steps" --json &&
        render
} >/dev/null 2>"$log" || status=$?

if [ "$status" -ne 0 ]; then
    cat "$log" >&2
    echo "validation: the job failed" >&2
    exit "$status"
fi
if grep -E 'wgpu_hal|VUID|UNASSIGNED|[Vv]alidation' "$log" >&2; then
    echo "validation: the messages above are in $log" >&2
    exit 1
fi
# Its best-practice messages are never empty, so their absence means that the layer is missing.
if ! VK_LAYER_ENABLES=VK_VALIDATION_FEATURE_ENABLE_BEST_PRACTICES_EXT render 2>&1 >/dev/null | grep -c BestPractices >/dev/null; then
    echo "validation: the layer was not asked" >&2
    exit 1
fi
echo "validation: $steps steps and a view without a message"
