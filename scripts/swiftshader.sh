#!/usr/bin/env bash
# SwiftShader, a software Vulkan driver with the limits of small GPUs (10 storage buffers a kernel, subgroups of 4), from Debian's
# chromium-common package:
#   scripts/swiftshader.sh COMMAND...    runs the command with it as the only driver
#   scripts/swiftshader.sh --where       prints the file that VK_DRIVER_FILES takes
set -euo pipefail
scripts=$(cd "$(dirname "$0")" && pwd)

folder=$("$scripts/debian_package.sh" chromium-common)
driver=$folder/usr/lib/chromium/vk_swiftshader_icd.json
[ -f "$driver" ] || {
    echo "swiftshader: this system's chromium-common has no ${driver#"$folder"}" >&2
    exit 4
}
[ "${1:-}" != --where ] || exec echo "$driver"
VK_DRIVER_FILES=$driver VK_ICD_FILENAMES=$driver TCGS_ADAPTER=swiftshader exec "$@"
