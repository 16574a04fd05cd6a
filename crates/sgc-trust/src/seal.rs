//! Sealing and opening the fragments of a message, each under its source's key (`docs/spec/trust.md`).
//!
//! One pass at the source (plaintext into the packet) and one at the sink (packet into the message). Nothing here keeps
//! state about messages: [`crate::ReplayWindow`] does. [`crate::BatchVerifier`] proves the sealing source.

use aws_lc_rs::aead::{Aad, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};
use aws_lc_rs::hkdf;
use sgc_wire::{MESSAGE_HEAD_BYTES, MessageHead, Name, PacketHeader, SinkId, SourceId, TopicGrant};
use zeroize::Zeroizing;

use crate::Suite;

/// Bytes that sealing adds to a fragment.
pub const TAG_BYTES: usize = 16;

/// The reason why a packet could not be opened. The packet is dropped and counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum OpenError {
    /// The suite in the packet is not that of the grant.
    #[error("cipher suite {found} is not the granted one")]
    Suite {
        /// Id found.
        found: u8,
    },
    /// The epoch in the packet has no key here.
    #[error("no key for epoch {found}")]
    Epoch {
        /// Epoch found.
        found: u32,
    },
    /// The payload's length disagrees with the header.
    #[error("payload length disagrees with the header")]
    Length,
    /// The seal does not verify: the packet was altered, or sealed without the key.
    #[error("the seal does not verify")]
    Forged,
    /// The bytes behind the tag contradict each other.
    #[error("the bytes behind the seal are malformed")]
    Trailer,
    /// The source did not sign the packet: it was altered, or made by another member with the topic's key.
    #[error("the source did not sign it")]
    Signature,
    /// The packet has MACs for other receivers only: it was sealed before its source knew of this one.
    #[error("it has no MAC for this node")]
    NoMac,
    /// The MAC for this receiver does not verify: the packet was altered, or made by another member with the topic's
    /// key.
    #[error("its MAC for this node does not verify")]
    Mac,
}

/// The key of one source in one epoch: for packets to all, or for those to one sink.
pub struct SourceKey {
    key: LessSafeKey,
    suite: Suite,
    epoch: u32,
    to: Option<SinkId>,
}

impl SourceKey {
    /// Derives the key of packets to all: `HKDF-SHA-256(topic key, "sgc source v1" ‖ suite ‖ epoch ‖ name ‖ source
    /// id)`; `None` for a suite that this build does not have.
    pub fn derive(grant: &TopicGrant, name: &Name, source: &SourceId) -> Option<Self> {
        Self::expand(grant, name, source, None)
    }

    /// Derives the key of packets to one sink: as [`Self::derive`], with the sink's id behind the source's. It never
    /// opens history for another sink, nor for an earlier sink id of this node.
    pub fn derive_addressed(
        grant: &TopicGrant,
        name: &Name,
        source: &SourceId,
        sink: &SinkId,
    ) -> Option<Self> {
        Self::expand(grant, name, source, Some(*sink))
    }

    fn expand(grant: &TopicGrant, name: &Name, source: &SourceId, to: Option<SinkId>) -> Option<Self> {
        let key = derive(b"sgc source v1", grant.key.expose(), grant, name, source, to.as_ref())?;
        Some(Self { key, suite: Suite::from_id(grant.suite)?, epoch: grant.epoch, to })
    }

    /// Suite.
    pub fn suite(&self) -> Suite {
        self.suite
    }

    /// Epoch.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Returns the sink that packets under this key are for; `None` for packets to all.
    pub fn to(&self) -> Option<SinkId> {
        self.to
    }

    /// Seals a fragment: `fragment`, behind the first one the message's head, and the tag. `out` must have
    /// [`sealed_bytes`] bytes, all of which are written.
    ///
    /// The header must have this key's suite, epoch and addressee. The caller must seal only one text under each
    /// (sequence, index), because the nonce is made of them.
    pub fn seal(&self, header: &PacketHeader, head: &MessageHead, fragment: &[u8], out: &mut [u8]) {
        debug_assert_eq!(fragment.len(), header.fragment_bytes());
        debug_assert_eq!((header.suite, header.epoch, header.to), (self.suite.id(), self.epoch, self.to));
        debug_assert_eq!(out.len(), sealed_bytes(header));
        let head = head.to_array();
        let head = if header.index == 0 { &head[..] } else { &[] };
        let (text, rest) = out.split_at_mut(fragment.len());
        self.key
            .seal_out_of_place_scatter(
                nonce(header),
                Aad::from(header.associated_data()),
                fragment,
                text,
                head,
                rest,
            )
            .expect("fragments are far below the AEAD's length limit");
    }

