#!/usr/bin/env bash
# Holds a running service to openapi.yaml with schemathesis: starts `tcgs serve` on a port of the system's choice with a fresh
# data folder and no workers, so that nothing trains, sends what the contract allows and what it forbids, and stops it.
#   scripts/schemathesis.sh [EXAMPLES]    examples an operation, 20 if not given
# The program is target/debug/tcgs unless TCGS names another. Its log is in target/schemathesis.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

version=4.32.5
examples=${1:-20}
target=${CARGO_TARGET_DIR:-target}
program=${TCGS:-$target/debug/tcgs}
out=$target/schemathesis
venv=$out/venv

if [ "$("$venv/bin/schemathesis" --version 2>/dev/null | awk '{print $NF}')" != "$version" ]; then
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "schemathesis==$version"
fi

scratch=$(mktemp -d)
stop() {
    if [ -n "${server:-}" ]; then
        kill "$server" 2>/dev/null || true
        wait "$server" 2>/dev/null || true
    fi
    rm -rf "$scratch"
}
trap stop EXIT

key=$("$program" keys create --name contract --scopes admin --data "$scratch/data" --json | grep -o 'tcgs_[0-9a-f]*' | head -n 1)

# Places are for clients that come one after another here; a small upload limit keeps what is sent small.
"$program" --log-format json serve --listen 127.0.0.1:0 --data "$scratch/data" --workers 0 --failures-per-minute 1000000 --max-upload 8MiB \
    --body-pause 2s --drain 2s 2>"$out/service.log" &
server=$!
address=
for _ in $(seq 300); do
    address=$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$out/service.log" | head -n 1)
    [ -z "$address" ] || break
    kill -0 "$server" 2>/dev/null || { cat "$out/service.log" >&2; exit 1; }
    sleep 0.1
done
[ -n "$address" ] || { echo "schemathesis: the service did not start" >&2; cat "$out/service.log" >&2; exit 1; }

# Something to ask about: a job that has ended, so that its events do too.
"$program" sample "$scratch/scene.zip" >/dev/null
call() { curl -sSf -H "Authorization: Bearer $key" "$@"; }
job=$(call -X POST -H 'Content-Type: application/zip' --data-binary "@$scratch/scene.zip" "http://$address/v1/jobs" -o /dev/null -D - |
    tr -d '\r' | sed -n 's,^location: /v1/jobs/,,Ip')
call -X POST "http://$address/v1/jobs/$job/cancel" -o /dev/null
{
    cat scripts/schemathesis.toml
    printf '\n[[operations]]\ninclude-path-regex = "^/v1/jobs/[{]id[}]"\nexclude-method = "DELETE"\n'
    # A preference to wait is granted for longer than schemathesis waits.
    printf 'parameters = { "path.id" = "%s", "header.Prefer" = "wait=1" }\n' "$job"
} >"$scratch/schemathesis.toml"

# Failures have to come back the same on the next run, so the seed is fixed; SCHEMATHESIS_SEED tries another.
status=0
PYTHONPATH=scripts PYTHONDONTWRITEBYTECODE=1 timeout "${SCHEMATHESIS_SECONDS:-900}" "$venv/bin/schemathesis" --config-file "$scratch/schemathesis.toml" run openapi.yaml \
    --header "Authorization: Bearer $key" --url "http://$address" --max-examples "$examples" --seed "${SCHEMATHESIS_SEED:-20261121}" \
    --generation-database none || status=$?
if ! kill -0 "$server" 2>/dev/null; then
    echo "schemathesis: the service has ended" >&2
    tail -n 20 "$out/service.log" >&2
    exit 1
fi
if grep -E '"level":"ERROR"' "$out/service.log" >&2; then
    echo "schemathesis: the service logged the errors above" >&2
    exit 1
fi
exit "$status"
