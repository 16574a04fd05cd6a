//! [`Questions`]: the names that are asked for here, and the questions of other routers.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use sgc_wire::{Name, NodeId};

use crate::limits::Limits;
use crate::link_id::LinkId;
use crate::shares::Shares;

/// Time for which a router that asked is told of new owners.
const QUERY_LEASE: Duration = Duration::from_secs(60);
/// Least time after which the same question is passed on again.
pub(super) const QUERY_AGAIN: Duration = Duration::from_secs(5);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum QuestionState {
    /// The answer is not known yet.
    Open,
    Answered,
}

/// A question that was passed on, or began here.
#[derive(Clone, Copy, Debug)]
struct Question {
    id: u64,
    at: Instant,
    state: QuestionState,
}

/// The consequence of a question for a name that is not known here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Asked {
    /// It is to be passed on.
    PassOn,
    /// The same question is under way.
    UnderWay,
    /// The router asks for too many names.
    TooMany,
}

/// Returns the keys of everything that was asked over a link.
fn all_of(link: LinkId) -> RangeInclusive<(LinkId, Name)> {
    (link, Name([0; 32]))..=(link, Name([0xff; 32]))
}

/// All questions.
#[derive(Debug)]
pub(super) struct Questions {
    /// Number that is mixed into those of questions.
    incarnation: u64,
    limits: Limits,
    /// Names that are asked for, with the time of the next question.
    asking: BTreeMap<Name, Instant>,
    ask_at: BTreeSet<(Instant, Name)>,
    /// The last question for a name that was passed on, charged to its bringer.
    passed_on: Shares<Name, Question>,
    /// Unknown names that routers asked for over a link, with the end of their interest.
    asks: Shares<(LinkId, Name), Instant>,
    /// Owners of names that a router asked for, and the end of its interest in changes.
    follows: BTreeMap<LinkId, BTreeMap<NodeId, Instant>>,
    /// Number of questions that began here.
    count: u64,
    prune_at: Option<Instant>,
}

impl Questions {
    pub(super) fn new(incarnation: u64, limits: &Limits) -> Self {
        Self {
            incarnation,
            limits: limits.clone(),
            asking: BTreeMap::new(),
            ask_at: BTreeSet::new(),
            passed_on: Shares::default(),
            asks: Shares::default(),
            follows: BTreeMap::new(),
            count: 0,
            prune_at: None,
        }
    }

    /// Forgets the questions of a link.
    pub(super) fn link_down(&mut self, link: LinkId) {
        self.asks.remove_range(all_of(link));
        self.follows.remove(&link);
    }

    /// Returns the times of the next question and of the next [`Self::prune`].
    pub(super) fn deadlines(&self) -> impl Iterator<Item = Instant> {
        self.ask_at.first().map(|(at, _)| *at).into_iter().chain(self.prune_at)
    }

    // ---- Names that are asked for here.

    /// Returns the time of the next question for a name.
    pub(super) fn due(&self, name: &Name) -> Option<Instant> {
        self.asking.get(name).copied()
    }

    /// Ends the questions for a name.
    pub(super) fn stop_asking(&mut self, name: &Name) {
        if let Some(at) = self.asking.remove(name) {
            self.ask_at.remove(&(at, *name));
        }
    }

    /// Asks for a name at that time.
    pub(super) fn ask_again(&mut self, name: Name, at: Instant) {
        self.stop_asking(&name);
        self.asking.insert(name, at);
        self.ask_at.insert((at, name));
    }

