#!/usr/bin/env bash
# Makes tests/upgrade from an earlier version's program: a data folder, and the same as a dump of a PostgreSQL database, each with a finished
# job, a running one with a checkpoint, and a queued one, as a power cut leaves them.
#   scripts/upgrade_fixture.sh PROGRAM
# Needs PostgreSQL's programs and, as root, a user `postgres`.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

program=$(realpath "${1:?the earlier program}")
scratch=$(mktemp -d)
bin=$(dirname "$(compgen -G '/usr/lib/postgresql/*/bin/initdb' | sort -V | tail -n 1)")
as_user=()
[ "$(id -u)" -ne 0 ] || as_user=(setpriv --reuid=postgres --regid=postgres --clear-groups)
stop() {
    kill -KILL ${server:-} ${worker:-} 2>/dev/null || true
    "${as_user[@]}" "$bin/pg_ctl" -D "$scratch/postgres/data" -m immediate stop >/dev/null 2>&1 || true
    rm -rf "$scratch"
}
trap stop EXIT
chmod 755 "$scratch"

# A dataset whose jobs take some seconds.
"$program" sample --side 32 "$scratch/sample.zip" >/dev/null
# A twentieth of its points, so that checkpoints are small.
python3 - "$scratch/sample.zip" "$scratch/scene.zip" <<'END'
import re, sys, zipfile

with zipfile.ZipFile(sys.argv[1]) as sample, zipfile.ZipFile(sys.argv[2], "w") as scene:
    for name in sample.namelist():
        content = sample.read(name)
        if name.endswith(".ply"):
            head, points = content.split(b"end_header\n", 1)
            count = int(re.search(rb"element vertex (\d+)", head).group(1))
            row = len(points) // count
            head = head.replace(b"element vertex %d" % count, b"element vertex %d" % (count // 20))
            content = head + b"end_header\n" + points[: count // 20 * row]
        scene.writestr(name, content)
END

# leave FOLDER ARGUMENT...: three jobs on a data folder, cut off while the second one runs. ARGUMENT names the database.
leave() {
    local data=$1 address=
    shift
    "$program" --log-format json serve --workers 0 --listen 127.0.0.1:0 --data "$data" "$@" 2>"$scratch/serve.log" &
    server=$!
    while [ -z "$address" ]; do
        kill -0 "$server" || { cat "$scratch/serve.log" >&2; exit 1; }
        sleep 0.1
        address=$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$scratch/serve.log" | head -n 1)
    done
    TCGS_CHECKPOINT_EVERY=1s "$program" worker --data "$data" "$@" 2>"$scratch/worker.log" &
    worker=$!
    submit() { "$program" submit --server "http://$address" "$scratch/scene.zip" --preset preview --iterations "$1" "${@:2}"; }
    submit 20 --wait >/dev/null
    submit 200 >/dev/null
    submit 20 >/dev/null
    # A checkpoint has its name once it is complete.
    until find "$data/checkpoints" -name checkpoint.safetensors 2>/dev/null | grep -q .; do sleep 0.2; done
    kill -KILL "$worker" "$server"
    wait "$worker" "$server" 2>/dev/null || true
    server= worker=
}

pack() { (archive=$PWD/tests/upgrade/$2.zip; rm -f "$archive"; cd "$1" && python3 -m zipfile -c "$archive" ./*); }

leave "$scratch/data"
pack "$scratch/data" data

mkdir "$scratch/postgres"
chown "$(id -u):$(id -g)" "$scratch/postgres"
[ "$(id -u)" -ne 0 ] || chown postgres:postgres "$scratch/postgres"
"${as_user[@]}" "$bin/initdb" -D "$scratch/postgres/data" -U tcgs -A trust -E UTF8 >/dev/null
"${as_user[@]}" "$bin/pg_ctl" -D "$scratch/postgres/data" -w -l "$scratch/postgres/log" -o "-k $scratch/postgres -c listen_addresses=''" start >/dev/null
url="postgres://tcgs@localhost/postgres?host=$scratch/postgres"
"$program" migrate --data "$scratch/shared" --database "$url" >/dev/null
leave "$scratch/shared" --database "$url"
"$bin/pg_dump" -h "$scratch/postgres" -U tcgs --inserts --no-owner --no-privileges postgres >tests/upgrade/postgres.sql
pack "$scratch/shared" shared
ls -l tests/upgrade
