//! [`Wishes`]: the most that this node wants of the topics of others, and that others want of its own.

use std::collections::{BTreeMap, BTreeSet};

use sgc_ros::Shaping;
use sgc_session::Wished;
use sgc_wire::{Name, NodeId, Wish};

/// Most nodes that are asked for their wishes.
const ASKED_NODES_MAX: usize = 256;

/// The wishes of this node and of others.
#[derive(Default)]
pub(crate) struct Wishes {
    /// The most that this node wants of each topic, with the topic's owner.
    own: BTreeMap<Name, (NodeId, Wished)>,
    is_own_changed: bool,
    asked: BTreeSet<NodeId>,
    told: BTreeMap<NodeId, BTreeMap<Name, Wished>>,
    /// Subscribers, or what they wish, may have changed.
    is_changed: bool,
}

/// Effect: nodes that are asked for their wishes from here on, and those that are asked no longer.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct AskedNodes {
    pub(crate) ask: Vec<NodeId>,
    pub(crate) leave: Vec<NodeId>,
}

impl Wishes {
    /// Sets what this node wants of a topic of another node.
    pub(crate) fn set_own(&mut self, name: Name, owner: NodeId, shaping: &Shaping) {
        let wished = Wished { interval: shaping.interval, bits_per_s: shaping.bits_per_s };
        self.is_own_changed |= if wished == Wished::default() {
            self.own.remove(&name).is_some()
        } else {
            self.own.insert(name, (owner, wished)) != Some((owner, wished))
        };
    }

    /// Forgets what this node wanted of a topic that it left.
    pub(crate) fn left(&mut self, name: &Name) {
        self.is_own_changed |= self.own.remove(name).is_some();
    }

    /// Returns what this node wants, by owner, if that has changed.
    pub(crate) fn take_own(&mut self) -> Option<BTreeMap<NodeId, Vec<Wish>>> {
        if !std::mem::take(&mut self.is_own_changed) {
            return None;
        }
        let mut by_owner = BTreeMap::<_, Vec<_>>::new();
        for (name, (owner, Wished { interval, bits_per_s })) in &self.own {
            let wish = Wish { interface: *name, interval: *interval, bits_per_s: *bits_per_s };
            by_owner.entry(*owner).or_default().push(wish);
        }
        Some(by_owner)
    }

    /// Notes that a subscriber came or went.
    pub(crate) fn subscribers_changed(&mut self) {
        self.is_changed = true;
    }

    /// Takes all the wishes of a node, if it was asked.
    pub(crate) fn told(&mut self, peer: NodeId, wishes: &[Wish]) {
        if self.asked.contains(&peer) {
            let wished = |wish: &Wish| Wished { interval: wish.interval, bits_per_s: wish.bits_per_s };
            let wishes = wishes.iter().map(|wish| (wish.interface, wished(wish))).collect();
            self.told.insert(peer, wishes);
            self.is_changed = true;
        }
    }

    /// Forgets the wishes of a node that withdrew them.
    pub(crate) fn withdrawn(&mut self, peer: &NodeId) {
        self.is_changed |= self.told.remove(peer).is_some();
    }

    /// Returns `true` once after a change.
    pub(crate) fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.is_changed)
    }

    /// Asks these nodes, which get topics, and no others.
    pub(crate) fn ask(&mut self, subscribers: &BTreeSet<NodeId>) -> AskedNodes {
        let leave: Vec<_> = self.asked.difference(subscribers).copied().collect();
        for peer in &leave {
            self.asked.remove(peer);
            self.told.remove(peer);
        }
        let mut ask = Vec::new();
        for peer in subscribers {
            if self.asked.len() < ASKED_NODES_MAX && self.asked.insert(*peer) {
                ask.push(*peer);
            }
        }
        AskedNodes { ask, leave }
    }

    /// Returns what all these subscribers of a topic want together. One that did not say it wants everything.
    pub(crate) fn of(&self, name: &Name, subscribers: impl Iterator<Item = NodeId>) -> Wished {
        let one =
            |peer: NodeId| self.told.get(&peer).and_then(|of| of.get(name)).copied().unwrap_or_default();
        subscribers.map(one).reduce(Wished::or_more).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const NAME: Name = Name([1; 32]);
    const OTHER: Name = Name([2; 32]);

    fn node(n: u8) -> NodeId {
        NodeId([n; 32])
    }

    fn every(ms: u64) -> Option<Duration> {
        Some(Duration::from_millis(ms))
    }

    #[test]
    fn own_wishes_are_told_to_the_owners_after_each_change() {
        let mut wishes = Wishes::default();
        assert_eq!(wishes.take_own(), None);
        let slow = Shaping { interval: every(200), ..Shaping::default() };
        wishes.set_own(NAME, node(1), &slow);
        let wish = Wish { interface: NAME, interval: every(200), bits_per_s: None };
        assert_eq!(wishes.take_own(), Some(BTreeMap::from([(node(1), vec![wish])])));
        wishes.set_own(NAME, node(1), &slow);
        // An age is no wish: it depends on the path.
        wishes.set_own(OTHER, node(1), &Shaping { max_age: every(200), ..Shaping::default() });
        assert_eq!(wishes.take_own(), None);
        wishes.set_own(NAME, node(1), &Shaping::default());
        assert_eq!(wishes.take_own(), Some(BTreeMap::new()));
        wishes.set_own(NAME, node(1), &slow);
        wishes.left(&NAME);
        wishes.left(&NAME);
        assert_eq!((wishes.take_own(), wishes.take_own()), (Some(BTreeMap::new()), None));
    }

    #[test]
    fn a_topic_has_what_its_most_demanding_subscriber_wants() {
        let mut wishes = Wishes::default();
        let [quick, slow, silent] = [1, 2, 3].map(node);
        let wish = |ms| Wish { interface: NAME, interval: every(ms), bits_per_s: None };
        wishes.told(quick, &[wish(100)]);
        assert!(!wishes.take_changed(), "it was not asked");
        let all = BTreeSet::from([quick, slow, silent]);
        assert_eq!(wishes.ask(&all), AskedNodes { ask: vec![quick, slow, silent], leave: vec![] });
        wishes.told(quick, &[wish(100)]);
        wishes.told(slow, &[wish(500), Wish { interface: OTHER, ..wish(9) }]);
        assert!(wishes.take_changed() && !wishes.take_changed());
        let of = |wishes: &Wishes, nodes: &[NodeId]| wishes.of(&NAME, nodes.iter().copied()).interval;
        assert_eq!(of(&wishes, &[quick, slow]), every(100));
        assert_eq!(of(&wishes, &[slow]), every(500));
        assert_eq!((of(&wishes, &[slow, silent]), of(&wishes, &[])), (None, None));
        wishes.withdrawn(&slow);
        assert!(wishes.take_changed());
        assert_eq!(of(&wishes, &[slow]), None);
        wishes.told(slow, &[wish(500)]);
        let left = wishes.ask(&BTreeSet::from([quick]));
        assert_eq!(left, AskedNodes { ask: vec![], leave: vec![slow, silent] });
        assert_eq!(of(&wishes, &[slow]), None);
        let many: BTreeSet<_> = (0..=u8::MAX)
            .map(node)
            .chain([NodeId([[9; 16], [1; 16]].concat().try_into().unwrap())])
            .collect();
        assert_eq!(wishes.ask(&many).ask.len(), ASKED_NODES_MAX - 1);
    }
}
