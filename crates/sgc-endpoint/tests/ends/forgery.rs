//! Altered packets, packets of other members and copied packets are refused, and leave nothing behind.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use sgc_trust::{BATCH_PACKETS_MAX, OpenError};
use sgc_wire::{Decode, Encode, PacketHeader};

use super::*;

fn with_payload(packet: &Packet, payload: Vec<u8>) -> Packet {
    Packet { header: packet.header.clone(), payload: Bytes::from(payload).into() }
}

/// A batch of `count` messages of 20 bytes and more.
fn batch(source: &mut Source, count: usize) -> Vec<Packet> {
    let mut packets = Vec::new();
    for n in 0..count {
        packets.extend(published(source, bytes(20 + n), n + 1 < count));
    }
    assert_eq!(packets.len(), count);
    packets
}

#[test]
fn any_altered_bit_is_detected() {
    for suite in Suite::ALL {
        let mut source = unrecovered(suite, 5);
        let mut fresh = sink(suite, &[&source]);
        // A verifier that knows the batch already takes another code path.
        let mut knowing = sink(suite, &[&source]);
        let packets = batch(&mut source, 5);
        assert_eq!(delivered(&mut knowing, &packets[..2]).len(), 2);
        for good in &packets[3..] {
            let payload = text(good);
            for bit in 0..payload.len() * 8 {
                let mut bad = payload.clone();
                bad[bit / 8] ^= 1 << (bit % 8);
                let bad = with_payload(good, bad);
                for sink in [&mut fresh, &mut knowing] {
                    let result = sink.handle_packet(&bad);
                    assert!(matches!(result, Err(SinkDrop::Open(_))), "{suite}, bit {bit}: {result:?}");
                }
            }
            let header = good.header.to_vec();
            for bit in 0..header.len() * 8 {
                let mut bad = header.clone();
                bad[bit / 8] ^= 1 << (bit % 8);
                let Ok(bad) = PacketHeader::from_slice(&bad) else { continue };
                if bad.name != NAME || bad.hops != good.header.hops {
                    continue;
                }
                let bad = Packet { header: bad, payload: good.payload.clone() };
                for sink in [&mut fresh, &mut knowing] {
                    let result = sink.handle_packet(&bad);
                    let parked = bad.header.epoch > 1 && result == Ok(Delivery::Parked);
                    assert!(parked || result.is_err(), "{suite}, header bit {bit}: {result:?}");
                }
            }
        }
        for sink in [&mut fresh, &mut knowing] {
            assert_eq!(delivered(sink, &packets[3..]).len(), 2, "and the true ones still arrive in {suite}");
        }
    }
}

#[test]
fn trailers_of_impossible_lengths_and_places_are_refused() {
    let suite = Suite::Standard;
    let mut source = unrecovered(suite, 5);
    let mut sink = sink(suite, &[&source]);
    let good = batch(&mut source, 7).swap_remove(6);
    let payload = text(&good);
    let end = payload.len() - 64 - 4;
    let place = |index: u16, count: u16| {
        let mut bad = payload.clone();
        bad[end..end + 2].copy_from_slice(&index.to_be_bytes());
        bad[end + 2..end + 4].copy_from_slice(&count.to_be_bytes());
        with_payload(&good, bad)
    };
    for (index, count) in [(6, 0), (6, 6), (7, 7), (6, 65), (0, 7), (6, u16::MAX), (u16::MAX, u16::MAX)] {
        assert_eq!(
            sink.handle_packet(&place(index, count)),
            Err(OpenError::Trailer.into()),
            "{index}/{count}"
        );
    }
    // The same length of path, elsewhere in the tree.
    assert_eq!(sink.handle_packet(&place(2, 3).clone()), Err(OpenError::Trailer.into()));
    assert_eq!(sink.handle_packet(&place(4, 5)), Err(OpenError::Trailer.into()));
    let checked = sink.signatures_checked();
    assert_eq!(checked, 0, "no signature was looked at for those");
    let mut longer = payload.clone();
    longer.push(0);
    assert!(sink.handle_packet(&with_payload(&good, longer)).is_err());
    let sealed = good.header.fragment_bytes() + sgc_wire::MESSAGE_HEAD_BYTES + sgc_trust::TAG_BYTES;
    for cut in sealed..payload.len() {
        assert!(sink.handle_packet(&with_payload(&good, payload[..cut].to_vec())).is_err());
    }
    assert_eq!(delivered(&mut sink, &[good]).len(), 1);
}

#[test]
fn every_size_of_batch_verifies_whatever_is_lost_in_any_order() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for suite in [Suite::Standard, Suite::Paper] {
        let mut source = unrecovered(suite, 5);
        let mut sink = sink(suite, &[&source]);
        for count in 1..=BATCH_PACKETS_MAX {
            let mut packets = batch(&mut source, count);
            packets.retain(|_| rng.next_u32() % 4 > 0);
            for n in (1..packets.len()).rev() {
                packets.swap(n, rng.next_u32() as usize % (n + 1));
            }
            let before = sink.signatures_checked();
            assert_eq!(delivered(&mut sink, &packets).len(), packets.len(), "{count}");
            assert_eq!(sink.signatures_checked() - before, u64::from(!packets.is_empty()));
        }
    }
}

