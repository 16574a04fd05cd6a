//! Proof of a packet's source to each receiver, by a MAC under a key that the owner shares with that receiver alone.
//!
//! The MAC covers header, ciphertext and tag. A MAC of the AEAD's tag alone would not do: a member has the topic's key,
//! with which it can make another ciphertext for a given tag. [`crate::BatchVerifier`] is the other proof of the
//! `pairwise` suites, by a signature, where receivers are many or unknown to the source.

use std::fmt;

use aws_lc_rs::aead::{Aad, LessSafeKey};
use aws_lc_rs::constant_time::verify_slices_are_equal;
use aws_lc_rs::hkdf;
use bytes::BufMut;
use rand_core::RngCore;
use sgc_wire::{
    HEADER_BYTES_MAX, Name, NodeId, PacketHeader, ReceiverKey, SecretBytes, SinkId, SourceId, TopicGrant,
};
use zeroize::Zeroizing;

use crate::seal::{derive, nonce};
use crate::{OpenError, Suite, TAG_BYTES, opened_bytes};

/// Most receivers for which a packet has a MAC. For more, its source signs.
pub const RECEIVERS_MAX: usize = 8;

/// First byte of a trailer with a signature.
pub(crate) const FORM_SIGNATURE: u8 = 0;
/// First byte of a trailer with MACs.
const FORM_MACS: u8 = 1;
/// Bytes of a MAC: those of an AEAD's tag.
const MAC_BYTES: usize = TAG_BYTES;
/// Bytes of a key's id and the MAC under it.
const ENTRY_BYTES: usize = 4 + MAC_BYTES;

/// The secret of an owner from which the keys of one topic's receivers are derived. It never leaves the owner.
#[derive(Debug)]
pub struct ReceiverSecret(SecretBytes);

impl ReceiverSecret {
    /// Takes a secret of 32 random bytes; for vectors.
    pub fn new(secret: SecretBytes) -> Self {
        Self(secret)
    }

    /// Draws a secret.
    pub fn generate(rng: &mut impl RngCore) -> Self {
        let mut bytes = Zeroizing::new([0; 32]);
        rng.fill_bytes(&mut *bytes);
        Self(SecretBytes::new(*bytes))
    }

    /// Returns the key of a node: `HKDF-SHA-256("sgc receiver v1", secret, name ‖ node id)`. It is the same for all
    /// requests of the node, so that packets under way survive a new route.
    pub fn derive_key(&self, name: &Name, node: &NodeId) -> ReceiverKey {
        let mut bytes = Zeroizing::new([0; 36]);
        hkdf::Salt::new(hkdf::HKDF_SHA256, b"sgc receiver v1")
            .extract(self.0.expose())
            .expand(&[name.as_bytes(), node.as_bytes()], KeyBytes)
            .and_then(|okm| okm.fill(&mut bytes[..]))
            .expect("HKDF-SHA-256 always yields 36 bytes");
        let (mut id, mut key) = ([0; 4], Zeroizing::new([0; 32]));
        id.copy_from_slice(&bytes[..4]);
        key.copy_from_slice(&bytes[4..]);
        ReceiverKey { id, key: SecretBytes::new(*key) }
    }
}

/// The length of a key and its id.
struct KeyBytes;

impl hkdf::KeyType for KeyBytes {
    fn len(&self) -> usize {
        36
    }
}

/// A receiver's key for the packets of one source in one epoch: for those to all, or for those to one sink.
pub struct MacKey {
    id: [u8; 4],
    key: LessSafeKey,
}

impl MacKey {
    /// Derives the key: `HKDF-SHA-256("sgc mac v1", receiver key ‖ topic key, suite ‖ epoch ‖ name ‖ source id)`, with
    /// the sink's id behind it for packets to one sink, as for [`crate::SourceKey`]; `None` for a suite that this build
    /// does not have.
    pub fn derive(
        receiver: &ReceiverKey,
        grant: &TopicGrant,
        name: &Name,
        source: &SourceId,
        to: Option<&SinkId>,
    ) -> Option<Self> {
        let mut secret = Zeroizing::new([0; 64]);
        secret[..32].copy_from_slice(receiver.key.expose());
        secret[32..].copy_from_slice(grant.key.expose());
        let key = derive(b"sgc mac v1", &secret[..], grant, name, source, to)?;
        Some(Self { id: receiver.id, key })
    }

