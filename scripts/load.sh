#!/usr/bin/env bash
# Measures the service while a job trains: request rate and latency of a job's state and of parts of a file, many clients that
# follow one job, latency of views, and the cost of a stream of views to training. Loopback only; SECONDS_EACH seconds a
# row. Prints two tables.
#   scripts/load.sh    needs wrk and python3 beside what make demo needs
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

seconds=${SECONDS_EACH:-10}
clients=${CLIENTS:-100}
program=${TCGS:-${CARGO_TARGET_DIR:-target}/release/tcgs}
command -v wrk >/dev/null || { echo "load: install wrk" >&2; exit 1; }
[ -x "$program" ] || { echo "load: build the program first (make build)" >&2; exit 1; }

scratch=$(mktemp -d)
stop() {
    [ -z "${server:-}" ] || { kill "$server" 2>/dev/null || true; wait "$server" 2>/dev/null || true; }
    rm -rf "$scratch"
}
trap stop EXIT

"$program" --log-format json serve --listen 127.0.0.1:0 --data "$scratch/data" --max-connections-per-address 512 2>"$scratch/log" &
server=$!
address=
for _ in $(seq 300); do
    address=$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$scratch/log" | head -n 1)
    [ -z "$address" ] || break
    kill -0 "$server" || { cat "$scratch/log" >&2; exit 1; }
    sleep 0.1
done
base=http://$address

"$program" sample "$scratch/scene.zip" >/dev/null
send() {
    curl -sSf -X POST -H 'Content-Type: application/zip' --data-binary "@$scratch/scene.zip" "$base/v1/jobs?iterations=$1" -o /dev/null \
        -D - | tr -d '\r' | sed -n 's,^location: ,,Ip'
}
state() { curl -sSf "$base$1" | grep -o '"state":"[a-z]*"' | head -n 1 | cut -d'"' -f4; }

finished=$(send 60)
until [ "$(state "$finished")" = succeeded ]; do
    [ "$(state "$finished")" != failed ] || { curl -s "$base$finished" >&2; exit 1; }
    sleep 1
done

cat >"$scratch/report.lua" <<'LUA'
done = function(summary, latency)
    io.write(string.format("%.0f %.2f %.2f %d\n", summary.requests / summary.duration * 1e6, latency:percentile(50) / 1e3,
        latency:percentile(99) / 1e3, summary.errors.status + summary.errors.connect + summary.errors.read + summary.errors.timeout))
end
LUA
{ cat "$scratch/report.lua"; echo 'wrk.headers["Range"] = "bytes=0-65535"'; } >"$scratch/range.lua"

row() { printf '| %s | %s | %s | %s | %s |\n' "$@"; }
load() { # what, path, script
    local figures
    read -r -a figures < <(wrk -t2 -c16 -d "${seconds}s" -s "$scratch/$3.lua" "$base$2" | tail -n 1)
    row "$1" "${figures[@]}"
}
asked=0
views() { # what, side
    asked=$((asked + 1))
    python3 - "$base$finished/view" "$2" "$seconds" "$1" "$asked" <<'PY'
import sys, time, urllib.request

url, side, seconds, what, row = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4], int(sys.argv[5])
times, end = [], time.monotonic() + seconds
while time.monotonic() < end or len(times) < 5:
    turn = len(times) * 0.37
    # Every view differs, so that none comes from the cache.
    query = f"?position={3 + turn % 1},{-3 + turn % 2},1.5&look_at=0,0,{0.5 + row / 100}&width={side}&height={side}&format=jpeg"
    began = time.monotonic()
    urllib.request.urlopen(url + query, timeout=60).read()
    times.append(1e3 * (time.monotonic() - began))
times.sort()
at = lambda share: times[min(len(times) - 1, int(share * len(times)))]
print(f"| {what} | {1e3 * len(times) / sum(times):.1f} | {at(0.5):.1f} | {at(0.99):.1f} | 0 |")
PY
}

echo "| what | requests/s | p50 ms | p99 ms | errors |"
echo "|---|--:|--:|--:|--:|"
load "a job's state, nothing trains" "$finished" report
load "64 KiB of a file, nothing trains" "$finished/artifact" range
views "a view of 256x256, nothing trains" 256
views "a view of 512x512, nothing trains" 512
running=$(send 100000)
until [ "$(state "$running")" = running ] && curl -sSf "$base$running" | grep -q '"phase":"train"'; do sleep 1; done
load "the state of the job that trains" "$running" report
load "64 KiB of a file beside training" "$finished/artifact" range
views "a view of 256x256 beside training" 256
views "a view of 512x512 beside training" 512

# Growth makes later steps slower, so the undisturbed rate is measured before and after.
step() { curl -sSf "$base$running" | grep -o '"step":[0-9]*' | head -n 1 | cut -d: -f2; }
pace() { # what
    local from to began ended
    from=$(step) began=$(date +%s.%N)
    sleep "$seconds"
    to=$(step) ended=$(date +%s.%N)
    awk -v what="$1" -v steps=$((to - from)) -v began="$began" -v ended="$ended" \
        'BEGIN { printf "| %s | %.2f |\n", what, steps / (ended - began) }' >>"$scratch/pace"
}
pace "alone"
for width in 256 512; do
    curl -sSfN "$base$finished/stream?orbit=1000&fps=60&width=$width" -o "$scratch/pictures" &
    stream=$!
    until [ -s "$scratch/pictures" ]; do kill -0 $stream; sleep 0.1; done
    pace "beside a stream of views of $width pixels"
    kill $stream
    wait $stream 2>/dev/null || true
    echo "| pictures in that time | $(grep -ac '^Content-Type' "$scratch/pictures") |" >>"$scratch/pace"
    rm "$scratch/pictures"
    pace "alone again"
done

# Every client has to see the same events, from the first to the last.
for client in $(seq "$clients"); do
    curl -sN --max-time 120 -H 'Accept: text/event-stream' "$base$running/events" >"$scratch/stream.$client" &
    followers+=($!)
done
until [ "$(curl -sSf "$base/metrics" | sed -n 's/^tcgs_event_streams \([0-9]*\).*/\1/p')" = "$clients" ]; do sleep 0.2; done
load "the state of the job, $clients clients following" "$running" report
curl -sSf -X POST "$base$running/cancel" -o /dev/null
wait "${followers[@]}"
echo
echo "$clients clients followed the job to its end; different histories among them: $(grep -h '^id:' "$scratch"/stream.* | sort | uniq -c |
    awk -v all="$clients" '$1 != all' | wc -l) events not seen by all"
echo
echo "| training | steps/s |"
echo "|---|--:|"
cat "$scratch/pace"
