//! Members in rules: finds names that the fleet file lacks, and names of which no member was heard.
//!
//! Certificates prove a node and its groups by keyed hashes. So a node can check whether a name, or a similar one, is
//! that of a member it has heard, but it cannot list names.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::{Duration, Instant};

use sgc_config::{Config, Recipient, nearest};
use sgc_trust::{Fleet, Grantees, Identity, VerifiedPeer};
use sgc_wire::{GroupTag, NodeId};

/// Most members that are remembered.
const HEARD_MAX: usize = 4096;
/// Most spellings that are tried for one member, which takes some milliseconds.
const SPELLINGS_MAX: usize = 4096;
/// How long a name must look misspelt until the log says so: after a start, members are heard one after the other.
const SUSPICION: Duration = Duration::from_secs(10);
/// Letters of names (`sgc_trust` label rule).
const LETTERS: &str = "abcdefghijklmnopqrstuvwxyz0123456789-_.";

/// Names of members in rules.
#[derive(Clone, Debug, Default)]
pub(crate) struct MemberNames {
    nodes: BTreeMap<NodeId, String>,
    groups: BTreeMap<GroupTag, String>,
    /// Names in `from`. Those in `nodes` and `groups` are of `to` and `publish`.
    owners: BTreeMap<NodeId, String>,
}

impl MemberNames {
    /// Collects the names of a configuration.
    pub(crate) fn from_config(config: &Config, identity: &Identity) -> Self {
        let mut names = Self::default();
        for recipient in config.shares.iter().flat_map(|share| share.to.iter().chain(&share.publish)) {
            match recipient {
                Recipient::Node(node) => {
                    let id = identity.node_id_of(node.as_str());
                    names.nodes.extend(id.map(|id| (id, node.to_string())));
                }
                Recipient::Group(group) => {
                    let tag = identity.fleet_secret().map(|secret| secret.group_tag(group.as_str()));
                    names.groups.extend(tag.map(|tag| (tag, group.to_string())));
                }
                Recipient::Everyone | Recipient::Partner(_) => {}
            }
        }
        for used in &config.uses {
            let id = identity.node_id_of(used.from.as_str());
            names.owners.extend(id.map(|id| (id, used.from.to_string())));
        }
        names
    }
}

/// A name in a rule of which no member was heard.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UnheardName {
    /// Name in the rule.
    pub(crate) written: String,
    /// Name of a heard member that differs by one letter.
    pub(crate) meant: Option<String>,
}

/// Members that were heard since the start, and the names in rules.
#[derive(Debug, Default)]
pub(crate) struct Members {
    names: MemberNames,
    nodes: BTreeSet<NodeId>,
    groups: BTreeSet<GroupTag>,
    /// Misspelt names with the probable spelling.
    meant: BTreeMap<String, Suspicion>,
    /// The same for names in `from`, also if the right spelling is in another rule.
    owners_meant: BTreeMap<String, String>,
}

/// A name that is probably misspelt.
#[derive(Debug)]
struct Suspicion {
    meant: String,
    since: Instant,
    is_told: bool,
}

impl Members {
    pub(crate) fn new(names: MemberNames, own: &Identity) -> Self {
        Self { names, nodes: [own.node_id()].into(), ..Self::default() }
    }

    /// Replaces the names by those of another configuration.
    pub(crate) fn set_names(&mut self, names: MemberNames, own: &Identity, now: Instant) {
        self.names = names;
        self.compare(own, now);
    }

    /// Notes a heard member.
    pub(crate) fn heard(&mut self, peer: &VerifiedPeer, own: &Identity, now: Instant) {
        if peer.ca == own.as_peer().ca && self.nodes.len() < HEARD_MAX && self.nodes.insert(peer.node_id) {
            let room = HEARD_MAX.saturating_sub(self.groups.len());
            self.groups.extend(peer.groups.iter().take(room));
            self.compare(own, now);
        }
    }

    /// Notes a node whose catalogue has come.
    pub(crate) fn heard_owner(&mut self, node: NodeId, own: &Identity, now: Instant) {
        if self.nodes.len() < HEARD_MAX && self.nodes.insert(node) {
            self.compare(own, now);
        }
    }

    /// Returns the misspelt names that the log should report now, each once, with the right spelling.
    pub(crate) fn take_misspelt(&mut self, now: Instant) -> Vec<(String, String)> {
        let mut due = Vec::new();
        for (written, suspicion) in &mut self.meant {
            if !suspicion.is_told
                && is_typing_error(written, &suspicion.meant)
                && suspicion.since + SUSPICION <= now
            {
                suspicion.is_told = true;
                due.push((written.clone(), suspicion.meant.clone()));
            }
        }
        due
    }

