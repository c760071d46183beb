#!/usr/bin/env bash
# Mutation testing of one layer: scripts/mutants.sh MODULE [cargo-mutants option...], for instance
#   scripts/mutants.sh codec --shard 0/8
# lists the mutants that no test notices in target/mutants/MODULE/mutants.out/missed.txt.
#
# The whole program takes 15 to 40 s a mutant. So a layer of the service, those it uses and its tests are copied into a crate of their
# own, where unit and integration tests are one binary: 3 s to build after a change. `codec` is a crate already.
set -euo pipefail
cd "$(dirname "$0")/.."
# shellcheck source=scripts/env.sh
. scripts/env.sh

module=${1:?a module: codec, store or http}
shift
case $module in
codec)
    files=(FORMAT.md fuzz/targets.rs fuzz/corpus tests/golden tests/oracles tests/it/support/skip.rs crates/tcgs-codec)
    # 0.5 to 19 s each without optimization, 72 s together.
    slow='bytes_do_not_depend_on_the_number_of_threads|small_files_that_ask_for_hours|no_flipped_bit_behind_mended|two_thousand_anchors|more_work_than_the_format_allows|within_a_half_percent_of_the_ideal|every_flipped_bit_behind_good|garbage_sections_behind|attributes_come_from_are_found_and_pay|every_kind_and_width|bytes_and_scene_do_not_depend|scenes_of_the_corpus_come_back|independent_decoder|channels_that_(follow|are_independent)|the_coder_is_as_close|a_few_bytes_that_stand|networks_give_nearly|coarser_steps_save|integers_cost_less|every_flipped_bit_of_header|headers_of_the_corpus|ordinary_scenes|attributes_take_no_more'
    first='the_encoder_still_writes_the_golden_files|golden_files_decode'
    ;;
store)
    layers=(domain store)
    support=(bucket database eventually fakes fault_store gate postgres skip totals)
    files=(crates shaders migrations tests/schemas benches/store/simulation)
    # PostgreSQL.
    without=(store/postgres store/postgres_server)
    slow='simulated_clock|both_schemas_have_the_same|bucket_faults'
    first='^store::'
    ;;
http)
    layers=(domain engine store viewers https webhooks worker http)
    support=(authority balancer bucket contract database eventually fakes faults postgres receiver service skip server sse)
    files=(crates shaders migrations openapi.yaml)
    without=()
    # Three run the program, one runs all scenarios again; the others take 3 to 14 s each, 65 s together.
    never='pages_of_other_sites_change|without_keys_the_service|through_no_proxy|the_program_trusts|whose_server_died|every_operation_and_status'
    slow='what_is_anothers_is_not|a_picture_is_rendered_while|the_offset_is_always|no_operation_answers_without|secrets_are_in_no_log|a_dataset_becomes_a_file|readiness_names|whatever_is_answered_reaches'
    first='^http::'
    ;;
*)
    echo "mutants: no module '$module'" >&2
    exit 2
    ;;
esac
never=${never:-^$}

scratch=target/mutants/$module
mkdir -p "$scratch"
# What was built and found stays.
find "$scratch" -mindepth 1 -maxdepth 1 ! -name target ! -name 'mutants.out*' -exec rm -r {} +
mkdir -p "$scratch"/{src,tests/it/support,.config}
for file in "${files[@]}"; do
    mkdir -p "$scratch/$(dirname "$file")"
    cp -r "$file" "$scratch/$file"
done
cp Cargo.lock "$scratch/"

