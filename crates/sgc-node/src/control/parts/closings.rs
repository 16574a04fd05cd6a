//! [`Closings`]: sources whose publishers are gone, and the nodes that may still lack their last messages.
//!
//! Messages that left this node may wait in front of a router that stands still, or be lost with a link. The end of a
//! share travels apart from them and would overtake them. So a source asks its sinks to confirm its last message.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use sgc_wire::{Name, NodeId, SourceId};

/// Longest wait for the confirmations of one source. Versions before them confirm nothing.
const CONFIRM_MAX: Duration = Duration::from_secs(30);
/// Time for which a node that has lost its path counts among those that receive.
const PATHLESS_COUNTS_FOR: Duration = Duration::from_secs(10);
/// Most nodes and names of that time; beyond it the oldest are forgotten.
const PATHLESS_MAX: usize = 4096;

/// The closings of all sources of this node.
#[derive(Default)]
pub(crate) struct Closings {
    open: BTreeMap<Name, BTreeMap<SourceId, Closing>>,
    /// Nodes that lost their paths of late, the oldest first.
    pathless: VecDeque<Pathless>,
}

/// A node that received a name.
struct Pathless {
    name: Name,
    node: NodeId,
    since: Instant,
}

/// The closing of one source.
struct Closing {
    /// Its last message.
    last: u64,
    until: Instant,
    /// The nodes that have not confirmed it.
    lacking: BTreeSet<NodeId>,
}

impl Closings {
    /// Begins to wait until the nodes that receive have confirmed the `last` message of a source. Has no effect if they
    /// are waited for already.
    pub(crate) fn begin(
        &mut self,
        now: Instant,
        name: Name,
        source: SourceId,
        last: u64,
        subscribers: impl IntoIterator<Item = NodeId>,
    ) {
        self.forget_pathless(now);
        let of_name = self.open.entry(name).or_default();
        if of_name.get(&source).is_some_and(|closing| closing.last == last) {
            return;
        }
        let pathless = self.pathless.iter().filter(|lost| lost.name == name).map(|lost| lost.node);
        let lacking = subscribers.into_iter().chain(pathless).collect();
        of_name.insert(source, Closing { last, until: now + CONFIRM_MAX, lacking });
    }

    /// Takes a node's confirmation that it has everything of a source up to `seq`.
    pub(crate) fn confirmed(&mut self, name: &Name, source: &SourceId, node: &NodeId, seq: u64) {
        let closing = self.open.get_mut(name).and_then(|of_name| of_name.get_mut(source));
        if let Some(closing) = closing.filter(|closing| seq >= closing.last) {
            closing.lacking.remove(node);
        }
    }

    /// Notes that a node that receives lost its path, or left.
    pub(crate) fn lost_path(&mut self, now: Instant, name: Name, node: NodeId) {
        self.forget_pathless(now);
        if self.pathless.len() >= PATHLESS_MAX {
            self.pathless.pop_front();
        }
        self.pathless.push_back(Pathless { name, node, since: now });
    }

    /// Forgets the nodes that have been without a path for too long.
    fn forget_pathless(&mut self, now: Instant) {
        while self.pathless.front().is_some_and(|lost| lost.since + PATHLESS_COUNTS_FOR <= now) {
            self.pathless.pop_front();
        }
    }

    /// Waits no longer for a node that may not receive any more.
    pub(crate) fn cut(&mut self, name: &Name, node: &NodeId) {
        self.pathless.retain(|lost| (&lost.name, &lost.node) != (name, node));
        let of_name = self.open.get_mut(name).into_iter().flat_map(BTreeMap::values_mut);
        for closing in of_name {
            closing.lacking.remove(node);
        }
    }

    /// Iterates over the sources of a name whose publishers are gone.
    pub(crate) fn of(&self, name: &Name) -> impl Iterator<Item = SourceId> {
        self.open.get(name).into_iter().flat_map(BTreeMap::keys).copied()
    }

