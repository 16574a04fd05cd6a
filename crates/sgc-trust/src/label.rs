//! The names that people give to nodes, groups and fleets, checked once when they are made.
//!
//! They never travel: certificates carry keyed hashes of them ([`crate::FleetSecret::pseudonym`]). Because the hashes
//! cover the exact bytes, only one spelling is allowed: lower case, no spaces.

use std::fmt;
use std::str::FromStr;

/// The group whose members may ask every node of their fleet how it is doing, unless a node names others.
pub const OBSERVERS_GROUP: &str = "observers";

/// Most groups of one node: that many fit into [`sgc_wire::CERT_BYTES_MAX`].
pub const GROUPS_MAX: usize = 32;
/// Longest name of a node, group or fleet, bytes.
pub const LABEL_BYTES_MAX: usize = 64;

/// The reason why a text is no name of a node, group or fleet.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LabelError {
    /// The text is empty.
    #[error("a {kind} name cannot be empty")]
    Empty {
        /// Node, group or fleet.
        kind: &'static str,
    },
    /// Too long.
    #[error("a {kind} name has at most {LABEL_BYTES_MAX} characters, this one has {bytes}")]
    TooLong {
        /// Node, group or fleet.
        kind: &'static str,
        /// Its length.
        bytes: usize,
    },
    /// The name starts with a dot, a dash or an underscore.
    #[error("{kind} name {found:?} has to start with a letter or a digit")]
    Start {
        /// Node, group or fleet.
        kind: &'static str,
        /// The text.
        found: String,
    },
    /// A character that names do not have.
    #[error("{kind} name {found:?} cannot contain {character:?}: use a-z, 0-9, '-', '_' and '.'")]
    Character {
        /// Node, group or fleet.
        kind: &'static str,
        /// The text.
        found: String,
        /// The first offending character.
        character: char,
    },
}

macro_rules! label {
    ($(#[$doc:meta])* $name:ident, $kind:literal) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(Box<str>);

        impl $name {
            /// Returns the text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = LabelError;

            fn from_str(text: &str) -> Result<Self, LabelError> {
                check($kind, text).map(|()| Self(text.into()))
            }
        }

        impl AsRef<str> for $name {
            fn as_ref(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!(stringify!($name), "({:?})"), self.as_str())
            }
        }
    };
}

label!(
    /// The name of a node inside its fleet: `arm-1`. One to 64 of a-z, 0-9, '-', '_' and '.'.
    NodeName, "node"
);
label!(
    /// The name of a group of nodes: `operators`. Spelt as a [`NodeName`].
    GroupName, "group"
);
label!(
    /// The name of a fleet, for people only. Spelt as a [`NodeName`].
    FleetName, "fleet"
);

fn check(kind: &'static str, text: &str) -> Result<(), LabelError> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '-' | '_' | '.');
    let found = || text.to_owned();
    match text.chars().next() {
        None => Err(LabelError::Empty { kind }),
        Some(_) if text.len() > LABEL_BYTES_MAX => Err(LabelError::TooLong { kind, bytes: text.len() }),
        Some(first) => match text.chars().find(|c| !allowed(*c)) {
            Some(character) => Err(LabelError::Character { kind, found: found(), character }),
            None if !first.is_ascii_alphanumeric() => Err(LabelError::Start { kind, found: found() }),
            None => Ok(()),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_one_spelling_is_allowed() {
        for good in ["arm-1", "a", "0", "lab.arm_2", &"x".repeat(LABEL_BYTES_MAX)] {
            assert_eq!(good.parse::<NodeName>().unwrap().as_str(), good);
        }
        let refused = |text: &str| text.parse::<GroupName>().unwrap_err();
        assert_eq!(refused(""), LabelError::Empty { kind: "group" });
        assert!(matches!(refused(&"x".repeat(65)), LabelError::TooLong { bytes: 65, .. }));
        assert!(matches!(refused("-a"), LabelError::Start { .. }));
        for (text, character) in
            [("Arm", 'A'), ("a b", ' '), ("a:b", ':'), ("a/b", '/'), ("ü", 'ü'), ("a\n", '\n')]
        {
            assert!(matches!(refused(text), LabelError::Character { character: c, .. } if c == character));
        }
    }
}
