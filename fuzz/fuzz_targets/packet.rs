//! Data packets: no input panics, fragments stay within their message, and what decodes encodes to the same bytes.
#![no_main]

use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use sgc_wire::{Encode, MESSAGE_BYTES_MAX, Packet};

fuzz_target!(|input: &[u8]| {
    let Ok(packet) = Packet::from_datagram(Bytes::copy_from_slice(input)) else { return };
    let header = &packet.header;
    let start = u64::from(header.index) * u64::from(header.grid);
    assert!(start + header.fragment_bytes() as u64 <= u64::from(header.total.max(1)));
    assert!(header.total <= MESSAGE_BYTES_MAX && u32::from(header.index) < header.fragments());
    let mut encoded = header.to_vec();
    packet.payload.copy_into(&mut encoded);
    assert_eq!(encoded, input);
});
