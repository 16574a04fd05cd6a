//! The client of the store of names: it reads any bytes alike in all pieces, and whatever servers send, operations end in
//! time and memory is bounded. The first byte selects the case.

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    match input.split_first() {
        Some((choice, rest)) if choice % 2 == 0 => sgc_store::fuzz_replies(rest),
        Some((_, rest)) => sgc_store::fuzz_servers(rest),
        None => {}
    }
}
