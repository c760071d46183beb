#!/usr/bin/env bash
# Validates docker/kubernetes against the schemas of Kubernetes, unknown fields refused, with kubernetes-validate (from PyPI, schemas
# included) at a fixed version.
set -euo pipefail
cd "$(dirname "$0")/.."

version=1.37.0
venv=${CARGO_TARGET_DIR:-target}/tools/kubernetes-validate-$version

if ! "$venv/bin/kubernetes-validate" --version >/dev/null 2>&1; then
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "kubernetes-validate==$version"
fi
files=()
for file in docker/kubernetes/*.yaml; do
    # A file of kubectl's own, which no server sees.
    [ "${file##*/}" = kustomization.yaml ] || files+=("$file")
done
"$venv/bin/kubernetes-validate" --strict --quiet "${files[@]}"
echo "$(cat "${files[@]}" | grep -c '^kind: ') resources of ${#files[@]} files are as Kubernetes $version has them"