    /// Checks the MAC for this receiver in a packet that has opened.
    ///
    /// # Errors
    /// [`OpenError::NoMac`] if the packet has none, [`OpenError::Mac`] if it does not verify, [`OpenError::Length`] or
    /// [`OpenError::Trailer`] if the trailer is malformed.
    pub fn check(&self, header: &PacketHeader, payload: &[u8]) -> Result<(), OpenError> {
        let (sealed, macs) = split(header, payload)?;
        let mut own =
            macs.chunks_exact(ENTRY_BYTES).filter_map(|entry| entry.strip_prefix(&self.id)).peekable();
        if own.peek().is_none() {
            return Err(OpenError::NoMac);
        }
        let expected = self.mac(header, sealed);
        // Two keys may have one id.
        let is_ours = |mac: &[u8]| verify_slices_are_equal(mac, &expected).is_ok();
        if own.any(is_ours) { Ok(()) } else { Err(OpenError::Mac) }
    }

    /// Returns the tag of the suite's AEAD with the header as its text, and ciphertext and tag of the packet as its
    /// associated data. The nonce is that of the packet: where one repeats, so does all of this.
    fn mac(&self, header: &PacketHeader, sealed: &[u8]) -> [u8; MAC_BYTES] {
        let (mut text, mut mac) = ([0; HEADER_BYTES_MAX], [0; MAC_BYTES]);
        let associated = header.associated_data();
        let text = &mut text[..associated.as_ref().len()];
        text.copy_from_slice(associated.as_ref());
        let tag = self
            .key
            .seal_in_place_separate_tag(nonce(header), Aad::from(sealed), text)
            .expect("headers and fragments are far below the AEAD's length limit");
        mac.copy_from_slice(tag.as_ref());
        mac
    }
}

impl fmt::Debug for MacKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("MacKey(..)")
    }
}

/// Returns the length of a trailer with this number of MACs, bytes.
pub fn mac_trailer_bytes(receivers: usize) -> usize {
    2 + receivers * ENTRY_BYTES
}

/// Appends a trailer with a MAC under each key to a sealed packet's ciphertext and tag. There must be at most
/// [`RECEIVERS_MAX`] keys, derived for the packet's suite, epoch, name, source and addressee.
pub fn put_macs<B: BufMut + AsRef<[u8]>>(header: &PacketHeader, sealed: &mut B, keys: &[MacKey]) {
    debug_assert!(keys.len() <= RECEIVERS_MAX);
    let mut entries = [0; RECEIVERS_MAX * ENTRY_BYTES];
    for (key, entry) in keys.iter().zip(entries.chunks_exact_mut(ENTRY_BYTES)) {
        entry[..4].copy_from_slice(&key.id);
        entry[4..].copy_from_slice(&key.mac(header, sealed.as_ref()));
    }
    sealed.put_u8(FORM_MACS);
    sealed.put_u8(keys.len() as u8);
    sealed.put_slice(&entries[..keys.len() * ENTRY_BYTES]);
}

/// Returns `true` if a packet of a `pairwise` suite has MACs, `false` if it has a signature.
///
/// # Errors
/// [`OpenError::Length`] without a trailer, [`OpenError::Trailer`] if it has an unknown form.
pub fn has_macs(header: &PacketHeader, payload: &[u8]) -> Result<bool, OpenError> {
    match payload.get(opened_bytes(header) + TAG_BYTES) {
        Some(&FORM_SIGNATURE) => Ok(false),
        Some(&FORM_MACS) => Ok(true),
        Some(_) => Err(OpenError::Trailer),
        None => Err(OpenError::Length),
    }
}

