//! No key seals two texts under one nonce, in any history of sources: the one mistake that AES-GCM does not forgive.

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use sgc_trust::{TAG_BYTES, opened_bytes};

use super::*;

/// The inputs of a packet's key and nonce.
type KeyAndNonce = (u32, SourceId, Option<SinkId>, u64, u16);

/// Everything that was sealed: associated data, ciphertext and tag. With one key and nonce, two of them are
/// the same only if text and associated data are.
#[derive(Default)]
struct SealedTexts(BTreeMap<KeyAndNonce, (Vec<u8>, Vec<u8>)>);

impl SealedTexts {
    fn add(&mut self, seed: u64, packet: &Packet) {
        let h = &packet.header;
        let mut sealed = text(packet);
        sealed.truncate(opened_bytes(h) + TAG_BYTES);
        let seen = (h.associated_data().as_ref().to_vec(), sealed);
        let before = self.0.insert((h.epoch, h.source, h.to, h.seq, h.index), seen.clone());
        assert!(before.is_none_or(|b| b == seen), "seed {seed}: a nonce again for another text: {h:?}");
    }
}

#[test]
fn nonces_are_unique_over_histories_of_publishing_rekeying_replaying_and_restarting() {
    for seed in 0..60 {
        let suite = Suite::ALL[seed as usize % 4];
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut dice = move |n: u32| rng.next_u32() % n;
        let (mut sealed, mut epoch, mut incarnation) = (SealedTexts::default(), 1, 0u8);
        // So few that marks about lost messages precede many answers.
        let recovery = RecoveryLimits { messages_max: 6, bytes_max: 1 << 20 };
        let config = |id| SourceConfig { recovery, ..config(id, 4) };
        let mut source = source_with(suite, config(incarnation));
        let (mut replays, mut live) = (0, 0);
        for _ in 0..300 {
            let mut packets = Vec::new();
            match dice(20) {
                0 => {
                    epoch += dice(2);
                    let changed = source.rekey(&grant(suite, epoch, &[]), |p| packets.push(p));
                    assert!(!changed || (source.epoch(), source.published_in_epoch()) == (epoch, 0));
                }
                1 if incarnation < 40 => {
                    // The process restarts; the topic's key may live on.
                    incarnation += 1;
                    source = Source::new(config(incarnation), &grant(suite, epoch, &[]), message_key(suite))
                        .unwrap();
                }
                2..=5 => {
                    let sink = SinkId([dice(3) as u8; 16]);
                    let from = u64::from(dice(10));
                    source.replay(sink, from, from + u64::from(dice(1000)), |p| packets.push(p));
                    replays += packets.len();
                }
                6 => source.mark(|p| packets.push(p)),
                7 => source.record(&HEAD, vec![dice(256) as u8; 100].into()).unwrap(),
                n => {
                    let payload = vec![dice(256) as u8; dice(40_000) as usize];
                    let head = MessageHead { source_timestamp_ns: i64::from(dice(1000)), ..HEAD };
                    source.publish(&head, payload.into(), n % 2 == 0, |p| packets.push(p)).unwrap();
                    live += packets.len();
                }
            }
            packets.iter().for_each(|p| sealed.add(seed, p));
        }
        assert!(replays > 50 && live > 50 && sealed.0.len() > 100, "{replays} {live}");
    }
}

/// A packet sent again to the same sink in the same epoch is the same, bit for bit; to another, or in another epoch, it
/// is under another key.
#[test]
fn replays_repeat_themselves_and_nothing_else() {
    for suite in [Suite::Group, Suite::Standard] {
        let mut source = source(suite, 4);
        published(&mut source, bytes(100), false);
        let sealed = |packets: &[Packet]| -> Vec<Vec<u8>> {
            // Without the tag, in which the header counts too.
            let cut = |p: &Packet| text(p)[..opened_bytes(&p.header)].to_vec();
            packets.iter().map(cut).collect()
        };
        let first = sealed(&replayed(&mut source));
        assert_eq!(first, sealed(&replayed(&mut source)));
        let mut other = Vec::new();
        source.replay(SinkId([7; 16]), 1, u64::MAX, |p| other.push(p));
        let other = sealed(&other);
        assert!(source.rekey(&grant(suite, 2, &[]), |_| {}));
        let later = sealed(&replayed(&mut source));
        for ((first, other), later) in first.iter().zip(&other).zip(&later) {
            assert!(first != other && first != later && other != later);
        }
    }
}
