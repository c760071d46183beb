#!/usr/bin/env bash
# Installs what a fresh Debian-like machine lacks to build, test and run: a C compiler, curl, the Vulkan loader with
# Mesa's software driver (lavapipe), and a Rust toolchain, with its target for WebAssembly. Does nothing, silently, if all is present.
#   scripts/setup.sh [--for-videos]   also ffmpeg, which reads videos
#   scripts/setup.sh [--for-tests]    also programs that single tests need, or are skipped: Chromium, npm, systemd-analyze,
#                                     PostgreSQL, Rust's WebAssembly target; fails in the end if one cannot be had
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

say() { printf 'setup: %s\n' "$*" >&2; }

give_up() {
    say "$*"
    exit 1
}

as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    elif command -v sudo >/dev/null && { sudo -n true 2>/dev/null || [ -t 0 ]; }; then
        sudo "$@"
    else
        give_up "neither root nor sudo here; as root, run: $*"
    fi
}

apt() { as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq "$@"; }

updated=
apt_update() {
    [ -n "$updated" ] || apt update || say "the package lists could not all be refreshed; going on with what there is"
    updated=yes
}

apt_install() { apt install -y --no-install-recommends "$@"; }

need_apt() {
    command -v apt-get >/dev/null || give_up "$1 is missing and there is no apt-get; install it with this system's packages"
}

# The version of a package that apt would install, empty if none.
candidate() { apt-cache policy "$1" 2>/dev/null | sed -n 's/^ *Candidate: *//p' | grep -v '(none)' || true; }

