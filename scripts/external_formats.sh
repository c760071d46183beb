#!/usr/bin/env bash
# external_formats.sh IN.ply OUTDIR: a file of plain Gaussians through the formats of others and back. Writes OUTDIR/other.sog and
# other_v3.spz and other_v4.spz, what each decodes to (sog.ply, spz_v3.ply, spz_v4.ply, which `tcgs eval` measures), and
# OUTDIR/sizes.tsv: format, bytes of the file, bytes of IN.ply, the .ply that it decodes to. The table is also printed. A conversion
# may take TCGS_EXTERNAL_SECONDS (1800); a format that takes longer is left out.
set -euo pipefail

if [ $# -ne 2 ] || [ ! -f "$1" ]; then
    echo "usage: external_formats.sh IN.ply OUTDIR" >&2
    exit 2
fi
input=$1
out=$2
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$out"

limit=${TCGS_EXTERNAL_SECONDS:-1800}

convert() { timeout "$limit" "$here/splat_transform.sh" --quiet -w "$@" >&2; }
size() { wc -c <"$1" | tr -d ' '; }

# What this program's files say of their background and dataset, which a converter drops.
note=$(head -c 4096 "$input" | LC_ALL=C grep -a -m 1 '^comment tcgs ' || true)

# back FILE OUT.ply: decodes, and puts the note back behind the two first lines of the header.
back() {
    convert "$1" "$2" || return
    [ -z "$note" ] || {
        { LC_ALL=C head -n 2 "$2"; printf '%s\n' "$note"; LC_ALL=C tail -n +3 "$2"; } >"$2.noted"
        mv "$2.noted" "$2"
    }
}

# format NAME FILE FLAGS…: there and back; a format that takes too long is said and left out.
format() {
    local name=$1 file=$2 decoded=$1.ply status=0
    shift 2
    convert "$input" "$@" "$out/$file" && back "$out/$file" "$out/$decoded" || status=$?
    if [ $status -eq 124 ]; then
        echo "external_formats: $name is left out: it took more than $limit seconds" >&2
        return
    fi
    [ $status -eq 0 ] || exit $status
    printf '%s\t%s\t%s\t%s\n' "$name" "$(size "$out/$file")" "$(size "$input")" "$decoded" >>"$out/sizes.tsv"
}

printf 'format\tbytes\tply_bytes\tdecoded\n' >"$out/sizes.tsv"
# Clustering takes a time that grows with the square of the Gaussians, and is faster on any adapter, even a software one, than on none.
adapters=$("$here/splat_transform.sh" --list-gpus 2>/dev/null || true)
device=cpu
[[ $adapters != *"[0] "* ]] || device=0
format sog other.sog -g "$device"
format spz_v3 other_v3.spz --spz-version 3
format spz_v4 other_v4.spz --spz-version 4
cat "$out/sizes.tsv"