    /// Iterates over the sources that wait for confirmations.
    pub(crate) fn unconfirmed(&self, now: Instant, name: &Name) -> impl Iterator<Item = SourceId> {
        let waits = move |closing: &Closing| !closing.lacking.is_empty() && closing.until > now;
        let of_name = self.open.get(name).into_iter().flatten();
        of_name.filter(move |(_, closing)| waits(closing)).map(|(source, _)| *source)
    }

    /// Forgets the sources of a name but those that `keep` names.
    pub(crate) fn retain(&mut self, name: &Name, keep: impl Fn(&SourceId) -> bool) {
        if let Some(of_name) = self.open.get_mut(name) {
            of_name.retain(|source, _| keep(source));
            if of_name.is_empty() {
                self.open.remove(name);
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods)]
mod tests {
    use super::*;

    const NAME: Name = Name([1; 32]);
    const SOURCE: SourceId = SourceId([2; 16]);

    fn node(n: u8) -> NodeId {
        NodeId([n; 32])
    }

    fn waits(closings: &Closings, now: Instant) -> bool {
        closings.unconfirmed(now, &NAME).next().is_some()
    }

    #[test]
    fn source_waits_until_every_node_has_confirmed_its_last_message() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        closings.begin(now, NAME, SOURCE, 7, [node(1), node(2), node(2)]);
        assert_eq!(closings.unconfirmed(now, &NAME).collect::<Vec<_>>(), [SOURCE]);
        closings.confirmed(&NAME, &SOURCE, &node(1), 6);
        closings.confirmed(&NAME, &SOURCE, &node(2), 8);
        closings.confirmed(&NAME, &SOURCE, &node(3), 7);
        assert!(waits(&closings, now), "the first has confirmed an earlier message only");
        closings.confirmed(&NAME, &SOURCE, &node(1), 7);
        assert!(!waits(&closings, now));
        // The same message needs no second confirmation; a later one does.
        closings.begin(now, NAME, SOURCE, 7, [node(1)]);
        assert!(!waits(&closings, now));
        closings.begin(now, NAME, SOURCE, 9, [node(1)]);
        assert!(waits(&closings, now));
    }

    #[test]
    fn nobody_is_waited_for_longer_than_the_bound_or_after_the_loss_of_its_right() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        closings.begin(now, NAME, SOURCE, 1, []);
        assert!(!waits(&closings, now), "nobody receives");
        closings.begin(now, NAME, SOURCE, 2, [node(1)]);
        assert!(waits(&closings, now + CONFIRM_MAX - Duration::from_millis(1)));
        assert!(!waits(&closings, now + CONFIRM_MAX));
        closings.cut(&NAME, &node(1));
        assert!(!waits(&closings, now));
    }

    #[test]
    fn node_that_lost_its_path_shortly_before_is_waited_for() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        closings.lost_path(now, NAME, node(1));
        closings.lost_path(now, Name([9; 32]), node(2));
        closings.begin(now + PATHLESS_COUNTS_FOR - Duration::from_millis(1), NAME, SOURCE, 1, []);
        assert!(waits(&closings, now));
        closings.confirmed(&NAME, &SOURCE, &node(1), 1);
        assert!(!waits(&closings, now));
        closings.begin(now + PATHLESS_COUNTS_FOR, NAME, SOURCE, 2, []);
        assert!(!waits(&closings, now), "that was too long ago");
        // The oldest give way.
        closings.lost_path(now, NAME, node(1));
        (0..PATHLESS_MAX).for_each(|_| closings.lost_path(now, Name([9; 32]), node(2)));
        assert_eq!(closings.pathless.len(), PATHLESS_MAX);
        closings.begin(now, NAME, SOURCE, 3, []);
        assert!(!waits(&closings, now));
    }

    #[test]
    fn sources_that_are_gone_are_forgotten() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        let other = SourceId([3; 16]);
        closings.begin(now, NAME, SOURCE, 1, [node(1)]);
        closings.begin(now, NAME, other, 5, [node(1)]);
        closings.retain(&NAME, |source| *source == other);
        assert_eq!(closings.of(&NAME).collect::<Vec<_>>(), [other]);
        closings.retain(&NAME, |_| false);
        assert!(closings.open.is_empty());
    }
}
