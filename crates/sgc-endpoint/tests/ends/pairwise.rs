//! The `pairwise` suites: MACs for few receivers, signatures for many, and neither lets a member forge another.

use std::sync::Arc;

use sgc_endpoint::Receivers;
use sgc_trust::{OpenError, RECEIVERS_MAX, ReceiverSecret};
use sgc_wire::{NodeId, ReceiverKey};

use super::*;

const SUITES: [Suite; 2] = [Suite::Pairwise, Suite::PairwiseChacha];

/// The owner of the topic, as far as its receivers are concerned.
struct Owner {
    secret: ReceiverSecret,
    receivers: Arc<Receivers>,
}

impl Owner {
    fn new() -> Self {
        Self { secret: ReceiverSecret::new(SecretBytes::new([7; 32])), receivers: Arc::default() }
    }

    fn key(&self, node: u8) -> ReceiverKey {
        self.secret.derive_key(&NAME, &NodeId([node; 32]))
    }

    /// Grants the topic to a sink of a node whose number is the sink's.
    fn admit(&self, suite: Suite, node: u8, sources: &[&Source]) -> Sink {
        let id = SinkId([node; 16]);
        self.receivers.add(id, NodeId([node; 32]), || self.key(node));
        let grant = TopicGrant { receiver: Some(self.key(node)), ..grant(suite, 1, &announced(sources)) };
        Sink::new(NAME, id, grant, false, SinkLimits::default())
    }

    fn source(&self, suite: Suite, config: SourceConfig) -> Source {
        source_with(suite, SourceConfig { receivers: Some(self.receivers.clone()), ..config })
    }
}

#[test]
fn few_receivers_have_macs_and_the_source_signs_nothing() {
    for suite in SUITES {
        let owner = Owner::new();
        let mut source = owner.source(suite, config(5, 0));
        let mut sinks: Vec<_> =
            (1..=RECEIVERS_MAX as u8).map(|n| owner.admit(suite, n, &[&source])).collect();
        let messages = [bytes(0), bytes(20), bytes(100_000)];
        for message in &messages {
            // Nothing waits for a batch.
            let packets = published(&mut source, message.clone(), true);
            for sink in &mut sinks {
                assert_eq!(delivered(sink, &packets), std::slice::from_ref(message), "{suite}");
            }
        }
        let checked: u64 = sinks.iter().map(Sink::signatures_checked).sum();
        assert_eq!((source.progress().signatures(), checked), (0, 0), "{suite}");
    }
}

#[test]
fn many_receivers_get_signatures_until_they_are_few_again() {
    let (suite, owner) = (Suite::Pairwise, Owner::new());
    let mut source = owner.source(suite, config(5, 0));
    let many = RECEIVERS_MAX as u8 + 1;
    let mut sinks: Vec<_> = (1..=many).map(|n| owner.admit(suite, n, &[&source])).collect();
    let first = published(&mut source, bytes(20), false);
    assert_eq!(source.progress().signatures(), 1);
    // A message waits for a signature when the number falls. It leaves before the next.
    assert!(published(&mut source, bytes(21), true).is_empty());
    owner.receivers.remove(&SinkId([many; 16]));
    let rest = published(&mut source, bytes(22), true);
    assert_eq!((rest.len(), source.progress().signatures()), (2, 2));
    let gone = sinks.pop().unwrap();
    for sink in &mut sinks {
        assert_eq!(delivered(sink, &first), [bytes(20)]);
        assert_eq!(delivered(sink, &rest), [bytes(21), bytes(22)]);
    }
    let mut gone = gone;
    assert_eq!(delivered(&mut gone, &[first[0].clone(), rest[0].clone()]), [bytes(20), bytes(21)]);
    assert_eq!(gone.handle_packet(&rest[1]), Err(OpenError::NoMac.into()), "it is not a receiver any more");
}

