//! The data path by itself, for benchmarks to count: tables of names, and queues that nobody but the benchmark empties.
//!
//! No link, no socket, no task. What nodes do between these two ends is in `dataplane.rs` and `outflow.rs`.

use std::sync::Arc;

use sgc_router::{FibEntry, LinkId, Tree};
use sgc_wire::{Name, Packet};

use crate::dataplane::{DataPlane, Forward, Out};
use crate::outflow::OutFlow;

/// The link that everything comes from.
const UP: LinkId = LinkId(1);

/// Names that all come over one link and go out over the same others.
pub struct Forwarding {
    data: DataPlane,
    outs: Vec<Arc<OutFlow>>,
}

impl Forwarding {
    /// Tables of these names, each with so many ways out.
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

    /// Sends a packet on, as the task that read it from its link does.
    pub async fn forward(&self, packet: Packet) {
        self.data.forward(UP, packet).await;
    }

    /// Takes the oldest packet from the queue of every way out; waits where there is none.
    pub async fn take(&self, mut sink: impl FnMut(Packet)) {
        for out in &self.outs {
            sink(out.queued().await);
        }
    }
}