# The layer as the library of a crate.
layer_crate() {
    for layer in "${layers[@]}"; do
        cp -r "src/$layer"* "$scratch/src/"
    done
    cp -r "tests/it/$module" "$scratch/tests/it/"
    for file in "${support[@]}"; do
        cp -r "tests/it/support/$file"* "$scratch/tests/it/support/"
    done
    for file in "${without[@]}"; do
        sed -i "/^mod ${file##*/};/d" "$scratch/tests/it/${file%/*}/mod.rs"
    done
    if [ "$module" = http ]; then
        # What tests of the whole program use; those are not run.
        support+=(dataset program)
        echo 'pub fn zip() -> Vec<u8> { Vec::new() }' >"$scratch/tests/it/support/dataset.rs"
        echo 'pub fn command() -> std::process::Command { std::process::Command::new("false") }' >"$scratch/tests/it/support/program.rs"
    fi
    # The root of tests is a module.
    sed -i 's/pub(in crate::/&it::/' "$scratch/tests/it/$module"/*.rs
    sed -i 's/use crate::{http,/use crate::{it::http,/' "$scratch/tests/it/$module/mod.rs"
    # What `http` is given.
    [ "$module" != store ] || sed -i '/^\/\/\/ The renderer of every scene/,$d' "$scratch/tests/it/support/fakes.rs"

    {
        echo '#![allow(dead_code, missing_docs, unused_imports, reason = "parts of the crate")]'
        # The names of integration tests hold inside of the library too.
        echo 'extern crate self as tcgs;'
        sed -n '/^pub use/p' src/lib.rs
        printf 'pub mod %s;\n' "${layers[@]}"
        echo '#[cfg(test)] #[path = "../tests/it/support/mod.rs"] mod support;'
        echo '#[cfg(test)] #[path = "../tests/it/main.rs"] mod it;'
    } >"$scratch/src/lib.rs"
    echo "mod $module;" >"$scratch/tests/it/main.rs"
    printf '#[allow(unreachable_pub, reason = "as in the crate")] pub mod %s;\n' "${support[@]}" >"$scratch/tests/it/support/mod.rs"
}

# The manifest without what the crate does not have; of the codec only what its workspace shares.
sections='^\\[(profile|lints)|^\\[\\['
[ "$module" != codec ] || sections='^\\[(profile|lints|package|lib|dependencies|dev-dependencies|target)|^\\[\\['
[ "$module" = codec ] || layer_crate
awk -v without="$sections" '
    /^\[/ { section = $0 }
    section ~ without || /^default-run/ { next }
    { print }
    /^\[package\]/ { print "autobins = false\nautotests = false" }
' Cargo.toml >"$scratch/Cargo.toml"
cat >>"$scratch/Cargo.toml" <<'TOML'

[profile.dev]
debug = false

[profile.dev.package."*"]
opt-level = 2
TOML

# Tests of buckets are skipped without a server.
if [[ " ${support[*]:-} " == *" bucket "* && -z ${TCGS_S3_SERVER:-} ]]; then
    TCGS_S3_SERVER=$(scripts/s3_server.sh | tail -n 1)
    export TCGS_S3_SERVER
fi

# nextest stops at the first test that fails; those that fail most often run first.
mine="test(/^($module|it)::/)"
units="test(/^$module::/)"
packages=(--lib)
sources="src/$module/**"
if [ "$module" = codec ]; then
    mine='all()'
    units='kind(lib)'
    packages=(--package tcgs-codec)
    sources='crates/tcgs-codec/src/**'
fi
tests="$mine - test(/$never/)"
[ "${MUTANTS_TESTS:-}" = all ] || tests="$tests - test(/$slow/)"
cat >"$scratch/.config/nextest.toml" <<TOML
[profile.default]
default-filter = '$tests'

[[profile.default.overrides]]
filter = 'test(/$first/)'
priority = 100

[[profile.default.overrides]]
filter = '$units'
priority = 50

[[profile.default.overrides]]
filter = 'test(/$slow/)'
priority = -100
TOML

cd "$scratch"
# Builds of mutants do not wait for the lock of other builds.
export CARGO_TARGET_DIR=$PWD/target
# The tests have to pass before anything is changed.
cargo nextest run "${packages[@]}"
exec cargo mutants --in-place --test-tool nextest --baseline skip --timeout 120 --file "$sources" --output . "$@" -- "${packages[@]}"
