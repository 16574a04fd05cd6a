//! Connectivity checks of direct paths: whatever arrives at the socket while an attempt is under way, nothing panics, and
//! no more is sent than arrived and was offered.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_session::{DirectOutput, DirectPaths, LocalAddress};
use sgc_wire::{CandidateKind, NodeId, PATH_OFFER_BYTES, PathCandidate, PathOffer, PathQuestion};

const OWN: NodeId = NodeId([1; 32]);
const PEER: NodeId = NodeId([2; 32]);

/// Two nodes that know each other's offers. Their passwords are always the same, so inputs can be authentic.
pub struct Meeting {
    /// The node that the target attacks.
    pub near: DirectPaths,
    /// Its peer.
    pub far: DirectPaths,
}

/// The address of the attacked node.
pub fn near_address() -> SocketAddr {
    ([192, 0, 2, 1], 5000).into()
}

/// The address of its peer.
pub fn far_address() -> SocketAddr {
    ([192, 0, 2, 2], 5000).into()
}

impl Meeting {
    /// Lets both nodes exchange their offers.
    pub fn new(now: Instant) -> Self {
        let side = |own, seed, address| {
            let mut side = DirectPaths::new(own, ChaCha20Rng::seed_from_u64(seed));
            side.set_local(now, vec![LocalAddress { kind: CandidateKind::Host, address, base: address }]);
            side
        };
        let (mut near, mut far) = (side(OWN, 1, near_address()), side(PEER, 2, far_address()));
        far.want(now, &[OWN].into());
        far.handle_timeout(now);
        let question = std::iter::from_fn(|| far.poll()).find_map(|output| match output {
            DirectOutput::Ask { question, .. } => Some(question),
            _ => None,
        });
        if let Some(offer) = question.and_then(|question| near.asked(now, PEER, question)) {
            let theirs = far.asked(now, OWN, PathQuestion { attempt: offer.attempt });
            far.offered(now, OWN, &offer);
            let kind = CandidateKind::Host;
            let candidates = vec![PathCandidate { kind, place: far_address().into() }];
            if let Some(theirs) = theirs {
                near.offered(now, PEER, &PathOffer { candidates, ..theirs });
            }
        }
        Self { near, far }
    }
}

/// Runs one input of the target: datagrams, each behind the last byte of its source and its length.
pub fn run(mut input: &[u8]) {
    let mut now = Instant::now();
    let Meeting { mut near, .. } = Meeting::new(now);
    let (mut arrived, mut sent) = (PATH_OFFER_BYTES, 0);
    while let Some(([source, high, low], rest)) = input.split_first_chunk() {
        let len = usize::from(u16::from_be_bytes([*high, *low])).min(rest.len());
        let (datagram, rest) = rest.split_at(len);
        input = rest;
        now += Duration::from_millis(u64::from(*source));
        arrived += datagram.len();
        near.received(now, near_address(), ([192, 0, 2, *source], 5000).into(), datagram);
        near.handle_timeout(now);
        while let Some(output) = near.poll() {
            if let DirectOutput::Send { datagram, .. } = output {
                sent += datagram.len();
            }
        }
        // No address answers, since nobody knows the transactions of the checks.
        assert!(sent <= arrived, "{sent} bytes for {arrived}");
    }
}