/// Returns the bytes of a suite's trailers that say which form they have.
pub(crate) fn form_bytes(suite: Suite) -> usize {
    usize::from(suite.is_pairwise())
}

/// Divides a payload with MACs into sealed bytes and MACs.
fn split<'a>(header: &PacketHeader, payload: &'a [u8]) -> Result<(&'a [u8], &'a [u8]), OpenError> {
    let (sealed, trailer) =
        payload.split_at_checked(opened_bytes(header) + TAG_BYTES).ok_or(OpenError::Length)?;
    match trailer {
        [FORM_MACS, count, macs @ ..] if usize::from(*count) <= RECEIVERS_MAX => {
            let fits = macs.len() == usize::from(*count) * ENTRY_BYTES;
            if fits { Ok((sealed, macs)) } else { Err(OpenError::Length) }
        }
        _ => Err(OpenError::Trailer),
    }
}

#[cfg(test)]
mod tests {
    use sgc_wire::Class;

    use super::*;

    const NAME: Name = Name([1; 32]);
    const SOURCE: SourceId = SourceId([2; 16]);
    const SUITES: [Suite; 2] = [Suite::Pairwise, Suite::PairwiseChacha];

    fn secret() -> ReceiverSecret {
        ReceiverSecret::new(SecretBytes::new([7; 32]))
    }

    fn grant(header: &PacketHeader, topic_key: u8) -> TopicGrant {
        let key = SecretBytes::new([topic_key; 32]);
        let PacketHeader { epoch, suite, .. } = *header;
        TopicGrant { epoch, suite, key, receiver: None, sources: Vec::new(), entry: None }
    }

    fn derived(receiver: &ReceiverKey, header: &PacketHeader) -> MacKey {
        derived_under(receiver, header, 3)
    }

    fn derived_under(receiver: &ReceiverKey, header: &PacketHeader, topic_key: u8) -> MacKey {
        let grant = grant(header, topic_key);
        MacKey::derive(receiver, &grant, &header.name, &header.source, header.to.as_ref()).unwrap()
    }

    fn key(node: u8, header: &PacketHeader) -> MacKey {
        derived(&secret().derive_key(&NAME, &NodeId([node; 32])), header)
    }

    fn header(suite: Suite) -> PacketHeader {
        PacketHeader {
            reliable: true,
            class: Class::Default,
            hops: 9,
            suite: suite.id(),
            epoch: 1,
            name: NAME,
            source: SOURCE,
            seq: 1,
            total: 100,
            index: 1,
            grid: 50,
            to: None,
        }
    }

    fn packet(header: &PacketHeader, keys: &[MacKey]) -> Vec<u8> {
        let mut sealed = vec![5; opened_bytes(header) + TAG_BYTES];
        put_macs(header, &mut sealed, keys);
        sealed
    }

    #[test]
    fn each_receiver_checks_its_own_mac() {
        for header in SUITES.map(header) {
            let all = [1, 2, 3, 4].map(|node| key(node, &header));
            let packet = packet(&header, &all);
            assert_eq!(packet.len(), opened_bytes(&header) + TAG_BYTES + mac_trailer_bytes(4));
            assert_eq!(has_macs(&header, &packet), Ok(true));
            for key in &all {
                assert_eq!(key.check(&header, &packet), Ok(()));
            }
            assert_eq!(key(5, &header).check(&header, &packet), Err(OpenError::NoMac));
        }
    }

