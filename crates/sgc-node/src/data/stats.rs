//! Counters of the data path, and reasons of drops.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard};

use sgc_router::LinkId;
use sgc_sync::lock;
use sgc_wire::{Name, NodeId};

use crate::drops::DropKind;
use crate::state::audit::PeerNames;

/// Traffic of one name at this node.
#[derive(Debug, Default)]
pub(crate) struct NameStats {
    /// Packets accepted.
    pub packets: AtomicU64,
    /// Bytes of their payloads.
    pub bytes: AtomicU64,
    /// Packets dropped.
    pub dropped: AtomicU64,
    /// Packets and messages dropped, by reason.
    reasons: [AtomicU64; DataDrop::ALL.len()],
}

impl NameStats {
    /// Counts an accepted packet.
    pub(crate) fn count(&self, bytes: usize) {
        self.packets.fetch_add(1, Relaxed);
        self.bytes.fetch_add(bytes as u64, Relaxed);
    }

    /// Counts drops by their reason.
    pub(crate) fn count_drops(&self, reason: DataDrop, several: u64) {
        if let Some(count) = self.reasons.get(reason as usize) {
            count.fetch_add(several, Relaxed);
        }
    }

    /// Returns the nonzero drops by reason.
    pub(crate) fn reasons(&self) -> BTreeMap<String, u64> {
        let all = DataDrop::ALL.into_iter().zip(&self.reasons);
        let all = all.map(|(reason, count)| (reason.key().to_owned(), count.load(Relaxed)));
        all.filter(|(_, count)| *count > 0).collect()
    }
}

/// Reasons why the data path drops a packet or a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DataDrop {
    /// The name has no tree, because nobody joined.
    NoTree,
    /// The packet came over a link that is not on the tree towards its source.
    WrongWay,
    /// The hop limit is reached.
    HopLimit,
    /// The packet is addressed to a sink that is not here.
    NoSuchSink,
    /// A reliable consumer was stalled for too long.
    Stalled,
    /// A newer best-effort packet replaced it.
    Stale,
    /// The link ended.
    LinkClosed,
    /// The packet is malformed.
    Malformed,
    /// The packet has a label without a name.
    UnknownLabel,
    /// The name has no grant yet.
    NotGranted,
    /// The source has used all its numbers.
    SourceExhausted,
    /// A sink refused the packet. The sink's own counter has the reason.
    Sink,
    /// No local writer takes the message.
    NoWriter,
    /// The message exceeds the largest size.
    TooLarge,
    /// A newer message replaced it because of the configured rate or bandwidth.
    Thinned,
    /// The message exceeds the configured age.
    TooOld,
    /// The publisher's history was repeated after a restart of its node.
    Repeated,
    /// A newer message replaced it, here or at a local publisher that writes faster than this node can send.
    Overrun,
    /// The message is or becomes JSON, and its type is unknown here.
    NoDefinition,
    /// The message does not match its type and was not converted to JSON.
    NotConverted,
    /// A command of a topic with a dead-man switch came late.
    LateCommand,
    /// A command whose lateness cannot be known yet.
    UnjudgedCommand,
    /// A command came after the dead-man switch stopped the robot, and before somebody let go and began again.
    NotResumed,
}

/// A drop on the data path: the packet or message itself, or older ones that made room for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{messages} dropped: {}", reason.key())]
pub(crate) struct Dropped {
    pub(crate) reason: DataDrop,
    /// The number of dropped messages or packets.
    pub(crate) messages: u64,
}

impl Dropped {
    /// Returns the drop of a single message or packet.
    pub(crate) fn one(reason: DataDrop) -> Self {
        Self { reason, messages: 1 }
    }

    /// Fails if any messages were dropped.
    pub(crate) fn check(reason: DataDrop, messages: u64) -> Result<(), Self> {
        if messages > 0 { Err(Self { reason, messages }) } else { Ok(()) }
    }
}

