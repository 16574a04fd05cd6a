//! Naming: selects the rule for an interface, and its name on the other side.
//!
//! A rule names one interface, or matches several with `*` and `**`. This module also resolves conflicts: an
//! interface that wildcards would both share and bring is carried one way only, and nothing is brought under a name
//! that ROS 2 does not allow.

use sgc_wire::{CatalogueEntry, Kind, Metadata, NodeId};

use super::{Direction, Problem, Routes, ShareRule, UseRule};
use crate::interface::Part;
use crate::names::is_topic_name;

/// Most interfaces that one wildcard rule shares or brings.
pub const ROUTES_PER_WILDCARD_MAX: usize = 512;
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
    fn covers(&self, topic: &str, name: &str) -> bool {
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

impl ShareRule {
    /// Returns `true` if the rule covers the local interface with this name.
    pub(super) fn covers(&self, kind: Kind, local_name: &str) -> bool {
        self.metadata.kind == kind && self.naming.shares(&self.metadata.ros_name, local_name)
    }

    /// Returns the metadata under which an interface is shared.
    pub fn metadata_of(&self, local_name: &str, type_name: &str) -> Metadata {
        let ros_name = self.naming.renamed(&self.metadata.ros_name, local_name);
        Metadata { ros_name, type_name: type_name.to_owned(), ..self.metadata.clone() }
    }

    /// Returns `true` if the rule may share several interfaces.
    pub fn is_pattern(&self) -> bool {
        is_pattern(&self.metadata.ros_name)
    }
}

impl UseRule {
    /// Returns `true` if the rule asks for this entry of the owner's catalogue.
    pub(super) fn covers(&self, owner: &NodeId, entry: &CatalogueEntry) -> bool {
        let may = match self.direction {
            Direction::Bring => entry.subscribe,
            Direction::Publish => entry.publish,
        };
        let Metadata { kind, ros_name, type_name, .. } = &entry.metadata;
        let is_of_type = || self.type_name.as_ref().is_none_or(|wanted| wanted == type_name);
        may && self.is_of_catalogue(owner)
            && self.kind == *kind
            && self.naming.covers(&self.topic, ros_name)
            && (!self.is_pattern() || is_of_type())
    }

    /// Returns the name on the local network.
    pub fn local_name(&self, metadata: &Metadata) -> String {
        self.naming.renamed(&self.topic, &metadata.ros_name)
    }

    /// Returns `true` if the rule may use several interfaces.
    pub fn is_pattern(&self) -> bool {
        is_pattern(&self.topic)
    }

    /// Returns `true` if the rule reserves exactly this local name, whatever the owner lists.
    fn claims(&self, kind: Kind, local_name: &str) -> bool {
        self.kind == kind && !self.is_pattern() && self.naming.renamed(&self.topic, &self.topic) == local_name
    }
}

impl<R> Routes<R> {
    /// Returns the rule that shares a local interface: the first that names it, else the first wildcard that covers
    /// it. Where the type is known, wildcard rules for other types are skipped.
    pub(super) fn share_rule(&self, kind: Kind, local_name: &str, type_name: Option<&str>) -> Option<usize> {
        let literal = |rule: &ShareRule| !rule.is_pattern() && rule.covers(kind, local_name);
        let named = self.share_rules.iter().position(literal);
        named.or_else(|| {
            let index = self.wildcard_share(kind, local_name, type_name)?;
            self.used_as(kind, local_name).is_none().then_some(index)
        })
    }

    fn wildcard_share(&self, kind: Kind, local_name: &str, type_name: Option<&str>) -> Option<usize> {
        let is_of_type = |rule: &ShareRule| {
            let wanted = rule.metadata.type_name.as_str();
            wanted.is_empty() || type_name.is_none_or(|found| found == wanted)
        };
        let covers =
            |rule: &ShareRule| rule.is_pattern() && rule.covers(kind, local_name) && is_of_type(rule);
        self.share_rules.iter().position(covers)
    }

    /// Returns the rule for an owner's entry: the first that names it, else the first wildcard that covers it.
    pub(super) fn use_rule(&self, owner: &NodeId, entry: &CatalogueEntry) -> Option<usize> {
        let find = |pattern| {
            let asks = |rule: &UseRule| rule.is_pattern() == pattern && rule.covers(owner, entry);
            self.use_rules.iter().position(asks)
        };
        find(false).or_else(|| find(true))
    }

    /// Returns the owner whose interface has this local name, by a rule that names it or a running route.
    fn used_as(&self, kind: Kind, local_name: &str) -> Option<&str> {
        let named = self.use_rules.iter().find(|rule| rule.claims(kind, local_name));
        let running = || {
            let has = |metadata: &Metadata, name: &str| metadata.kind == kind && name == local_name;
            let route = self.uses.values().find(|u| has(&u.entry.metadata, &u.local_name))?;
            Some(&self.use_rules[route.rule])
        };
        named.or_else(running).map(|rule| rule.owner_name.as_str())
    }

    /// Returns `true` if this local name is shared by a rule that names it or by a running route.
    fn is_shared_as(&self, kind: Kind, local_name: &str) -> bool {
        let literal = |rule: &ShareRule| !rule.is_pattern() && rule.covers(kind, local_name);
        let running = || kind == Kind::Topic && self.shares.values().any(|s| s.local_name == local_name);
        self.share_rules.iter().any(literal) || running()
    }

    /// Returns the problem if a local interface that a wildcard covers is not shared because the name is used.
    pub(super) fn why_not_shared(&self, kind: Kind, local_name: &str, type_name: &str) -> Option<Problem> {
        self.wildcard_share(kind, local_name, Some(type_name))?;
        let owner = self.used_as(kind, local_name)?.to_owned();
        Some(Problem::UsedNotShared { topic: local_name.to_owned(), owner })
    }

    /// Returns the problem that keeps an owner's entry from having its local name. Rules that name it were checked
    /// before.
    pub(super) fn why_not_used(&self, rule: usize, metadata: &Metadata) -> Option<Problem> {
        let rule = &self.use_rules[rule];
        if !rule.is_pattern() {
            return None;
        }
        let (topic, owner) = (rule.local_name(metadata), rule.owner_name.clone());
        if !is_topic_name(&metadata.ros_name) || !is_topic_name(&topic) {
            return Some(Problem::NoName { topic, owner });
        }
        self.is_shared_as(metadata.kind, &topic).then_some(Problem::SharedNotUsed { topic, owner })
    }
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