    #[test]
    fn any_altered_bit_of_header_ciphertext_tag_or_mac_is_detected() {
        for header in SUITES.map(header) {
            let key = key(1, &header);
            let good = packet(&header, std::slice::from_ref(&key));
            for bit in 0..good.len() * 8 {
                let mut bad = good.clone();
                bad[bit / 8] ^= 1 << (bit % 8);
                assert!(key.check(&header, &bad).is_err(), "bit {bit}");
            }
            for other in [
                PacketHeader { seq: 2, ..header.clone() },
                PacketHeader { source: SourceId([9; 16]), ..header.clone() },
                PacketHeader { epoch: 2, ..header.clone() },
                PacketHeader { name: Name([9; 32]), ..header.clone() },
                PacketHeader { reliable: false, ..header.clone() },
                PacketHeader { class: Class::Realtime, ..header.clone() },
                PacketHeader { total: 150, ..header.clone() },
                PacketHeader { to: Some(SinkId([9; 16])), ..header.clone() },
            ] {
                assert_eq!(key.check(&other, &good), Err(OpenError::Mac), "{other:?}");
            }
            let forwarded = PacketHeader { hops: 3, ..header.clone() };
            assert_eq!(key.check(&forwarded, &good), Ok(()), "routers count hops");
        }
    }

    #[test]
    fn two_keys_under_one_id_are_told_apart() {
        let header = header(Suite::Pairwise);
        let both = [key(2, &header), key(1, &header)].map(|key| MacKey { id: [1; 4], ..key });
        let packet = packet(&header, &both);
        assert_eq!(both.map(|key| key.check(&header, &packet)), [Ok(()); 2]);
    }

    #[test]
    fn trailers_of_another_length_or_form_are_refused() {
        let header = header(Suite::Pairwise);
        let key = key(1, &header);
        let good = packet(&header, std::slice::from_ref(&key));
        let at = opened_bytes(&header) + TAG_BYTES;
        for cut in 0..good.len() {
            let refused = key.check(&header, &good[..cut]);
            assert!(matches!(refused, Err(OpenError::Length | OpenError::Trailer)), "{cut}: {refused:?}");
        }
        assert_eq!(key.check(&header, &[&good[..], &[0]].concat()), Err(OpenError::Length));
        let mut many = good[..at].to_vec();
        many.extend([FORM_MACS, RECEIVERS_MAX as u8 + 1]);
        many.extend([0; (RECEIVERS_MAX + 1) * ENTRY_BYTES]);
        assert_eq!(key.check(&header, &many), Err(OpenError::Trailer));
        let mut unknown = good.clone();
        unknown[at] = 2;
        assert_eq!(has_macs(&header, &unknown), Err(OpenError::Trailer));
        assert_eq!(has_macs(&header, &good[..at]), Err(OpenError::Length));
    }

    #[test]
    fn receiver_keys_are_those_of_one_secret_name_and_node() {
        let key = secret().derive_key(&NAME, &NodeId([1; 32]));
        assert_eq!(key, secret().derive_key(&NAME, &NodeId([1; 32])));
        let others = [
            secret().derive_key(&NAME, &NodeId([2; 32])),
            secret().derive_key(&Name([2; 32]), &NodeId([1; 32])),
            ReceiverSecret::new(SecretBytes::new([8; 32])).derive_key(&NAME, &NodeId([1; 32])),
        ];
        assert!(others.iter().all(|other| other.key != key.key && other.id != key.id));
    }

    /// One nonce occurs in each of these contexts, so each needs a key of its own.
    #[test]
    fn each_topic_key_epoch_name_source_and_addressee_has_a_key_of_its_own() {
        let receiver = secret().derive_key(&NAME, &NodeId([1; 32]));
        let base = header(Suite::Pairwise);
        let contexts = [
            base.clone(),
            PacketHeader { epoch: 2, ..base.clone() },
            PacketHeader { name: Name([9; 32]), ..base.clone() },
            PacketHeader { source: SourceId([9; 16]), ..base.clone() },
            PacketHeader { to: Some(SinkId([1; 16])), ..base.clone() },
            PacketHeader { to: Some(SinkId([2; 16])), ..base.clone() },
        ];
        let mac = |key: MacKey| key.mac(&base, b"the same text");
        let mut macs = contexts.map(|context| mac(derived(&receiver, &context))).to_vec();
        macs.push(mac(derived_under(&receiver, &base, 4)));
        let different: std::collections::BTreeSet<_> = macs.iter().collect();
        assert_eq!(different.len(), macs.len());
    }
}
