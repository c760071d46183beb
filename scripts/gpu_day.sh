#!/usr/bin/env bash
# Tests and measures the program on a GPU within a time limit, the most decisive parts first. Runs the binaries of `make gpu-kit` and
# needs bash, tar, xz and python3, neither cargo nor a network.
#
#   gpu_day.sh [--seconds N] [PART...]    by default 540 seconds and all parts, in the order of `parts` below
#
# A command starts only if its estimated seconds are left, and is stopped at its limit. Writes three files to $OUT, by default the
# folder results beside this script:
#   gpu_day.json   machine, and of each command seconds, status and figures; rewritten after each part; input of scripts/hardware.py
#   log.txt        the output of every command
#   scenes.tar     the trained files that fit into 16 MB
#
# TCGS_ADAPTER chooses the adapter, by default the best one. For a trial on a CPU, GPU_DAY_STEPS sets the steps of all trainings and
# GPU_DAY_SIZES the sizes of the kernel benchmark.
# Parts are called by their names.
# shellcheck disable=SC2329
set -uo pipefail
kit=$(cd "$(dirname "$0")" && pwd)
out=${OUT:-$kit/results}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
scenes=$work/scenes
records=$work/records
log=$out/log.txt
# Packing and the last stop need this many seconds of the limit.
reserve=8
max_scenes_bytes=16000000
export TCGS_ADAPTER=${TCGS_ADAPTER:-auto}
export XDG_RUNTIME_DIR=${XDG_RUNTIME_DIR:-$work}
# NVIDIA's container runtime mounts the driver here and does not tell the loader.
nvidia=/usr/local/nvidia/share/vulkan/icd.d/nvidia_icd.json
if [ -z "${VK_DRIVER_FILES:-}" ] && [ -f "$nvidia" ]; then
    export VK_DRIVER_FILES=$nvidia
fi

say() { printf 'gpu_day: %s\n' "$*" | tee -a "$log"; }

now_ms() { echo $((${EPOCHREALTIME/[.,]/} / 1000)); }

seconds_left() { echo $((seconds - SECONDS - reserve)); }

# record NAME KIND EXIT_STATUS MILLISECONDS REASON COMMAND...: what gpu_day.py reads, beside the output in NAME.txt.
record() { printf '%s\n' "$began" "$part" "$mode" "$2" "$3" "$4" "$5" "${*:6}" >"$records/$1.run"; }

# run KIND NAME ESTIMATE LIMIT COMMAND...: runs a command if its estimate fits, and records output, seconds and status.
run() {
    local kind=$1 name=$2 estimate=$3 limit=$4 left status began
    shift 4
    left=$(seconds_left)
    began=$(now_ms)
    if [ "$left" -lt "$estimate" ]; then
        record "$name" "$kind" - 0 "takes about $estimate s, $left s are left" "$*"
        return 1
    fi
    [ "$limit" -le "$left" ] || limit=$left
    printf '== %s, at most %s s\n' "$name" "$limit"
    timeout --kill-after 3 "$limit" "$@" >"$records/$name.txt" 2>&1 </dev/null
    status=$?
    record "$name" "$kind" "$status" $(($(now_ms) - began)) "" "$*"
    { printf '\n== %s: %s\n' "$name" "$*"; cat "$records/$name.txt"; } >>"$log"
    return "$status"
}

leave_out() {
    local began
    began=$(now_ms)
    record "$1" none - 0 "$2"
}

# train NAME ESTIMATE LIMIT DATASET FLAGS...: one run, with its metrics as JSON.
train() {
    local name=$1 estimate=$2 limit=$3 dataset=$4
    shift 4
    if [ ! -d "$dataset" ]; then
        leave_out "$name" "there is no dataset $(basename "$dataset")"
        return 1
    fi
    [ -z "${GPU_DAY_STEPS:-}" ] || set -- "$@" --iterations "$GPU_DAY_STEPS"
    run train "$name" "$estimate" "$limit" "$work/tcgs" train "$dataset" -o "$scenes/$name.$(extension "$*")" --json "$@"
}

extension() {
    case " $1 " in
    *' 3dgs '*) echo ply ;;
    *' scaffold '*) echo safetensors ;;
    *) echo tcgs ;;
    esac
}

# Waits for the runs that were started with `&`. Their seconds count the others' load, so no table shows them.
wait_for() {
    local id
    for id in "$@"; do
        wait "$id"
    done
}

doctor() { run doctor doctor 2 30 "$work/tcgs" doctor --json; }

# Kernels against their f64 twins, on hard cases.
accuracy() { run accuracy accuracy 10 60 "$work/tcgs" bench accuracy --json; }

# The same seed must give the same bytes, here under the load of the other run.
repeat() {
    local name ids=() steps=${GPU_DAY_STEPS:-400}
    run sample sample 4 60 "$work/tcgs" sample "$work/sample"
    mode=side-by-side
    for name in repeat-first repeat-second; do
        GPU_DAY_STEPS=$steps train "$name" 12 60 "$work/sample" &
        ids+=($!)
    done
    wait_for "${ids[@]}"
    mode=alone
    if [ -f "$scenes/repeat-first.tcgs" ] && [ -f "$scenes/repeat-second.tcgs" ]; then
        run compare repeat-compare 1 10 cmp "$scenes/repeat-first.tcgs" "$scenes/repeat-second.tcgs"
    fi
}

