//! What the data path needs to know of one name. Immutable: a change makes a new entry.

use sgc_wire::SinkId;
use smallvec::SmallVec;

use crate::LinkId;

/// The compiled tree of one name at this node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FibEntry {
    /// The link towards the owner; data may come from it.
    pub up: LinkId,
    /// Links with at least one subscriber behind them, each once, ascending.
    pub down: SmallVec<[LinkId; 4]>,
    /// Links with at least one publisher behind them; data may come from them too.
    pub publishers: SmallVec<[LinkId; 1]>,
    /// Which link each sink is behind, ascending by sink, for packets to one sink.
    pub sinks: Vec<(SinkId, LinkId)>,
}

impl FibEntry {
    /// True if data of this name may come in over `link`.
    pub fn accepts_from(&self, link: LinkId) -> bool {
        link == self.up || self.publishers.contains(&link)
    }

    /// The links that a packet for all goes out on, having come in over `ingress`.
    pub fn egress(&self, ingress: LinkId) -> impl Iterator<Item = LinkId> + '_ {
        let up = (ingress != self.up).then_some(self.up);
        self.down.iter().copied().filter(move |l| *l != ingress && Some(*l) != up).chain(up)
    }

    /// The link that a packet for one sink goes out on.
    pub fn egress_to(&self, sink: &SinkId) -> Option<LinkId> {
        self.sinks.binary_search_by(|(s, _)| s.cmp(sink)).ok().map(|i| self.sinks[i].1)
    }
}
