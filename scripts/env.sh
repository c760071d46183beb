# Sourced by the Makefile and the scripts: the path of rustup's cargo, and a private runtime folder, which Vulkan's loader and
# drivers need and containers and cron jobs lack.

export PATH="${CARGO_HOME:-$HOME/.cargo}/bin:$PATH"

if [ -z "${XDG_RUNTIME_DIR:-}" ] || [ ! -w "$XDG_RUNTIME_DIR" ]; then
    XDG_RUNTIME_DIR="${TMPDIR:-/tmp}/tcgs-runtime-$(id -u)"
    mkdir -p -m 700 "$XDG_RUNTIME_DIR"
    # In a shared temporary folder another user may have created it first.
    if [ ! -O "$XDG_RUNTIME_DIR" ]; then
        XDG_RUNTIME_DIR=$(mktemp -d)
    fi
    export XDG_RUNTIME_DIR
fi
