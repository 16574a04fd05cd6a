#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| sgc_fuzz_targets::zenoh::run(input));
