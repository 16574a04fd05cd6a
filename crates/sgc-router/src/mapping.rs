//! How it becomes known which node owns a name: two ways, behind one trait.
//!
//! A mapping decides who is told of what, and who is asked; `names.rs` keeps what is known and sends the frames.
//! Routers with different mappings understand each other: what one is not told, it asks for.

use crate::router::LinkId;

/// Which mapping a router uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MappingKind {
    /// Advertisements go to all routers, as in the paper (FogROS2-SGC, section IV): every router knows every name.
    #[default]
    Flood,
    /// Advertisements stay at the routers that the owner is attached to; others ask when somebody wants a name, and keep
    /// the answer for as long as it is wanted.
    Query,
}

/// What is known of a name that somebody waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NameLocation {
    /// Nothing, or its owner is nowhere in reach.
    Unknown,
    /// Where it is, from one who tells everybody.
    Flooded,
    /// Where it is, as an answer that came over this link.
    Answered(LinkId),
}

/// Whom to ask about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ask {
    Nobody,
    Everyone,
    /// So that this neighbour goes on telling of changes.
    One(LinkId),
}

/// How names spread.
pub(crate) trait Mapping: std::fmt::Debug + Send + Sync {
    /// Returns `true` if routers are told of names that they did not ask for.
    fn tells_unasked(&self) -> bool;

    /// Whom to ask about a name that somebody here waits for.
    fn ask(&self, known: NameLocation) -> Ask {
        match known {
            NameLocation::Unknown => Ask::Everyone,
            NameLocation::Flooded => Ask::Nobody,
            NameLocation::Answered(link) => Ask::One(link),
        }
    }
}

#[derive(Debug)]
struct Flood;

impl Mapping for Flood {
    fn tells_unasked(&self) -> bool {
        true
    }
}

#[derive(Debug)]
struct Query;

impl Mapping for Query {
    fn tells_unasked(&self) -> bool {
        false
    }
}

impl MappingKind {
    pub(crate) fn build(self) -> Box<dyn Mapping> {
        match self {
            Self::Flood => Box::new(Flood),
            Self::Query => Box::new(Query),
        }
    }
}
