//! [`OpenBuffer`]: the memory into which a packet is opened.

use bytes::BytesMut;
use sgc_wire::{Decode, MESSAGE_HEAD_BYTES, MessageHead, MessageKind, PacketHeader};

use super::delivery::SinkDrop;

/// Place of a packet's opened text.
pub(super) enum OpenBuffer {
    /// Memory of its own, which becomes the message.
    Whole(BytesMut),
    /// Its place in the message.
    InPlace,
    /// Memory that is used again; the fragment is copied to its place.
    Aside(Vec<u8>),
}

impl OpenBuffer {
    /// Returns the opened text, if it is here.
    pub(super) fn text(&self) -> &[u8] {
        match self {
            Self::Whole(text) => text,
            Self::Aside(text) => text,
            Self::InPlace => &[],
        }
    }

    /// Takes the head off a message's first packet.
    pub(super) fn take_head(&mut self, header: &PacketHeader) -> Result<Option<MessageHead>, SinkDrop> {
        if header.index != 0 || matches!(self, Self::InPlace) {
            return Ok(None);
        }
        let at = self.text().len() - MESSAGE_HEAD_BYTES;
        let head = MessageHead::from_slice(&self.text()[at..]).map_err(|_| SinkDrop::Head)?;
        self.truncate(at);
        // Number 0 is the mark of a history's end, and nothing else.
        if (head.kind == MessageKind::Synced) != (header.seq == 0) {
            return Err(SinkDrop::Head);
        }
        Ok(Some(head))
    }

    /// Cuts off the rest.
    fn truncate(&mut self, bytes: usize) {
        match self {
            Self::Whole(text) => text.truncate(bytes),
            Self::Aside(text) => text.truncate(bytes),
            Self::InPlace => {}
        }
    }
}
