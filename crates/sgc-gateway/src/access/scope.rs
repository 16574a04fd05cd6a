//! The rights of a client: four lists of names and patterns, like those of a `[[share]]`.
//!
//! [`super::Access`] decides which scope a client gets.

use std::fmt;

use sgc_ros::{TOPIC_BYTES_MAX, is_topic_name, matches};
use sgc_wire::{DecodeError, Reader, Writer};

/// Most patterns of one scope, for all four rights together.
pub const SCOPE_PATTERNS_MAX: usize = 128;
/// Most bytes of all patterns of one scope, so that a token fits an HTTP header.
pub const SCOPE_BYTES_MAX: usize = 4096;

const EVERYTHING: &str = "/**";

/// An action of a client on an interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Right {
    /// Receive messages of a topic.
    Subscribe,
    /// Publish on a topic.
    Publish,
    /// Call a service, send goals to an action, or set and read a node's parameters under its own name.
    Call,
    /// Answer calls of a service, or carry out goals of an action.
    Serve,
}

impl Right {
    /// All rights, in the order in which tokens store them.
    pub const ALL: [Self; 4] = [Self::Subscribe, Self::Publish, Self::Call, Self::Serve];

    /// Returns the key of the right in a configuration and on the command line.
    pub fn key(self) -> &'static str {
        match self {
            Self::Subscribe => "subscribe",
            Self::Publish => "publish",
            Self::Call => "call",
            Self::Serve => "serve",
        }
    }
}

impl fmt::Display for Right {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.key())
    }
}

/// The rights of a client, empty by default. Each entry is the full name of an interface or a pattern: `*` matches
/// one word, `**` any number of words.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Scope {
    /// Topics that the client may receive.
    pub subscribe: Vec<String>,
    /// Topics that the client may publish on.
    pub publish: Vec<String>,
    /// Services and actions that the client may call.
    pub call: Vec<String>,
    /// Services and actions that the client may serve.
    pub serve: Vec<String>,
}

impl Scope {
    /// Returns the scope that permits everything.
    pub fn everything() -> Self {
        let all = || vec![EVERYTHING.to_owned()];
        Self { subscribe: all(), publish: all(), call: all(), serve: all() }
    }

    /// Returns `true` if the scope gives this right to the interface with this full name. Nothing permits an invalid
    /// ROS 2 name.
    pub fn permits(&self, right: Right, name: &str) -> bool {
        is_topic_name(name) && self.patterns(right).iter().any(|pattern| matches(pattern, name))
    }

    /// Returns the names and patterns of a right.
    pub fn patterns(&self, right: Right) -> &[String] {
        match right {
            Right::Subscribe => &self.subscribe,
            Right::Publish => &self.publish,
            Right::Call => &self.call,
            Right::Serve => &self.serve,
        }
    }

    /// Adds the rights of another scope, without duplicates.
    pub fn add(&mut self, other: &Self) {
        for right in Right::ALL {
            let own = self.patterns_mut(right);
            for pattern in other.patterns(right) {
                if !own.contains(pattern) {
                    own.push(pattern.clone());
                }
            }
        }
    }

    /// Returns `true` if the scope permits nothing.
    pub fn is_empty(&self) -> bool {
        Right::ALL.iter().all(|right| self.patterns(*right).is_empty())
    }

    /// Fails if the scope exceeds its bounds, permits nothing or contains an invalid pattern.
    pub fn check(&self) -> Result<(), ScopeError> {
        let all = || Right::ALL.into_iter().flat_map(|right| self.patterns(right));
        let (count, bytes) = (all().count(), all().map(String::len).sum());
        if count == 0 {
            return Err(ScopeError::Nothing);
        }
        if count > SCOPE_PATTERNS_MAX {
            return Err(ScopeError::TooMany { count });
        }
        if bytes > SCOPE_BYTES_MAX {
            return Err(ScopeError::TooLong { bytes });
        }
        match all().find(|pattern| !is_scope_pattern(pattern)) {
            Some(wrong) => Err(ScopeError::Pattern { pattern: wrong.clone() }),
            None => Ok(()),
        }
    }

    pub(super) fn encode(&self, w: &mut Writer) {
        Right::ALL.iter().for_each(|right| w.list(self.patterns(*right), |w, pattern| w.str(pattern)));
    }

    pub(super) fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let mut scope = Self::default();
        for right in Right::ALL {
            let pattern = |r: &mut Reader<'_>| r.str("pattern", TOPIC_BYTES_MAX);
            *scope.patterns_mut(right) = r.list(right.key(), SCOPE_PATTERNS_MAX, pattern)?;
        }
        Ok(scope)
    }

    fn patterns_mut(&mut self, right: Right) -> &mut Vec<String> {
        match right {
            Right::Subscribe => &mut self.subscribe,
            Right::Publish => &mut self.publish,
            Right::Call => &mut self.call,
            Right::Serve => &mut self.serve,
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_empty() {
            return f.write_str("nothing");
        }
        let mut first = true;
        for right in Right::ALL {
            let patterns = self.patterns(right);
            if !patterns.is_empty() {
                write!(f, "{}{right} {}", if first { "" } else { "; " }, patterns.join(" "))?;
                first = false;
            }
        }
        Ok(())
    }
}

