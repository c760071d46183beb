#![no_main]

#[path = "../memory.rs"]
mod memory;
#[allow(dead_code, reason = "one of its functions is the target")]
#[path = "../readers.rs"]
mod readers;

libfuzzer_sys::fuzz_target!(|data: &[u8]| memory::bounded(readers::camera, data));
