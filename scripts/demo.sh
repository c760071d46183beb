#!/usr/bin/env bash
# One session from start to end: starts the service, sends the bundled scene, follows the job, downloads the file, requests
# a view by frame and one by pose. Results are in out/demo. DEMO_ITERATIONS sets the length of the training.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

iterations=${DEMO_ITERATIONS:-400}
out=out/demo
bin=${CARGO_TARGET_DIR:-target}/release/tcgs

say() { printf '%s\n' "$*"; }

fail() {
    say "demo: $*" >&2
    [ ! -s "$out/serve.log" ] || tail -n 20 "$out/serve.log" >&2
    exit 1
}

# The first value of a key in a JSON text; enough for the flat values shown here.
value() { tr -d '\n' | grep -oE "\"$1\" *: *(\"[^\"]*\"|[^],}]*)" | head -n 1 | sed -E 's/^"[^"]*" *: *//; s/^"//; s/"$//'; }

# A number to so many decimals, in C's notation whatever the locale; a dash for values not known yet.
rounded() { case $2 in '' | null) echo - ;; *) LC_ALL=C printf "%.$1f\n" "$2" ;; esac; }

# A free loopback port.
free_port() {
    local port
    for port in $(seq $((20000 + RANDOM % 20000)) 65000); do
        if ! (exec 3<>"/dev/tcp/127.0.0.1/$port") 2>/dev/null; then
            echo "$port"
            return
        fi
    done
}

server=
work=$(mktemp -d)
stop() {
    if [ -n "$server" ] && kill -0 "$server" 2>/dev/null; then
        kill -TERM "$server"
        wait "$server" || true
    fi
    rm -rf "$work"
}
trap stop EXIT
trap 'exit 130' INT TERM

say "building (release)"
cargo build --release --locked --quiet
rm -rf "$out"
mkdir -p "$out"

"$bin" sample "$work/scene.zip"
"$bin" sample "$work/scene" >/dev/null

url=http://127.0.0.1:$(free_port)
"$bin" serve --listen "${url#http://}" --data "$work/data" 2>"$out/serve.log" &
server=$!
for _ in $(seq 120); do
    curl -fsS "$url/readyz" >/dev/null 2>&1 && break
    kill -0 "$server" 2>/dev/null || fail "the service ended before it was ready"
    sleep 0.5
done
curl -fsS "$url/readyz" >/dev/null || fail "the service is not ready after a minute"
say "serving on $url"

job=$(curl -sS --fail-with-body -H 'Content-Type: application/zip' --data-binary "@$work/scene.zip" \
    "$url/v1/jobs?preset=preview&iterations=$iterations") || fail "the dataset was refused: $job"
id=$(value id <<<"$job")
say "job $id: $iterations steps"

shown=
while :; do
    job=$(curl -sS --fail-with-body "$url/v1/jobs/$id") || fail "the job cannot be read: $job"
    state=$(value state <<<"$job")
    line="$(value phase <<<"$job") $(value step <<<"$job")/$(value total <<<"$job")"
    line+="  loss $(rounded 4 "$(value loss <<<"$job")")  PSNR $(rounded 2 "$(value psnr <<<"$job")")"
    line+="  anchors $(value anchors <<<"$job")  Gaussians $(value gaussians <<<"$job")"
    line+="  $(rounded 0 "$(value elapsed_seconds <<<"$job")") s"
    if [ -t 1 ]; then
        printf '\r\033[K%s' "$line"
    elif [ "$line" != "$shown" ] && [ $((SECONDS % 10)) -lt 2 ]; then
        say "$line"
        shown=$line
    fi
    case $state in
        succeeded) break ;;
        failed | cancelled) fail "the job $state: $job" ;;
    esac
    kill -0 "$server" 2>/dev/null || fail "the service ended"
    sleep 2
done
[ ! -t 1 ] || printf '\n'

printf '%s\n' "$job" >"$out/job.json"
fetch() { curl -sS --fail-with-body -o "$out/$1" "$url$2" || fail "$2 was refused: $(cat "$out/$1")"; }
fetch scene.tcgs "/v1/jobs/$id/artifact"
fetch view_by_frame.png "/v1/jobs/$id/view?frame=images/view_06.png"
fetch view_by_pose.png \
    "/v1/jobs/$id/view?position=2.6,-2.2,2.4&look_at=0.12,0.1,0.32&up=0,0,1&fov=49&width=400&height=400"
cp "$work/scene/images/view_06.png" "$out/photograph.png"
"$bin" inspect "$out/scene.tcgs" >"$out/inspect.txt"
# A program that was built without a compiler for WebAssembly has no page.
rm -f "$out/scene.html"
"$bin" export "$out/scene.tcgs" --format html --output "$out/scene.html" --dataset "$work/scene" >"$out/export.txt" 2>&1 || true

test_metrics=$(tr -d '\n' <<<"$job" | grep -oE '"test" *: *\{[^}]*\}' | head -n 1)
say ""
psnr=$(rounded 2 "$(value psnr <<<"$test_metrics")")
ssim=$(rounded 4 "$(value ssim <<<"$test_metrics")")
say "held-out views   PSNR $psnr dB, SSIM $ssim"
say "file             $(wc -c <"$out/scene.tcgs") bytes: $out/scene.tcgs ($out/inspect.txt: where they go)"
say "view by frame    $out/view_by_frame.png, beside $out/photograph.png, which training did not see"
say "view by pose     $out/view_by_pose.png"
if [ -e "$out/scene.html" ]; then
    say "viewer           $out/scene.html, in a browser with WebGPU"
else
    say "viewer           none: $(head -n 1 "$out/export.txt")"
fi
say "job and log      $out/job.json, $out/serve.log"