    /// Iterates over the misspelt names with the right spelling.
    pub(crate) fn misspelt(&self) -> impl Iterator<Item = (&str, &str)> {
        let all = self.meant.iter().map(|(written, suspicion)| (written.as_str(), suspicion.meant.as_str()));
        all.filter(|(written, meant)| is_typing_error(written, meant))
    }

    /// Returns the name of a heard member that differs by one letter from an owner's that was not heard.
    pub(crate) fn owner_meant(&self, written: &str) -> Option<&str> {
        self.owners_meant.get(written).map(String::as_str)
    }

    /// Returns the names in a policy of which no member was heard.
    pub(crate) fn unheard(&self, grantees: &Grantees) -> Vec<UnheardName> {
        let nodes = grantees.nodes.iter().filter(|id| !self.nodes.contains(*id));
        let nodes = nodes.filter_map(|id| self.names.nodes.get(id).cloned());
        let groups = grantees.groups.iter().filter(|(_, tag)| !self.groups.contains(tag));
        let groups = groups.filter_map(|(_, tag)| Some(group_word(self.names.groups.get(tag)?)));
        let name = |written: String| {
            let meant = self.meant.get(&written).map(|suspicion| suspicion.meant.clone());
            UnheardName { meant, written }
        };
        nodes.chain(groups).map(name).collect()
    }

    /// Compares spellings of the names in rules with heard members that no rule names. Names that were heard meanwhile
    /// are suspected no longer.
    fn compare(&mut self, own: &Identity, now: Instant) {
        let mut left = SPELLINGS_MAX;
        let mut spelt = |name: &str, is_heard: &dyn Fn(&str) -> bool| {
            let mut tried = 0;
            let found =
                spellings(name).take(left).inspect(|_| tried += 1).find(|spelling| is_heard(spelling));
            left -= tried;
            found
        };
        // No rule means its own node.
        let is_other = |id: &NodeId| self.nodes.contains(id) && *id != own.node_id();
        let (mut meant, mut owners_meant) = (BTreeMap::new(), BTreeMap::new());
        for (_, name) in self.names.nodes.iter().filter(|(id, _)| !self.nodes.contains(*id)) {
            let is_heard = |spelling: &str| {
                let id = own.node_id_of(spelling);
                id.is_some_and(|id| is_other(&id) && !self.names.nodes.contains_key(&id))
            };
            if let Some(spelling) = spelt(name, &is_heard) {
                meant.insert(name.clone(), spelling);
            }
        }
        for (_, name) in self.names.owners.iter().filter(|(id, _)| !self.nodes.contains(*id)) {
            let heard = |spelling: &str| own.node_id_of(spelling).filter(is_other);
            let Some(spelling) = spelt(name, &|spelling| heard(spelling).is_some()) else { continue };
            // Nodes of a fleet may have similar names, such as arm-left and arm-lift.
            if heard(&spelling).is_some_and(|id| !self.names.owners.contains_key(&id)) {
                meant.insert(name.clone(), spelling.clone());
            }
            owners_meant.insert(name.clone(), spelling);
        }
        for (_, name) in self.names.groups.iter().filter(|(tag, _)| !self.groups.contains(*tag)) {
            let is_heard = |spelling: &str| {
                let tag = own.fleet_secret().map(|secret| secret.group_tag(spelling));
                tag.is_some_and(|tag| self.groups.contains(&tag) && !self.names.groups.contains_key(&tag))
            };
            if let Some(spelling) = spelt(name, &is_heard) {
                meant.insert(group_word(name), group_word(&spelling));
            }
        }
        let mut before = std::mem::take(&mut self.meant);
        self.meant.extend(meant.into_iter().map(|(written, meant)| {
            let suspicion = match before.remove(&written) {
                Some(old) => Suspicion { meant, ..old },
                None => Suspicion { meant, since: now, is_told: false },
            };
            (written, suspicion)
        }));
        self.owners_meant = owners_meant;
    }
}

/// Returns `true` if a name differs from the meant one in more than its digits. Nodes of a series, such as arm-1 and
/// arm-2, are different nodes, and some of them may be off.
fn is_typing_error(written: &str, meant: &str) -> bool {
    let letters = |name: &str| name.chars().filter(|letter| !letter.is_ascii_digit()).collect::<String>();
    letters(written) != letters(meant)
}

fn group_word(group: &str) -> String {
    format!("group:{group}")
}

/// Iterates over names that differ by one letter: swapped, missing, replaced or added.
fn spellings(name: &str) -> impl Iterator<Item = String> {
    let letters: Vec<char> = name.chars().collect();
    let with = move |change: &dyn Fn(&mut Vec<char>)| {
        let mut changed = letters.clone();
        change(&mut changed);
        changed.into_iter().collect::<String>()
    };
    let len = name.chars().count();
    let mut all: Vec<String> = (1..len).map(|at| with(&|word| word.swap(at - 1, at))).collect();
    all.extend((0..len).map(|at| {
        with(&|word| {
            word.remove(at);
        })
    }));
    for letter in LETTERS.chars() {
        all.extend((0..len).map(|at| with(&|word| word[at] = letter)));
        all.extend((0..=len).map(|at| with(&|word| word.insert(at, letter))));
    }
    all.into_iter()
}

