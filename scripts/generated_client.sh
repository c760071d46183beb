#!/usr/bin/env bash
# Generates a Python client from openapi.yaml with openapi-python-client (from PyPI) and runs a whole session with it
# (scripts/generated_client.py) against a service that trains for a few steps. A warning of the generator is a failure,
# because it omits what it warns about.
#   scripts/generated_client.sh [STEPS]    training steps, 20 if not given
# The program is target/debug/tcgs unless TCGS names another. Client and log are in target/generated-client.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

version=0.29.1
steps=${1:-20}
target=${CARGO_TARGET_DIR:-target}
program=${TCGS:-$target/debug/tcgs}
out=$target/generated-client
venv=$out/venv

if [ "$("$venv/bin/openapi-python-client" --version 2>/dev/null | awk '{print $NF}')" != "$version" ]; then
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "openapi-python-client==$version"
fi

# The generator runs ruff, which comes with it, on what it wrote.
if ! PATH="$PWD/$venv/bin:$venv/bin:$PATH" "$venv/bin/openapi-python-client" generate --path openapi.yaml --config scripts/generated_client.yaml \
    --output-path "$out/tcgs_client" --overwrite --meta none --fail-on-warning >"$out/generator.log" 2>&1; then
    cat "$out/generator.log" >&2
    echo "generated_client: the generator warns of the contract, or fails at it" >&2
    exit 1
fi
listed=$(grep -c '^ *operationId:' openapi.yaml)
generated=$(find "$out/tcgs_client/api" -name '*.py' ! -name __init__.py | wc -l)
if [ "$listed" -ne "$generated" ]; then
    echo "generated_client: $generated of $listed operations were generated" >&2
    exit 1
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

key=$("$program" keys create --name generated --scopes admin --data "$scratch/data" --json | grep -o 'tcgs_[0-9a-f]*' | head -n 1)
"$program" --log-format json serve --listen 127.0.0.1:0 --data "$scratch/data" --drain 2s 2>"$out/service.log" &
server=$!
address=
for _ in $(seq 300); do
    address=$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$out/service.log" | head -n 1)
    [ -z "$address" ] || break
    kill -0 "$server" 2>/dev/null || { cat "$out/service.log" >&2; exit 1; }
    sleep 0.1
done
[ -n "$address" ] || { echo "generated_client: the service did not start" >&2; cat "$out/service.log" >&2; exit 1; }

"$program" sample --side 48 "$scratch/scene.zip" >/dev/null
status=0
TCGS_API_KEY="$key" PYTHONPATH="$out" PYTHONDONTWRITEBYTECODE=1 timeout "${GENERATED_CLIENT_SECONDS:-1500}" "$venv/bin/python" \
    scripts/generated_client.py "http://$address" "$scratch/scene.zip" "$steps" || status=$?
if [ "$status" -ne 0 ]; then
    tail -n 20 "$out/service.log" >&2
fi
exit "$status"
