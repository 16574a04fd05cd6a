//! Three rules by which routers learn the owners of names, behind one trait.
//!
//! A mapping decides which routers are told, and which are asked; `names/` keeps the records and sends the frames.
//! Routers with different mappings understand each other: a router asks for names that it is not told.

use crate::link_id::LinkId;

/// The mapping of a router.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MappingKind {
    /// Advertisements go to all routers, as in the paper (FogROS2-SGC, section IV): every router knows every name.
    #[default]
    Flood,
    /// Advertisements stay at the routers that the owner is attached to; others ask when somebody wants a name, and
    /// keep the answer for as long as it is wanted.
    Query,
    /// As [`Self::Query`], but routers keep advertisements in a store that they share, and look names up there before
    /// they ask.
    Store,
}

/// Knowledge of the place of a name that somebody waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NameLocation {
    /// Unknown, or its owner is out of reach.
    Unknown,
    /// Known from a router that tells all names, or from the store, which reports changes.
    Told,
    /// Known from an answer that came over this link.
    Answered(LinkId),
}

/// The routers to ask about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ask {
    Nobody,
    Everyone,
    /// One neighbour, so that it continues to tell changes.
    One(LinkId),
}

/// A rule by which names spread.
pub(crate) trait Mapping: std::fmt::Debug + Send + Sync {
    /// Returns `true` if routers are told of names that they did not ask for.
    fn tells_unasked(&self) -> bool;

    /// Returns the routers to ask about a name that somebody here waits for.
    fn ask(&self, known: NameLocation) -> Ask {
        match known {
            NameLocation::Unknown => Ask::Everyone,
            NameLocation::Told => Ask::Nobody,
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

/// The rule of [`MappingKind::Query`], and of [`MappingKind::Store`] for routers without that store.
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
            Self::Query | Self::Store => Box::new(Query),
        }
    }
}