#[test]
fn mingled_batches_are_each_verified_once() {
    let suite = Suite::Standard;
    let mut source = unrecovered(suite, 5);
    let mut sink = sink(suite, &[&source]);
    let batches: Vec<_> = (0..4).map(|_| batch(&mut source, 64)).collect();
    let mingled: Vec<_> = (0..64).flat_map(|n| batches.iter().map(move |b| b[n].clone())).collect();
    assert_eq!(delivered(&mut sink, &mingled).len(), 256);
    assert_eq!(sink.signatures_checked(), 4);
}

#[test]
fn a_member_cannot_forge_another() {
    for suite in Suite::ALL.into_iter().filter(|s| s.is_signed()) {
        let mut honest = source(suite, 3);
        let mut sink =
            Sink::new(NAME, SINK, grant(suite, 1, &[honest.announce()]), true, SinkLimits::default());
        // Mallory was granted the topic: it holds its key, and makes a source under the honest one's id.
        let own = MessageKey::generate(Suite::Standard);
        let own = if own.fits(suite) { own } else { MessageKey::generate(suite) };
        let mut mallory = Source::new(config(5, 3), &grant(suite, 1, &[]), own).unwrap();
        published(&mut mallory, bytes(99), false);
        let forged = replayed(&mut mallory);
        for packet in &forged {
            assert_eq!(sink.handle_packet(packet), Err(OpenError::Signature.into()), "{suite}");
        }
        assert_eq!(sink.unsynced().count(), 1, "not even the mark of synchrony");
        let good = published(&mut honest, bytes(30), false).remove(0);
        assert_eq!(delivered(&mut sink, &replayed(&mut honest)), [bytes(30)]);
        let forged = published(&mut mallory, bytes(40), false);
        assert_eq!(sink.handle_packet(&forged[0]), Err(OpenError::Signature.into()));
        // A true trailer behind a text of its own: it holds the AEAD key, so only the signature stands
        // against it.
        let next = batch(&mut honest, 3);
        let mut own = batch(&mut mallory, 3);
        for (own, true_one) in own.iter_mut().zip(&next) {
            let sealed = own.header.fragment_bytes() + 28;
            let payload = [&text(own)[..sealed], &text(true_one)[sealed..]].concat();
            own.header.seq = true_one.header.seq;
            *own = with_payload(own, payload);
        }
        for packet in own.iter().chain([&good]) {
            assert!(sink.handle_packet(packet).is_err());
        }
        assert_eq!(delivered(&mut sink, &next).len(), 3);
    }
}

/// The signature of a batch moved to a batch of another size, source or name does not verify: the headers of
/// the packets are in the leaves, so sources can share a key.
#[test]
fn sources_that_share_a_key_cannot_be_taken_for_each_other() {
    let suite = Suite::Standard;
    let (mut one, mut other) = (source(suite, 0), source_with(suite, config(6, 0)));
    let mut sink = sink(suite, &[&one, &other]);
    let (a, b) = (batch(&mut one, 2), batch(&mut other, 2));
    let mut swapped = a[0].clone();
    swapped.header.source = b[0].header.source;
    assert!(sink.handle_packet(&swapped).is_err());
    let tail = a[0].header.fragment_bytes() + 28;
    let moved = with_payload(&b[0], [&text(&b[0])[..tail], &text(&a[0])[tail..]].concat());
    assert_eq!(sink.handle_packet(&moved), Err(OpenError::Signature.into()));
    assert_eq!(delivered(&mut sink, &[a, b].concat()).len(), 4);
}

#[test]
fn a_forged_packet_leaves_no_trace_and_costs_at_most_one_verification() {
    let suite = Suite::Standard;
    let mut honest = source(suite, 0);
    let mut sink = sink(suite, &[&honest]);
    let mut mallory = Source::new(config(5, 0), &grant(suite, 1, &[]), MessageKey::generate(suite)).unwrap();
    // Fragments in the right places of a message in transfer, of members and of strangers.
    let good = published(&mut honest, bytes(100_000), false);
    let forged = published(&mut mallory, vec![0xee; 100_000], false);
    for (good, forged) in good.iter().zip(&forged) {
        let before = sink.signatures_checked();
        assert_eq!(sink.handle_packet(forged), Err(OpenError::Signature.into()));
        assert_eq!(sink.signatures_checked() - before, 1);
        let mut noise = text(good);
        noise[0] ^= 1;
        assert_eq!(sink.handle_packet(&with_payload(good, noise)), Err(OpenError::Forged.into()));
        assert_eq!(sink.signatures_checked() - before, 1, "strangers cost no verification");
        let complete = sink.handle_packet(good).unwrap();
        if let Delivery::Message(message) = complete {
            assert_eq!(message.payload, bytes(100_000));
        }
    }
    assert_eq!(sink.incomplete(), 0);
    let next = published(&mut honest, bytes(5), false);
    assert_eq!(delivered(&mut sink, &next), [bytes(5)]);
}

#[test]
fn an_announced_key_that_is_none_verifies_nothing() {
    let suite = Suite::Standard;
    let mut honest = source(suite, 0);
    for key in [Bytes::new(), Bytes::from(vec![0; 32]), message_key(Suite::Paper).public().clone()] {
        let announce = SourceAnnounce { key, ..honest.announce() };
        let mut sink = Sink::new(NAME, SINK, grant(suite, 1, &[announce]), false, SinkLimits::default());
        let packets = published(&mut honest, bytes(5), false);
        assert_eq!(sink.handle_packet(&packets[0]), Err(OpenError::Signature.into()));
    }
}
