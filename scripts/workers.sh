#!/usr/bin/env bash
# Measures how many small jobs a service finishes in a minute with 1, 2 and 4 worker processes, and prints a table with its conditions.
#   scripts/workers.sh [JOBS [STEPS [WORKERS...]]]    12 jobs of 20 steps if not given, of the bundled scene at 64 pixels
# The program is target/release/tcgs unless TCGS names another. One job before each row fills the driver's cache of kernels.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

jobs=${1:-12}
steps=${2:-20}
counts=("${@:3}")
[ ${#counts[@]} -gt 0 ] || counts=(1 2 4)
program=${TCGS:-${CARGO_TARGET_DIR:-target}/release/tcgs}
[ -x "$program" ] || { echo "workers: build the program first (make build), or name one with TCGS" >&2; exit 1; }

scratch=$(mktemp -d)
server=
stop() {
    [ -z "$server" ] || { kill "$server" 2>/dev/null || true; wait "$server" 2>/dev/null || true; }
    server=
}
trap 'stop; rm -rf "$scratch"' EXIT
"$program" sample "$scratch/scene.zip" --side 64 >/dev/null

# start WORKERS: starts a service in a fresh data folder, and sets $base.
start() {
    local _ address=
    "$program" --log-format json serve --listen 127.0.0.1:0 --data "$scratch/data-$1" --workers "$1" 2>"$scratch/log" &
    server=$!
    for _ in $(seq 300); do
        address=$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$scratch/log" | head -n 1)
        [ -z "$address" ] || break
        kill -0 "$server" || { cat "$scratch/log" >&2; exit 1; }
        sleep 0.1
    done
    base=http://$address
}
# send: queues a job, and prints its path.
send() {
    curl -sSf -X POST -H 'Content-Type: application/zip' --data-binary "@$scratch/scene.zip" "$base/v1/jobs?iterations=$steps" \
        -o /dev/null -D - | tr -d '\r' | sed -n 's,^location: ,,Ip'
}
# wait_for PATH...: waits until all have succeeded.
wait_for() {
    local job state
    for job in "$@"; do
        while :; do
            state=$(curl -sSf "$base$job" | grep -o '"state":"[a-z]*"' | head -n 1 | cut -d '"' -f 4)
            case $state in
            succeeded) break ;;
            failed | cancelled)
                curl -s "$base$job" >&2
                exit 1
                ;;
            esac
            sleep 0.2
        done
    done
}

adapter=$("$program" doctor 2>/dev/null | sed -n 3p)
driver=$("$program" doctor 2>/dev/null | sed -n 's/^  driver *//p' | head -n 1)
echo "$jobs jobs of $steps steps, $(nproc) cores of $(sed -n 's/^model name.*: //p' /proc/cpuinfo | head -n 1), load $(cut -d ' ' -f 1 /proc/loadavg), $program"
echo "adapter: $adapter, $driver"
echo
echo '| worker processes | jobs/minute | seconds a job waited and ran, mean |'
echo '|--:|--:|--:|'
for count in "${counts[@]}"; do
    start "$count"
    wait_for "$(send)"
    began=$(date +%s.%N)
    mapfile -t sent < <(for _ in $(seq "$jobs"); do send; done)
    wait_for "${sent[@]}"
    ended=$(date +%s.%N)
    mean=$(for job in "${sent[@]}"; do curl -sSf "$base$job"; done | python3 -c '
import json, sys
from datetime import datetime
text, decoder, spent = sys.stdin.read(), json.JSONDecoder(), []
while text.strip():
    job, end = decoder.raw_decode(text.lstrip())
    text = text.lstrip()[end:]
    moment = lambda key: datetime.fromisoformat(job[key].split(".")[0].rstrip("Z"))
    spent.append((moment("finished_at") - moment("created_at")).total_seconds())
print(f"{sum(spent) / len(spent):.0f}")')
    awk -v count="$count" -v jobs="$jobs" -v began="$began" -v ended="$ended" -v mean="$mean" \
        'BEGIN { printf "| %d | %.2f | %s |\n", count, 60 * jobs / (ended - began), mean }'
    stop
done