impl DataDrop {
    /// All reasons in the order of their numbers.
    pub const ALL: [Self; 23] = [
        Self::NoTree,
        Self::WrongWay,
        Self::HopLimit,
        Self::NoSuchSink,
        Self::Stalled,
        Self::Stale,
        Self::LinkClosed,
        Self::Malformed,
        Self::UnknownLabel,
        Self::NotGranted,
        Self::SourceExhausted,
        Self::Sink,
        Self::NoWriter,
        Self::TooLarge,
        Self::Thinned,
        Self::TooOld,
        Self::Repeated,
        Self::Overrun,
        Self::NoDefinition,
        Self::NotConverted,
        Self::LateCommand,
        Self::UnjudgedCommand,
        Self::NotResumed,
    ];

    /// Returns a short, stable name for counters.
    pub const fn key(self) -> &'static str {
        match self {
            Self::NoTree => "no_subscriber",
            Self::WrongWay => "wrong_way",
            Self::HopLimit => "hop_limit",
            Self::NoSuchSink => "no_such_sink",
            Self::Stalled => "stalled",
            Self::Stale => "stale",
            Self::LinkClosed => "link_closed",
            Self::Malformed => "malformed",
            Self::UnknownLabel => "unknown_label",
            Self::NotGranted => "not_granted",
            Self::SourceExhausted => "source_exhausted",
            Self::Sink => "sink",
            Self::NoWriter => "no_writer",
            Self::TooLarge => "too_large",
            Self::Thinned => "thinned",
            Self::TooOld => "too_old",
            Self::Repeated => "repeated",
            Self::Overrun => "overrun",
            Self::NoDefinition => "no_definition",
            Self::NotConverted => "not_converted",
            Self::LateCommand => "late_command",
            Self::UnjudgedCommand => "unjudged_command",
            Self::NotResumed => "not_resumed",
        }
    }
}

impl DropKind for DataDrop {
    fn key(&self) -> &'static str {
        DataDrop::key(*self)
    }
}

/// Most rows of drops by culprit. Beyond it, the smallest one is dropped.
const ROWS_MAX: usize = 512;

/// The cause of a drop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Culprit {
    /// A link. Its rows end with it.
    Link(LinkId),
    /// A peer.
    Peer(NodeId),
}

impl From<LinkId> for Culprit {
    fn from(link: LinkId) -> Self {
        Self::Link(link)
    }
}

impl From<NodeId> for Culprit {
    fn from(peer: NodeId) -> Self {
        Self::Peer(peer)
    }
}

