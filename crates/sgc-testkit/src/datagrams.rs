//! [`Datagrams`]: the UDP packets of a world that belong to no link, their way, loss and record.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::time::Duration;

use crate::ids::NodeKey;
use crate::networks::Networks;
use crate::record::SentDatagram;
use crate::rng::Dice;

/// A function that replaces a check by others, each with the source that it pretends to have, if not the true one.
pub(crate) type TamperChecks =
    Box<dyn FnMut(&SentDatagram) -> Vec<(Option<SocketAddr>, SocketAddr, Vec<u8>)>>;

/// Port at which the routers of a world are.
const ROUTER_PORT: u16 = 7447;

/// The networks of a world, and the packets in them.
#[derive(Default)]
pub(crate) struct Datagrams {
    pub(crate) networks: Networks,
    /// Draws that worlds without hosts do not make, so their histories stay as they were.
    dice: Option<Dice>,
    latencies: BTreeMap<(NodeKey, NodeKey), Duration>,
    pub(crate) loss_percent: usize,
    pub(crate) tampers: BTreeMap<NodeKey, TamperChecks>,
    /// Packets since the record was begun.
    pub(crate) sent: Option<Vec<SentDatagram>>,
}

impl Datagrams {
    /// Sets the seed of losses and latencies, once.
    pub(crate) fn begin(&mut self, seed: u64) {
        self.dice.get_or_insert_with(|| Dice::new(seed ^ 0xd1a6_7a35));
    }

    /// Returns the one-way latency between two hosts, drawn once.
    pub(crate) fn latency(&mut self, a: NodeKey, b: NodeKey, range: &RangeInclusive<Duration>) -> Duration {
        let dice = &mut self.dice;
        let draw = || dice.as_mut().map_or(*range.start(), |dice| dice.time(range));
        *self.latencies.entry((a.min(b), a.max(b))).or_insert_with(draw)
    }

    /// Draws whether a packet is lost.
    pub(crate) fn is_lost(&mut self) -> bool {
        let percent = self.loss_percent;
        self.dice.as_mut().is_some_and(|dice| dice.chance(percent))
    }
}

/// Returns the address of a router.
pub(crate) fn router_address(router: NodeKey) -> SocketAddr {
    SocketAddr::from(([198, 51, 100, router.0 as u8], ROUTER_PORT))
}
