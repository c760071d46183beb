#![no_main]

#[path = "../targets.rs"]
mod targets;
#[path = "../../tests/it/codec/wire.rs"]
mod wire;

libfuzzer_sys::fuzz_target!(|data: &[u8]| targets::decode_header(data));
