//! [`Closings`]: sources whose publishers are gone, and the nodes that may still lack their last messages.
//!
//! Messages that left this node may wait in front of a router that stands still, or be lost with a link. The end of a
//! share travels apart from them and would overtake them. So a source asks its sinks to confirm its last message.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use sgc_wire::{Name, NodeId, SourceId};

/// Longest wait for a node that has confirmed something before: 64 MiB pass a megabit a second.
const CONFIRM_MAX: Duration = Duration::from_secs(600);
/// Longest wait for another node, which may be of a version that confirms nothing.
const CONFIRM_UNKNOWN_MAX: Duration = Duration::from_secs(30);
/// Time after which a question is repeated, and the longest: the time doubles. A question takes a place among the kept
/// messages.
const ASK_AGAIN: [Duration; 2] = [Duration::from_secs(2), Duration::from_secs(64)];
/// Time for which a node that has lost its path counts among those that receive.
const PATHLESS_COUNTS_FOR: Duration = Duration::from_secs(10);
/// Most nodes and names of that time; beyond it the oldest are forgotten.
const PATHLESS_MAX: usize = 4096;
/// Most nodes that are known to confirm.
const CONFIRMING_MAX: usize = 4096;

/// The closings of all sources of this node.
#[derive(Default)]
pub(crate) struct Closings {
    open: BTreeMap<Name, BTreeMap<SourceId, Closing>>,
    /// Nodes that lost their paths of late, the oldest first.
    pathless: VecDeque<Pathless>,
    /// Nodes that have confirmed something.
    confirming: BTreeSet<NodeId>,
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
    since: Instant,
    ask_at: Instant,
    /// Time until the question after that.
    gap: Duration,
    /// The nodes that have not confirmed it.
    lacking: BTreeSet<NodeId>,
}

impl Closings {
    /// Waits until the nodes that receive have confirmed the `last` message of a source. Returns `true` if they are to
    /// be asked now.
    pub(crate) fn wait_for(
        &mut self,
        now: Instant,
        name: Name,
        source: SourceId,
        last: u64,
        subscribers: impl IntoIterator<Item = NodeId>,
    ) -> bool {
        self.forget_pathless(now);
        let of_name = self.open.entry(name).or_default();
        if of_name.get(&source).is_none_or(|closing| closing.last != last) {
            let pathless = self.pathless.iter().filter(|lost| lost.name == name).map(|lost| lost.node);
            let lacking = subscribers.into_iter().chain(pathless).collect();
            of_name.insert(source, Closing { last, since: now, ask_at: now, gap: ASK_AGAIN[0], lacking });
        }
        let due = of_name
            .get_mut(&source)
            .filter(|closing| closing.is_waiting(now, &self.confirming) && closing.ask_at <= now);
        due.map(|closing| {
            closing.ask_at = now + closing.gap;
            closing.gap = (2 * closing.gap).min(ASK_AGAIN[1]);
        })
        .is_some()
    }

    /// Takes a node's confirmation that it has everything of a source up to `seq`.
    pub(crate) fn confirmed(&mut self, name: &Name, source: &SourceId, node: &NodeId, seq: u64) {
        if self.confirming.len() < CONFIRMING_MAX {
            self.confirming.insert(*node);
        }
        let closing = self.open.get_mut(name).and_then(|of_name| of_name.get_mut(source));
        if let Some(closing) = closing.filter(|closing| seq >= closing.last) {
            closing.lacking.remove(node);
        }
    }

