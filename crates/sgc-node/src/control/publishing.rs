//! Publishing on names of other nodes: the offers, and the keys under which this node publishes.

use std::time::{Duration, Instant};

use sgc_ros::Shaping;
use sgc_wire::{Class, NodeId, SourceId, TopicGrant};

/// Time for which a publisher keeps the old key of another node's topic. The owner gives the others as long to get the
/// new one.
const REKEY_WAIT: Duration = Duration::from_secs(1);

/// A topic of another node that this node wants to publish on.
pub(crate) struct Offer {
    pub(crate) owner: NodeId,
    /// Suite id on the wire.
    pub(crate) suite: u8,
    pub(crate) class: Class,
    pub(crate) reliable: bool,
    pub(crate) shaping: Shaping,
    /// Whether it is a service.
    pub(crate) calls: bool,
}

/// State of publishing under another node's name.
pub(crate) struct Publishing {
    id: SourceId,
    class: Class,
    reliable: bool,
    /// Grant of the source's current key; `None` until the owner granted it.
    grant: Option<TopicGrant>,
    /// Key of the next epoch, and its beginning.
    next: Option<(Instant, TopicGrant)>,
}

/// Effect of a grant to publish.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GrantEffect {
    /// The key stays, or changes later.
    Kept,
    /// Numbers begin again under another key, because the owner is new or has restarted.
    Anew,
}

impl Publishing {
    /// Creates the state before the first grant.
    pub(crate) fn new(id: SourceId, class: Class, reliable: bool) -> Self {
        Self { id, class, reliable, grant: None, next: None }
    }

    /// Returns the source, its class, and whether it is reliable.
    pub(crate) fn source(&self) -> (SourceId, Class, bool) {
        (self.id, self.class, self.reliable)
    }

    /// Handles a grant to publish, or a new epoch.
    pub(crate) fn granted(&mut self, now: Instant, grant: &TopicGrant) -> GrantEffect {
        match &self.grant {
            Some(known) if (known.epoch, &known.key) == (grant.epoch, &grant.key) => GrantEffect::Kept,
            Some(known) if known.epoch < grant.epoch => {
                self.next = Some((now + REKEY_WAIT, grant.clone()));
                GrantEffect::Kept
            }
            Some(_) | None => {
                self.grant = Some(grant.clone());
                self.next = None;
                GrantEffect::Anew
            }
        }
    }

    /// Returns the key of the next epoch once it has begun.
    pub(crate) fn take_due(&mut self, now: Instant) -> Option<TopicGrant> {
        self.next.take_if(|(at, _)| *at <= now).map(|(_, grant)| grant)
    }

    /// Notes that messages are sealed with this key.
    pub(crate) fn rekeyed(&mut self, grant: TopicGrant) {
        self.grant = Some(grant);
    }

    /// Returns the beginning of the next epoch.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.next.as_ref().map(|(at, _)| *at)
    }
}
