//! The number of a link.

use std::fmt;

/// A link of this node, by number. Numbers are never used again while the process lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkId(pub u32);

impl LinkId {
    /// The link to this node's own endpoint; always up.
    pub const LOCAL: Self = Self(0);
    /// The store, as the bringer of announcements. It is no link: nothing is sent over it.
    pub const STORE: Self = Self(u32::MAX);
}

impl fmt::Display for LinkId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::LOCAL => f.write_str("local"),
            Self::STORE => f.write_str("store"),
            Self(number) => write!(f, "link {number}"),
        }
    }
}
