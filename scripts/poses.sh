#!/usr/bin/env bash
# Makes the private Python environment in which jobs and `tcgs poses` find cameras: pycolmap and numpy, pinned by their hashes, through
# PyPI. Installs ffmpeg too, which reads videos.
#   scripts/poses.sh           makes it where `tcgs poses` looks for it, if it is not there
#   scripts/poses.sh --where   also prints its interpreter
# TCGS_POSES_FOLDER names another folder, for programs that find the interpreter in TCGS_POSES_PYTHON.
set -euo pipefail
cd "$(dirname "$0")/.."

environment=${TCGS_POSES_FOLDER:-${XDG_DATA_HOME:-$HOME/.local/share}/tcgs/poses}
requirements=scripts/poses_requirements.txt

if ! cmp -s "$requirements" "$environment/requirements.txt"; then
    # What is there is removed, and a named folder may have anything.
    if [ -n "$(ls -A "$environment" 2>/dev/null)" ] && [ ! -e "$environment/pyvenv.cfg" ]; then
        printf 'poses: %s is not empty and no Python environment; name another folder in TCGS_POSES_FOLDER\n' "$environment" >&2
        exit 1
    fi
    rm -rf "$environment"
    python3 -m venv "$environment" >&2
    "$environment/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: --require-hashes -r "$requirements" >&2
    "$environment/bin/python3" -I -c 'import pycolmap'
    # Last, so that an interrupted installation is made again.
    cp "$requirements" "$environment/requirements.txt"
fi
scripts/setup.sh --for-videos >&2 || printf 'poses: without ffmpeg, videos cannot be read\n' >&2
[ "${1:-}" != --where ] || printf '%s\n' "$environment/bin/python3"