/// A name in a rule that the fleet file lacks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownMember {
    /// Key and interface of the rule.
    pub place: String,
    /// The name, after `group:` if it is a group's.
    pub name: String,
    /// A similar name of the fleet.
    pub nearest: Option<String>,
}

impl fmt::Display for UnknownMember {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = if self.name.starts_with("group:") {
            "no node of the fleet is in"
        } else {
            "the fleet has no node of"
        };
        write!(f, "{} names \"{}\", and {what} that", self.place, self.name)?;
        f.write_str(if self.name.starts_with("group:") { " group" } else { " name" })?;
        match &self.nearest {
            Some(nearest) => write!(f, "; did you mean \"{nearest}\"?"),
            None => Ok(()),
        }
    }
}

/// Returns the names in a configuration that the fleet file lacks. A file without a roster yields none.
pub fn unknown_members(config: &Config, fleet: &Fleet) -> Vec<UnknownMember> {
    if !fleet.has_roster() {
        return Vec::new();
    }
    let nodes: BTreeSet<&str> = fleet.nodes().map(|node| node.name.as_str()).collect();
    let groups: BTreeSet<String> =
        fleet.nodes().flat_map(|node| &node.groups).map(|group| group_word(group.as_str())).collect();
    let mut unknown = Vec::new();
    let mut check = |place: &dyn Fn() -> String, name: String| {
        let known: Vec<&str> = match name.starts_with("group:") {
            true => groups.iter().map(String::as_str).collect(),
            false => nodes.iter().copied().collect(),
        };
        if !known.contains(&name.as_str()) {
            let nearest = nearest(&name, &known).map(str::to_owned);
            unknown.push(UnknownMember { place: place(), name, nearest });
        }
    };
    let named = |recipient: &Recipient| {
        matches!(recipient, Recipient::Node(_) | Recipient::Group(_)).then(|| recipient.to_string())
    };
    for share in &config.shares {
        for (key, recipients) in [("to", &share.to), ("publish", &share.publish)] {
            let place = || format!("`{key}` of {}", share.topic);
            recipients.iter().filter_map(named).for_each(|name| check(&place, name));
        }
    }
    for used in &config.uses {
        check(&|| format!("`from` of {}", used.topic), used.from.to_string());
    }
    let operators = config.authority.iter().flat_map(|authority| &authority.operators);
    operators.filter_map(named).for_each(|name| check(&|| "`operators`".to_owned(), name));
    let observers = config.observers.iter().flatten();
    observers.filter_map(named).for_each(|name| check(&|| "`observers`".to_owned(), name));
    unknown
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use rand_core::{OsRng, TryRngCore as _};
    use sgc_trust::EnrollRequest;
    use sgc_wire::UnixMillis;

    use super::*;

    fn config(text: &str) -> Config {
        let text = format!("identity = 'arm.identity'\nnode.routers = ['quic://r:1']\n{text}");
        sgc_config::parse(&text, "node.toml", std::path::Path::new(""), &|_| None).unwrap()
    }

    fn members(fleet: &mut Fleet, names: [(&str, &[&str]); 2]) -> [Identity; 2] {
        names.map(|(name, groups)| {
            let mut request = EnrollRequest::new(name.parse().unwrap(), now());
            request.groups = groups.iter().map(|group| group.parse().unwrap()).collect();
            fleet.enroll(&request, &mut OsRng.unwrap_err()).unwrap()
        })
    }

    fn now() -> UnixMillis {
        crate::clock::now().unix
    }

    fn fleet() -> Fleet {
        Fleet::create("lab".parse().unwrap(), now(), &mut OsRng.unwrap_err()).unwrap()
    }

    const RULES: &str = "[[share]]\ntopic = '/a'\nto = ['deks', 'lamp', 'group:op', 'group:vision']\n\
                         [[use]]\nfrom = 'desk'\ntopic = '/b'\n";

    #[test]
    fn names_that_a_fleet_does_not_have_are_found_with_what_was_meant() {
        let mut fleet = fleet();
        members(&mut fleet, [("arm", &[]), ("desk", &["ops"])]);
        let found: Vec<_> = unknown_members(&config(RULES), &fleet).iter().map(ToString::to_string).collect();
        assert_eq!(
            found,
            [
                "`to` of /a names \"deks\", and the fleet has no node of that name; did you mean \"desk\"?",
                "`to` of /a names \"lamp\", and the fleet has no node of that name",
                "`to` of /a names \"group:op\", and no node of the fleet is in that group; did you mean \"group:ops\"?",
                "`to` of /a names \"group:vision\", and no node of the fleet is in that group",
            ]
        );
    }

    #[test]
    fn owner_in_a_use_is_compared_with_members_that_are_heard_of() {
        let mut fleet = fleet();
        let [arm, desk] = members(&mut fleet, [("arm", &[]), ("desk", &["ops"])]);
        let config = config("[[use]]\nfrom = 'deks'\ntopic = '/b'\n");
        let begun = Instant::now();
        let mut members = Members::new(MemberNames::from_config(&config, &arm), &arm);
        assert_eq!(members.owner_meant("deks"), None);
        members.heard(desk.as_peer(), &arm, begun);
        assert_eq!(members.misspelt().collect::<Vec<_>>(), [("deks", "desk")]);
        assert_eq!(members.owner_meant("deks"), Some("desk"));
        // A name that another rule has may be meant, but is no reason for a warning.
        let both = "[[use]]\nfrom = 'deks'\ntopic = '/b'\n[[use]]\nfrom = 'desk'\ntopic = '/c'\n";
        let mut members = Members::new(MemberNames::from_config(&super::tests::config(both), &arm), &arm);
        members.heard_owner(desk.node_id(), &arm, begun);
        assert_eq!(members.misspelt().next(), None);
        assert_eq!(members.owner_meant("deks"), Some("desk"));
    }

    #[test]
    fn names_are_compared_with_members_that_are_heard_of() {
        let mut fleet = fleet();
        let [arm, desk] = members(&mut fleet, [("arm", &[]), ("desk", &["ops"])]);
        let config = config(RULES);
        let begun = Instant::now();
        let mut members = Members::new(MemberNames::from_config(&config, &arm), &arm);
        let grantees =
            crate::control::settings::policy::grantees(&config.shares[0].to, &arm, &Default::default());
        let unheard = |members: &Members| -> BTreeMap<String, Option<String>> {
            members.unheard(&grantees).into_iter().map(|name| (name.written, name.meant)).collect()
        };
        assert!(unheard(&members).len() == 4 && unheard(&members).values().all(Option::is_none));
        members.heard(desk.as_peer(), &arm, begun);
        let pair = |a: &str, b: &str| (a.to_owned(), b.to_owned());
        assert_eq!(members.take_misspelt(begun), [], "the others may still be heard");
        let told = members.take_misspelt(begun + SUSPICION);
        assert_eq!(told, [pair("deks", "desk"), pair("group:op", "group:ops")]);
        assert_eq!(unheard(&members)["deks"].as_deref(), Some("desk"));
        assert_eq!(unheard(&members)["lamp"], None);
        members.heard(desk.as_peer(), &arm, begun);
        assert_eq!(members.take_misspelt(begun + 2 * SUSPICION), [], "said once");
        // A node of another fleet with this name is another node.
        let mut other = super::tests::fleet();
        let [_, stranger] = super::tests::members(&mut other, [("x", &[]), ("lamp", &["vision"])]);
        members.heard(stranger.as_peer(), &arm, begun);
        assert!(members.misspelt().count() == 2 && unheard(&members).contains_key("lamp"));
        // The corrected name belongs to a member that was heard before.
        let mut right = config.clone();
        right.shares[0].to = vec![Recipient::Node("desk".parse().unwrap())];
        members.set_names(MemberNames::from_config(&right, &arm), &arm, begun);
        assert!(members.misspelt().next().is_none());
        assert!(
            members
                .unheard(&crate::control::settings::policy::grantees(
                    &right.shares[0].to,
                    &arm,
                    &Default::default()
                ))
                .is_empty()
        );
    }

    #[test]
    fn similar_names_are_suspected_only_until_their_nodes_are_heard() {
        let mut fleet = fleet();
        let [arm, left] = members(&mut fleet, [("arm-1", &[]), ("left", &[])]);
        let [lift, third] = members(&mut fleet, [("lift", &[]), ("arm-3", &[])]);
        let config = config("[[share]]\ntopic = '/a'\nto = ['left', 'arm-2']\n");
        let begun = Instant::now();
        let mut members = Members::new(MemberNames::from_config(&config, &arm), &arm);
        let misspelt =
            |members: &Members| members.misspelt().map(|(written, _)| written.to_owned()).collect::<Vec<_>>();
        // The node's own name is near that of the second arm, and no other arm is suspected to be meant.
        members.heard(third.as_peer(), &arm, begun);
        assert_eq!(misspelt(&members), [] as [String; 0]);
        members.heard(lift.as_peer(), &arm, begun);
        assert_eq!(misspelt(&members), ["left"]);
        members.heard(left.as_peer(), &arm, begun);
        assert_eq!(misspelt(&members), [] as [String; 0]);
        assert_eq!(members.take_misspelt(begun + SUSPICION), []);
    }
}
