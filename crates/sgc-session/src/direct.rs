//! Direct paths: [`DirectPaths`] finds, with each peer that this node exchanges data with, a pair of addresses between
//! which packets pass without a router.
//!
//! Both nodes ask each other for their addresses through their routers. Then each runs connectivity checks (ICE, RFC
//! 8445) from the socket of its links, in the agent of the crate `is`. The node with the lesser id controls: it dials the
//! pair that it nominates. The other accepts a link from the addresses whose checks it authenticated.
//!
//! Checks go to addresses that a peer names or forges, so an attempt sends no more to addresses that have not answered
//! than the peer's offer and its checks have bytes.

mod addresses;
mod attempt;
mod links;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use is::stun::StunMessage;
use rand_chacha::ChaCha20Rng;
use rand_core::RngCore as _;
use sgc_wire::{Decode as _, NodeId, PathOffer, PathQuestion, RefuseReason};

pub use self::addresses::{LocalAddress, REFLEXIVE_MAX, is_checkable, local_addresses};
use self::attempt::{Attempt, Progress};
pub use self::links::DirectLinkTable;
use crate::backoff::doubled;

/// Most peers with which this node has, or looks for, a direct path.
pub const DIRECT_PEERS_MAX: usize = 256;
/// Most attempts at one time.
pub const DIRECT_ATTEMPTS_MAX: usize = 32;
/// Longest time for an attempt, from the question to the link.
pub const DIRECT_ATTEMPT_MAX: Duration = Duration::from_secs(10);
/// Shortest wait, before jitter, after an attempt that failed. It is doubled each time.
const RETRY_MIN: Duration = Duration::from_secs(2);
/// Longest such wait.
const RETRY_MAX: Duration = Duration::from_secs(300);
/// A link that was up for less counts as a failure, so that a path that works badly is not used again and again.
const LINK_PROVEN_AFTER: Duration = Duration::from_secs(60);
/// Most attempts that one peer begins within a time. Programs that are restarted need a few.
const ASKED_MAX: usize = 4;
const ASKED_WITHIN: Duration = Duration::from_secs(10);

/// Work for the driver.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DirectOutput {
    /// Ask the peer for its addresses, in place of an earlier question.
    Ask {
        /// The peer.
        peer: NodeId,
        /// The question.
        question: PathQuestion,
    },
    /// End the question to the peer.
    Leave {
        /// The peer.
        peer: NodeId,
    },
    /// Send a check, or the answer to one.
    Send {
        /// The address to send from.
        from: SocketAddr,
        /// The address to send to.
        to: SocketAddr,
        /// The datagram.
        datagram: Vec<u8>,
    },
    /// Accept a link of the peer from this address.
    Admit {
        /// The peer.
        peer: NodeId,
        /// The address.
        from: SocketAddr,
    },
    /// Accept no more links of the peer.
    Shut {
        /// The peer.
        peer: NodeId,
    },
    /// Dial the peer.
    Dial {
        /// The peer.
        peer: NodeId,
        /// The address.
        to: SocketAddr,
    },
}

/// Reasons why there is no direct path to a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoDirectPath {
    /// The first attempt is under way.
    #[error("a direct path is being looked for")]
    First,
    /// The peer did not tell its addresses.
    #[error(
        "the peer does not answer the question for its addresses: its version is older, or `direct` there is \"never\""
    )]
    Unanswered,
    /// The peer permits no direct link with this node.
    #[error("the peer permits no direct link with this node")]
    Refused,
    /// The peer cannot tell its addresses now.
    #[error("the peer knows none of its addresses yet, or has too many other attempts under way")]
    Unready,
    /// No check was answered.
    #[error("no packet passes between the two networks: a NAT or a firewall on the way drops them")]
    Blocked,
    /// Checks were answered, and no link came of it.
    #[error("packets pass, and no link was made")]
    NoLink,
    /// There is a link, and nothing arrives over it.
    #[error("nothing arrives over the direct link")]
    Silent,
    /// There was a link, and it ended.
    #[error("the direct link ended")]
    Lost,
    /// This node has no address that a peer could reach.
    #[error("this node has no address that the peer could reach")]
    NoAddress,
    /// One node has IPv4 alone, and the other IPv6 alone.
    #[error("the two nodes have no address of one family: one has IPv4 alone, and the other IPv6 alone")]
    NoCommonFamily,
    /// Too many attempts are under way.
    #[error("{DIRECT_ATTEMPTS_MAX} other attempts are under way")]
    Busy,
}

/// The path to a peer.
#[derive(Debug)]
struct Peer {
    /// This node exchanges data with it.
    is_wanted: bool,
    attempt: Option<Box<Attempt>>,
    /// Time since which a direct link is up.
    linked: Option<Instant>,
    /// Whether nothing arrives over it.
    is_silent: bool,
    failures: u32,
    retry_at: Option<Instant>,
    why_not: NoDirectPath,
    /// Times of the last attempts that it began.
    asked: VecDeque<Instant>,
}

