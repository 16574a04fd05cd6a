//! Control frames: no input panics, and decoded frames encode to the same bytes.
use sgc_wire::{Control, Decode, Encode};

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    if let Ok(frame) = Control::from_slice(input) {
        assert_eq!(frame.to_vec(), input);
    }
}
