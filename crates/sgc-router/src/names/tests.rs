//! Tests of [`Names`] in surroundings of their own: without router, trees and signatures.

use bytes::Bytes;
use sgc_testkit::{Clock, Member, identity};
use sgc_wire::{AdvertBody, Hello, Now, UnixMillis};

use super::*;
use crate::limits::allowances::Allowances;
use crate::links::{Links, Neighbour};
use crate::output::{Output, Outputs};
use crate::topology::Topology;

const NAME: Name = Name([7; 32]);
/// The link to the owner of [`NAME`], a proxy.
const OWNER: LinkId = LinkId(1);
/// The link to a proxy that asks for it.
const READER: LinkId = LinkId(2);

/// A router's names, with the owner and a reader behind links.
struct Bench {
    now: Now,
    links: Links,
    topology: Topology,
    allowances: Allowances,
    outputs: Outputs,
    names: Names,
}

impl Bench {
    fn new() -> Self {
        let now = Clock::default().now();
        let config = RouterConfig::for_tests(now);
        let hello = Hello { minor: 0, incarnation: 1, transit: false, yields: false, started: UnixMillis(1) };
        let mut bench = Self {
            now,
            links: Links::new(config.node, hello),
            topology: Topology::new(now.instant, &config),
            allowances: Allowances::new(&config.limits),
            outputs: Outputs::default(),
            names: Names::new(&config),
        };
        for (link, member) in [(OWNER, "arm-1"), (READER, "desk")] {
            let neighbour = Neighbour::from(identity(&Member::new(member)).as_peer());
            bench.links.add(now, link, neighbour);
            bench.links.greet(link, hello);
            bench.names.link_up(link);
        }
        bench
    }

    fn with<T>(&mut self, handle: impl FnOnce(&mut Names, &mut Context<'_>) -> T) -> T {
        let mut cx = Context {
            now: self.now,
            network: Network { links: &self.links, topology: &self.topology },
            allowances: &mut self.allowances,
            outputs: &mut self.outputs,
            store: None,
        };
        handle(&mut self.names, &mut cx)
    }

    /// Lets the owner advertise or withdraw the name; the digest is the number.
    fn announce(&mut self, seq: u8, withdraw: bool) -> Option<Admitted> {
        let owner = identity(&Member::new("arm-1")).as_peer().clone();
        let body = AdvertBody {
            chain: Vec::new(),
            seq: seq.into(),
            issued_at: self.now.unix,
            lease_ms: 60_000,
            withdraw,
            blinds: Vec::new(),
        };
        let arrival = Arrival {
            link: OWNER,
            from: self.links.peer(OWNER).unwrap(),
            cost: 0,
            signed: SignedBody { body: Bytes::new(), signature: Bytes::new() },
            digest: [seq; 32],
            advert: VerifiedAdvert { owner, body, names: vec![NAME] },
        };
        let admission = self.with(|names, cx| names.admit(cx, arrival));
        if let Admission::Admitted(admitted) = admission { Some(admitted) } else { None }
    }

    /// Returns the outputs so far as short text.
    fn outputs(&mut self) -> Vec<String> {
        let text = |output| match output {
            Output::Send { link, frame: Control::Advert { .. } } => format!("{link}: advert"),
            Output::Send { link, frame: Control::Unreach { .. } } => format!("{link}: unreach"),
            Output::Dropped(dropped) => dropped.reason.key().to_owned(),
            other => format!("{other:?}"),
        };
        std::iter::from_fn(|| self.outputs.pop()).map(text).collect()
    }
}

#[test]
fn reader_is_told_of_a_name_once_and_of_its_withdrawal() {
    let mut bench = Bench::new();
    bench.with(|names, cx| names.add_interests(cx, READER, &[NAME]));
    assert_eq!(bench.outputs(), [""; 0]);
    let admitted = bench.announce(1, false).unwrap();
    assert_eq!((admitted.changed.as_slice(), admitted.kind), (&[NAME][..], RecordKind::Advert));
    for _ in 0..2 {
        bench.with(|names, cx| names.routes_changed(cx, &[NAME]));
    }
    assert_eq!(bench.outputs(), ["link 2: advert"]);
    let admitted = bench.announce(2, true).unwrap();
    assert_eq!(admitted.kind, RecordKind::Withdrawal);
    bench.with(|names, cx| names.tell_withdrawal(cx, OWNER, admitted.id, &admitted.changed));
    bench.with(|names, cx| names.routes_changed(cx, &[NAME]));
    assert_eq!(bench.outputs(), ["link 2: advert"], "no unreach after the withdrawal");
}

#[test]
fn stale_record_is_no_news_and_its_owner_learns_the_newer_one() {
    let mut bench = Bench::new();
    assert!(bench.announce(5, false).is_some() && bench.announce(4, false).is_none());
    assert_eq!(bench.outputs(), ["link 1: advert", "stale"]);
    bench.announce(6, false);
    assert!(matches!(bench.names.recognise(&[5; 32]), Recognised::Ended { seq: 5, .. }));
    assert!(matches!(bench.names.recognise(&[6; 32]), Recognised::Known { .. }));
}

#[test]
fn name_has_a_route_while_its_record_and_its_link_last() {
    let mut bench = Bench::new();
    bench.announce(1, false);
    let routed = |bench: &mut Bench| {
        bench.with(|names, cx| (names.next_hop(cx.network, &NAME), names.routed(cx.network)))
    };
    assert_eq!(routed(&mut bench), (Some((OWNER, 10_000)), 1));
    bench.links.remove(OWNER);
    assert_eq!(routed(&mut bench), (None, 0));
    let over = bench.now.instant + std::time::Duration::from_secs(60);
    assert_eq!(bench.names.expire_next(over), Some(vec![NAME]));
    assert!(bench.names.owner(&NAME).is_none() && bench.names.owners().next().is_none());
}
