#!/usr/bin/env bash
# peers.sh IN.ply OUTDIR: a file of plain Gaussians through the formats of others and back. Writes OUTDIR/peer.sog and
# peer_v3.spz and peer_v4.spz, what each decodes to (sog.ply, spz_v3.ply, spz_v4.ply, which `tcgs eval` measures), and
# OUTDIR/sizes.tsv: format, bytes of the file, bytes of IN.ply, the .ply that it decodes to. The table is also printed.
set -euo pipefail

if [ $# -ne 2 ] || [ ! -f "$1" ]; then
    echo "usage: peers.sh IN.ply OUTDIR" >&2
    exit 2
fi
input=$1
out=$2
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$out"

convert() { "$here/splat_transform.sh" --quiet -w "$@" >&2; }
size() { wc -c <"$1" | tr -d ' '; }

# What this program's files say of their background and dataset, which a converter drops.
note=$(head -c 4096 "$input" | LC_ALL=C grep -a -m 1 '^comment tcgs ' || true)

# back FILE OUT.ply: decodes, and puts the note back behind the two first lines of the header.
back() {
    convert "$1" "$2"
    [ -z "$note" ] || {
        { LC_ALL=C head -n 2 "$2"; printf '%s\n' "$note"; LC_ALL=C tail -n +3 "$2"; } >"$2.noted"
        mv "$2.noted" "$2"
    }
}

convert "$input" -g cpu "$out/peer.sog"
convert "$input" --spz-version 3 "$out/peer_v3.spz"
convert "$input" --spz-version 4 "$out/peer_v4.spz"
back "$out/peer.sog" "$out/sog.ply"
back "$out/peer_v3.spz" "$out/spz_v3.ply"
back "$out/peer_v4.spz" "$out/spz_v4.ply"
{
    printf 'format\tbytes\tply_bytes\tdecoded\n'
    printf 'sog\t%s\t%s\tsog.ply\n' "$(size "$out/peer.sog")" "$(size "$input")"
    printf 'spz_v3\t%s\t%s\tspz_v3.ply\n' "$(size "$out/peer_v3.spz")" "$(size "$input")"
    printf 'spz_v4\t%s\t%s\tspz_v4.ply\n' "$(size "$out/peer_v4.spz")" "$(size "$input")"
} | tee "$out/sizes.tsv"