kernels() {
    local sizes
    read -ra sizes <<<"${GPU_DAY_SIZES:-20000x800 200000x1080 1000000x1080}"
    run kernels kernels 15 120 "$work/kernels" "${sizes[@]}" detail
    run context context 4 60 "$work/kernels" context detail
}

profile() {
    GPU_DAY_STEPS=${GPU_DAY_STEPS:-1000} train profile 25 120 "$work/data/chair_800" --preset standard --profile --background white
}

# One at a time: these seconds are the figures.
chair_800() {
    train chair_800-tcgs 45 200 "$work/data/chair_800" --preset standard --background white
    train chair_800-3dgs 40 200 "$work/data/chair_800" --preset standard --background white --model 3dgs
}

# The first trained scene, from above.
views() {
    local scene
    for scene in "$scenes"/chair_800-tcgs.tcgs "$scenes"/profile.tcgs "$scenes"/repeat-first.tcgs; do
        [ ! -f "$scene" ] || break
    done
    if [ ! -f "$scene" ]; then
        leave_out views "no scene was trained"
        return
    fi
    run views views 22 60 "$work/tcgs" bench views "$scene" --json --pose \
        '{"camera_to_world": [[1,0,0,0],[0,-1,0,0],[0,0,-1,4],[0,0,0,1]], "fx": 800, "width": 800, "height": 800}'
}

# Kernels against their f64 twins and central differences, on the adapter and on its other variant of kernels.
tests() {
    if [ ! -f "$work/tests" ] || [ ! -f "$work/render_tests" ]; then
        leave_out tests "the kit has no tests"
        return
    fi
    run tests tests 60 150 env -C "$work" "$work/render_tests" --skip oracle --test-threads 4
    run tests training_tests 90 150 env -C "$work" "$work/tests" train::loss train::adam train::wavelet train::rate:: \
        train::context --skip oracle --test-threads 4
}

# Quality of the small set: seeds and baselines.
chair() {
    local seed model ids=()
    mode=side-by-side
    for seed in 0 1 2; do
        train "chair-tcgs-seed-$seed" 50 150 "$work/data/chair" --preset preview --background white --seed "$seed" &
        ids+=($!)
    done
    for model in scaffold 3dgs; do
        train "chair-$model" 50 150 "$work/data/chair" --preset preview --background white --model "$model" &
        ids+=($!)
    done
    wait_for "${ids[@]}"
}

# Quality of the large set: another seed, a baseline, a smaller weight of the rate.
chair_800_quality() {
    local ids=() shared=("$work/data/chair_800" --preset standard --background white)
    mode=side-by-side
    train chair_800-tcgs-seed-1 150 280 "${shared[@]}" --seed 1 &
    ids+=($!)
    train chair_800-tcgs-lambda-0.0001 150 280 "${shared[@]}" --lambda 0.0001 &
    ids+=($!)
    train chair_800-scaffold 150 280 "${shared[@]}" --model scaffold &
    ids+=($!)
    wait_for "${ids[@]}"
}

# Adds trained files, the smallest first, as long as they fit.
pack_scenes() {
    local size name total=0 fitting=()
    while read -r size name; do
        total=$((total + size + 1024))
        if [ "$total" -le "$max_scenes_bytes" ]; then
            fitting+=("$name")
        else
            say "$name does not fit into scenes.tar"
        fi
    done < <(find "$scenes" -type f -printf '%s %P\n' | sort -n)
    [ ${#fitting[@]} -eq 0 ] || tar -C "$scenes" -cf "$out/scenes.tar" "${fitting[@]}"
}

parts=(doctor accuracy repeat kernels profile chair_800 views tests chair chair_800_quality)

SECONDS=0
seconds=540
chosen=()
while [ $# -gt 0 ]; do
    case $1 in
    --seconds)
        if ! [[ ${2:-} =~ ^[1-9][0-9]*$ ]]; then
            echo "gpu_day: --seconds needs a whole number of seconds" >&2
            exit 2
        fi
        seconds=$2
        shift
        ;;
    *)
        if [[ " ${parts[*]} " != *" $1 "* ]]; then
            echo "gpu_day: there is no part $1; there are ${parts[*]}" >&2
            exit 2
        fi
        chosen+=("$1")
        ;;
    esac
    shift
done
[ ${#chosen[@]} -gt 0 ] || chosen=("${parts[@]}")
rm -f "$out"/{gpu_day.json,log.txt,scenes.tar}
mkdir -p "$out" "$scenes" "$records" "$work/data"
tar -C "$work" -xJf "$kit/binaries.tar.xz" || exit 1
for archive in "$kit"/data/*.tar; do
    [ ! -f "$archive" ] || tar -C "$work/data" -xf "$archive"
done
: >"$log"
GPU_DAY_STARTED=$(date -u '+%Y-%m-%dT%H:%M:%SZ')
GPU_DAY_REVISION=$(cat "$kit/revision" 2>/dev/null)
export GPU_DAY_STARTED GPU_DAY_REVISION GPU_DAY_SECONDS=$seconds
say "started $GPU_DAY_STARTED, revision $GPU_DAY_REVISION, $seconds s"
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null | tee -a "$log"
for part in "${chosen[@]}"; do
    mode=alone
    "$part"
    python3 "$kit/gpu_day.py" "$records" "$out/gpu_day.json" >"$work/summary.txt"
    healthy=$?
done
pack_scenes
printf '\n== summary, after %s s\n' "$SECONDS" | tee -a "$log"
tee -a "$log" <"$work/summary.txt"
exit "$healthy"
