# Sourced by the Makefile and the scripts: where rustup puts cargo, and a private runtime folder, which Vulkan's
# loader and drivers ask for and which a container or a cron job has none of.

export PATH="${CARGO_HOME:-$HOME/.cargo}/bin:$PATH"

if [ -z "${XDG_RUNTIME_DIR:-}" ] || [ ! -w "$XDG_RUNTIME_DIR" ]; then
    XDG_RUNTIME_DIR="${TMPDIR:-/tmp}/tcgs-runtime-$(id -u)"
    mkdir -p -m 700 "$XDG_RUNTIME_DIR"
    # In a shared temporary folder somebody else may have been first.
    if [ ! -O "$XDG_RUNTIME_DIR" ]; then
        XDG_RUNTIME_DIR=$(mktemp -d)
    fi
    export XDG_RUNTIME_DIR
fi
