//! The data path in isolation, for benchmarks: forwarding tables, and queues that only the benchmark empties.
//!
//! There is no link, socket or task. `dataplane.rs` and `outflow.rs` have the code of nodes between these two ends.

use std::sync::Arc;

use sgc_router::{FibEntry, LinkId, Tree};
use sgc_wire::{Name, Packet};

use crate::data::dataplane::{DataPlane, Forward, Out};
use crate::data::outflow::OutFlow;

/// Link from which all packets come.
const UP: LinkId = LinkId(1);

/// Names that come over one link and leave over the same others.
pub struct Forwarding {
    data: DataPlane,
    outs: Vec<Arc<OutFlow>>,
}

impl Forwarding {
    /// Creates tables of these names with `ways` destinations each.
    pub fn new(names: impl IntoIterator<Item = Name>, ways: u32) -> Self {
        let links: Vec<_> = (0..ways).map(|way| LinkId(UP.0 + 1 + way)).collect();
        let outs: Vec<_> = links.iter().map(|_| OutFlow::idle()).collect();
        let data = DataPlane::default();
        for name in names {
            let tree = Tree { up: UP, down: links.as_slice().into(), publishers: [].as_slice().into() };
            let entry = FibEntry { trees: [tree].into(), sinks: Vec::new() };
            let ways = links.iter().zip(&outs);
            let ways = ways.map(|(link, out)| (*link, Out::Link(Arc::clone(out), Arc::default()))).collect();
            data.set(name, Some(Forward::new(entry, ways, Arc::default())));
        }
        Self { data, outs }
    }

    /// Forwards a packet, as a receiving task does.
    pub async fn forward(&self, packet: Packet) {
        self.data.forward(UP, packet).await;
    }

    /// Takes the oldest packet from the queue of each destination. Waits if there is none.
    pub async fn take(&self, mut sink: impl FnMut(Packet)) {
        for out in &self.outs {
            sink(out.queued().await);
        }
    }
}
