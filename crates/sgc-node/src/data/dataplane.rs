//! The data path: from the link or local reader of a packet to all its destinations.
//!
//! Receiving tasks call [`DataPlane::forward`] themselves. The look-up is one atomic load of an immutable table, and
//! payloads are shared, not copied. Only the control task changes tables, by replacing them.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use arc_swap::ArcSwap;
use sgc_router::{FibEntry, LinkId};
use sgc_session::Activity;
use sgc_wire::{Name, Packet};
use tracing::{debug, warn};

use crate::control::peers::peer_rate::PeerRates;
use crate::data::outflow::OutFlow;
use crate::data::pending::PendingBytes;
use crate::data::sinks::LocalSink;
use crate::data::stats::{CountDrops, DataDrop, Dropped, Drops, NameStats};

/// Number of tables over which names are spread, so that a change copies only a part.
const SHARDS: usize = 64;

/// Destinations of the packets of one name.
pub(crate) struct Forward {
    entry: FibEntry,
    outs: Vec<(LinkId, Out)>,
    stats: Arc<NameStats>,
}

/// One destination.
pub(crate) enum Out {
    /// A link.
    Link(Arc<OutFlow>, Arc<Activity>),
    /// This node's own subscriber.
    Local(Arc<LocalSink>),
}

impl Forward {
    /// Creates an entry. `outs` must have a destination for every link on which `entry` sends data.
    pub(crate) fn new(entry: FibEntry, outs: Vec<(LinkId, Out)>, stats: Arc<NameStats>) -> Self {
        Self { entry, outs, stats }
    }

    fn out(&self, link: LinkId) -> Option<&Out> {
        self.outs.iter().find(|(l, _)| *l == link).map(|(_, out)| out)
    }
}

/// Forwarding tables of a node.
pub(crate) struct DataPlane {
    shards: [ArcSwap<HashMap<Name, Arc<Forward>>>; SHARDS],
    drops: Drops,
    rates: PeerRates,
    holds: Arc<PendingBytes>,
}

impl Default for DataPlane {
    fn default() -> Self {
        Self::new(PeerRates::default())
    }
}

impl DataPlane {
    /// Creates empty tables.
    pub(crate) fn new(rates: PeerRates) -> Self {
        let (drops, holds) = (Drops::default(), Arc::default());
        Self { shards: std::array::from_fn(|_| ArcSwap::default()), drops, rates, holds }
    }

    /// Returns the count of bytes that topics keep pending.
    pub(crate) fn holds(&self) -> &Arc<PendingBytes> {
        &self.holds
    }

    /// Returns the rate limits of peers.
    pub(crate) fn rates(&self) -> &PeerRates {
        &self.rates
    }

    /// Sets or removes the entry of a name.
    pub(crate) fn set(&self, name: Name, forward: Option<Forward>) {
        let shard = self.shard(&name);
        let mut table = HashMap::clone(&shard.load());
        match forward {
            Some(forward) => table.insert(name, Arc::new(forward)),
            None => table.remove(&name),
        };
        shard.store(Arc::new(table));
    }

    /// Returns `true` if a packet under `name` has a destination.
    pub(crate) fn is_wanted(&self, name: &Name) -> bool {
        self.shard(name).load().contains_key(name)
    }

    /// Returns `true` if all destinations of `name` have headroom for a short message, even if others send at the same
    /// moment.
    pub(crate) fn has_headroom(&self, name: &Name) -> bool {
        let tables = self.shard(name).load();
        tables.get(name).is_none_or(|forward| {
            forward.outs.iter().all(|(_, out)| match out {
                Out::Link(flow, _) => flow.has_headroom(),
                // A local sink may take its time to write.
                Out::Local(_) => false,
            })
        })
    }

    /// Returns `true` if packets under `name` wait for a link.
    pub(crate) fn has_waiting(&self, name: &Name) -> bool {
        let tables = self.shard(name).load();
        tables.get(name).is_some_and(|forward| {
            forward.outs.iter().any(|(_, out)| matches!(out, Out::Link(flow, _) if !flow.is_empty()))
        })
    }

    /// Sends a packet to its destinations. Waits while a reliable one is full; the others of the same name wait with
    /// it.
    pub(crate) async fn forward(&self, ingress: LinkId, mut packet: Packet) {
        let Some(forward) = self.shard(&packet.header.name).load().get(&packet.header.name).cloned() else {
            return self.drop_packet(ingress, &packet, DataDrop::NoTree);
        };
        if !forward.entry.accepts_from(ingress) {
            forward.stats.dropped.fetch_add(1, Relaxed);
            return self.drop_packet(ingress, &packet, DataDrop::WrongWay);
        }
        if ingress != LinkId::LOCAL {
            match packet.header.hops.checked_sub(1) {
                Some(hops) if hops > 0 => packet.header.hops = hops,
                _ => {
                    forward.stats.dropped.fetch_add(1, Relaxed);
                    return self.drop_packet(ingress, &packet, DataDrop::HopLimit);
                }
            }
        }
        forward.stats.count(packet.payload.len());
        if let Some(sink) = packet.header.to {
            return match forward.entry.egress_to(ingress, &sink).and_then(|link| forward.out(link)) {
                Some(out) => self.send(ingress, &forward, out, packet).await,
                None => self.drop_packet(ingress, &packet, DataDrop::NoSuchSink),
            };
        }
        let mut rest = forward.entry.egress(ingress).filter_map(|link| forward.out(link)).peekable();
        while let Some(out) = rest.next() {
            if rest.peek().is_none() {
                return self.send(ingress, &forward, out, packet).await;
            }
            self.send(ingress, &forward, out, packet.clone()).await;
        }
    }

