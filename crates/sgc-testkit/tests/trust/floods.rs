//! Floods of frames: their cost is bounded, and other nodes go on.

use std::sync::Arc;

use sgc_endpoint::Event;
use sgc_router::LinkClose;
use sgc_testkit::{NodeKey, Sharing, World, WorldConfig};
use sgc_trust::{Identity, Kem, ReplyKey};
use sgc_wire::{Control, JoinBody, Name, RejectReason, Request, SignedBody, SinkId};

use crate::{Scene, assert_received, closed, drops, events, flowing_with, frames, ms, publish_steadily};

/// Returns a join of `name`, valid or not, as the `n`th sink.
fn join(world: &World, identity: &Identity, name: Name, n: u64, valid: bool) -> Control {
    let mut sink = [0x77; 16];
    sink[..8].copy_from_slice(&n.to_be_bytes());
    let body = JoinBody {
        name,
        sink: SinkId(sink),
        request: Request::Subscribe { describe: false },
        issued_at: world.now().unix,
        chain: identity.chain_bytes(),
        reply_key: ReplyKey::generate(Kem::default()).public().clone(),
    };
    let SignedBody { body, signature } = identity.sign_join(&body);
    let mut signature = signature.to_vec();
    let at = signature.len() - 1;
    signature[at] ^= u8::from(!valid);
    Control::Join { signed: SignedBody { body, signature: signature.into() } }
}

/// Returns the scene with one more member at the first router.
fn scene(config: WorldConfig) -> (Scene, NodeKey, Arc<Identity>) {
    let mut scene = flowing_with(config, |s| s);
    let mallory = scene.world.proxy("mallory");
    scene.world.link(scene.east, mallory);
    scene.world.run(ms(500));
    let identity = sgc_testkit::identity(scene.world.member(mallory));
    (scene, mallory, identity)
}

