//! What stands in front of DTLS records, and what is said inside of them.
#![no_main]

libfuzzer_sys::fuzz_target!(|datagram: &[u8]| sgc_transport::exercise_front(datagram));
