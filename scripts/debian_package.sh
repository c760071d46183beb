#!/usr/bin/env bash
# Unpacks a Debian package without installing it, so that a driver or layer does not affect other programs:
# scripts/debian_package.sh PACKAGE prints the folder of its files, target/packages/PACKAGE, and downloads it if missing.
set -euo pipefail
cd "$(dirname "$0")/.."

package=$1
folder=${CARGO_TARGET_DIR:-$PWD/target}/packages/$package

say() { printf 'debian_package: %s\n' "$*" >&2; }

candidate() { apt-cache policy "$1" 2>/dev/null | sed -n 's/^ *Candidate: *//p' | grep -v '(none)' || true; }

refresh_lists() {
    if [ "$(id -u)" -eq 0 ]; then
        apt-get -qq update
    elif command -v sudo >/dev/null && { sudo -n true 2>/dev/null || [ -t 0 ]; }; then
        sudo apt-get -qq update
    else
        say "neither root nor sudo here; as root, run: apt-get update"
        return 1
    fi
}

# As root, apt would download as a user without write permission here.
fetch() { apt-get -qq -o APT::Sandbox::User=root download "$package"; }

if [ ! -d "$folder" ]; then
    command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || {
        say "$package comes as a Debian package, and there is no apt-get here"
        exit 4
    }
    [ -n "$(candidate "$package")" ] || refresh_lists >&2 || say "the package lists could not all be refreshed"
    mkdir -p "$(dirname "$folder")"
    scratch=$(mktemp -d "$folder.XXXXXX")
    trap 'rm -rf "$scratch"' EXIT
    say "fetching $package"
    # An outdated package list names files that are no longer in the archive.
    (cd "$scratch" && { fetch || { refresh_lists && fetch; }; }) >&2
    mkdir "$scratch/files"
    dpkg-deb --extract "$scratch"/*.deb "$scratch/files"
    mv -T "$scratch/files" "$folder" 2>/dev/null || [ -d "$folder" ]
fi
echo "$folder"