/// Floods from `mallory` while `/chatter` is published, which loses nothing.
fn flood(
    scene: &mut Scene,
    mallory: NodeKey,
    per_tick: usize,
    mut frame: impl FnMut(&World, u64) -> Control,
) {
    let Scene { world, arm, east, .. } = scene;
    let east = *east;
    let mut n = 0;
    let published = publish_steadily(world, *arm, ms(10), ms(2000), |world, _| {
        for _ in 0..per_tick {
            if closed(world, east).is_empty() {
                n += 1;
                let frame = frame(world, n);
                world.inject(mallory, east, &frame);
            }
        }
    });
    world.run(ms(1000));
    for user in scene.users() {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

#[test]
fn flood_of_forged_joins_ends_link_after_bounded_number_of_verifications() {
    let mut config = WorldConfig::new(70);
    config.router_limits.forgeries_max = 20;
    let (mut scene, mallory, identity) = scene(config);
    let name = scene.world.name(scene.arm, "/chatter");
    flood(&mut scene, mallory, 5, |world, n| join(world, &identity, name, n, false));
    let Scene { world, arm, east, .. } = &scene;
    assert_eq!(closed(world, *east), [LinkClose::Forgeries]);
    // Frames in flight when the link ended are not examined.
    let verified = drops(world, *east, "not_verified");
    assert!((20..=24).contains(&verified), "{verified}");
    let reached = frames(world, *east, *arm).iter().filter(|f| matches!(f, Control::Join { .. })).count();
    assert_eq!(reached, 6, "the owner hears of none: three for the catalogue, three for the topic");
}

#[test]
fn flood_of_forged_revocation_lists_and_advertisements_ends_link() {
    let mut config = WorldConfig::new(71);
    config.router_limits.forgeries_max = 20;
    let (mut scene, mallory, _) = scene(config);
    let list = sgc_testkit::revocation_list("acme", &[], 7);
    flood(&mut scene, mallory, 1, |_, n| {
        let mut list = list.to_vec();
        let at = list.len() - 1 - (n as usize % 8);
        list[at] ^= 1;
        Control::Crl { der: list.into() }
    });
    assert_eq!(closed(&scene.world, scene.east), [LinkClose::Forgeries]);
    assert!((20..=24).contains(&drops(&scene.world, scene.east, "crl")));
}

#[test]
fn flood_of_valid_joins_is_refused_beyond_limit_of_link() {
    let mut config = WorldConfig::new(72);
    config.router_limits.joins_burst = 40; // and five a second
    let (mut scene, mallory, identity) = scene(config);
    let name = scene.world.name(scene.arm, "/chatter");
    let log = scene.world.log().len();
    flood(&mut scene, mallory, 4, |world, n| join(world, &identity, name, n, true));
    let Scene { world, arm, east, .. } = &mut scene;
    assert!(closed(world, *east).is_empty(), "valid requests are no forgeries");
    let asked = events(world, *arm, log).filter(|(e, _)| matches!(e, Event::SinkRefused { .. })).count();
    assert!((40..=55).contains(&asked), "{asked} of 800 reached the owner");
    let limited = frames(world, *east, mallory)
        .iter()
        .filter(|f| matches!(f, Control::Reject { reason: RejectReason::Limit, .. }))
        .count();
    assert!(limited >= 700, "{limited} were refused unseen");
    // Another link has an allowance of its own.
    scene.world.restart(scene.desk);
    scene.world.until_granted(scene.desk, scene.arm, "/chatter");
}

#[test]
fn flood_of_handshake_places_by_one_node_leaves_places_for_others() {
    let mut scene = flowing_with(WorldConfig::new(73), |s| s);
    let max = sgc_endpoint::Limits::default().sinks_per_peer_max;
    let names = [scene.world.name(scene.arm, "/chatter"), scene.world.catalogue_name(scene.arm)];
    let identity = sgc_testkit::identity(scene.world.member(scene.desk));
    let desk_id = &identity.node_id();
    let log = scene.world.log().len();
    // An honest node would give back places that it did not request.
    scene.world.tamper(scene.desk, scene.west, |frame| match frame {
        Control::Leave { .. } => vec![],
        frame => vec![frame.clone()],
    });
    for n in 0..200 {
        for name in names {
            let frame = join(&scene.world, &identity, name, n, true);
            scene.world.inject(scene.desk, scene.west, &frame);
        }
        scene.world.run(ms(5));
    }
    scene.world.run(ms(500));
    let Scene { world, arm, west, desk, .. } = &mut scene;
    let places = world.granted(*arm, "/chatter").iter().filter(|n| *n == desk).count();
    assert_eq!(places, max);
    // It takes its own oldest places.
    let left = events(world, *arm, log)
        .filter(|(e, _)| matches!(e, Event::SinkLeft { peer, .. } if peer == desk_id));
    assert!((200 - (max - 1)..240).contains(&left.count()));
    assert_eq!(world.forwarding_sinks(*west, &names[1]).len(), max + 2, "and so for the catalogue");
    // Each place is one to be rekeyed; a new one still comes in.
    let late = world.proxy("late");
    let all: Vec<_> = scene.users().into_iter().chain([late]).collect();
    scene.world.link(scene.west, late);
    scene.world.reshare(scene.arm, "/chatter", Sharing::to(&all));
    scene.world.use_topic(late, scene.arm, "/chatter");
    scene.world.until_granted(late, scene.arm, "/chatter");
}

#[test]
fn flood_of_links_by_one_node_is_refused() {
    let mut config = WorldConfig::new(74);
    config.router_limits.links_per_node_max = 4;
    let (mut scene, mallory, _) = scene(config);
    for _ in 0..9 {
        scene.world.link(scene.east, mallory);
    }
    scene.world.run(ms(500));
    assert_eq!(closed(&scene.world, scene.east), vec![LinkClose::TooMany; 6]);
    // A node with too many links may still end some and come back.
    scene.world.crash(mallory);
    scene.world.run(ms(500));
    scene.world.start(mallory);
    scene.world.run(ms(500));
    let name = scene.world.catalogue_name(mallory);
    assert_eq!(scene.world.distance(scene.east, &name), Some(1));
}