    /// Returns `true` if a node has confirmed something.
    pub(crate) fn confirms(&self, node: &NodeId) -> bool {
        self.confirming.contains(node)
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

    /// Returns `true` if a source of a name waits for confirmations.
    pub(crate) fn is_waiting(&self, now: Instant, name: &Name) -> bool {
        let mut of_name = self.open.get(name).into_iter().flat_map(BTreeMap::values);
        of_name.any(|closing| closing.is_waiting(now, &self.confirming))
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

impl Closing {
    fn is_waiting(&self, now: Instant, confirming: &BTreeSet<NodeId>) -> bool {
        self.lacking.iter().any(|node| {
            let max = if confirming.contains(node) { CONFIRM_MAX } else { CONFIRM_UNKNOWN_MAX };
            self.since + max > now
        })
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
        closings.is_waiting(now, &NAME)
    }

    #[test]
    fn source_waits_until_every_node_has_confirmed_its_last_message() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        assert!(closings.wait_for(now, NAME, SOURCE, 7, [node(1), node(2), node(2)]));
        closings.confirmed(&NAME, &SOURCE, &node(1), 6);
        closings.confirmed(&NAME, &SOURCE, &node(2), 8);
        closings.confirmed(&NAME, &SOURCE, &node(3), 7);
        assert!(waits(&closings, now), "the first has confirmed an earlier message only");
        closings.confirmed(&NAME, &SOURCE, &node(1), 7);
        assert!(!waits(&closings, now));
        // The same message needs no second confirmation; a later one does.
        assert!(!closings.wait_for(now, NAME, SOURCE, 7, [node(1)]) && !waits(&closings, now));
        assert!(closings.wait_for(now, NAME, SOURCE, 9, [node(1)]) && waits(&closings, now));
    }

    #[test]
    fn question_is_repeated_in_longer_and_longer_times() {
        let (mut closings, begin) = (Closings::default(), Instant::now());
        closings.confirmed(&NAME, &SOURCE, &node(1), 0);
        let mut asks =
            |s: &u64| closings.wait_for(begin + Duration::from_secs(*s), NAME, SOURCE, 1, [node(1)]);
        let asked: Vec<_> = (0..700).filter(|s| asks(s)).collect();
        assert_eq!(asked, [0, 2, 6, 14, 30, 62, 126, 190, 254, 318, 382, 446, 510, 574]);
    }

    #[test]
    fn nobody_is_waited_for_longer_than_the_bound_or_after_the_loss_of_its_right() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        assert!(!closings.wait_for(now, NAME, SOURCE, 1, []) && !waits(&closings, now), "nobody receives");
        assert!(closings.wait_for(now, NAME, SOURCE, 2, [node(1)]));
        let before = |max: Duration| now + max - Duration::from_millis(1);
        assert!(
            waits(&closings, before(CONFIRM_UNKNOWN_MAX)) && !waits(&closings, now + CONFIRM_UNKNOWN_MAX)
        );
        // A node of a version that confirms is waited for longer.
        closings.confirmed(&Name([9; 32]), &SOURCE, &node(1), 1);
        assert!(closings.confirms(&node(1)) && !closings.confirms(&node(2)));
        assert!(waits(&closings, before(CONFIRM_MAX)) && !waits(&closings, now + CONFIRM_MAX));
        closings.cut(&NAME, &node(1));
        assert!(!waits(&closings, now));
    }

    #[test]
    fn node_that_lost_its_path_shortly_before_is_waited_for() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        closings.lost_path(now, NAME, node(1));
        closings.lost_path(now, Name([9; 32]), node(2));
        closings.wait_for(now + PATHLESS_COUNTS_FOR - Duration::from_millis(1), NAME, SOURCE, 1, []);
        assert!(waits(&closings, now));
        closings.confirmed(&NAME, &SOURCE, &node(1), 1);
        assert!(!waits(&closings, now));
        closings.wait_for(now + PATHLESS_COUNTS_FOR, NAME, SOURCE, 2, []);
        assert!(!waits(&closings, now), "that was too long ago");
        // The oldest give way.
        closings.lost_path(now, NAME, node(1));
        (0..PATHLESS_MAX).for_each(|_| closings.lost_path(now, Name([9; 32]), node(2)));
        assert_eq!(closings.pathless.len(), PATHLESS_MAX);
        closings.wait_for(now, NAME, SOURCE, 3, []);
        assert!(!waits(&closings, now));
    }

    #[test]
    fn sources_that_are_gone_are_forgotten() {
        let (mut closings, now) = (Closings::default(), Instant::now());
        let other = SourceId([3; 16]);
        closings.wait_for(now, NAME, SOURCE, 1, [node(1)]);
        closings.wait_for(now, NAME, other, 5, [node(1)]);
        closings.retain(&NAME, |source| *source == other);
        assert_eq!(closings.of(&NAME).collect::<Vec<_>>(), [other]);
        closings.retain(&NAME, |_| false);
        assert!(closings.open.is_empty());
    }
}