impl Peer {
    fn new(is_wanted: bool, now: Instant) -> Self {
        Self {
            is_wanted,
            attempt: None,
            linked: None,
            is_silent: false,
            failures: 0,
            retry_at: is_wanted.then_some(now),
            why_not: NoDirectPath::First,
            asked: VecDeque::new(),
        }
    }

    /// Returns `true` if an attempt may follow one that the peer began, and counts it.
    fn may_begin_anew(&mut self, now: Instant) -> bool {
        self.asked.retain(|at| now.saturating_duration_since(*at) < ASKED_WITHIN);
        let may = self.asked.len() < ASKED_MAX;
        if may {
            self.asked.push_back(now);
        }
        may
    }

    fn is_idle(&self) -> bool {
        !self.is_of_use() && self.attempt.is_none()
    }

    /// Returns `true` if this node exchanges data with it, or has a link to it.
    fn is_of_use(&self) -> bool {
        self.is_wanted || self.linked.is_some()
    }

    /// Returns `true` if a link carries data.
    fn is_reached(&self) -> bool {
        self.linked.is_some() && !self.is_silent
    }
}

/// The direct paths of a node.
#[derive(Debug)]
pub struct DirectPaths {
    own: NodeId,
    rng: ChaCha20Rng,
    local: Vec<LocalAddress>,
    peers: BTreeMap<NodeId, Peer>,
    outputs: VecDeque<DirectOutput>,
    /// Checks that were not sent, because the peer's offer paid for no more.
    withheld: u64,
    /// Candidates of peers that no host of theirs can have, or that must not be checked.
    refused_candidates: u64,
}

impl DirectPaths {
    /// Creates the machine of the node `own`, without addresses. Passwords are drawn from `rng`.
    pub fn new(own: NodeId, rng: ChaCha20Rng) -> Self {
        Self {
            own,
            rng,
            local: Vec::new(),
            peers: BTreeMap::new(),
            outputs: VecDeque::new(),
            withheld: 0,
            refused_candidates: 0,
        }
    }

    /// Sets the addresses of this node. If they changed, the network did: attempts begin anew, those that wait are due,
    /// and a better path is looked for to peers with a link.
    pub fn set_local(&mut self, now: Instant, local: Vec<LocalAddress>) {
        if self.local == local {
            return;
        }
        self.local = local;
        let mut under_way = Vec::new();
        for (node, peer) in &mut self.peers {
            peer.failures = 0;
            if peer.attempt.is_some() {
                under_way.push(*node);
            } else if peer.is_of_use() {
                peer.retry_at = Some(now);
            }
        }
        under_way.into_iter().for_each(|node| self.begin(now, node));
    }

    /// Sets the peers with which this node exchanges data, beyond those that look for a path to it.
    pub fn want(&mut self, now: Instant, wanted: &BTreeSet<NodeId>) {
        for (node, peer) in &mut self.peers {
            let is_wanted = wanted.contains(node);
            if is_wanted && !peer.is_of_use() && peer.attempt.is_none() {
                peer.retry_at = Some(peer.retry_at.map_or(now, |at| at.max(now)));
            }
            peer.is_wanted = is_wanted;
        }
        for node in wanted.iter().filter(|node| **node != self.own) {
            if self.peers.len() < DIRECT_PEERS_MAX {
                self.peers.entry(*node).or_insert_with(|| Peer::new(true, now));
            }
        }
        // A failure is remembered until the peer may be tried again.
        self.peers.retain(|_, peer| !peer.is_idle() || peer.retry_at.is_some_and(|at| at > now));
    }

    /// Answers the question of a peer. `is_permitted` says whether it may have a direct link.
    pub fn answer(
        &mut self,
        now: Instant,
        node: NodeId,
        is_permitted: bool,
        question: &[u8],
    ) -> Result<PathOffer, RefuseReason> {
        if !is_permitted {
            return Err(RefuseReason::NotPermitted);
        }
        let question = PathQuestion::from_slice(question).map_err(|_| RefuseReason::RoleNotOffered)?;
        self.asked(now, node, question).ok_or(RefuseReason::Limit)
    }

