//! The multiplexer of stream links: two ends agree whatever their users do, and one end survives any bytes. The first
//! byte selects the case.

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    match input.split_first() {
        Some((choice, rest)) if choice % 2 == 0 => sgc_transport::fuzzing::fuzz_operations(rest),
        Some((_, rest)) => sgc_transport::fuzzing::fuzz_bytes(rest),
        None => {}
    }
}
