#!/usr/bin/env bash
# Tests a running service against openapi.yaml with schemathesis: trains one small scene with `tcgs serve` in a fresh data
# folder, restarts it without workers, sends valid and invalid requests, first about a cancelled job and then about the
# finished one, and stops it.
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

# A key whose name, rate and project may be changed; a rate of one request a minute would end the run's own.
spare=$("$program" keys create --name spare --data "$scratch/data" --json)
spare_key=$(grep -o '"id": *"[^"]*"' <<<"$spare" | cut -d '"' -f 4)
spare_project=$(grep -o '"project_id": *"[^"]*"' <<<"$spare" | cut -d '"' -f 4)
key=$("$program" keys create --name contract --scopes admin --data "$scratch/data" --json | grep -o 'tcgs_[0-9a-f]*' | head -n 1)

# start ARGUMENT...: starts the service and sets $address. A small upload limit keeps generated bodies small.
start() {
    local _
    "$program" --log-format json serve --listen 127.0.0.1:0 --data "$scratch/data" --failures-per-minute 1000000 --max-upload 8MiB \
        --body-idle-timeout 2s --drain 2s "$@" 2>"$out/service.log" &
    server=$!
    address=
    for _ in $(seq 300); do
        address=$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$out/service.log" | head -n 1)
        [ -z "$address" ] || return 0
        kill -0 "$server" 2>/dev/null || break
        sleep 0.1
    done
    echo "schemathesis: the service did not start" >&2
    cat "$out/service.log" >&2
    exit 1
}

call() { curl -sSf -H "Authorization: Bearer $key" "$@"; }

# create QUERY: makes a job of the bundled scene and prints its id.
create() {
    call -X POST -H 'Content-Type: application/zip' --data-binary "@$scratch/scene.zip" "http://$address/v1/jobs?$1" -o /dev/null -D - |
        tr -d '\r' | sed -n 's,^location: /v1/jobs/,,Ip'
}

"$program" sample --side 32 "$scratch/scene.zip" >/dev/null
start --workers 1
finished=$(create 'iterations=20&preset=preview')
state=
for _ in $(seq 600); do
    state=$(call "http://$address/v1/jobs/$finished" | tr -d '\n' | grep -o '"state" *: *"[a-z]*"' | head -n 1 | tr -d ' ' | cut -d '"' -f 4)
    case $state in queued | running) sleep 0.5 ;; *) break ;; esac
done
[ "$state" = succeeded ] || {
    echo "schemathesis: the job that was to finish is '$state'" >&2
    exit 1
}
kill "$server"
wait "$server" || true

start --workers 0
# Slow on first use, so done before schemathesis waits for it.
for format in ply spz; do
    call "http://$address/v1/jobs/$finished/export?format=$format" -o /dev/null
done
call "http://$address/v1/jobs/$finished/view?frame=images/view_06.png" -o /dev/null
cancelled=$(create iterations=20)
call -X POST "http://$address/v1/jobs/$cancelled/cancel" -o /dev/null
# The only job that is deleted: otherwise ids from lists are tried, that of the finished job among them.
spare_job=$(create iterations=20)
call -X POST "http://$address/v1/jobs/$spare_job/cancel" -o /dev/null

# hold JOB SEED CONFIG FLAG...: one run, whose ids of jobs are JOB. `Prefer: wait` may take longer than schemathesis waits.
status=0
hold() {
    local job=$1 seed=$2 config=$3
    shift 3
    {
        cat "$config"
        printf '\n[[operations]]\ninclude-path-regex = "^/v1/jobs/[{]id[}]"\nexclude-method = "DELETE"\n'
        printf 'parameters = { "path.id" = "%s", "header.Prefer" = "wait=1" }\n' "$job"
        printf '\n[[operations]]\ninclude-path = "/v1/jobs/{id}"\ninclude-method = "DELETE"\nparameters = { "path.id" = "%s" }\n' "$spare_job"
        # Always the spare key, which an earlier request may have revoked: it need not be there after another one was made.
        printf '\n[[operations]]\ninclude-path = "/v1/keys/{id}"\nparameters = { "path.id" = "%s" }\n' "$spare_key"
        printf 'checks.ensure_resource_availability.enabled = false\n'
        printf '\n[[operations]]\ninclude-path = "/v1/projects/{id}"\nparameters = { "path.id" = "%s" }\n' "$spare_project"
    } >"$scratch/schemathesis.toml"
    printf '\nschemathesis: %s, seed %s\n' "$config" "$seed"
    PYTHONPATH=scripts PYTHONDONTWRITEBYTECODE=1 timeout "${SCHEMATHESIS_SECONDS:-900}" "$venv/bin/schemathesis" \
        --config-file "$scratch/schemathesis.toml" run openapi.yaml --header "Authorization: Bearer $key" --url "http://$address" \
        --request-timeout 60 --max-examples "$examples" --seed "$seed" --generation-database none "$@" || status=$?
    kill -0 "$server" 2>/dev/null || {
        echo "schemathesis: the service has ended" >&2
        tail -n 20 "$out/service.log" >&2
        exit 1
    }
}

# Seeds are fixed so that failures are reproducible; SCHEMATHESIS_SEED tries others.
seed=${SCHEMATHESIS_SEED:-20261121}
hold "$cancelled" "$seed" scripts/schemathesis.toml
# Animations take a time proportional to their pictures, and the contract allows many.
before=$(call "http://$address/metrics")
hold "$finished" "$((seed + 1))" scripts/schemathesis_finished.toml --include-path-regex '^/v1/jobs/[{]id[}]' --exclude-method DELETE \
    --exclude-path-regex '/(stream|animation)$'
after=$(call "http://$address/metrics")

# answered METRICS ROUTE: how many requests succeeded.
answered() {
    awk -v route="route=\"/v1/jobs/{id}/$2\"" '/^http_request_duration_seconds_count/ && index($0, route) && /status="20[06]"/ { sum += $NF } END { print sum + 0 }' <<<"$1"
}
for route in artifact artifacts cameras export events series report; do
    [ "$(answered "$after" $route)" -gt "$(answered "$before" $route)" ] || {
        echo "schemathesis: /v1/jobs/{id}/$route never answered with what was asked for" >&2
        status=1
    }
done

# Generated frame names do not exist and are refused, and generated streams may be long, so each operation gets one valid request here.
view='{"frame": "images/view_06.png", "width": 16, "height": 16}'
# shows PATH [CURL OPTION...]
shows() {
    local route=$1
    shift
    call "http://$address/v1/jobs/$finished/$route" -o /dev/null "$@" || {
        echo "schemathesis: /v1/jobs/{id}/${route%%\?*} does not answer" >&2
        status=1
    }
}
json='Content-Type: application/json'
shows "view?frame=images/view_06.png&width=16&height=16"
shows "view?width=16"
shows "stream?frames=2&width=16"
shows views -H "$json" -d "{\"views\": [$view]}"
shows animation -H "$json" -d "{\"path\": [$view], \"frames\": 2}"
if grep -E '"level":"ERROR"' "$out/service.log" >&2; then
    echo "schemathesis: the service logged the errors above" >&2
    exit 1
fi
exit "$status"