    /// Takes the question of a peer that may have a direct link. Returns the answer; `None` if it asks too often, or
    /// there is no room.
    pub fn asked(&mut self, now: Instant, node: NodeId, question: PathQuestion) -> Option<PathOffer> {
        let under_way = self.attempts();
        let is_full = self.peers.len() >= DIRECT_PEERS_MAX;
        let peer = match self.peers.get_mut(&node) {
            Some(peer) => peer,
            None if is_full || node == self.own || self.local.is_empty() => return None,
            None => self.peers.entry(node).or_insert_with(|| Peer::new(false, now)),
        };
        let is_new = peer.attempt.is_none();
        if let Some(attempt) = &mut peer.attempt
            && attempt.is_with(question.attempt)
        {
            return Some(attempt.offer());
        }
        if (is_new && under_way >= DIRECT_ATTEMPTS_MAX) || !peer.may_begin_anew(now) {
            return None;
        }
        self.begin(now, node);
        let attempt = self.peers.get_mut(&node)?.attempt.as_mut()?;
        attempt.is_with(question.attempt).then(|| attempt.offer())
    }

    /// Takes the answer of a peer.
    pub fn offered(&mut self, now: Instant, node: NodeId, offer: &PathOffer) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let Some(attempt) = &mut peer.attempt else { return };
        self.outputs.push_back(DirectOutput::Leave { peer: node });
        if !attempt.take_offer(now, offer, &mut self.refused_candidates) {
            // The peer began anew in between. Two that do so at one time could follow each other without end.
            if !peer.may_begin_anew(now) {
                return self.fail(now, node, NoDirectPath::Unanswered);
            }
            self.begin(now, node);
        } else if !attempt.shares_family(offer) {
            return self.fail(now, node, NoDirectPath::NoCommonFamily);
        }
        self.advance(now, node);
    }

    /// Notes that the peer, or a router before it, refuses its addresses: for good, or for now.
    pub fn refused(&mut self, now: Instant, node: NodeId, is_for_good: bool) {
        if self.peers.get(&node).is_some_and(|peer| peer.attempt.is_some()) {
            let why = if is_for_good { NoDirectPath::Refused } else { NoDirectPath::Unready };
            self.fail(now, node, why);
        }
    }

    /// Takes a datagram that looks like a check. Returns `false` if it is none of an attempt under way.
    pub fn received(&mut self, now: Instant, to: SocketAddr, from: SocketAddr, datagram: &[u8]) -> bool {
        let Ok(message) = StunMessage::parse(datagram) else { return false };
        let mut attempts = self.peers.iter().filter_map(|(node, peer)| Some((*node, peer.attempt.as_ref()?)));
        let Some(node) = attempts.find(|(_, attempt)| attempt.accepts(&message)).map(|(node, _)| node) else {
            return false;
        };
        if let Some(attempt) = self.peers.get_mut(&node).and_then(|peer| peer.attempt.as_mut()) {
            attempt.receive(now, to, from, (message, datagram.len()));
        }
        self.advance(now, node);
        true
    }

    /// Returns `true` if a link of this peer at this address comes of an attempt.
    pub fn is_expected(&self, node: &NodeId, address: SocketAddr) -> bool {
        let attempt = self.peers.get(node).and_then(|peer| peer.attempt.as_ref());
        attempt.is_some_and(|attempt| attempt.expects(address))
    }

    /// Notes that a direct link to a peer is up.
    pub fn linked(&mut self, now: Instant, node: NodeId) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        if peer.attempt.take().is_some() {
            self.outputs.push_back(DirectOutput::Leave { peer: node });
        }
        (peer.linked, peer.is_silent, peer.retry_at) = (Some(now), false, None);
    }

    /// Notes whether nothing arrives over all direct links to a peer. Its address may be another one now.
    pub fn silent(&mut self, now: Instant, node: NodeId, is_silent: bool) {
        let Some(peer) = self.peers.get_mut(&node).filter(|peer| peer.linked.is_some()) else { return };
        if std::mem::replace(&mut peer.is_silent, is_silent) == is_silent {
            return;
        }
        peer.retry_at = (is_silent && peer.attempt.is_none()).then_some(now);
        if is_silent {
            peer.why_not = NoDirectPath::Silent;
        }
    }

    /// Notes that the last direct link to a peer ended.
    pub fn ended(&mut self, now: Instant, node: NodeId) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        let Some(since) = peer.linked.take() else { return };
        peer.is_silent = false;
        peer.why_not = NoDirectPath::Lost;
        if peer.attempt.is_some() {
            return;
        }
        self.outputs.push_back(DirectOutput::Shut { peer: node });
        let is_proven = now.saturating_duration_since(since) >= LINK_PROVEN_AFTER;
        peer.failures = if is_proven { 1 } else { peer.failures.saturating_add(1) };
        let wait = doubled(RETRY_MIN, peer.failures, RETRY_MAX, &mut self.rng);
        peer.retry_at = Some(now + wait);
    }

    /// Notes that the link that was dialled was not made.
    pub fn not_dialled(&mut self, now: Instant, node: NodeId) {
        if self.peers.get(&node).is_some_and(|peer| peer.attempt.is_some()) {
            self.fail(now, node, NoDirectPath::NoLink);
        }
    }

    /// Acts on timers that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        let due = |peer: &Peer| {
            peer.attempt.is_none() && peer.is_of_use() && peer.retry_at.is_some_and(|at| at <= now)
        };
        let begin: Vec<_> = self.peers.iter().filter(|(_, peer)| due(peer)).map(|(node, _)| *node).collect();
        for node in begin {
            if self.local.is_empty() {
                self.wait(now, node, NoDirectPath::NoAddress);
            } else if self.attempts() >= DIRECT_ATTEMPTS_MAX {
                self.wait(now, node, NoDirectPath::Busy);
            } else {
                self.begin(now, node);
            }
        }
        let under_way: Vec<_> =
            self.peers.iter().filter(|(_, peer)| peer.attempt.is_some()).map(|(node, _)| *node).collect();
        for node in under_way {
            self.advance(now, node);
        }
    }

    /// Returns the time at which to call [`Self::handle_timeout`].
    pub fn deadline(&mut self) -> Option<Instant> {
        let times = self.peers.values_mut().filter_map(|peer| match &mut peer.attempt {
            Some(attempt) => Some(attempt.deadline()),
            None => peer.retry_at.filter(|_| peer.is_of_use()),
        });
        times.min()
    }

    /// Returns the next output.
    pub fn poll(&mut self) -> Option<DirectOutput> {
        self.outputs.pop_front()
    }

    /// Returns why there is no direct path to a peer; `None` if there is one, or nobody looks for one.
    pub fn why_not(&self, node: &NodeId) -> Option<NoDirectPath> {
        self.peers.get(node).filter(|peer| !peer.is_reached()).map(|peer| peer.why_not)
    }

    /// Returns `true` if this node exchanges data with a peer.
    pub fn is_wanted(&self, node: &NodeId) -> bool {
        self.peers.get(node).is_some_and(|peer| peer.is_wanted)
    }

    /// Returns `true` if a check may arrive.
    pub fn has_attempts(&self) -> bool {
        self.attempts() > 0
    }

    /// Returns the number of checks that were not sent because the offers paid for no more, and that of refused
    /// candidates.
    pub fn refusals(&self) -> (u64, u64) {
        (self.withheld, self.refused_candidates)
    }

    fn attempts(&self) -> usize {
        self.peers.values().filter(|peer| peer.attempt.is_some()).count()
    }

    /// Begins an attempt, in place of one under way.
    fn begin(&mut self, now: Instant, node: NodeId) {
        let is_controlling = self.own < node;
        let attempt = Attempt::new(now, is_controlling, &self.local, &mut self.rng);
        let question = PathQuestion { attempt: attempt.number() };
        let Some(peer) = self.peers.get_mut(&node) else { return };
        (peer.attempt, peer.retry_at) = (Some(Box::new(attempt)), None);
        self.outputs.push_back(DirectOutput::Shut { peer: node });
        self.outputs.push_back(DirectOutput::Ask { peer: node, question });
    }

    /// Lets an attempt go on, and passes on its results.
    fn advance(&mut self, now: Instant, node: NodeId) {
        let Some(attempt) = self.peers.get_mut(&node).and_then(|peer| peer.attempt.as_mut()) else { return };
        let Progress { sent, admitted, dialled } = attempt.advance(now, &mut self.withheld);
        let over = attempt.over(now);
        for (from, to, datagram) in sent {
            self.outputs.push_back(DirectOutput::Send { from, to, datagram });
        }
        for from in admitted {
            self.outputs.push_back(DirectOutput::Admit { peer: node, from });
        }
        if let Some(to) = dialled {
            self.outputs.push_back(DirectOutput::Dial { peer: node, to });
        }
        if let Some(why) = over {
            self.fail(now, node, why);
        }
    }

    fn fail(&mut self, now: Instant, node: NodeId, why: NoDirectPath) {
        self.outputs.push_back(DirectOutput::Leave { peer: node });
        self.outputs.push_back(DirectOutput::Shut { peer: node });
        self.wait(now, node, why);
    }

    /// Lets a peer wait for the next attempt.
    fn wait(&mut self, now: Instant, node: NodeId, why: NoDirectPath) {
        let Some(peer) = self.peers.get_mut(&node) else { return };
        peer.attempt = None;
        if peer.is_reached() {
            // The link stays. A better path is looked for when the network changes again.
            peer.retry_at = None;
            return;
        }
        peer.failures = peer.failures.saturating_add(1);
        peer.why_not = why;
        peer.retry_at = Some(now + doubled(RETRY_MIN, peer.failures, RETRY_MAX, &mut self.rng));
    }
}

/// Draws bytes.
fn draw<const N: usize>(rng: &mut ChaCha20Rng) -> [u8; N] {
    let mut bytes = [0; N];
    rng.fill_bytes(&mut bytes);
    bytes
}

#[cfg(test)]
mod tests;
