//! Data packets, with names and under labels: no input panics, fragments stay within their message, and decoded packets
//! encode to the same bytes, and in the other form to the same header.
use bytes::Bytes;
use sgc_wire::{Label, MESSAGE_BYTES_MAX, Name, Packet};

/// Resolves every other label to a name that contains the label.
fn name_of(label: Label) -> Option<Name> {
    let mut name = [0xaa; 32];
    name[..4].copy_from_slice(&label.index().to_be_bytes());
    label.index().is_multiple_of(2).then_some(Name(name))
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let Ok(packet) = Packet::from_datagram_as(Bytes::copy_from_slice(input), name_of) else { return };
    let header = &packet.header;
    let start = u64::from(header.index) * u64::from(header.grid);
    assert!(start + header.fragment_bytes() as u64 <= u64::from(header.total.max(1)));
    assert!(header.total <= MESSAGE_BYTES_MAX && u32::from(header.index) < header.fragments());
    let name = header.name.0;
    let given = u32::from_be_bytes([name[0], name[1], name[2], name[3]]);
    let own = Label::new(given).filter(|label| name_of(*label) == Some(header.name) && input[0] == 0x11);
    for label in [own, None] {
        let mut encoded = Vec::new();
        header.put_as(label, &mut encoded);
        packet.payload.copy_into(&mut encoded);
        assert_eq!(encoded.len(), packet.encoded_bytes_as(label));
        if own == label {
            assert_eq!(encoded, input);
        }
        let again = Packet::from_datagram_as(encoded.into(), name_of).expect("what was encoded decodes");
        assert_eq!(again.header, packet.header);
    }
}
