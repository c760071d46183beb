#![no_main]

#[path = "../targets.rs"]
mod targets;
#[path = "../../crates/tcgs-codec/tests/it/wire.rs"]
mod wire;

libfuzzer_sys::fuzz_target!(|data: &[u8]| targets::roundtrip(data));