    /// Opens a packet's payload into `out`, which must have [`opened_bytes`] bytes and must not be used after an error.
    /// Bytes behind the tag are ignored.
    pub fn open(&self, header: &PacketHeader, payload: &[u8], out: &mut [u8]) -> Result<(), OpenError> {
        if header.suite != self.suite.id() {
            return Err(OpenError::Suite { found: header.suite });
        }
        if header.epoch != self.epoch {
            return Err(OpenError::Epoch { found: header.epoch });
        }
        let text_bytes = opened_bytes(header);
        let length_fits = match payload.len().checked_sub(text_bytes + TAG_BYTES) {
            Some(trailer) => self.suite.is_signed() || trailer == 0,
            None => false,
        };
        if !length_fits || out.len() != text_bytes {
            return Err(OpenError::Length);
        }
        let (text, rest) = payload.split_at(text_bytes);
        self.key
            .open_separate_gather(
                nonce(header),
                Aad::from(header.associated_data()),
                text,
                &rest[..TAG_BYTES],
                out,
            )
            .map_err(|_| OpenError::Forged)
    }
}

/// Returns the opened length of a packet's payload: the fragment, and behind the first one the message's head.
pub fn opened_bytes(header: &PacketHeader) -> usize {
    header.fragment_bytes() + if header.index == 0 { MESSAGE_HEAD_BYTES } else { 0 }
}

/// Returns the sealed length of a fragment: the opened length and the tag.
pub fn sealed_bytes(header: &PacketHeader) -> usize {
    opened_bytes(header) + TAG_BYTES
}

/// Derives a key for the packets of one source in one epoch: `HKDF-SHA-256(salt, secret, suite ‖ epoch ‖ name ‖ source
/// id)`, with the sink's id behind it for packets to one sink; `None` for a suite that this build does not have.
pub(crate) fn derive(
    salt: &[u8],
    secret: &[u8],
    grant: &TopicGrant,
    name: &Name,
    source: &SourceId,
    to: Option<&SinkId>,
) -> Option<LessSafeKey> {
    let suite = Suite::from_id(grant.suite)?;
    let mut bytes = Zeroizing::new([0; 32]);
    let sink = to.map_or(&[][..], |sink| sink.as_bytes());
    hkdf::Salt::new(hkdf::HKDF_SHA256, salt)
        .extract(secret)
        .expand(
            &[&[grant.suite], &grant.epoch.to_be_bytes(), name.as_bytes(), source.as_bytes(), sink],
            hkdf::HKDF_SHA256,
        )
        .and_then(|okm| okm.fill(&mut bytes[..]))
        .expect("HKDF-SHA-256 always yields 32 bytes");
    let key = UnboundKey::new(suite.cipher(), &bytes[..]).expect("both ciphers take keys of 32 bytes");
    Some(LessSafeKey::new(key))
}

pub(crate) fn nonce(header: &PacketHeader) -> Nonce {
    let mut bytes = [0; NONCE_LEN];
    bytes[..8].copy_from_slice(&header.seq.to_be_bytes());
    bytes[8..].copy_from_slice(&u32::from(header.index).to_be_bytes());
    Nonce::assume_unique_for_key(bytes)
}

#[cfg(test)]
mod tests {
    use sgc_wire::{Class, Decode, MessageKind, SecretBytes};

    use super::*;

    const CIPHERS: [Suite; 2] = [Suite::Group, Suite::GroupChacha];

    fn grant(suite: Suite) -> TopicGrant {
        TopicGrant {
            epoch: 1,
            suite: suite.id(),
            key: SecretBytes::new([7; 32]),
            receiver: None,
            sources: Vec::new(),
            entry: None,
        }
    }

    fn key(h: &PacketHeader) -> SourceKey {
        let grant = grant(Suite::from_id(h.suite).unwrap());
        SourceKey::expand(&grant, &Name([1; 32]), &SourceId([2; 16]), h.to).unwrap()
    }

