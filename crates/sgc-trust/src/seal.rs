//! Sealing and opening the fragments of a message, each under its source's key (`docs/spec/trust.md`).
//!
//! One pass at the source (plaintext into the packet) and one at the sink (packet into the message); nothing
//! here keeps state about messages, see [`crate::ReplayWindow`] for that.

use aws_lc_rs::aead::{AES_256_GCM, Aad, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};
use aws_lc_rs::hkdf;
use sgc_wire::{MESSAGE_HEAD_BYTES, MessageHead, Name, PacketHeader, SourceId, TopicGrant};
use zeroize::Zeroizing;

/// Bytes that sealing adds to a fragment.
pub const TAG_BYTES: usize = 16;

/// How payloads of a topic are protected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Suite {
    /// AES-256-GCM with the topic's key: members trust each other not to forge one another.
    Group,
}

impl Suite {
    /// Id on the wire. 2–15 are reserved for signed suites and other ciphers.
    pub fn id(self) -> u8 {
        match self {
            Self::Group => 1,
        }
    }

    /// The suite with that id, if this build has it.
    pub fn from_id(id: u8) -> Option<Self> {
        (id == 1).then_some(Self::Group)
    }
}

/// Why a packet could not be opened. The packet is dropped and counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum OpenError {
    /// The suite in the packet is not the one that was granted.
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
    /// The seal does not verify: altered, or sealed by one without the key.
    #[error("the seal does not verify")]
    Forged,
}

/// The key of one source in one epoch.
pub struct SourceKey {
    key: LessSafeKey,
    suite: Suite,
    epoch: u32,
}

impl SourceKey {
    /// `HKDF-SHA-256(topic key, "sgc source v1" ‖ suite ‖ epoch ‖ name ‖ source id)`; `None` for a suite that this
    /// build does not have.
    pub fn derive(grant: &TopicGrant, name: &Name, source: &SourceId) -> Option<Self> {
        let suite = Suite::from_id(grant.suite)?;
        let mut bytes = Zeroizing::new([0; 32]);
        hkdf::Salt::new(hkdf::HKDF_SHA256, b"sgc source v1")
            .extract(grant.key.expose())
            .expand(
                &[&[grant.suite], &grant.epoch.to_be_bytes(), name.as_bytes(), source.as_bytes()],
                hkdf::HKDF_SHA256,
            )
            .and_then(|okm| okm.fill(&mut bytes[..]))
            .expect("HKDF-SHA-256 always yields 32 bytes");
        let key = UnboundKey::new(&AES_256_GCM, &bytes[..]).expect("32 bytes are an AES-256 key");
        Some(Self { key: LessSafeKey::new(key), suite, epoch: grant.epoch })
    }

    /// Suite.
    pub fn suite(&self) -> Suite {
        self.suite
    }

    /// Epoch.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Appends the sealed fragment to `out`: `fragment`, and behind the first one the message's head.
    ///
    /// The caller must use each (sequence, index) of a source once: the nonce is made of them.
    pub fn seal(&self, header: &PacketHeader, head: &MessageHead, fragment: &[u8], out: &mut Vec<u8>) {
        use sgc_wire::Encode;
        debug_assert_eq!(fragment.len(), header.fragment_bytes());
        let head = if header.index == 0 { head.to_vec() } else { Vec::new() };
        let start = out.len();
        out.resize(start + fragment.len() + head.len() + TAG_BYTES, 0);
        let (text, rest) = out[start..].split_at_mut(fragment.len());
        self.key
            .seal_out_of_place_scatter(
                nonce(header),
                Aad::from(header.associated_data()),
                fragment,
                text,
                &head,
                rest,
            )
            .expect("fragments are far below the AEAD's length limit");
    }

    /// Opens a packet's payload into `out`, which must have [`opened_bytes`] bytes.
    pub fn open(&self, header: &PacketHeader, sealed: &[u8], out: &mut [u8]) -> Result<(), OpenError> {
        if header.suite != self.suite.id() {
            return Err(OpenError::Suite { found: header.suite });
        }
        if header.epoch != self.epoch {
            return Err(OpenError::Epoch { found: header.epoch });
        }
        if sealed.len() != opened_bytes(header) + TAG_BYTES || out.len() != opened_bytes(header) {
            return Err(OpenError::Length);
        }
        let (text, tag) = sealed.split_at(opened_bytes(header));
        self.key
            .open_separate_gather(nonce(header), Aad::from(header.associated_data()), text, tag, out)
            .map_err(|_| OpenError::Forged)
    }
}