    /// Returns `true` if a question is due.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.ask_at.first().is_some_and(|(at, _)| *at <= now)
    }

    /// Returns a name for which a question is due, each once.
    pub(super) fn take_due(&mut self, now: Instant) -> Option<Name> {
        let (at, name) = self.ask_at.first().copied().filter(|(at, _)| *at <= now)?;
        self.ask_at.remove(&(at, name));
        Some(name)
    }

    /// Returns the number of a new question: unique, and without a trace of the asker.
    pub(super) fn next_id(&mut self) -> u64 {
        self.count += 1;
        // The odd factor gives different numbers to runs whose own numbers are near each other.
        let spread = self.count.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.incarnation.wrapping_add(spread)
    }

    // ---- Questions that are passed on.

    /// Returns `true` if an open question for the name was passed on, or it is asked for here.
    pub(super) fn is_open(&self, name: &Name) -> bool {
        let is_open = |question: &Question| question.state == QuestionState::Open;
        self.asking.contains_key(name) || self.passed_on.get(name).is_some_and(is_open)
    }

    /// Returns `true` if this very question for the name was passed on.
    pub(super) fn has_passed_on(&self, name: &Name, id: u64) -> bool {
        self.passed_on.get(name).is_some_and(|question| question.id == id)
    }

    /// Notes that the name is known.
    pub(super) fn answered(&mut self, name: &Name) {
        if let Some(question) = self.passed_on.get_mut(name) {
            question.state = QuestionState::Answered;
        }
    }

    /// Notes a question that `by` brought. Returns `false` if there is no room for it.
    pub(super) fn pass_on(&mut self, now: Instant, by: NodeId, id: u64, name: Name) -> bool {
        let question = Question { id, at: now, state: QuestionState::Open };
        // If a question were forgotten while copies of it are in flight, those would be passed on again.
        let is_settled = |question: &Question| question.at + QUERY_AGAIN <= now;
        self.passed_on.insert(by, name, question, self.limits.questions_max, is_settled)
    }

    // ---- Routers that asked.

    /// Notes that a router asks for a name that is not known here.
    pub(super) fn ask(&mut self, now: Instant, link: LinkId, node: NodeId, name: Name) -> Asked {
        let ask = (link, name);
        if !self.asks.contains(&ask) && self.asks.held_by(&node) >= self.limits.interests_per_peer_max {
            return Asked::TooMany;
        }
        self.asks.insert(node, ask, now + QUERY_LEASE, self.limits.asks_max, |_| true);
        let is_passed_on = |q: &Question| q.state == QuestionState::Open && q.at + QUERY_AGAIN > now;
        if self.passed_on.get(&name).is_some_and(is_passed_on) { Asked::UnderWay } else { Asked::PassOn }
    }

    /// Returns `true` if the router asked for the name, which was unknown.
    pub(super) fn asks(&self, link: LinkId, name: &Name) -> bool {
        self.asks.contains(&(link, *name))
    }

    /// Returns the number of names that the node asked for and that were unknown.
    pub(super) fn asked_by(&self, node: &NodeId) -> usize {
        self.asks.held_by(node)
    }

    /// Iterates over the names that the router behind a link asked for and that were unknown.
    pub(super) fn asked_over(&self, link: LinkId) -> impl Iterator<Item = &Name> {
        self.asks.keys(all_of(link)).map(|(_, name)| name)
    }

    /// Notes that a router is told these names of an owner, and of changes from now on. Returns `true` if it was not
    /// told of that owner's changes before.
    pub(super) fn follow(&mut self, now: Instant, link: LinkId, owner: &NodeId, names: &[Name]) -> bool {
        for name in names {
            self.asks.remove(&(link, *name));
        }
        let until = now + QUERY_LEASE;
        self.prune_at.get_or_insert(until);
        self.follows.entry(link).or_default().insert(*owner, until).is_none()
    }

    /// Returns `true` if the router is told of changes of the owner.
    pub(super) fn follows(&self, link: LinkId, owner: &NodeId) -> bool {
        self.follows.get(&link).is_some_and(|owners| owners.contains_key(owner))
    }

    /// Lets [`Self::prune`] happen once a question that was just noted is over.
    pub(super) fn prune_later(&mut self, now: Instant) {
        self.prune_at.get_or_insert(now + QUERY_LEASE);
    }

    /// Forgets questions that are over.
    pub(super) fn prune(&mut self, now: Instant) {
        if self.prune_at.is_none_or(|at| at > now) {
            return;
        }
        for owners in self.follows.values_mut() {
            owners.retain(|_, until| *until > now);
        }
        self.follows.retain(|_, owners| !owners.is_empty());
        self.asks.retain(|until| *until > now);
        self.passed_on.retain(|q| q.at + QUERY_LEASE > now);
        let all_idle = self.passed_on.is_empty() && self.asks.is_empty() && self.follows.is_empty();
        self.prune_at = (!all_idle).then(|| now + QUERY_LEASE);
    }
}
