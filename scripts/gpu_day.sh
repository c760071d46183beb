#!/usr/bin/env bash
# Everything that shows whether the program is right and fast on a GPU, most decisive first, each part under a time limit, from the
# binaries of `make gpu-kit`; needs neither cargo nor a network.
#   gpu_day.sh [PART...]     runs the named parts (see `parts` below), by default all
# Writes two files to $OUT (default: the folder results beside this script): log.txt, with the metrics of every run, and scenes.tar,
# with the trained files. TCGS_ADAPTER chooses the adapter, by default the best one. GPU_DAY_STEPS sets the steps of all trainings,
# for a trial on a CPU.
set -uo pipefail
kit=$(cd "$(dirname "$0")" && pwd)
out=${OUT:-$kit/results}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
scenes=$work/scenes
mkdir -p "$out" "$scenes"
log=$out/log.txt
export TCGS_ADAPTER=${TCGS_ADAPTER:-auto}
if [ -z "${XDG_RUNTIME_DIR:-}" ]; then
    export XDG_RUNTIME_DIR=$work
fi
# Where NVIDIA's container runtime mounts the driver without telling the loader.
nvidia=/usr/local/nvidia/share/vulkan/icd.d/nvidia_icd.json
if [ -z "${VK_DRIVER_FILES:-}" ] && [ -f "$nvidia" ]; then
    export VK_DRIVER_FILES=$nvidia
fi

summary=()

# part NAME SECONDS COMMAND...: runs the command into the log, under the limit, and notes how it ended.
part() {
    local name=$1 limit=$2 began=$SECONDS status
    shift 2
    printf '\n== %s (at most %s s): %s\n' "$name" "$limit" "$*" | tee -a "$log"
    timeout --kill-after 10 "$limit" "$@" 2>&1 | tee -a "$log"
    status=${PIPESTATUS[0]}
    summary+=("$(printf '%-22s %5s s  %s' "$name" $((SECONDS - began)) "$(verdict "$status")")")
    return "$status"
}

verdict() {
    case $1 in
    0) echo ok ;;
    124 | 137) echo 'stopped at its limit' ;;
    *) echo "failed with status $1" ;;
    esac
}

# train NAME SECONDS DATASET FLAGS...: one run.
train() {
    local name=$1 limit=$2 dataset=$3
    shift 3
    [ -d "$dataset" ] || { summary+=("$(printf '%-22s        left out: no %s' "$name" "$dataset")"); return; }
    case " $* " in
    *' --iterations '*) ;;
    *) [ -z "${GPU_DAY_STEPS:-}" ] || set -- "$@" --iterations "$GPU_DAY_STEPS" ;;
    esac
    part "$name" "$limit" "$work/tcgs" train "$dataset" -o "$scenes/$name.$(extension "$@")" "$@"
}

extension() {
    case " $* " in
    *' 3dgs '*) echo ply ;;
    *' scaffold '*) echo safetensors ;;
    *) echo tcgs ;;
    esac
}

doctor() { part doctor 60 "$work/tcgs" doctor; }

# Kernels against their f64 twins and central differences, on the adapter and on its other variant of kernels.
tests() { (cd "$work" && part tests 420 "$work/tests" gpu:: render:: train::loss train::adam train::wavelet train::rate:: train::context --skip oracle --test-threads 4); }

# The same seed must give the same bytes.
repeat() {
    local run
    "$work/tcgs" sample "$work/sample" >/dev/null
    for run in first second; do
        train "repeat-$run" 120 "$work/sample" --iterations "${GPU_DAY_STEPS:-400}"
    done
    part repeat-compare 10 cmp "$scenes/repeat-first.tcgs" "$scenes/repeat-second.tcgs"
}

accuracy() { part accuracy 120 "$work/tcgs" bench accuracy; }

kernels() {
    part kernels-200k 60 "$work/kernels" 200000x512 200000x1080 detail
    part kernels-1m 120 "$work/kernels" 1000000x512 1000000x1080 detail
    part kernels-context 60 "$work/kernels" context detail
}

profile() { train profile 180 "$work/data/chair" --preset preview --profile; }

chair() {
    local model
    for model in 3dgs scaffold tcgs; do
        train "chair-$model" 180 "$work/data/chair" --preset preview --model "$model"
    done
}

chair_800() {
    local model
    for model in tcgs 3dgs; do
        train "chair_800-$model" 600 "$work/data/chair_800" --preset standard --model "$model"
    done
}

# The first trained scene that there is, from a camera of the bundled set's own.
views() {
    local scene
    for scene in "$scenes"/chair-tcgs.tcgs "$scenes"/repeat-first.tcgs; do
        [ -f "$scene" ] && break
    done
    part views 120 "$work/tcgs" bench views "$scene" --pose \
        '{"camera_to_world": [[1,0,0,0],[0,-1,0,0],[0,0,-1,4],[0,0,0,1]], "fx": 800, "width": 800, "height": 800}'
}

parts=(doctor tests repeat accuracy kernels profile chair views chair_800)

tar -C "$work" -xJf "$kit/binaries.tar.xz" || exit 1
mkdir -p "$work/data"
for archive in "$kit"/data/*.tar; do
    [ ! -f "$archive" ] || tar -C "$work/data" -xf "$archive"
done
: >"$log"
date -u '+started %Y-%m-%dT%H:%M:%SZ' | tee -a "$log"
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null | tee -a "$log"
[ $# -gt 0 ] || set -- "${parts[@]}"
for name in "$@"; do
    case " ${parts[*]} " in
    *" $name "*) "$name" ;;
    *) echo "gpu_day: there is no part $name; there are ${parts[*]}" >&2; exit 2 ;;
    esac
done
printf '\n== summary\n' | tee -a "$log"
printf '%s\n' "${summary[@]}" | tee -a "$log"
tar -C "$scenes" -cf "$out/scenes.tar" .
case ${summary[*]} in *failed*) exit 1 ;; esac
