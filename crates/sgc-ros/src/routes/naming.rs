//! Naming: the interfaces that a rule names or matches with `*` and `**`, and their names on the other side.

use crate::interface::Part;

/// Names that `namespace` does not change, because programs look for exactly these for all robots together (tf2's
/// listeners; rqt_console). `/clock` is not among them, because two clocks would make time jump.
pub const GLOBAL_TOPICS: [&str; 3] = ["/tf", "/tf_static", "/rosout"];
/// Names that no wildcard shares, because every ROS 2 node publishes on them.
pub const LITERAL_TOPICS: [&str; 2] = ["/rosout", "/parameter_events"];

/// The exceptions of a rule and its renaming.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Naming {
    /// Names and patterns that the rule does not cover.
    pub except: Vec<String>,
    /// The renaming.
    pub rename: Rename,
}

/// The name of an interface on the other side: for others if it is shared, here if it is used.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Rename {
    /// The same name.
    #[default]
    Keep,
    /// This name. If the rule's topic ends in a wildcard, this does too, and it stands for the same words.
    As(String),
    /// The same name below this namespace, except for [`GLOBAL_TOPICS`].
    Namespace(String),
}

impl Naming {
    /// Returns the name of `name` on the other side, under a rule for `topic`.
    pub fn renamed(&self, topic: &str, name: &str) -> String {
        match &self.rename {
            Rename::Keep => name.to_owned(),
            Rename::As(other) if is_pattern(topic) => {
                let stem = |text: &str| text.rfind('/').map_or(0, |at| at);
                let (topic, other) = (&topic[..stem(topic)], &other[..stem(other)]);
                name.strip_prefix(topic).map_or_else(|| name.to_owned(), |rest| format!("{other}{rest}"))
            }
            Rename::As(other) => other.clone(),
            Rename::Namespace(_) if GLOBAL_TOPICS.contains(&name) => name.to_owned(),
            Rename::Namespace(namespace) => format!("{namespace}{name}"),
        }
    }

    /// Returns the naming for a part of the rule's interface.
    pub fn for_part(&self, part: &Part) -> Self {
        let rename = match &self.rename {
            Rename::As(other) => Rename::As(part.name(other)),
            other => other.clone(),
        };
        Self { except: self.except.clone(), rename }
    }

    /// Returns `true` if a share of `topic` covers the local interface `name`, unless another rule takes precedence.
    pub fn shares(&self, topic: &str, name: &str) -> bool {
        self.covers(topic, name) && (!is_pattern(topic) || is_for_wildcards(name))
    }

    /// Returns `true` if a rule for `topic` covers `name`.
    pub(super) fn covers(&self, topic: &str, name: &str) -> bool {
        match is_pattern(topic) {
            true => matches(topic, name) && !self.except.iter().any(|pattern| matches(pattern, name)),
            false => topic == name,
        }
    }
}

/// Returns `true` if a rule for `topic` may cover several interfaces.
pub fn is_pattern(topic: &str) -> bool {
    topic.contains('*')
}

/// Returns `true` if a name matches a pattern. `*` stands for one word, `**` for any number, but at least one at the
/// end.
pub fn matches(pattern: &str, name: &str) -> bool {
    let mut pattern: Vec<&str> = pattern.split('/').collect();
    if let Some(last) = pattern.last_mut().filter(|last| **last == "**") {
        *last = "*";
        pattern.push("**");
    }
    let name: Vec<&str> = name.split('/').collect();
    // Only the last `**` is tried at other places, because an earlier one never needs to match more.
    let (mut at, mut word, mut retry) = (0, 0, None);
    while word < name.len() {
        match pattern.get(at) {
            Some(&"**") => {
                retry = Some((at + 1, word));
                at += 1;
            }
            Some(token) if *token == "*" || *token == name[word] => {
                at += 1;
                word += 1;
            }
            _ => {
                let Some((after, taken)) = retry else { return false };
                retry = Some((after, taken + 1));
                (at, word) = (after, taken + 1);
            }
        }
    }
    pattern[at..].iter().all(|token| *token == "**")
}

/// Returns `true` if wildcards share the name. They skip topics that every node publishes, and names that ROS 2
/// hides, such as the parts of actions (`/_action/`).
pub fn is_for_wildcards(name: &str) -> bool {
    !LITERAL_TOPICS.contains(&name) && !name.split('/').any(|word| word.starts_with('_'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wildcards_match_words() {
        for (pattern, yes, no) in [
            ("/a", &["/a"][..], &["/a/b", "/b", "/aa"][..]),
            ("/*", &["/a", "/b_c"], &["/a/b"]),
            ("/**", &["/a", "/a/b", "/a/b/c"], &[]),
            ("/a/*", &["/a/b"], &["/a", "/a/b/c", "/ab/c"]),
            ("/a/**", &["/a/b", "/a/b/c"], &["/a", "/ab", "/b/a/c"]),
            ("/**/image", &["/image", "/a/image", "/a/b/image"], &["/image/raw", "/a/images"]),
            ("/a/**/b/*", &["/a/b/c", "/a/x/b/c", "/a/b/b/c", "/a/b/x/b/c"], &["/a/b", "/a/b/c/d", "/b/c"]),
            ("/*/a/**", &["/x/a/b"], &["/a/b", "/x/a"]),
            ("/**/a/**/b", &["/a/b", "/a/a/b/b", "/x/a/y/b"], &["/b/a", "/a/b/c"]),
        ] {
            assert!(yes.iter().all(|name| matches(pattern, name)), "{pattern} {yes:?}");
            assert!(!no.iter().any(|name| matches(pattern, name)), "{pattern} {no:?}");
        }
        // A mismatch is found quickly even in a hard case.
        let (pattern, name) = ("/**/a".repeat(40), "/a".repeat(120) + "/b");
        assert!(!matches(&pattern, &name));
    }

    #[test]
    fn other_names_stand_for_the_same_words() {
        let naming = |rename| Naming { except: Vec::new(), rename };
        let named = |other: &str| naming(Rename::As(other.into()));
        assert_eq!(named("/r/cam").renamed("/cam", "/cam"), "/r/cam");
        assert_eq!(named("/r/cam/**").renamed("/cam/**", "/cam/a/b"), "/r/cam/a/b");
        assert_eq!(named("/**").renamed("/cam/**", "/cam/a/b"), "/a/b");
        assert_eq!(named("/r/*").renamed("/*", "/a"), "/r/a");
        let spaced = naming(Rename::Namespace("/r".into()));
        assert_eq!(spaced.renamed("/**", "/a/b"), "/r/a/b");
        assert_eq!(GLOBAL_TOPICS.map(|name| spaced.renamed("/**", name)), GLOBAL_TOPICS);
        assert_eq!(spaced.renamed("/**", "/clock"), "/r/clock");
    }

    #[test]
    fn exceptions_count_for_wildcards_and_hidden_names_for_none() {
        let naming = Naming { except: vec!["/a/debug/**".into(), "/a/x".into()], ..Naming::default() };
        assert!(naming.covers("/a/**", "/a/b") && naming.covers("/a/**", "/a/debug"));
        assert!(!naming.covers("/a/**", "/a/debug/b") && !naming.covers("/a/**", "/a/x"));
        for name in ["/rosout", "/parameter_events", "/a/_action/feedback", "/_hidden"] {
            assert!(!is_for_wildcards(name), "{name}");
        }
        assert!(is_for_wildcards("/a_b/c_") && is_for_wildcards("/tf"));
    }
}
