//! No key seals two texts under one nonce, whatever happens to the nodes.

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_endpoint::Event;
use sgc_testkit::{Dice, NodeKey, Sharing, What, World, WorldConfig};
use sgc_trust::{SourceKey, Suite, TAG_BYTES, opened_bytes};
use sgc_wire::{Name, Packet, PacketHeader, SinkId, SourceId, TopicGrant};

use crate::ms;

/// The inputs of key and nonce that a packet shows.
type Slot = (Name, u8, u32, SourceId, Option<SinkId>, u64, u16);

/// The authenticated data and the sealed text, for which a key and a nonce may be used once.
type SealedText = (PacketHeader, Vec<u8>);

fn slot(header: &PacketHeader) -> Slot {
    let PacketHeader { name, suite, epoch, source, to, seq, index, .. } = *header;
    (name, suite, epoch, source, to, seq, index)
}

fn sealed(packet: &Packet) -> SealedText {
    let mut payload = Vec::new();
    packet.payload.copy_into(&mut payload);
    // A signature may differ each time it is made.
    payload.truncate(opened_bytes(&packet.header) + TAG_BYTES);
    (PacketHeader { hops: 0, ..packet.header.clone() }, payload)
}

/// Returns the keys that were granted for a name and an epoch, over all runs of its owner.
fn keys(world: &World) -> BTreeMap<(Name, u32), Vec<TopicGrant>> {
    let mut keys: BTreeMap<_, Vec<TopicGrant>> = BTreeMap::new();
    for logged in world.log() {
        let What::Event(
            Event::Granted { name, grant, .. }
            | Event::Rekeyed { name, grant }
            | Event::OwnGrant { name, grant },
        ) = &logged.what
        else {
            continue;
        };
        let known = keys.entry((*name, grant.epoch)).or_default();
        if known.iter().all(|k| k.key != grant.key) {
            known.push(grant.clone());
        }
    }
    keys
}

/// Returns the index of the key that opens a packet.
fn key_of(packet: &Packet, keys: &[TopicGrant]) -> Option<usize> {
    let header = &packet.header;
    let mut payload = Vec::new();
    packet.payload.copy_into(&mut payload);
    keys.iter().position(|grant| {
        let key = match &header.to {
            Some(sink) => SourceKey::derive_addressed(grant, &header.name, &header.source, sink),
            None => SourceKey::derive(grant, &header.name, &header.source),
        };
        key.is_some_and(|key| key.open(header, &payload, &mut vec![0; opened_bytes(header)]).is_ok())
    })
}

/// Returns two different packets that share key and nonce.
fn repeated(world: &World) -> Option<String> {
    let keys = keys(world);
    let mut seen: BTreeMap<Slot, Vec<(Packet, SealedText)>> = BTreeMap::new();
    for captured in world.captured_packets() {
        let packet = &captured.packet;
        let slot = slot(&packet.header);
        let sealed = sealed(packet);
        let others = seen.entry(slot).or_default();
        if others.iter().any(|(_, s)| *s == sealed) {
            continue;
        }
        let keys = keys.get(&(slot.0, slot.2)).map(Vec::as_slice).unwrap_or_default();
        let own = key_of(packet, keys);
        if others.iter().any(|(other, _)| key_of(other, keys) == own) {
            return Some(format!("{slot:?} twice under one key ({own:?})"));
        }
        others.push((packet.clone(), sealed));
    }
    None
}

struct History {
    world: World,
    dice: Dice,
    arm: NodeKey,
    users: Vec<NodeKey>,
    routers: Vec<NodeKey>,
}

impl History {
    fn new(seed: u64) -> Self {
        let mut dice = Dice::new(seed);
        let mut world = World::with(WorldConfig::new(seed));
        world.capture();
        let arm = world.proxy("arm-1");
        let routers = vec![world.router("east"), world.router("west")];
        let users: Vec<_> = ["desk", "lap", "tab"].map(|n| world.proxy(n)).into();
        world.link(arm, routers[0]);
        world.link(arm, routers[1]);
        world.link(routers[0], routers[1]);
        for user in &users {
            world.link(routers[dice.below(2)], *user);
        }
        let suite = dice.pick(&[Suite::Standard, Suite::Group, Suite::StandardChacha]);
        let publishers = [users[0]].into();
        let sharing =
            Sharing { publishers, suite, ..Sharing::to(&users[1..]) }.transient_local(dice.below(6));
        world.share(arm, "/chatter", sharing);
        world.publish_on(users[0], arm, "/chatter");
        world.use_topic(users[1], arm, "/chatter");
        world.use_topic(users[2], arm, "/chatter");
        world.run(ms(1500));
        Self { world, dice, arm, users, routers }
    }

    fn step(&mut self) {
        let Self { world, dice, arm, users, routers } = self;
        let arm = *arm;
        let user = users[dice.below(3)];
        match dice.below(20) {
            0 => world.restart(arm),
            1 => world.restart(user),
            2 => world.restart(routers[dice.below(2)]),
            3..5 => world.rotate(arm, "/chatter"),
            5 => {
                world.cut(routers[0], routers[1]);
                world.run(dice.time(&(ms(0)..=ms(500))));
                world.rejoin(routers[0], routers[1]);
            }
            6 => {
                let on = world.nodes().next().expect("the owner");
                let sharing = Sharing { publishers: [users[0]].into(), ..Sharing::to(&users[1..]) };
                world.unshare(on, "/chatter");
                world.run(dice.time(&(ms(0)..=ms(500))));
                world.share(on, "/chatter", sharing.transient_local(dice.below(6)));
            }
            7..13 => {
                for _ in 0..dice.within(1..=5) {
                    let bytes = [8, 300, 40_000][dice.below(3)];
                    world.publish_bytes(arm, "/chatter", bytes);
                }
            }
            13..17 => {
                world.publish_as(users[0], arm, "/chatter");
            }
            _ => world.run(dice.time(&(ms(0)..=Duration::from_secs(3)))),
        }
    }
}

#[test]
fn no_nonce_is_used_for_two_texts_over_restarts_rotations_and_histories() {
    let mut packets = 0;
    let mut anew = 0;
    for seed in 0..25 {
        let mut history = History::new(seed);
        for _ in 0..60 {
            history.step();
        }
        history.world.run(ms(2000));
        let found = repeated(&history.world);
        assert_eq!(found, None, "seed {seed}\n{}", history.world.trace());
        packets += history.world.captured_packets().len();
        anew += keys(&history.world).values().filter(|k| k.len() > 1).count();
    }
    // The histories contained the cases in which nonces could repeat.
    assert!(packets > 5000, "{packets}");
    assert!(anew > 25, "{anew}");
}
