//! Bytes in front of DTLS records, and messages inside of them.
/// Runs one input of the target.
pub fn run(datagram: &[u8]) {
    sgc_transport::exercise_front(datagram);
}
