//! Rights in a fleet: the members that the recipients in nodes' rules stand for.
//!
//! Nodes report their rules as they are written. Which members are in a group, only the fleet's authority knows.

use std::collections::BTreeMap;

use serde::{Serialize, Serializer};
use sgc_node::admin::report::{ReportMember, ReportRights, ReportRule};

const EVERYONE: &str = "*";
const GROUP: &str = "group:";
const PARTNER: &str = "partner:";

/// The recipients in the rules of a fleet.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Recipients {
    /// The members that are not revoked, by name. Those that only route are among them, since an owner judges their
    /// certificates like others.
    pub members: Vec<String>,
    /// The partners that rules name. Each node says itself which fleet a name means.
    pub partners: Vec<String>,
    /// The meaning of each recipient, by its words in rules.
    pub meanings: BTreeMap<String, Meaning>,
}

/// The meaning of a recipient.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Meaning {
    /// The members for which it stands, as places in [`Recipients::members`].
    pub members: Vec<usize>,
    /// The reason why it stands for nobody, though it should.
    pub doubt: Option<Doubt>,
}

/// Reasons why a recipient stands for no member.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Doubt {
    /// No member has this name.
    UnknownNode,
    /// The member is revoked.
    RevokedNode,
    /// No member is in the group.
    EmptyGroup,
    /// Not all members are known here.
    NotAllKnown,
}

impl Doubt {
    /// Returns the reason in words that follow the recipient.
    pub fn words(self) -> &'static str {
        match self {
            Self::UnknownNode => "no member has this name",
            Self::RevokedNode => "it is revoked",
            Self::EmptyGroup => "nobody is in it",
            Self::NotAllKnown => "it is not among the members that are known here",
        }
    }
}

impl Serialize for Doubt {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.words())
    }
}

