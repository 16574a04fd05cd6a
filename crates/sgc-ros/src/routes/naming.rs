//! Which rule an interface falls under, and what it is called on the other side. Whatever begins a route asks here.
//!
//! A rule names one interface, or with `*` and `**` those that match. Names are judged here as well: one that a wildcard
//! would both share and bring is carried one way only, and nothing is brought under a name that ROS 2 has no room for.

use sgc_wire::{CatalogueEntry, Kind, Metadata, NodeId};

use super::{Direction, Problem, Routes, ShareRule, UseRule};
use crate::interface::Part;
use crate::names::is_topic_name;

/// Interfaces that one rule with a wildcard shares, or brings.
pub const ROUTES_PER_WILDCARD_MAX: usize = 512;
/// Names that `namespace` leaves as they are: programs look for them under exactly these, for all robots together
/// (tf2's listeners; rqt_console). `/clock` is not one of them: two of it would make time jump.
pub const GLOBAL_TOPICS: [&str; 3] = ["/tf", "/tf_static", "/rosout"];
/// Names that no wildcard shares: every node of a ROS 2 network publishes on them.
pub const LITERAL_TOPICS: [&str; 2] = ["/rosout", "/parameter_events"];

/// What a rule leaves out of what its wildcard covers, and what it calls the rest.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Naming {
    /// Names and patterns that the rule does not cover.
    pub except: Vec<String>,
    /// The other name.
    pub rename: Rename,
}

/// What an interface is called on the other side: for others if it is shared, here if it is used.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Rename {
    /// The same.
    #[default]
    Keep,
    /// This. If the rule's topic ends in a wildcard so does this, and stands for the same words.
    As(String),
    /// The same behind this, but for [`GLOBAL_TOPICS`].
    Namespace(String),
}

impl Naming {
    /// What `name` is called on the other side, under a rule for `topic`.
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

    /// The same for a part of the interface that the rule is for.
    pub fn of_part(&self, part: &Part) -> Self {
        let rename = match &self.rename {
            Rename::As(other) => Rename::As(part.name(other)),
            other => other.clone(),
        };
        Self { except: self.except.clone(), rename }
    }

    /// Whether a share of `topic` shares the local interface of this name, if no other rule stands above it.
    pub fn shares(&self, topic: &str, name: &str) -> bool {
        self.covers(topic, name) && (!is_pattern(topic) || is_for_wildcards(name))
    }

    /// Whether a rule for `topic` covers `name`.
    fn covers(&self, topic: &str, name: &str) -> bool {
        match is_pattern(topic) {
            true => matches(topic, name) && !self.except.iter().any(|pattern| matches(pattern, name)),
            false => topic == name,
        }
    }
}

/// Whether a rule for it may cover several interfaces.
pub fn is_pattern(topic: &str) -> bool {
    topic.contains('*')
}

/// Whether a name falls under a pattern: `*` is one word, `**` any number of them, at the end at least one.
pub fn matches(pattern: &str, name: &str) -> bool {
    let mut pattern: Vec<&str> = pattern.split('/').collect();
    if let Some(last) = pattern.last_mut().filter(|last| **last == "**") {
        *last = "*";
        pattern.push("**");
    }
    let name: Vec<&str> = name.split('/').collect();
    // Only the last `**` has to be tried at other places: what the ones before it took need never be more.
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

/// Whether a wildcard shares it: not what every node publishes, nor what ROS 2 hides, of which the topics within an action
/// are a part (`/_action/`).
pub fn is_for_wildcards(name: &str) -> bool {
    !LITERAL_TOPICS.contains(&name) && !name.split('/').any(|word| word.starts_with('_'))
}

impl ShareRule {
    /// Whether it shares the local interface of this name.
    pub(super) fn covers(&self, kind: Kind, local_name: &str) -> bool {
        self.metadata.kind == kind && self.naming.shares(&self.metadata.ros_name, local_name)
    }

    /// What it is shared as.
    pub fn metadata_of(&self, local_name: &str, type_name: &str) -> Metadata {
        let ros_name = self.naming.renamed(&self.metadata.ros_name, local_name);
        Metadata { ros_name, type_name: type_name.to_owned(), ..self.metadata.clone() }
    }

    /// Whether it may share several interfaces.
    pub fn is_pattern(&self) -> bool {
        is_pattern(&self.metadata.ros_name)
    }
}

impl UseRule {
    /// Whether it asks for what its owner lists so.
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

    /// What it is called on the local network.
    pub fn local_name(&self, metadata: &Metadata) -> String {
        self.naming.renamed(&self.topic, &metadata.ros_name)
    }

    /// Whether it may ask for several interfaces.
    pub fn is_pattern(&self) -> bool {
        is_pattern(&self.topic)
    }

    /// Whether it is for this one name on the local network, whatever its owner lists.
    fn claims(&self, kind: Kind, local_name: &str) -> bool {
        self.kind == kind && !self.is_pattern() && self.naming.renamed(&self.topic, &self.topic) == local_name
    }
}

impl<R> Routes<R> {
    /// The rule that shares a local interface: the first that names it, else the first whose wildcard covers it, of those
    /// that are for its type where that is known.
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

    /// The rule that asks for what an owner lists: the first that names it, else the first whose wildcard covers it.
    pub(super) fn use_rule(&self, owner: &NodeId, entry: &CatalogueEntry) -> Option<usize> {
        let find = |pattern| {
            let asks = |rule: &UseRule| rule.is_pattern() == pattern && rule.covers(owner, entry);
            self.use_rules.iter().position(asks)
        };
        find(false).or_else(|| find(true))
    }

    /// Whose interface has this name here, by a rule that names it or one that is brought or published on at present.
    fn used_as(&self, kind: Kind, local_name: &str) -> Option<&str> {
        let named = self.use_rules.iter().find(|rule| rule.claims(kind, local_name));
        let running = || {
            let has = |metadata: &Metadata, name: &str| metadata.kind == kind && name == local_name;
            let route = self.uses.values().find(|u| has(&u.entry.metadata, &u.local_name))?;
            Some(&self.use_rules[route.rule])
        };
        named.or_else(running).map(|rule| rule.owner_name.as_str())
    }

    /// Whether this name is shared here, by a rule that names it or at present.
    fn is_shared_as(&self, kind: Kind, local_name: &str) -> bool {
        let literal = |rule: &ShareRule| !rule.is_pattern() && rule.covers(kind, local_name);
        let running = || kind == Kind::Topic && self.shares.values().any(|s| s.local_name == local_name);
        self.share_rules.iter().any(literal) || running()
    }

    /// Why a local interface that a wildcard covers is not shared, if it is because it is used.
    pub(super) fn why_not_shared(&self, kind: Kind, local_name: &str, type_name: &str) -> Option<Problem> {
        self.wildcard_share(kind, local_name, Some(type_name))?;
        let owner = self.used_as(kind, local_name)?.to_owned();
        Some(Problem::UsedNotShared { topic: local_name.to_owned(), owner })
    }

    /// Why what an owner lists cannot be here under the name that a rule gives it. Rules that name it were judged before.
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
        // What takes time to refuse takes little.
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
