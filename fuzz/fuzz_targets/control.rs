//! Control frames: no input panics, and what decodes encodes to the same bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use sgc_wire::{Control, Decode, Encode};

fuzz_target!(|input: &[u8]| {
    if let Ok(frame) = Control::from_slice(input) {
        assert_eq!(frame.to_vec(), input);
    }
});
