//! The problems that the route machine reports to the user, and [`Problems`], those that exist now.
//!
//! Each problem has a cause, the endpoint or route that it concerns. When a cause changes, it is checked again, and
//! its new problems replace the old ones: they are reported when they begin, and forgotten when they end.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use sgc_wire::{ENTRY_SOURCES_MAX, Name, NodeId};

use super::local_graph::LOCAL_ENDPOINTS_MAX;
use super::rules::{ENTRIES_PER_RULE_MAX, ROUTES_PER_WILDCARD_MAX};
use crate::network::Guid;
use crate::qos::QosMismatch;

/// A mismatch between two sides, with both values and the fix.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum Problem {
    /// A local writer's type is not the one that the share names.
    #[error(
        "{topic}: shared as {expected}, but a local publisher has {found}; it is not shared. Change `type` in the [[share]] or the publisher"
    )]
    ShareType {
        /// Topic.
        topic: String,
        /// Type in the rule.
        expected: String,
        /// Type of the writer.
        found: String,
    },
    /// The owner shares another type than the rule asks for.
    #[error(
        "{topic}: {owner} shares it as {found}, but this node asks for {expected}. Change `type` in the [[use]] or at {owner}"
    )]
    UseType {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type in the rule.
        expected: String,
        /// Type in the catalogue.
        found: String,
    },
    /// A local endpoint on a used topic has another type than the owner shares.
    #[error("{topic}: {owner} shares it as {remote}, but a local {end} has {local}; the two will not talk")]
    LocalType {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type shared.
        remote: String,
        /// The kind of the local endpoint.
        end: LocalEnd,
        /// Type of the local endpoint.
        local: String,
    },
    /// Both sides call the type alike and mean different things (type hashes of REP 2016).
    #[error(
        "{topic}: {owner} has {type_name} with the hash {remote}, but a local {end} has it with {local}; each reads the other's messages wrong or not at all. Build both from one definition of {type_name}"
    )]
    LocalHash {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type on both sides.
        type_name: String,
        /// Hash of the owner's.
        remote: String,
        /// The kind of the local endpoint.
        end: LocalEnd,
        /// Hash of the local endpoint's.
        local: String,
    },
    /// Two publishers of one share have different definitions of the type.
    #[error(
        "{topic}: local publishers have different definitions of {type_name}, with the hashes {first} and {second}; subscribers read some messages wrong. Build both from one definition"
    )]
    ShareHash {
        /// Topic.
        topic: String,
        /// Type of both.
        type_name: String,
        /// One hash.
        first: String,
        /// Another.
        second: String,
    },
    /// A local subscriber asks for more than the far publisher offers.
    #[error(
        "{topic}: {offerer} offers {mismatch}; it receives nothing from there. {}", mismatch.fix(&offerer.to_string())
    )]
    LocalQos {
        /// Topic.
        topic: String,
        /// The offering side.
        offerer: Offerer,
        /// Where the two differ.
        mismatch: QosMismatch,
    },
    /// Local writers of one topic offer different QoS.
    #[error("{topic}: local publishers offer different QoS; it is shared with the weakest, {offered}")]
    MixedQos {
        /// Topic.
        topic: String,
        /// The combined offer.
        offered: String,
    },
    /// An owner shares one topic in too many forms.
    #[error(
        "{topic}: {owner} shares it in more than {ENTRIES_PER_RULE_MAX} forms; the rest is not brought here"
    )]
    TooManyEntries {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// Two owners' topics have one name here and different types.
    #[error(
        "{topic}: {owner} shares it as {found}, but what {other} shares has the same name here and is {known}: \
         subscribers hear one of the two. Give one another name, with `as` or `namespace` in its [[use]]"
    )]
    MergedTypes {
        /// Topic here.
        topic: String,
        /// The first owner.
        owner: String,
        /// Its type.
        found: String,
        /// The second owner.
        other: String,
        /// Its type.
        known: String,
    },
    /// A wildcard would share an interface that this node uses.
    #[error(
        "{topic}: a wildcard would share it, but this node uses it from {owner}, so that it is not shared. Put it into \
         `except` of the [[share]], or give what {owner} shares another name here, with `as` or `namespace` in the [[use]]"
    )]
    UsedNotShared {
        /// Topic here.
        topic: String,
        /// The owner.
        owner: String,
    },
    /// A wildcard would bring an interface that this node shares.
    #[error(
        "{topic}: {owner} shares it, but so does this node, so that it is not brought here. Put it into `except` of the \
         [[use]], or give it another name here, with `as` or `namespace`"
    )]
    SharedNotUsed {
        /// Topic here.
        topic: String,
        /// The owner.
        owner: String,
    },
    /// Two local topics would be shared under one name.
    #[error(
        "{topic}: would be shared as {called}, as which {other} is shared already; it is not shared. Change `as` or \
         `namespace` in one [[share]]"
    )]
    SharedAsOne {
        /// Topic here.
        topic: String,
        /// The shared name of both.
        called: String,
        /// The topic that is shared already.
        other: String,
    },
    /// The name is invalid in ROS 2.
    #[error(
        "{topic:?} of {owner} is no name for a topic of ROS 2, or too long a one; it is not brought here"
    )]
    NoName {
        /// The name here.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// The shared name is invalid in ROS 2.
    #[error(
        "{topic}: shared as {called:?} it would have too long a name; it is not shared. Take a shorter one"
    )]
    NoSharedName {
        /// Topic here.
        topic: String,
        /// The shared name.
        called: String,
    },
    /// A wildcard matches too many interfaces.
    #[error(
        "{topic}: more than {ROUTES_PER_WILDCARD_MAX} topics match; the rest is not {way}. Leave some out with \
         `except`, or split it into several rules"
    )]
    TooManyMatches {
        /// The pattern.
        topic: String,
        /// The way of the topics.
        way: Way,
    },
    /// The granted interface differs from the token.
    #[error(
        "{topic}: {owner} gives something else for the token than it says; it is not brought here. Ask for a new token"
    )]
    TokenEntry {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// The local network has too many endpoints.
    #[error(
        "the local network has more than {LOCAL_ENDPOINTS_MAX} endpoints; those beyond are not looked at"
    )]
    TooManyEndpoints,
    /// A topic has too many publishers to tell apart.
    #[error("{topic}: more than {ENTRY_SOURCES_MAX} publishers; the rest pass for one, with one history")]
    TooManySources {
        /// Topic.
        topic: String,
    },
}

