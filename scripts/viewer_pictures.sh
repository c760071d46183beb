#!/usr/bin/env bash
# viewer_pictures.sh SCENE.tcgs DATASET OUTDIR POSE.json…: pictures of a scene's exports by another program. Exports the scene to every
# format, draws each file from every pose (as `tcgs render --pose` takes it) with the PlayCanvas engine in a headless Chromium, and prints
# PSNR to pictures of the scene and of the .ply by tcgs. PlayCanvas reads .ply, .sog and .glb itself; splat-transform decodes .spz for it
# and usd-core .usda. TCGS names the program, TCGS_CHROMIUM the browser. Pictures stay in OUTDIR.
set -euo pipefail

if [ $# -lt 4 ] || [ ! -f "$1" ]; then
    echo "usage: viewer_pictures.sh SCENE.tcgs DATASET OUTDIR POSE.json..." >&2
    exit 2
fi
scene=$1
dataset=$2
out=$3
shift 3
here=$(cd "$(dirname "$0")" && pwd)
tcgs=${TCGS:-${CARGO_TARGET_DIR:-target}/release/tcgs}
chromium=${TCGS_CHROMIUM:-$(command -v chromium || command -v chromium-browser || command -v google-chrome || true)}
[ -n "$chromium" ] || {
    echo "viewer_pictures: no Chromium is installed (apt-get install chromium)" >&2
    exit 4
}
splat_transform=$("$here/splat_transform.sh" --where)
# The engine comes with splat-transform, at the version that its lock names.
playcanvas=$(dirname "$splat_transform")/../playcanvas/build/playcanvas.mjs
usd_python=${TCGS_USD_PYTHON:-$("$here/usd_python.sh" || true)}
mkdir -p "$out"

"$tcgs" export "$scene" --dataset "$dataset" -o "$out/scene.ply" >&2
files='{ "name": "ply", "file": "scene.ply", "type": "gsplat" }'
add() { files="$files, { \"name\": \"$1\", \"file\": \"$2\", \"type\": \"$3\" }"; }
convert() { "$tcgs" export "$out/scene.ply" --format "$1" -o "$out/scene.$2" --unmeasured >&2; }

convert glb glb
add glb scene.glb container
convert sog sog
add sog scene.sog gsplat
for format in spz spz3; do
    convert "$format" spz
    mv "$out/scene.spz" "$out/$format.spz"
    "$splat_transform" --quiet -w "$out/$format.spz" "$out/$format.ply" >&2
    add "$format" "$format.ply" gsplat
done
if [ -n "$usd_python" ]; then
    convert usda usda
    "$usd_python" "$here/read_usda.py" "$out/scene.usda" >"$out/usda.json"
    node "$here/usda_to_ply.mjs" "$out/usda.json" "$out/usda.ply"
    add usda usda.ply gsplat
else
    echo "viewer_pictures: usd-core cannot be had; .usda is left out" >&2
fi

cameras=
index=0
for pose in "$@"; do
    "$tcgs" render "$scene" --pose "$pose" -o "$out/scene_$index.png" >&2
    "$tcgs" render "$out/scene.ply" --pose "$pose" -o "$out/tcgs_$index.png" >&2
    entry="{ \"name\": \"$index\", \"scene\": \"scene_$index.png\", \"plain\": \"tcgs_$index.png\", \"pose\": $(cat "$pose") }"
    cameras="${cameras:+$cameras, }$entry"
    index=$((index + 1))
done
# As the scene's own background, which the .ply states.
background='[0, 0, 0]'
! LC_ALL=C head -c 4096 "$out/scene.ply" | grep -a -q '^comment tcgs .*white' || background='[1, 1, 1]'
printf '{ "files": [%s], "cameras": [%s], "background": %s }\n' "$files" "$cameras" "$background" >"$out/list.json"
node "$here/viewer_pictures.mjs" "$out" "$playcanvas" "$chromium"