    /// Counts a dropped packet, and logs the first one.
    pub(crate) fn drop_packet(&self, ingress: LinkId, packet: &Packet, reason: DataDrop) {
        self.count(ingress, &packet.header.name, reason);
    }

    async fn send(&self, ingress: LinkId, forward: &Forward, out: &Out, packet: Packet) {
        let name = packet.header.name;
        let written = match out {
            Out::Link(flow, activity) => {
                activity.note();
                flow.push(packet).await
            }
            Out::Local(sink) => sink.deliver(packet, &self.drops).await,
        };
        if let Err(dropped) = written {
            forward.stats.dropped.fetch_add(dropped.messages, Relaxed);
            self.count_from(ingress, &name, dropped);
        }
    }

    /// Counts drops under `name` from `ingress`.
    fn count_from(&self, ingress: LinkId, name: &Name, dropped: Dropped) {
        let Dropped { reason, messages } = dropped;
        debug!(%ingress, name = %name.short(), ?reason, messages, "dropped");
        if let Some(forward) = self.shard(name).load().get(name) {
            forward.stats.count_drops(reason, messages);
        }
        // A packet from the wrong link may have been under way while the path changed, so it is not suspicious.
        let suspicious = matches!(reason, DataDrop::HopLimit | DataDrop::Malformed);
        if self.drops.add_from(reason, ingress, messages) && suspicious {
            warn!(%ingress, reason = reason.key(), "dropped an invalid packet of a peer; counted from here on");
        }
    }

    fn shard(&self, name: &Name) -> &ArcSwap<HashMap<Name, Arc<Forward>>> {
        // Names are hashes, so any byte spreads them evenly.
        &self.shards[usize::from(name.0[0]) % SHARDS]
    }
}

impl CountDrops for DataPlane {
    fn count(&self, ingress: LinkId, name: &Name, reason: DataDrop) {
        self.count_from(ingress, name, Dropped::one(reason));
    }

    fn count_here(&self, name: &Name, reason: DataDrop, several: u64) {
        if let Some(forward) = self.shard(name).load().get(name) {
            forward.stats.count_drops(reason, several);
        }
        if self.drops.add(reason, several) {
            debug!(name = %name.short(), ?reason, several, "dropped; counted from here on");
        }
    }

    fn count_left_out(&self, name: &Name, dropped: Dropped) {
        if let Some(forward) = self.shard(name).load().get(name) {
            forward.stats.dropped.fetch_add(dropped.messages, Relaxed);
        }
        self.count_here(name, dropped.reason, dropped.messages);
    }

    fn drops(&self) -> &Drops {
        &self.drops
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_router::Tree;
    use sgc_wire::{Class, HOP_LIMIT, PacketHeader, Payload, SourceId};

    use super::*;

    #[tokio::test]
    async fn payloads_go_to_all_links_in_the_memory_they_came_in() {
        let name = Name([1; 32]);
        let [up, near, far] = [1, 2, 3].map(LinkId);
        let outs = [near, far].map(|link| (link, OutFlow::idle()));
        let ways = outs.iter().map(|(link, flow)| (*link, Out::Link(flow.clone(), Arc::default()))).collect();
        let (down, publishers) = ([near, far].as_slice().into(), [].as_slice().into());
        let entry = FibEntry { trees: [Tree { up, down, publishers }].into(), sinks: vec![] };
        let data = DataPlane::default();
        data.set(name, Some(Forward::new(entry, ways, Arc::default())));
        for reliable in [true, false] {
            let header = PacketHeader {
                reliable,
                class: Class::Default,
                hops: HOP_LIMIT,
                suite: 1,
                epoch: 1,
                name,
                source: SourceId([2; 16]),
                seq: 1,
                total: 1000,
                index: 0,
                grid: 16_384,
                to: None,
            };
            let payload = Payload([Bytes::from(vec![7; 600]), Bytes::from(vec![7; 400])].into());
            let places = |p: &Payload| p.0.iter().map(|b| (b.as_ptr(), b.len())).collect::<Vec<_>>();
            let came_in = places(&payload);
            data.forward(up, Packet { header, payload }).await;
            for (_, flow) in &outs {
                let sent = flow.queued().await;
                assert_eq!((places(&sent.payload), sent.header.hops), (came_in.clone(), HOP_LIMIT - 1));
            }
        }
    }
}