#[test]
fn history_for_one_sink_has_its_mac_however_many_others_there_are() {
    let (suite, owner) = (Suite::Pairwise, Owner::new());
    let mut source = owner.source(suite, config(5, 3));
    published(&mut source, bytes(20), false);
    let mut sinks: Vec<_> = (1..=9).map(|n| owner.admit(suite, n, &[&source])).collect();
    let signatures = source.progress().signatures();
    let history = replayed_to(&mut source, SinkId([3; 16]), 1);
    assert_eq!(source.progress().signatures(), signatures);
    let results: Vec<_> = history.iter().map(|packet| sinks[2].handle_packet(packet)).collect();
    assert_eq!(results.last(), Some(&Ok(Delivery::Synced(source.id()))), "{results:?}");
    assert!(history.iter().all(|packet| sinks[3].handle_packet(packet) == Err(SinkDrop::NotForUs)));
    // A sink that has left gets no MAC, but a signature.
    owner.receivers.remove(&SinkId([3; 16]));
    replayed_to(&mut source, SinkId([3; 16]), 1);
    assert_eq!(source.progress().signatures(), signatures + 1);
}

#[test]
fn packet_without_a_mac_for_a_new_sink_is_asked_for_again() {
    let (suite, owner) = (Suite::Pairwise, Owner::new());
    let mut source = owner.source(suite, config(5, 0));
    let mut early = owner.admit(suite, 1, &[&source]);
    // The source seals while the owner grants: the announcement does not count the message, and it has no MAC.
    let announced = announced(&[&source]);
    let missed = published(&mut source, bytes(20), false);
    owner.receivers.add(SinkId([2; 16]), NodeId([2; 32]), || owner.key(2));
    let grant = TopicGrant { receiver: Some(owner.key(2)), ..grant(suite, 1, &announced) };
    let mut late = Sink::new(NAME, SinkId([2; 16]), grant, false, SinkLimits::default());
    assert_eq!(late.handle_packet(&missed[0]), Err(OpenError::NoMac.into()));
    let next = published(&mut source, bytes(21), false);
    assert_eq!(late.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
    let answer = replayed_to(&mut source, SinkId([2; 16]), 1);
    assert_eq!(delivered(&mut late, &answer), [bytes(20), bytes(21)]);
    assert_eq!(delivered(&mut early, &[missed, next].concat()), [bytes(20), bytes(21)]);
}

/// Mallory is a receiver: it holds the topic's key and a receiver key of its own.
#[test]
fn a_receiver_cannot_forge_the_source_to_another() {
    for suite in SUITES {
        let owner = Owner::new();
        let mut honest = owner.source(suite, config(5, 0));
        let (mut victim, mut mallory) =
            (owner.admit(suite, 1, &[&honest]), owner.admit(suite, 2, &[&honest]));
        // With its own key under its own id, and under the victim's; and with the key of another owner.
        let renamed = ReceiverKey { id: owner.key(1).id, ..owner.key(2) };
        let other = Owner { secret: ReceiverSecret::new(SecretBytes::new([8; 32])), ..Owner::new() };
        for (key, refused) in [
            (owner.key(2), OpenError::NoMac),
            (renamed, OpenError::Mac),
            (ReceiverKey { id: owner.key(1).id, ..other.key(1) }, OpenError::Mac),
        ] {
            let receivers = Arc::<Receivers>::default();
            receivers.add(SinkId([1; 16]), NodeId([1; 32]), || key);
            let config = SourceConfig { receivers: Some(receivers), ..config(5, 0) };
            let mut forger =
                Source::new(config, &grant(suite, 1, &[]), message_key(Suite::Standard)).unwrap();
            for forged in published(&mut forger, bytes(40_000), false) {
                assert_eq!(victim.handle_packet(&forged), Err(refused.into()), "{suite}");
            }
        }
        // A MAC of the source behind a text of Mallory's: another ciphertext has another hash.
        let good = published(&mut honest, bytes(40), false).remove(0);
        let mut forger = source_with(suite, config(5, 0));
        let forged =
            published(&mut forger, bytes(40).iter().map(|b| b ^ 1).collect::<Vec<_>>(), false).remove(0);
        let sealed = good.header.fragment_bytes() + sgc_wire::MESSAGE_HEAD_BYTES + sgc_trust::TAG_BYTES;
        let moved = [&text(&forged)[..sealed], &text(&good)[sealed..]].concat();
        let moved = Packet { header: forged.header, payload: Bytes::from(moved).into() };
        assert_eq!(victim.handle_packet(&moved), Err(OpenError::Mac.into()));
        assert_eq!(victim.signatures_checked(), 0, "no forgery costs a signature");
        for sink in [&mut victim, &mut mallory] {
            assert_eq!(delivered(sink, std::slice::from_ref(&good)), [bytes(40)]);
        }
    }
}

/// A request of a service: its caller shares a key with the owner, who is the only receiver.
#[test]
fn callers_prove_their_requests_to_the_owner_and_not_for_each_other() {
    let (suite, owner) = (Suite::Pairwise, Owner::new());
    let caller = |node: u8, id: u8| {
        let receivers = Some(Arc::new(Receivers::of_caller(owner.key(node))));
        source_with(suite, SourceConfig { receivers, recovery: RecoveryLimits::NONE, ..config(id, 0) })
    };
    let (mut one, mut other) = (caller(1, 5), caller(2, 6));
    for (node, source) in [(1, &one), (2, &other)] {
        let sink = SinkId([node; 16]);
        owner.receivers.add(sink, NodeId([node; 32]), || owner.key(node));
        owner.receivers.set_caller(source.id(), sink);
    }
    let mut sink = sink(suite, &[&one, &other]);
    sink.set_callers(owner.receivers.clone());
    for (n, source) in [&mut one, &mut other].into_iter().enumerate() {
        assert_eq!(delivered(&mut sink, &published(source, bytes(20 + n), false)), [bytes(20 + n)]);
        assert_eq!(source.progress().signatures(), 0);
    }
    assert_eq!(sink.signatures_checked(), 0);
    // The second caller calls as the first, whose key it does not have.
    let mut forger = caller(2, 5);
    for _ in 0..3 {
        let forged = published(&mut forger, bytes(40), false);
        assert!(delivered(&mut sink, &forged).is_empty());
    }
    let forged = published(&mut forger, bytes(40), false);
    assert_eq!(sink.handle_packet(&forged[0]), Err(OpenError::NoMac.into()));
    assert_eq!(delivered(&mut sink, &published(&mut one, bytes(50), false)), [bytes(50)]);
    // A caller that is not granted any more is not believed in the epochs that it has not used.
    owner.receivers.remove(&SinkId([2; 16]));
    let next = grant(suite, 2, &announced(&[&one, &other]));
    assert!(regranted(&mut sink, SINK, next.clone()).is_empty());
    assert!(other.rekey(&next, |_| ()) && one.rekey(&next, |_| ()));
    assert_eq!(sink.handle_packet(&published(&mut other, bytes(60), false)[0]), Err(OpenError::NoMac.into()));
    assert_eq!(delivered(&mut sink, &published(&mut one, bytes(60), false)), [bytes(60)]);
}

#[test]
fn sink_without_a_receiver_key_takes_signatures_only() {
    let (suite, owner) = (Suite::Pairwise, Owner::new());
    let (mut own, mut far) = (owner.source(suite, config(5, 0)), source_with(suite, config(6, 0)));
    let mut sink = sink(suite, &[&own, &far]);
    assert_eq!(sink.handle_packet(&published(&mut own, bytes(20), false)[0]), Err(OpenError::NoMac.into()));
    assert_eq!(delivered(&mut sink, &published(&mut far, bytes(20), false)), [bytes(20)]);
}

#[test]
fn a_restarted_owner_has_other_keys() {
    let (suite, owner) = (Suite::Pairwise, Owner::new());
    let mut source = owner.source(suite, config(5, 0));
    let mut sink = owner.admit(suite, 1, &[&source]);
    assert_eq!(delivered(&mut sink, &published(&mut source, bytes(20), false)), [bytes(20)]);
    let restarted = Owner { secret: ReceiverSecret::new(SecretBytes::new([8; 32])), ..Owner::new() };
    let mut anew = restarted.source(suite, config(6, 0));
    restarted.receivers.add(SinkId([1; 16]), NodeId([1; 32]), || restarted.key(1));
    let receiver = Some(restarted.key(1));
    let key = SecretBytes::new([99; 32]);
    let granted = TopicGrant { receiver, key, ..grant(suite, 1, &announced(&[&anew])) };
    // The grant of the restarted owner has another topic key for the same epoch.
    let config = SourceConfig { receivers: Some(restarted.receivers.clone()), ..config(6, 0) };
    anew = Source::new(config, &granted, message_key(suite)).unwrap();
    assert!(regranted(&mut sink, SinkId([1; 16]), granted).is_empty());
    assert_eq!(delivered(&mut sink, &published(&mut anew, bytes(21), false)), [bytes(21)]);
}
