#!/usr/bin/env bash
# Runs the tests and counts them. Skipped tests are listed last, with reasons, before `N passed, M failed, K skipped`.
#   scripts/test.sh [ARGUMENT...]    arguments of `cargo test`
# If no test ends for TCGS_TEST_SILENCE seconds (default 1200), all are stopped and the hanging tests are named.
set -uo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

silence=${TCGS_TEST_SILENCE:-1200}
scratch=$(mktemp -d)
log=$scratch/log
export TCGS_TEST_SKIPS=$scratch/skips
: >"$log"
: >"$TCGS_TEST_SKIPS"

# Its own process group, so that the tests can be stopped with their children.
set -m
(
    cargo test --locked --workspace --no-fail-fast "$@" 2>&1 | tee "$log"
    exit "${PIPESTATUS[0]}"
) &
run=$!
set +m
stop() { kill -KILL -- "-$run" 2>/dev/null || true; }
trap 'stop; rm -rf "$scratch"' EXIT
trap 'exit 130' INT TERM

hangs() {
    awk '/^test .* has been running for over/ { running[$2] } /^test .* \.\.\. / { delete running[$2] } END { for (name in running) print name }' "$log"
}

hung=
while kill -0 "$run" 2>/dev/null; do
    sleep 1
    if [ $(($(date +%s) - $(stat -c %Y "$log"))) -gt "$silence" ]; then
        hung=$(hangs)
        : "${hung:=none that is known}"
        stop
        printf '\nno test has ended for %d s; running when they were stopped:\n%s\n' "$silence" "$hung"
        break
    fi
done
wait "$run" 2>/dev/null
status=$?

[ ! -s "$TCGS_TEST_SKIPS" ] || {
    printf '\n'
    sort -u "$TCGS_TEST_SKIPS"
    printf '\n%s\n' "'make test' installs what these lack where it can: an S3 server and splat-transform through cargo and npm, the rest as root."
}
skipped=$(sed -n 's/^SKIPPED \([^:]*\(::[^:]*\)*\): .*/\1/p' "$TCGS_TEST_SKIPS" | sort -u | wc -l)
awk -v skipped="$skipped" -v hung="${hung//$'\n'/,}" '
    /^test .* \.\.\. ok$/ { ok++ }
    /^test .* \.\.\. FAILED$/ { broken++ }
    /^test result:/ {
        for (i = 2; i <= NF; i++) {
            if ($i ~ /^passed/) passed += $(i - 1)
            if ($i ~ /^failed/) failed += $(i - 1)
            if ($i ~ /^ignored/) ignored += $(i - 1)
        }
    }
    END {
        # A stopped test binary has printed no result.
        if (hung != "") { passed = ok; failed = broken + split(hung, names, ",") }
        # Skipped tests count as passed in the output of libtest.
        printf "\n%d passed, %d failed, %d skipped\n", passed - skipped, failed, skipped + ignored
    }' "$log"
exit "$status"
