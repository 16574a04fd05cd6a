//! [`Withheld`]: the names of this node that are not told over a direct link, because more than one copy of their data
//! would pass the uplink.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_wire::Name;

use crate::link_id::LinkId;

/// Time for a node to join a name over a router. After that, it is told the name over its direct link all the same.
const FOUND_WITHIN: Duration = Duration::from_secs(5);

/// Whether the node behind a link finds a name without this link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// It has until then.
    Searches { until: Instant },
    /// It gets the name over another link.
    IsServed,
    /// It does not, so it is told the name.
    FoundNothing,
}

/// The nodes that get a name, for one direct link.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Demand {
    /// A router is in reach that can make copies.
    pub(crate) is_copied: bool,
    /// Other nodes than that of the link get the name through the uplink, over other links.
    pub(crate) others: bool,
    /// The node of the link gets it over another link.
    pub(crate) is_served: bool,
}

/// The withheld names.
#[derive(Debug, Default)]
pub(super) struct Withheld {
    names: BTreeMap<(LinkId, Name), State>,
}

impl Withheld {
    /// Returns `true` if a name is not told over a link.
    pub(super) fn contains(&self, link: LinkId, name: &Name) -> bool {
        self.names.get(&(link, *name)).is_some_and(|state| *state != State::FoundNothing)
    }

    /// Withholds a name from a link or tells it again. Returns `true` if that changes something for the neighbour.
    pub(super) fn set(&mut self, now: Instant, key: (LinkId, Name), demand: Demand) -> bool {
        let before = self.contains(key.0, &key.1);
        let state = self.names.get(&key).copied();
        let state = match demand {
            Demand { is_copied: false, .. } => None,
            Demand { others: true, is_served: true, .. } => Some(State::IsServed),
            Demand { others: false, is_served: true, .. } => None,
            // If two nodes leave for a router at one time, each misses the other's branch for a moment.
            Demand { .. } if matches!(state, Some(State::Searches { .. } | State::FoundNothing)) => state,
            Demand { others: true, .. } => Some(State::Searches { until: now + FOUND_WITHIN }),
            Demand { others: false, .. } => None,
        };
        match state {
            Some(state) => self.names.insert(key, state),
            None => self.names.remove(&key),
        };
        self.contains(key.0, &key.1) != before
    }

    /// Ends the searches that took too long. Returns their links and names.
    pub(super) fn release_due(&mut self, now: Instant) -> Vec<(LinkId, Name)> {
        let mut over = Vec::new();
        for (key, state) in &mut self.names {
            if matches!(state, State::Searches { until } if *until <= now) {
                *state = State::FoundNothing;
                over.push(*key);
            }
        }
        over
    }

    /// Forgets that a name was withheld from a link, or told there for want of another path.
    pub(super) fn forget(&mut self, link: LinkId, name: &Name) {
        self.names.remove(&(link, *name));
    }

    /// Returns the time of the next timeout.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let until = |state: &State| match state {
            State::Searches { until } => Some(*until),
            State::IsServed | State::FoundNothing => None,
        };
        self.names.values().filter_map(until).min()
    }

    /// Forgets all that was withheld from a link.
    pub(super) fn forget_link(&mut self, link: LinkId) {
        self.names.retain(|(other, _), _| *other != link);
    }
}