/// A kind of local endpoint of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum LocalEnd {
    /// A publisher.
    Publisher,
    /// A subscriber.
    Subscriber,
}

impl fmt::Display for LocalEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Publisher => "publisher",
            Self::Subscriber => "subscriber",
        })
    }
}

/// The way of the topics of a rule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Way {
    /// From another node to this one.
    Brought,
    /// From this node to others.
    Shared,
}

impl fmt::Display for Way {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Brought => "brought here",
            Self::Shared => "shared",
        })
    }
}

/// The side whose offer a local subscriber does not accept.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Offerer {
    /// The owner of a used topic, by its name.
    Owner(String),
    /// A node that publishes on a topic of this node.
    Publisher,
}

impl fmt::Display for Offerer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Owner(name) => f.write_str(name),
            Self::Publisher => f.write_str("the node that publishes on it"),
        }
    }
}

/// Most problems that are tracked at once. Further ones are not reported.
const PROBLEMS_MAX: usize = 4096;

/// The cause of a problem.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cause {
    /// The local network.
    Network,
    /// A local endpoint.
    Endpoint(Guid),
    /// A local publisher that a rule covers and that is not shared.
    Unshared(Guid),
    /// The shares that exist for messages of others.
    Inbound,
    /// A share route.
    Share(Name),
    /// An owner's catalogue.
    Catalogue(NodeId),
    /// The grant for a token.
    Token(Name),
}

/// The current problems.
#[derive(Debug, Default)]
pub(super) struct Problems {
    by_cause: BTreeMap<Cause, BTreeSet<Problem>>,
    /// The number of causes of each problem.
    holding: BTreeMap<Problem, usize>,
    /// `true` if the state that local endpoints are compared with has changed.
    is_stale: bool,
}

impl Problems {
    /// Adds a problem. Returns `true` if it is new.
    pub(super) fn add(&mut self, cause: Cause, problem: Problem) -> bool {
        if !self.holding.contains_key(&problem) && self.holding.len() >= PROBLEMS_MAX {
            return false;
        }
        if !self.by_cause.entry(cause).or_default().insert(problem.clone()) {
            return false;
        }
        let holders = self.holding.entry(problem).or_default();
        *holders += 1;
        *holders == 1
    }

    /// Replaces the problems of a cause and returns the new ones.
    pub(super) fn settle(&mut self, cause: Cause, problems: BTreeSet<Problem>) -> Vec<Problem> {
        let before = self.take(cause);
        let begun =
            problems.into_iter().filter(|p| self.add(cause, p.clone()) && !before.contains(p)).collect();
        self.release(before);
        begun
    }

    /// Removes and returns the problems of a cause. They hold until [`Self::release`], so that a problem added again
    /// meanwhile is not new.
    pub(super) fn take(&mut self, cause: Cause) -> BTreeSet<Problem> {
        self.by_cause.remove(&cause).unwrap_or_default()
    }

    /// Ends the taken problems, except those that were added again.
    pub(super) fn release(&mut self, taken: BTreeSet<Problem>) {
        for problem in taken {
            if let Some(holders) = self.holding.get_mut(&problem) {
                *holders -= 1;
                if *holders == 0 {
                    self.holding.remove(&problem);
                }
            }
        }
    }

    /// Iterates over the current problems, each once, in a fixed order.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Problem> {
        self.holding.keys()
    }

    /// Notes that the state has changed that local endpoints are compared with.
    pub(super) fn mark_stale(&mut self) {
        self.is_stale = true;
    }

    /// Returns `true` once after each [`Self::mark_stale`].
    pub(super) fn take_stale(&mut self) -> bool {
        std::mem::take(&mut self.is_stale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem(n: usize) -> Problem {
        Problem::TooManySources { topic: n.to_string() }
    }

    #[test]
    fn problem_holds_until_its_last_cause_ends_and_is_reported_again() {
        let mut problems = Problems::default();
        let [a, b] = [1, 2].map(|n| Cause::Endpoint(Guid([n; 16])));
        assert!(problems.add(a, problem(1)) && !problems.add(a, problem(1)));
        assert_eq!(problems.settle(b, [problem(1), problem(2)].into()), [problem(2)]);
        assert_eq!(problems.settle(a, BTreeSet::new()), []);
        assert_eq!(problems.settle(b, [problem(1)].into()), []);
        assert_eq!(problems.holding, [(problem(1), 1)].into());
        assert_eq!(problems.settle(b, BTreeSet::new()), []);
        assert_eq!((problems.holding.len(), problems.by_cause.len()), (0, 0));
        assert_eq!(problems.settle(b, [problem(1)].into()), [problem(1)]);
    }

    #[test]
    fn there_is_an_end_to_them() {
        let mut problems = Problems::default();
        for n in 0..2 * PROBLEMS_MAX {
            problems.add(Cause::Network, problem(n));
        }
        assert_eq!(problems.holding.len(), PROBLEMS_MAX);
        problems.settle(Cause::Network, BTreeSet::new());
        assert!(problems.add(Cause::Network, problem(0)));
    }
}
