#!/usr/bin/env bash
# Builds the image of docker/Dockerfile around target/debug/tcgs and uses it: `serve` as a user without rights over a read-only root trains a
# few steps, shows a view, stops, and finds its job again. The first stage, which compiles, is left out.
#   scripts/container.sh [STEPS]    training steps, 20 if not given
# Takes podman, buildah and runc or crun; where one is missing or cannot run here, says SKIPPED and why, which is a failure with CI=true.
# Where no registry can be reached, Debian's base image is made of its packages with mmdebstrap. Everything is in target/container.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

steps=${1:-20}
target=$(realpath "${CARGO_TARGET_DIR:-target}")
program=${TCGS:-$target/debug/tcgs}
out=$target/container
mkdir -p "$out/context/out"

skip() {
    echo "SKIPPED: $1"
    [ "${CI:-}" != true ]
    exit
}

for tool in podman buildah; do
    command -v "$tool" >/dev/null || skip "$tool is not installed (apt-get install podman buildah runc mmdebstrap)"
done
runtime=$(command -v runc || command -v crun) || skip "neither runc nor crun is installed"
storage=(--root "$out/storage" --runroot "$out/run" --storage-driver vfs)
engine=(podman "${storage[@]}" --log-level fatal --runtime "$runtime" --cgroup-manager cgroupfs)
build=(buildah "${storage[@]}" --log-level fatal)

# The second stage alone, with the program from here. Its base is pulled, or made of packages.
base=$(awk '/^FROM/ { base = $2 } END { print base }' docker/Dockerfile)
if ! "${engine[@]}" image exists "$base"; then
    if ! timeout 120 "${engine[@]}" pull --quiet "docker.io/library/$base" >"$out/pull.log" 2>&1; then
        command -v mmdebstrap >/dev/null || skip "no registry can be reached, and mmdebstrap is not installed"
        echo "no registry can be reached; $base is made of Debian's packages"
        mmdebstrap --quiet --variant=minbase bookworm "$out/base.tar" >"$out/base.log" 2>&1
        scratch=$("${build[@]}" from scratch)
        "${build[@]}" add --quiet "$scratch" "$out/base.tar" / >/dev/null
        "${build[@]}" commit --quiet --rm "$scratch" "localhost/$base" >/dev/null
        base=localhost/$base
    fi
fi
strip -o "$out/context/out/tcgs" "$program"
awk '/^FROM/ { stage++ } stage == 2' docker/Dockerfile |
    sed "s#^FROM .*#FROM $base#; s#^COPY --from=build #COPY #" >"$out/context/Dockerfile"
"${build[@]}" build --quiet --format docker --network host --isolation chroot --tag localhost/tcgs "$out/context" >"$out/build.log" 2>&1 || {
    tail -n 20 "$out/build.log" >&2
    exit 1
}
"${engine[@]}" run --rm --network none --ulimit nofile=1024:1024 --ulimit nproc=1024:1024 --entrypoint /bin/true localhost/tcgs 2>"$out/run.log" ||
    skip "containers do not run here: $(tail -n 1 "$out/run.log")"

name=tcgs-smoke-$$
port=$((20000 + $$ % 20000))
server=http://127.0.0.1:$port
scratch=$(mktemp -d)
stop() {
    "${engine[@]}" rm --force --time 5 "$name" >/dev/null 2>&1 || true
    "${engine[@]}" volume rm --force "$name" >/dev/null 2>&1 || true
    rm -rf "$scratch"
}
trap stop EXIT

# As docker/compose.yaml has it.
start() {
    "${engine[@]}" run --detach --name "$name" --network host --read-only --tmpfs /tmp --tmpfs /run/tcgs:mode=0777 --volume "$name:/data" \
        --cap-drop ALL --security-opt no-new-privileges --no-healthcheck --ulimit nofile=4096:4096 --ulimit nproc=1024:1024 \
        --env "TCGS_LISTEN=127.0.0.1:$port" localhost/tcgs >/dev/null
    local _
    for _ in $(seq 120); do
        ! curl -fsS "$server/readyz" >/dev/null 2>&1 || return 0
        sleep 0.5
    done
    "${engine[@]}" logs "$name" | tail -n 20 >&2
    echo "container: the service does not become ready" >&2
    exit 1
}
inside() { "${engine[@]}" exec "$name" "$@"; }

start
user=$(inside id -u)
[ "$user" = 10001 ] || { echo "container: it runs as user $user" >&2; exit 1; }
! inside touch /anything 2>/dev/null || { echo "container: its root can be written" >&2; exit 1; }
rights=$(inside sh -c 'sed -n "s/^CapEff:\t//p" /proc/1/status')
[ "$rights" = 0000000000000000 ] || { echo "container: it has the capabilities $rights" >&2; exit 1; }
inside sh -c "$(sed -n 's/^ *CMD \["sh", "-c", "\(.*\)"\]$/\1/p' docker/Dockerfile | sed 's/\\"/"/g')"

"$program" sample "$scratch/scene.zip" >/dev/null
job=$("$program" submit "$scratch/scene.zip" --server "$server" --iterations "$steps" --wait 2>"$scratch/submit.log" | tail -n 1) || {
    tail -n 5 "$scratch/submit.log" >&2
    exit 1
}
job=$(grep -o '[0-9a-f]\{8\}-[0-9a-f-]\{27\}' <<<"$job" | head -n 1)
curl -fsS -o "$scratch/view.png" "$server/v1/jobs/$job/view?frame=images/view_06.png"
[ "$(head -c 4 "$scratch/view.png" | tail -c 3)" = PNG ] || { echo "container: the view is no picture" >&2; exit 1; }

# It stops within its grace time, in order, and what it stored is in the volume.
"${engine[@]}" stop --time 60 "$name" >/dev/null
status=$("${engine[@]}" inspect --format '{{.State.ExitCode}}' "$name")
[ "$status" = 0 ] || { echo "container: it stopped with status $status" >&2; exit 1; }
"${engine[@]}" rm "$name" >/dev/null
start
curl -fsS "$server/v1/jobs/$job" | grep -q '"state": *"succeeded"' || { echo "container: the job is gone" >&2; exit 1; }
echo "the image serves as user $user over a read-only root: a job of $steps steps, a view of $(stat -c %s "$scratch/view.png") bytes, a restart"