impl Recipients {
    /// Finds the members for which the recipients of `rights` stand. `nodes` are the nodes of the fleet with what its
    /// authority knows of them; `is_complete` tells whether these are all.
    pub fn new<'a>(
        nodes: impl Iterator<Item = (&'a str, Option<&'a ReportMember>)>,
        is_complete: bool,
        rights: impl Iterator<Item = &'a ReportRights>,
    ) -> Self {
        let nodes: BTreeMap<_, _> = nodes.collect();
        let is_here = |member: &&ReportMember| member.revoked_ms.is_none();
        let here = nodes.iter().filter(|(_, member)| member.as_ref().is_none_or(is_here));
        let here: Vec<_> = here.map(|(name, member)| (*name, *member)).collect();
        let mut found =
            Self { members: here.iter().map(|(name, _)| (*name).to_owned()).collect(), ..Self::default() };
        let words = rights.flat_map(|rights| {
            let of_rules = rights.rules.iter().flat_map(|rule| rule.to.iter().chain(&rule.publish));
            of_rules.chain(&rights.observers).chain(&rights.operators)
        });
        for word in words {
            if found.meanings.contains_key(word) {
                continue;
            }
            let is_meant = |name: &str, member: Option<&ReportMember>| match word.strip_prefix(GROUP) {
                Some(group) => member.is_some_and(|member| member.groups.iter().any(|one| one == group)),
                // Routers are meant only by name or group.
                None if word == EVERYONE => member.is_none_or(|member| !member.router),
                None => word == name,
            };
            let meant = here.iter().enumerate().filter(|(_, (name, member))| is_meant(name, *member));
            let members: Vec<_> = meant.map(|(at, _)| at).collect();
            let doubt = match word.strip_prefix(PARTNER) {
                Some(_) => None,
                None if !members.is_empty() => None,
                None => Some(match nodes.get(word.as_str()).copied().flatten() {
                    Some(_) => Doubt::RevokedNode,
                    None if !is_complete => Doubt::NotAllKnown,
                    None if word.starts_with(GROUP) => Doubt::EmptyGroup,
                    None => Doubt::UnknownNode,
                }),
            };
            if let Some(partner) = word.strip_prefix(PARTNER) {
                found.partners.push(partner.to_owned());
            }
            found.meanings.insert(word.clone(), Meaning { members, doubt });
        }
        found.partners.sort();
        found
    }

    /// Returns recipients as a line, each unknown one with the reason.
    pub fn line(&self, words: &[String]) -> String {
        let word = |word: &String| match self.meanings.get(word).and_then(|meaning| meaning.doubt) {
            Some(doubt) => format!("{word} ({})", doubt.words()),
            None => word.clone(),
        };
        if words.is_empty() {
            "nobody".to_owned()
        } else {
            words.iter().map(word).collect::<Vec<_>>().join(", ")
        }
    }

    /// Returns a rule as a row: the interface, the recipients that may subscribe or call, and those that may publish.
    pub fn row(&self, rule: &ReportRule) -> Vec<String> {
        let is_topic = rule.kind == "topic";
        let mut interface =
            if is_topic { rule.interface.clone() } else { format!("{} {}", rule.kind, rule.interface) };
        if !rule.except.is_empty() {
            interface.push_str(&format!(" except {}", rule.except.join(", ")));
        }
        let mut to = self.line(&rule.to);
        for token in &rule.tokens {
            to.push_str(&format!(", token {token}"));
        }
        if rule.omitted > 0 {
            to.push_str(&format!(", {} more", rule.omitted));
        }
        vec![interface, to, if is_topic { self.line(&rule.publish) } else { "–".to_owned() }]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn member(name: &str, groups: &[&str]) -> ReportMember {
        let groups = groups.iter().map(|group| (*group).to_owned()).collect();
        ReportMember { name: name.into(), groups, ..ReportMember::default() }
    }

    fn members() -> Vec<ReportMember> {
        vec![
            member("arm", &["arms"]),
            ReportMember { router: true, ..member("cloud", &["arms"]) },
            member("desk", &["arms", "operators"]),
            ReportMember { revoked_ms: Some(1), ..member("stolen", &["arms", "thieves"]) },
        ]
    }

    fn rights(to: &[&str]) -> ReportRights {
        let to = to.iter().map(|word| (*word).to_owned()).collect();
        ReportRights { rules: vec![ReportRule { to, ..ReportRule::default() }], ..ReportRights::default() }
    }

    fn recipients(is_complete: bool, words: &[&str]) -> Recipients {
        let (members, rights) = (members(), rights(words));
        let nodes = members.iter().map(|member| (member.name.as_str(), Some(member)));
        // This node is no member that the authority knows, and reports.
        Recipients::new(nodes.chain([("guest", None)]), is_complete, std::iter::once(&rights))
    }

    #[test]
    fn groups_and_everyone_are_the_members_that_are_not_revoked() {
        let found = recipients(true, &["*", "group:arms", "group:operators", "desk", "guest", "desk"]);
        assert_eq!(found.members, ["arm", "cloud", "desk", "guest"]);
        for (word, names) in [
            ("*", &["arm", "desk", "guest"][..]),
            ("group:arms", &["arm", "cloud", "desk"]),
            ("group:operators", &["desk"]),
            ("desk", &["desk"]),
            ("guest", &["guest"]),
        ] {
            let meaning = &found.meanings[word];
            let meant: Vec<_> = meaning.members.iter().map(|at| found.members[*at].as_str()).collect();
            assert_eq!((&meant[..], meaning.doubt), (names, None), "{word}");
        }
    }

    #[test]
    fn recipient_that_stands_for_nobody_is_marked_with_the_reason() {
        for (word, is_complete, doubt) in [
            ("ghost", true, Some(Doubt::UnknownNode)),
            ("stolen", true, Some(Doubt::RevokedNode)),
            ("group:thieves", true, Some(Doubt::EmptyGroup)),
            ("group:arm", true, Some(Doubt::EmptyGroup)),
            ("ghost", false, Some(Doubt::NotAllKnown)),
            ("stolen", false, Some(Doubt::RevokedNode)),
            ("partner:acme", true, None),
            // A partner whose name a member has is not that member.
            ("partner:desk", true, None),
        ] {
            let found = recipients(is_complete, &[word]);
            let meaning = &found.meanings[word];
            assert_eq!((meaning.members.len(), meaning.doubt), (0, doubt), "{word} {is_complete}");
        }
        assert_eq!(recipients(true, &["partner:z", "partner:a", "partner:z"]).partners, ["a", "z"]);
    }

    #[test]
    fn row_of_a_rule_names_everybody_it_permits() {
        let found = recipients(true, &["desk", "ghost"]);
        let rule = ReportRule {
            kind: "topic".into(),
            interface: "/camera/**".into(),
            except: vec!["/camera/raw".into()],
            to: vec!["desk".into(), "ghost".into()],
            tokens: vec![3],
            omitted: 2,
            ..ReportRule::default()
        };
        let to = "desk, ghost (no member has this name), token 3, 2 more";
        assert_eq!(found.row(&rule), ["/camera/** except /camera/raw", to, "nobody"]);
        let service =
            ReportRule { kind: "service".into(), interface: "/reset".into(), ..ReportRule::default() };
        assert_eq!(found.row(&service), ["service /reset", "nobody", "–"]);
    }
}