/// Returns `true` for a valid name in which wildcards may stand for whole words.
fn is_scope_pattern(pattern: &str) -> bool {
    let words = pattern.split('/').map(|word| if matches!(word, "*" | "**") { "w" } else { word });
    pattern.len() <= TOPIC_BYTES_MAX && is_topic_name(&words.collect::<Vec<_>>().join("/"))
}

/// The reason why a scope is invalid.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScopeError {
    /// The scope permits nothing.
    #[error("it permits nothing: name at least one interface to subscribe to, publish on, call or serve")]
    Nothing,
    /// The scope has too many patterns.
    #[error(
        "it has {count} names and patterns, at most {SCOPE_PATTERNS_MAX} are allowed: use patterns, such as \"/arm/**\""
    )]
    TooMany {
        /// The number of patterns.
        count: usize,
    },
    /// The patterns have too many bytes.
    #[error(
        "its names and patterns have {bytes} bytes, at most {SCOPE_BYTES_MAX} are allowed: use patterns, such as \"/arm/**\""
    )]
    TooLong {
        /// The bytes of all patterns together.
        bytes: usize,
    },
    /// An entry is neither a name nor a pattern.
    #[error(
        "{pattern:?} is neither the full name of an interface (\"/arm/odom\") nor a pattern of such (\"/arm/*\", \"/**\")"
    )]
    Pattern {
        /// The entry.
        pattern: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scope(subscribe: &[&str]) -> Scope {
        Scope { subscribe: subscribe.iter().map(|s| (*s).to_owned()).collect(), ..Scope::default() }
    }

    #[test]
    fn a_right_to_one_thing_is_none_to_another() {
        let scope = Scope { publish: vec!["/cmd_vel".into()], ..scope(&["/arm/*", "/odom"]) };
        for (right, name, permitted) in [
            (Right::Subscribe, "/odom", true),
            (Right::Subscribe, "/odom2", false),
            (Right::Subscribe, "/arm/joint", true),
            (Right::Subscribe, "/arm", false),
            (Right::Subscribe, "/arm/joint/raw", false),
            (Right::Subscribe, "/cmd_vel", false),
            (Right::Publish, "/cmd_vel", true),
            (Right::Publish, "/odom", false),
            (Right::Call, "/odom", false),
            (Right::Serve, "/odom", false),
        ] {
            assert_eq!(scope.permits(right, name), permitted, "{right} {name}");
        }
    }

    #[test]
    fn everything_covers_all_names_and_nothing_else() {
        for right in Right::ALL {
            for name in ["/a", "/a/b/c", "/_hidden", "/navigate/_action/status"] {
                assert!(Scope::everything().permits(right, name), "{right} {name}");
                assert!(!Scope::default().permits(right, name), "{right} {name}");
            }
            for name in ["", "/", "a", "/a/", "//a", "/a b", "/**", "/\u{fc}"] {
                assert!(!Scope::everything().permits(right, name), "{right} {name:?}");
            }
        }
        assert_eq!(Scope::everything().check(), Ok(()));
    }

    #[test]
    fn invalid_scopes_are_explained() {
        assert_eq!(Scope::default().check(), Err(ScopeError::Nothing));
        for wrong in ["", "odom", "/arm*", "/a/", "/a b", "~/x", "/***", &format!("/{}", "a".repeat(300))] {
            assert_eq!(
                scope(&[wrong]).check(),
                Err(ScopeError::Pattern { pattern: wrong.into() }),
                "{wrong}"
            );
        }
        for right in ["/a", "/*", "/**", "/a/*/b", "/**/image", "/a/**/b"] {
            assert_eq!(scope(&[right]).check(), Ok(()), "{right}");
        }
        let many = vec!["/a"; SCOPE_PATTERNS_MAX + 1];
        assert_eq!(scope(&many).check(), Err(ScopeError::TooMany { count: SCOPE_PATTERNS_MAX + 1 }));
        let long = format!("/{}", "a".repeat(99));
        let bytes = 41 * long.len();
        assert_eq!(scope(&vec![long.as_str(); 41]).check(), Err(ScopeError::TooLong { bytes }));
    }

    #[test]
    fn scopes_add_up_and_say_what_they_permit() {
        let mut all = scope(&["/odom"]);
        all.add(&Scope { call: vec!["/plan".into()], ..scope(&["/odom", "/tf"]) });
        assert_eq!(all.to_string(), "subscribe /odom /tf; call /plan");
        assert_eq!(Scope::default().to_string(), "nothing");
    }
}
