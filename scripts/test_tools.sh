#!/usr/bin/env bash
# Sourced: installs the programs that single tests need, and exports where they are. Tests without what they need are skipped, so what
# cannot be had is said and fails nothing; `test_tools_missing` counts it.
test_tools_missing=0

lacks_test_tool() {
    printf 'test_tools: %s cannot be had here; tests that need it are skipped\n' "$1" >&2
    test_tools_missing=$((test_tools_missing + 1))
}

scripts/setup.sh --for-tests || lacks_test_tool 'a program of scripts/setup.sh --for-tests'
# shellcheck source=scripts/env.sh
. scripts/env.sh
# A variable that is set names the program already.
if [ -z "${TCGS_SPLAT_TRANSFORM:-}" ] && TCGS_SPLAT_TRANSFORM=$(scripts/splat_transform.sh --where); then
    export TCGS_SPLAT_TRANSFORM
elif [ -z "${TCGS_SPLAT_TRANSFORM:-}" ]; then
    lacks_test_tool splat-transform
fi
if [ -z "${TCGS_USD_PYTHON:-}" ] && TCGS_USD_PYTHON=$(scripts/usd_python.sh); then
    export TCGS_USD_PYTHON
elif [ -z "${TCGS_USD_PYTHON:-}" ]; then
    lacks_test_tool usd-core
fi
if [ -z "${TCGS_POSES_PYTHON:-}" ] && TCGS_POSES_PYTHON=$(scripts/poses.sh --where); then
    export TCGS_POSES_PYTHON
elif [ -z "${TCGS_POSES_PYTHON:-}" ]; then
    lacks_test_tool pycolmap
fi
if [ -z "${TCGS_S3_SERVER:-}" ] && TCGS_S3_SERVER=$(scripts/s3_server.sh); then
    export TCGS_S3_SERVER
elif [ -z "${TCGS_S3_SERVER:-}" ]; then
    lacks_test_tool 'an S3 server'
fi