    fn header(suite: Suite, total: u32, index: u16) -> PacketHeader {
        PacketHeader {
            reliable: true,
            class: Class::Default,
            hops: 9,
            suite: suite.id(),
            epoch: 1,
            name: Name([1; 32]),
            source: SourceId([2; 16]),
            seq: 1,
            total,
            index,
            grid: 16,
            to: None,
        }
    }

    const HEAD: MessageHead = MessageHead::new(MessageKind::Write, 99);

    fn sealed(h: &PacketHeader) -> Vec<u8> {
        let mut out = vec![0; sealed_bytes(h)];
        key(h).seal(h, &HEAD, &vec![5; h.fragment_bytes()], &mut out);
        out
    }

    fn opened(h: &PacketHeader, key: &SourceKey, sealed: &[u8]) -> Result<Vec<u8>, OpenError> {
        let mut out = vec![0; opened_bytes(h)];
        key.open(h, sealed, &mut out).map(|()| out)
    }

    #[test]
    fn sealed_packets_open_and_the_head_is_behind_the_first_fragment() {
        for suite in CIPHERS {
            for (total, index, bytes) in [(0, 0, 0), (5, 0, 5), (40, 0, 16), (40, 1, 16), (40, 2, 8)] {
                let h = header(suite, total, index);
                let plain = opened(&h, &key(&h), &sealed(&h)).unwrap();
                assert_eq!(&plain[..bytes], &vec![5; bytes]);
                if index == 0 {
                    assert_eq!(MessageHead::from_slice(&plain[bytes..]), Ok(HEAD));
                } else {
                    assert_eq!(plain.len(), bytes);
                }
            }
        }
    }

    #[test]
    fn any_altered_bit_of_payload_or_header_is_detected() {
        for suite in CIPHERS {
            let h = header(suite, 40, 1);
            let (key, good) = (key(&h), sealed(&h));
            for bit in 0..good.len() * 8 {
                let mut bad = good.clone();
                bad[bit / 8] ^= 1 << (bit % 8);
                assert_eq!(opened(&h, &key, &bad), Err(OpenError::Forged));
            }
            let altered = [
                PacketHeader { seq: 2, ..h.clone() },
                PacketHeader { index: 0, total: 4, ..h.clone() },
                PacketHeader { reliable: false, ..h.clone() },
                PacketHeader { class: Class::Realtime, ..h.clone() },
                PacketHeader { name: Name([9; 32]), ..h.clone() },
                PacketHeader { source: SourceId([9; 16]), ..h.clone() },
                PacketHeader { total: 48, ..h.clone() },
                PacketHeader { to: Some(SinkId([1; 16])), ..h.clone() },
            ];
            for h in altered {
                assert!(opened(&h, &key, &good).is_err(), "{h:?}");
            }
            let epoch = PacketHeader { epoch: 2, ..h.clone() };
            assert_eq!(opened(&epoch, &key, &good), Err(OpenError::Epoch { found: 2 }));
            let other = PacketHeader { suite: 99, ..h.clone() };
            assert_eq!(opened(&other, &key, &good), Err(OpenError::Suite { found: 99 }));
            assert_eq!(opened(&h, &key, &good[1..]), Err(OpenError::Length));
            assert_eq!(opened(&h, &key, &[&good[..], &[0]].concat()), Err(OpenError::Length));
        }
    }

    #[test]
    fn suites_sources_names_and_addressees_have_keys_of_their_own() {
        let h = PacketHeader { to: Some(SinkId([3; 16])), ..header(Suite::Group, 5, 0) };
        let good = sealed(&h);
        assert!(opened(&h, &key(&h), &good).is_ok());
        let g = grant(Suite::Group);
        let sink = SinkId([3; 16]);
        for key in [
            SourceKey::derive_addressed(&g, &h.name, &SourceId([9; 16]), &sink).unwrap(),
            SourceKey::derive_addressed(&g, &Name([8; 32]), &h.source, &sink).unwrap(),
            SourceKey::derive_addressed(&g, &h.name, &h.source, &SinkId([4; 16])).unwrap(),
            SourceKey::derive(&g, &h.name, &h.source).unwrap(),
        ] {
            assert_eq!(opened(&h, &key, &good), Err(OpenError::Forged));
        }
        assert!(SourceKey::derive(&TopicGrant { suite: 0, ..g }, &h.name, &h.source).is_none());
    }
}
