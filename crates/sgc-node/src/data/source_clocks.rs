//! [`SourceClocks`]: the clocks of the nodes that publish to a sink.

use std::collections::BTreeMap;
use std::time::Instant;

use arc_swap::ArcSwap;
use sgc_session::ClockBounds;
use sgc_wire::SourceId;

/// The known clocks by which the messages of a sink are stamped. A publisher is taken to run by the clock of its node,
/// though it may be on another host of that node's network.
#[derive(Default)]
pub(crate) struct SourceClocks(ArcSwap<Known>);

#[derive(Clone, Default)]
struct Known {
    owner: Option<ClockBounds>,
    others: BTreeMap<SourceId, ClockBounds>,
}

impl SourceClocks {
    /// Sets the clock of the name's owner.
    pub(crate) fn set_owner(&self, owner: Option<ClockBounds>) {
        self.0.store(Known { owner, others: BTreeMap::new() }.into());
    }

    /// Sets the clocks of those that publish to a share of this node.
    pub(crate) fn set_others(&self, others: BTreeMap<SourceId, ClockBounds>) {
        self.0.store(Known { owner: None, others }.into());
    }

    /// Returns the least age of a message, in ns; `None` if its source's clock is not known. `is_owner` tells whether the
    /// source is one of the name's owner.
    pub(crate) fn least_age(
        &self,
        now: Instant,
        source: &SourceId,
        is_owner: bool,
        stamp_ns: i64,
    ) -> Option<i64> {
        let known = self.0.load();
        let bounds = if is_owner { known.owner.as_ref() } else { known.others.get(source) };
        bounds.filter(|_| stamp_ns > 0).map(|bounds| bounds.least_age(now, stamp_ns))
    }

    /// Returns the bounds of the owner's clock.
    pub(crate) fn owner(&self) -> Option<ClockBounds> {
        self.0.load().owner
    }
}
