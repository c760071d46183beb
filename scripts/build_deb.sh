#!/usr/bin/env bash
# Packs the program, its systemd unit and its licenses as a Debian package, target/deb/tcgs_VERSION_ARCHITECTURE.deb:
#   scripts/build_deb.sh             packs target/release/tcgs, and builds it first
#   scripts/build_deb.sh PROGRAM     packs another program
# `apt-get install ./tcgs_*.deb` then installs it with a Vulkan driver. The unit is not started: the command line needs no service.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

target=${CARGO_TARGET_DIR:-$PWD/target}
program=${1:-$target/release/tcgs}
[ $# -gt 0 ] || cargo build --release --locked --quiet --bin tcgs
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"$/\1/p' Cargo.toml)
architecture=$(dpkg --print-architecture)
out=$target/deb
mkdir -p "$out"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
root=$work/root
documents=$root/usr/share/doc/tcgs

install -D -m 755 "$program" "$root/usr/bin/tcgs"
# Where it has debug information, names stay in backtraces and lines do not.
strip --strip-debug "$root/usr/bin/tcgs"
install -d -m 755 "$root/usr/lib/systemd/system" "$documents" "$root/DEBIAN"
sed 's#/usr/local/bin/tcgs#/usr/bin/tcgs#; s#docs/OPERATIONS.md says how to install it#/usr/share/doc/tcgs/OPERATIONS.md has its settings#' \
    docker/tcgs.service >"$root/usr/lib/systemd/system/tcgs.service"
cp docs/OPERATIONS.md docs/CLI.md README.md LICENSE-MIT LICENSE-APACHE "$documents"
gzip --best --no-name --stdout CHANGELOG.md >"$documents/changelog.gz"
cat >"$documents/copyright" <<'TEXT'
Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/
Upstream-Name: tcgs

Files: *
Copyright: the authors of tcgs
License: MIT or Apache-2.0
 LICENSE-MIT and LICENSE-APACHE in this folder have both texts.
 This software is based in part on the work of the Independent JPEG Group.
TEXT

# Libraries that the program is linked to, with the versions that it needs. Vulkan's loader is opened when the program runs.
mkdir "$work/debian"
touch "$work/debian/control"
libraries=$(cd "$work" && dpkg-shlibdeps -O --ignore-missing-info "$root/usr/bin/tcgs" | sed -n 's/^shlibs:Depends=//p')
cat >"$root/DEBIAN/control" <<TEXT
Package: tcgs
Version: $version
Architecture: $architecture
Maintainer: the authors of tcgs <tcgs@localhost>
Installed-Size: $(du --summarize --apparent-size "$root/usr" | cut -f 1)
Depends: ${libraries:+$libraries, }libvulkan1, mesa-vulkan-drivers | vulkan-icd, ca-certificates, passwd
Recommends: ffmpeg
Suggests: python3-venv, postgresql
Section: graphics
Priority: optional
Description: trains and compresses Gaussian-splatting scenes
 Photographs in, one small Gaussian-splatting scene out: over HTTP, on the
 command line, with or without a GPU. The service is not started;
 "systemctl enable --now tcgs" starts it on 127.0.0.1:8080.
TEXT

# As the unit's user, who owns /var/lib/tcgs alone.
cat >"$root/DEBIAN/postinst" <<'TEXT'
#!/bin/sh
set -e
if [ "$1" = configure ]; then
    getent passwd tcgs >/dev/null ||
        useradd --system --user-group --home-dir /nonexistent --no-create-home --shell /usr/sbin/nologin tcgs
    # The unit names these groups.
    for group in render video; do getent group "$group" >/dev/null || groupadd --system "$group"; done
fi
if [ -d /run/systemd/system ]; then
    systemctl daemon-reload
    systemctl try-restart tcgs.service
fi
TEXT
cat >"$root/DEBIAN/prerm" <<'TEXT'
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then
    systemctl disable --now tcgs.service
fi
TEXT
cat >"$root/DEBIAN/postrm" <<'TEXT'
#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then
    systemctl daemon-reload
fi
TEXT
chmod 755 "$root/DEBIAN/postinst" "$root/DEBIAN/prerm" "$root/DEBIAN/postrm"

package=$out/tcgs_${version}_$architecture.deb
dpkg-deb --root-owner-group -Zxz --build "$root" "$package" >/dev/null
printf '%s\n' "$package"