/// Bytes that a packet's payload opens to: the fragment, and behind the first one the message's head.
pub fn opened_bytes(header: &PacketHeader) -> usize {
    header.fragment_bytes() + if header.index == 0 { MESSAGE_HEAD_BYTES } else { 0 }
}

fn nonce(header: &PacketHeader) -> Nonce {
    let mut bytes = [0; NONCE_LEN];
    bytes[..8].copy_from_slice(&header.seq.to_be_bytes());
    bytes[8..].copy_from_slice(&u32::from(header.index).to_be_bytes());
    Nonce::assume_unique_for_key(bytes)
}

#[cfg(test)]
mod tests {
    use sgc_wire::{Class, MessageKind, SecretBytes};

    use super::*;

    fn grant() -> TopicGrant {
        TopicGrant {
            epoch: 1,
            suite: Suite::Group.id(),
            key: SecretBytes::new([7; 32]),
            sources: Vec::new(),
            entry: None,
        }
    }

    fn key(source: u8) -> SourceKey {
        SourceKey::derive(&grant(), &Name([1; 32]), &SourceId([source; 16])).unwrap()
    }

    fn header(total: u32, index: u16) -> PacketHeader {
        PacketHeader {
            reliable: true,
            class: Class::Default,
            hops: 9,
            suite: Suite::Group.id(),
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

    const HEAD: MessageHead = MessageHead { kind: MessageKind::Write, source_timestamp_ns: 99 };

    fn sealed(h: &PacketHeader) -> Vec<u8> {
        let mut out = Vec::new();
        key(2).seal(h, &HEAD, &vec![5; h.fragment_bytes()], &mut out);
        out
    }

    fn opened(h: &PacketHeader, sealed: &[u8]) -> Result<Vec<u8>, OpenError> {
        let mut out = vec![0; opened_bytes(h)];
        key(2).open(h, sealed, &mut out).map(|()| out)
    }

    #[test]
    fn what_is_sealed_opens_and_the_head_is_behind_the_first_fragment() {
        use sgc_wire::Decode;
        for (total, index, bytes) in [(0, 0, 0), (5, 0, 5), (40, 0, 16), (40, 1, 16), (40, 2, 8)] {
            let h = header(total, index);
            let plain = opened(&h, &sealed(&h)).unwrap();
            assert_eq!(&plain[..bytes], &vec![5; bytes]);
            if index == 0 {
                assert_eq!(MessageHead::from_slice(&plain[bytes..]), Ok(HEAD));
            } else {
                assert_eq!(plain.len(), bytes);
            }
        }
    }

    #[test]
    fn any_altered_bit_of_payload_or_header_is_detected() {
        let h = header(40, 1);
        let good = sealed(&h);
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(opened(&h, &bad), Err(OpenError::Forged));
        }
        let altered = [
            PacketHeader { seq: 2, ..h.clone() },
            PacketHeader { index: 0, total: 4, ..h.clone() },
            PacketHeader { reliable: false, ..h.clone() },
            PacketHeader { class: Class::Realtime, ..h.clone() },
            PacketHeader { name: Name([9; 32]), ..h.clone() },
            PacketHeader { source: SourceId([9; 16]), ..h.clone() },
            PacketHeader { total: 48, ..h.clone() },
        ];
        for h in altered {
            assert!(opened(&h, &good).is_err(), "{h:?}");
        }
        assert_eq!(
            opened(&PacketHeader { epoch: 2, ..h.clone() }, &good),
            Err(OpenError::Epoch { found: 2 })
        );
        assert_eq!(
            opened(&PacketHeader { suite: 9, ..h.clone() }, &good),
            Err(OpenError::Suite { found: 9 })
        );
        assert_eq!(opened(&h, &good[1..]), Err(OpenError::Length));
    }

    #[test]
    fn sources_epochs_and_names_have_keys_of_their_own() {
        let h = header(5, 0);
        let good = sealed(&h);
        let mut out = vec![0; opened_bytes(&h)];
        assert_eq!(key(3).open(&h, &good, &mut out), Err(OpenError::Forged));
        let elsewhere = SourceKey::derive(&grant(), &Name([8; 32]), &SourceId([2; 16])).unwrap();
        assert_eq!(elsewhere.open(&h, &good, &mut out), Err(OpenError::Forged));
        assert!(SourceKey::derive(&TopicGrant { suite: 0, ..grant() }, &h.name, &h.source).is_none());
    }
}