install_basics() {
    local missing=()
    command -v cc >/dev/null || missing+=(build-essential)
    command -v make >/dev/null || missing+=(make)
    command -v curl >/dev/null || missing+=(curl ca-certificates)
    # For the documented sessions, which tests run.
    command -v openssl >/dev/null || missing+=(openssl)
    python3 -c 'import requests' 2>/dev/null || missing+=(python3 python3-requests)
    # For schemathesis, in its own virtual environment.
    python3 -c 'import ensurepip' 2>/dev/null || missing+=(python3-venv)
    [ ${#missing[@]} -gt 0 ] || return 0
    need_apt "${missing[*]}"
    say "installing ${missing[*]}"
    apt_update
    apt_install "${missing[@]}" >&2
}

install_for_videos() {
    command -v ffmpeg >/dev/null && return 0
    need_apt ffmpeg
    say 'installing ffmpeg'
    apt_update
    apt_install ffmpeg >&2
}

# Whether a program for tests cannot be installed.
lacking=

install_for_tests() {
    local missing=()
    command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || missing+=(chromium)
    command -v npm >/dev/null || missing+=(npm)
    command -v systemd-analyze >/dev/null || missing+=(systemd)
    # Its server runs only for tests, as they start it; Debian's programs are not on the path.
    command -v initdb >/dev/null || compgen -G '/usr/lib/postgresql/*/bin/initdb' >/dev/null || missing+=(postgresql)
    [ ${#missing[@]} -gt 0 ] || return 0
    need_apt "${missing[*]}"
    apt_update
    # One name that apt does not know keeps it from installing the others; Ubuntu has Chromium as a snap alone.
    local known=() package
    for package in "${missing[@]}"; do
        if [ -n "$(candidate "$package")" ]; then
            known+=("$package")
        else
            say "this system has no package $package; install the program otherwise, or its tests are skipped"
            lacking=yes
        fi
    done
    [ ${#known[@]} -gt 0 ] || return 0
    say "installing ${known[*]}"
    apt_install "${known[@]}" >&2
}

has_loader() { { ldconfig -p 2>/dev/null || /sbin/ldconfig -p; } | grep 'libvulkan\.so\.1' >/dev/null; }

has_lavapipe() { compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' >/dev/null || compgen -G '/etc/vulkan/icd.d/lvp_icd*.json' >/dev/null; }

# Debian 12's own Mesa is half as fast as the one in its backports. Prints the release to install from if backports are
# reachable; adds the archive to apt's list if needed.
backports() {
    local id version codename list uri
    # shellcheck source=/dev/null
    . /etc/os-release
    id=${ID:-} version=${VERSION_ID:-} codename=${VERSION_CODENAME:-}
    [ "$id" = debian ] && [ "$version" = 12 ] || return 0
    if ! apt-cache policy | grep "$codename-backports" >/dev/null; then
        list=/etc/apt/sources.list.d/$codename-backports.list
        [ ! -e "$list" ] || return 0
        uri=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' "Codename: $codename" | sed -n 1p || true)
        say "adding $codename-backports to apt's sources ($list) for a faster Mesa"
        echo "deb ${uri:-http://deb.debian.org/debian} $codename-backports main" | as_root tee "$list" >/dev/null
        if ! apt update >&2; then
            say "$codename-backports cannot be reached; staying with $codename"
            as_root rm -f "$list"
            return 0
        fi
    fi
    echo "$codename-backports"
}

install_vulkan() {
    if has_loader && has_lavapipe; then return 0; fi
    need_apt "a Vulkan loader with lavapipe (libvulkan1, mesa-vulkan-drivers)"
    say "installing the Vulkan loader and Mesa's software driver"
    apt_update
    local release
    release=$(backports)
    if [ -n "$release" ] && apt_install -t "$release" libvulkan1 mesa-vulkan-drivers >&2; then return 0; fi
    apt_install libvulkan1 mesa-vulkan-drivers >&2
}

# Whether this cargo is as new as Cargo.toml asks; rustup's fetches the toolchain that rust-toolchain.toml names.
has_rust() {
    local wanted found
    command -v rustup >/dev/null && return 0
    command -v cargo >/dev/null || return 1
    wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
    found=$(cargo --version | cut -d ' ' -f 2)
    [ "$(printf '%s\n' "$wanted" "$found" | sort -V | head -n 1)" = "$wanted" ]
}

install_rust() {
    if ! has_rust; then
        command -v apt-get >/dev/null && apt_update
        if command -v apt-get >/dev/null && [ -n "$(candidate rustup)" ]; then
            say "installing rustup from this system's packages"
            apt_install rustup >&2
        else
            say "installing rustup from rustup.rs"
            curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs |
                sh -s -- -y --quiet --profile minimal --default-toolchain none --no-modify-path >&2
        fi
    fi
    command -v rustup >/dev/null || return 0
    local channel
    channel=$(sed -n 's/^channel = "\(.*\)"/\1/p' rust-toolchain.toml)
    # RUSTUP_TOOLCHAIN takes precedence; otherwise the named toolchain needs both components.
    [ -z "${RUSTUP_TOOLCHAIN:-}" ] || return 0
    if ! rustup run "$channel" cargo clippy --version >/dev/null 2>&1 ||
        ! rustup run "$channel" cargo fmt --version >/dev/null 2>&1; then
        say "installing Rust $channel"
        rustup toolchain install "$channel" --profile minimal --component clippy --component rustfmt >&2
    fi
}

# For the viewer in browsers; without it, pages show pictures of the service.
install_web() {
    scripts/wasm_cargo.sh --has && return 0
    command -v rustup >/dev/null || return 0
    say "installing Rust's target for WebAssembly"
    rustup target add wasm32-unknown-unknown >&2 || say 'it cannot be had here; tcgs is built without its viewer for browsers'
}

install_basics
install_vulkan
install_rust
install_web
case ${1:-} in
--for-tests)
    install_for_tests
    install_for_videos
    scripts/wasm_cargo.sh --install || say "no compiler for WebAssembly; scripts/decoder.sh skips its check"
    ;;
--for-videos) install_for_videos ;;
"") ;;
*) give_up "unknown argument $1" ;;
esac
[ -z "$lacking" ]
