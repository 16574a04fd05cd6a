//! The frames of owners and subscribers, encoded as on a link.

use std::sync::Arc;

use bytes::Bytes;
use rand_core::RngCore;
use sgc_trust::{Identity, name_of};
use sgc_wire::{
    ADVERT_NAMES_MAX, AdvertBody, Answer, AnswerBody, Blind, Control, Encode, JoinBody, Name, Request,
    SinkId, UnixMillis,
};

/// Names in a full advertisement.
pub(crate) const BATCH: usize = ADVERT_NAMES_MAX;
/// Names of one owner: a little less than a router takes from a proxy, so that there is room for those that are added
/// one at a time.
pub(super) const NAMES_PER_OWNER: usize = 60 * BATCH;
/// The longest lease that routers accept.
const LEASE_MS: u32 = 600_000;
/// Sizes of what an X25519 grant of one topic holds.
const REPLY_KEY_BYTES: usize = 32;
const SEALED_BYTES: usize = 59;

/// A node that owns names or subscribes to them, and its link at the router (or at this side of a real one).
pub(crate) struct Member<L> {
    pub(crate) identity: Arc<Identity>,
    pub(crate) link: L,
    chain: Vec<Bytes>,
    seq: u64,
}

/// An advertisement.
pub(crate) struct Advert {
    pub(crate) names: Vec<Name>,
    pub(crate) bytes: Bytes,
}

impl<L> Member<L> {
    pub(crate) fn new(identity: Arc<Identity>, link: L) -> Self {
        let chain = identity.chain_bytes();
        Self { identity, link, chain, seq: 0 }
    }

    /// An advertisement of so many new names.
    pub(crate) fn advert(&mut self, names: usize, now: UnixMillis, rng: &mut impl RngCore) -> Advert {
        self.seq += 1;
        let blinds: Vec<_> = (0..names).map(|_| Blind(random(rng))).collect();
        let owner = self.identity.node_id();
        let names = blinds.iter().map(|blind| name_of(&owner, blind)).collect();
        let body = AdvertBody {
            chain: self.chain.clone(),
            seq: self.seq,
            issued_at: now,
            lease_ms: LEASE_MS,
            withdraw: false,
            blinds,
        };
        let frame = Control::Advert { cost: 0, signed: self.identity.sign_advert(&body) };
        Advert { names, bytes: frame.to_bytes() }
    }

    /// A request to subscribe.
    pub(crate) fn join(&self, name: Name, now: UnixMillis, rng: &mut impl RngCore) -> (SinkId, Bytes) {
        let sink = SinkId(random(rng));
        let body = JoinBody {
            name,
            sink,
            request: Request::Subscribe { describe: false },
            issued_at: now,
            chain: self.chain.clone(),
            reply_key: random::<REPLY_KEY_BYTES>(rng).to_vec().into(),
        };
        (sink, Control::Join { signed: self.identity.sign_join(&body) }.to_bytes())
    }

    /// The owner's answer to it. Routers cannot look into a grant, so it holds noise.
    pub(crate) fn answer(&self, name: Name, sink: SinkId, rng: &mut impl RngCore) -> Bytes {
        let answer = Answer::Grant {
            enc: random::<REPLY_KEY_BYTES>(rng).to_vec().into(),
            sealed: random::<SEALED_BYTES>(rng).to_vec().into(),
        };
        let body = AnswerBody { name, sink, serial: 1, answer };
        Control::Answer { signed: self.identity.sign_answer(&body) }.to_bytes()
    }
}

fn random<const N: usize>(rng: &mut impl RngCore) -> [u8; N] {
    let mut bytes = [0; N];
    rng.fill_bytes(&mut bytes);
    bytes
}