/// Counts by kind, and by kind and culprit. They are written on the rare path only. The count of a kind includes all
/// its culprits, also of links that have ended.
#[derive(Debug, Default)]
pub(crate) struct Drops(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    kinds: BTreeMap<&'static str, u64>,
    rows: BTreeMap<(Culprit, &'static str), u64>,
    links: BTreeSet<LinkId>,
}

impl Drops {
    /// Counts one drop. Returns `true` if it is the first of its kind.
    pub(crate) fn count(&self, kind: impl DropKind) -> bool {
        self.add(kind, 1)
    }

    /// Counts several drops. Returns `true` if they are the first of their kind.
    pub(crate) fn add(&self, kind: impl DropKind, several: u64) -> bool {
        let mut counts = self.lock();
        let n = counts.kinds.entry(kind.key()).or_default();
        *n += several;
        *n == several
    }

    /// Counts a drop of a culprit. Returns `true` if it is the culprit's first of its kind. For a link that is not up,
    /// only the kind is counted.
    pub(crate) fn count_from(&self, kind: impl DropKind, culprit: impl Into<Culprit>) -> bool {
        self.add_from(kind, culprit, 1)
    }

    /// Counts several drops of a culprit, as [`Self::count_from`] does.
    pub(crate) fn add_from(&self, kind: impl DropKind, culprit: impl Into<Culprit>, several: u64) -> bool {
        let (kind, culprit) = (kind.key(), culprit.into());
        let mut counts = self.lock();
        let counts = &mut *counts;
        *counts.kinds.entry(kind).or_default() += several;
        if matches!(culprit, Culprit::Link(link) if link != LinkId::LOCAL && !counts.links.contains(&link)) {
            return false;
        }
        let key = (culprit, kind);
        if counts.rows.len() >= ROWS_MAX
            && !counts.rows.contains_key(&key)
            && let Some(smallest) = counts.rows.iter().min_by_key(|(_, n)| **n).map(|(key, _)| *key)
        {
            counts.rows.remove(&smallest);
        }
        let n = counts.rows.entry(key).or_default();
        *n += several;
        *n == several
    }

    /// Gives the drops of a link rows of their own from here on.
    pub(crate) fn link_up(&self, link: LinkId) {
        self.lock().links.insert(link);
    }

    /// Removes the rows of a link that ended.
    pub(crate) fn link_down(&self, link: LinkId) {
        let mut counts = self.lock();
        counts.links.remove(&link);
        counts.rows.retain(|(culprit, _), _| *culprit != Culprit::Link(link));
    }

    /// Returns all counts. Peers are called by the beginning of their ids.
    pub(crate) fn snapshot(&self) -> BTreeMap<String, u64> {
        self.snapshot_by_name(&PeerNames::default())
    }

    /// Returns all counts. Peers are called by their names.
    pub(crate) fn snapshot_by_name(&self, names: &PeerNames) -> BTreeMap<String, u64> {
        let counts = self.lock();
        let mut all: BTreeMap<_, _> = counts.kinds.iter().map(|(kind, n)| ((*kind).to_owned(), *n)).collect();
        for ((culprit, kind), n) in &counts.rows {
            let culprit = match culprit {
                Culprit::Link(link) => link.to_string(),
                Culprit::Peer(peer) => names.called(peer),
            };
            // Two peers may have one name.
            *all.entry(format!("{kind} from {culprit}")).or_default() += n;
        }
        all
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        lock(&self.0)
    }
}

/// Counts of everything that the data path drops.
pub(crate) trait CountDrops: Send + Sync + 'static {
    /// Counts a drop under `name` from `ingress`.
    fn count(&self, ingress: LinkId, name: &Name, reason: DataDrop);

    /// Counts several drops under `name` at this node itself.
    fn count_here(&self, name: &Name, reason: DataDrop, several: u64);

    /// Counts packets under `name` that this node had accepted and queued, and then left out.
    fn count_left_out(&self, name: &Name, dropped: Dropped);

    /// Returns drops by reason and link, and by reason for this node's sinks.
    fn drops(&self) -> &Drops;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_a_counter_of_its_own() {
        let stats = NameStats::default();
        for (place, reason) in DataDrop::ALL.into_iter().enumerate() {
            assert_eq!(reason as usize, place);
            stats.count_drops(reason, place as u64 + 1);
        }
        let reasons = stats.reasons();
        assert_eq!(reasons.len(), DataDrop::ALL.len());
        assert_eq!(reasons["not_resumed"], DataDrop::ALL.len() as u64);
    }

    #[test]
    fn rows_are_bounded_and_totals_are_not_lost() {
        let drops = Drops::default();
        let links = (0..10_000).map(LinkId);
        links.clone().for_each(|link| drops.link_up(link));
        assert!(drops.count_from(DataDrop::Stale, LinkId(1)));
        assert!(!drops.count_from(DataDrop::Stale, LinkId(1)));
        for link in links {
            drops.count_from(DataDrop::Stale, link);
        }
        let snapshot = drops.snapshot();
        assert_eq!(snapshot.len(), ROWS_MAX + 1);
        assert_eq!((snapshot["stale"], snapshot["stale from link 1"]), (10_002, 3), "the largest stays");
    }

    #[test]
    fn rows_end_with_their_link_and_stay_in_the_total() {
        let drops = Drops::default();
        for link in [1, 2].map(LinkId) {
            drops.link_up(link);
            drops.count_from(DataDrop::Stale, link);
        }
        drops.count_from(DataDrop::Stale, Culprit::Peer(NodeId([7; 32])));
        drops.link_down(LinkId(1));
        // The packet was under way when its link ended.
        assert!(!drops.count_from(DataDrop::Stale, LinkId(1)));
        let rows: Vec<_> = drops.snapshot().into_iter().collect();
        let row = |key: &str, n| (key.to_owned(), n);
        let peer = format!("stale from {}", NodeId([7; 32]).short());
        assert_eq!(rows, [row("stale", 4), row(&peer, 1), row("stale from link 2", 1)]);
        let names = PeerNames::from(BTreeMap::from([(NodeId([7; 32]), "arm".to_owned())]));
        assert_eq!(drops.snapshot_by_name(&names)["stale from arm"], 1);
    }
}
