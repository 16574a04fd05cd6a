//! Policies of shares: builds a [`Policy`] from the configuration, and explains a decision in the words of the
//! configuration.
//!
//! The owner's policy decides when a join arrives. [`explain`] asks the same policy.

use std::fmt::Write as _;

use sgc_config::{Config, Recipient, ShareConfig};
use sgc_ros::{DeadManRule, Interface, Part, ShareRule};
use sgc_trust::{CaFingerprint, Grantees, Identity, Policy, VerifiedPeer};
use sgc_wire::{GroupTag, Kind, Metadata, NodeId, Role};

use crate::admin::report::{REPORT_RECIPIENTS_MAX, REPORT_RULES_MAX, ReportRights, ReportRule};
use crate::control::fleet::partners::Partners;

/// A node as its certificate proves it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Subject {
    /// The node.
    pub node: NodeId,
    /// The CA that certified it.
    pub ca: CaFingerprint,
    /// Its groups, sorted.
    pub groups: Vec<GroupTag>,
    /// Whether its certificate lets it route.
    pub may_route: bool,
}

impl From<&VerifiedPeer> for Subject {
    fn from(peer: &VerifiedPeer) -> Self {
        Self { node: peer.node_id, ca: peer.ca, groups: peer.groups.to_vec(), may_route: peer.may_route }
    }
}

/// Decision about a request, with its reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verdict {
    /// Whether it is granted.
    pub permitted: bool,
    /// The entry that admits the node, or the reason why none does.
    pub because: String,
}

/// Returns the policy of a share.
pub fn policy(share: &ShareConfig, identity: &Identity, partners: &Partners) -> Policy {
    let all = |recipients: &[Recipient]| grantees(recipients, identity, partners);
    let mut policy = Policy { subscribe: all(&share.to), publish: all(&share.publish) };
    // Tokens exist for topics only.
    if share.interface != Interface::Topic {
        return policy;
    }
    for grant in tokens_of(share, partners) {
        match grant.node {
            Some(node) => drop(policy.subscribe.nodes.insert(node)),
            None => drop(policy.subscribe.fleets.insert(grant.ca)),
        }
    }
    policy
}

/// Returns the rights that a configuration gives, in its words.
pub(crate) fn written_rights(config: &Config, partners: &Partners) -> ReportRights {
    let rules = config.shares.iter().take(REPORT_RULES_MAX).map(|share| written_rule(share, partners));
    let operators = config.authority.iter().flat_map(|authority| &authority.operators);
    ReportRights {
        rules: rules.collect(),
        rules_omitted: config.shares.len().saturating_sub(REPORT_RULES_MAX),
        observers: first(config.observers().iter().map(ToString::to_string), &mut 0),
        operators: first(operators.map(ToString::to_string), &mut 0),
    }
}

fn written_rule(share: &ShareConfig, partners: &Partners) -> ReportRule {
    let mut omitted = 0;
    let words = |list: &[Recipient]| list.iter().map(ToString::to_string).collect::<Vec<_>>();
    let is_topic = share.interface == Interface::Topic;
    ReportRule {
        kind: share.interface.key().to_owned(),
        interface: share.topic.clone(),
        except: first(share.naming.except.iter().cloned(), &mut omitted),
        type_name: share.type_name.clone(),
        to: first(words(&share.to), &mut omitted),
        publish: first(words(&share.publish), &mut omitted),
        tokens: first(tokens_of(share, partners).filter(|_| is_topic).map(|grant| grant.id), &mut omitted),
        omitted,
    }
}

/// Returns the first elements, as many as a report has room for, and counts the others.
fn first<T>(all: impl IntoIterator<Item = T>, omitted: &mut usize) -> Vec<T> {
    let mut all = all.into_iter();
    let kept = all.by_ref().take(REPORT_RECIPIENTS_MAX).collect();
    *omitted += all.count();
    kept
}

/// Returns the route rules of a share, one for each topic and service.
pub fn share_rules(
    share: &ShareConfig,
    dead_man: Option<&DeadManRule>,
    identity: &Identity,
    partners: &Partners,
) -> Vec<ShareRule> {
    let whole = metadata(share, identity.node_name().as_str());
    let policy = policy(share, identity, partners);
    let rule = |part: &Part| ShareRule {
        metadata: Metadata {
            kind: part.kind,
            ros_name: part.name(&share.topic),
            type_name: part.type_name(share.type_name.as_deref()).unwrap_or_default(),
            ..whole.clone()
        },
        naming: share.naming.for_part(part),
        policy: match part.kind {
            // A client publishes requests, and nobody subscribes to them.
            Kind::Service => Policy { subscribe: Grantees::default(), publish: policy.subscribe.clone() },
            _ => policy.clone(),
        },
        suite: share.suite,
        class: share.priority,
        dead_man: dead_man.cloned(),
        shaping: share.shaping,
        qos: share.qos,
        dedicated: share.dedicated,
    };
    share.interface.parts().iter().map(rule).collect()
}

/// Returns the metadata of a share's name. A pattern has one name for each matching topic.
pub fn metadata(share: &ShareConfig, owner: &str) -> Metadata {
    metadata_as(share, owner, &share.naming.renamed(&share.topic, &share.topic))
}

fn metadata_as(share: &ShareConfig, owner: &str, topic: &str) -> Metadata {
    let extra = share.metadata.clone();
    let type_name = share.type_name.clone().unwrap_or_default();
    Metadata {
        node: extra.node,
        author: extra.author,
        maintainer: extra.maintainer,
        interface: extra.interface,
        description: extra.description,
        unique: extra.unique,
        ..Metadata::topic(owner, topic, &type_name)
    }
}

/// Returns whether `subject` may join a share as `role`, and the deciding entry.
pub fn explain(
    share: &ShareConfig,
    identity: &Identity,
    partners: &Partners,
    subject: &Subject,
    role: Role,
) -> Verdict {
    let finds = |set: &Grantees| {
        let Subject { node, ca, groups, may_route } = subject;
        set.find_parts(node, ca, groups, *may_route).is_some()
    };
    if subject.node == identity.node_id() {
        return Verdict { permitted: true, because: "it is the owner".to_owned() };
    }
    let policy = policy(share, identity, partners);
    let (key, entries, set) = match role {
        Role::Subscribe => ("to", &share.to, &policy.subscribe),
        Role::Publish => ("publish", &share.publish, &policy.publish),
    };
    let permitted = finds(set);
    let admits = |recipient: &&Recipient| {
        let mut only = Grantees::default();
        add(&mut only, recipient, identity, partners);
        finds(&only)
    };
    if let Some(recipient) = entries.iter().find(admits) {
        let because = format!("`{key}` names \"{recipient}\": {}", admission_reason(recipient, partners));
        return Verdict { permitted, because };
    }
    let token = tokens_of(share, partners).find(|grant| match grant.node {
        Some(node) => node == subject.node,
        None => grant.ca == subject.ca,
    });
    if let Some(grant) = token.filter(|_| role == Role::Subscribe) {
        return Verdict { permitted, because: format!("token {} was given for it", grant.id) };
    }
    Verdict { permitted, because: why_not(share, identity, partners, subject, key, entries) }
}

fn tokens_of<'p>(
    share: &'p ShareConfig,
    partners: &'p Partners,
) -> impl Iterator<Item = &'p crate::control::fleet::partners::TokenGrant> {
    partners.tokens.iter().filter(|grant| {
        grant.topic == share.topic && share.type_name.as_ref().is_none_or(|t| *t == grant.type_name)
    })
}

/// Returns the grantees that these recipients name.
pub(crate) fn grantees(recipients: &[Recipient], identity: &Identity, partners: &Partners) -> Grantees {
    let mut all = Grantees::default();
    recipients.iter().for_each(|recipient| add(&mut all, recipient, identity, partners));
    all
}

fn add(set: &mut Grantees, recipient: &Recipient, identity: &Identity, partners: &Partners) {
    let own = identity.as_peer().ca;
    match recipient {
        Recipient::Everyone => {
            set.fleets.insert(own);
        }
        Recipient::Node(node) => set.nodes.extend(identity.node_id_of(node.as_str())),
        Recipient::Group(group) => {
            let tag = identity.group_tag(group.as_str());
            set.groups.extend(tag.map(|tag| (own, tag)));
        }
        Recipient::Partner(name) => match partners.configured.get(name) {
            Some(partner) if partner.nodes.is_empty() => set.fleets.extend(&partner.cas),
            Some(partner) => set.nodes.extend(&partner.nodes),
            None => {}
        },
    }
}

fn admission_reason(recipient: &Recipient, partners: &Partners) -> &'static str {
    match recipient {
        Recipient::Everyone => "it is a member of this fleet",
        Recipient::Node(_) => "that is this node",
        Recipient::Group(_) => "its certificate puts it into that group",
        Recipient::Partner(name) => match partners.configured.get(name) {
            Some(partner) if partner.nodes.is_empty() => "its certificate is of that partner's CA",
            _ => "its node id is listed in that [[partner]]",
        },
    }
}

fn why_not(
    share: &ShareConfig,
    identity: &Identity,
    partners: &Partners,
    subject: &Subject,
    key: &str,
    entries: &[Recipient],
) -> String {
    if entries.is_empty() {
        return format!("`{key}` of {} names nobody", share.topic);
    }
    let list: Vec<_> = entries.iter().map(|entry| format!("\"{entry}\"")).collect();
    let mut text = format!("`{key}` of {} names {}, and it is none of them", share.topic, list.join(", "));
    if subject.may_route && subject.ca == identity.as_peer().ca {
        text.push_str(": it may route, and \"*\" does not stand for such nodes, so name it or a group of it");
    }
    let is_partner = partners.configured.iter().find(|(_, p)| p.cas.contains(&subject.ca));
    if subject.ca == identity.as_peer().ca {
        let groups = subject.groups.len();
        let _ = write!(
            text,
            " (a member of this fleet, in {groups} group{})",
            if groups == 1 { "" } else { "s" }
        );
    } else if let Some((name, partner)) = is_partner {
        let listed = partner.nodes.is_empty() || partner.nodes.contains(&subject.node);
        let not = if listed { "" } else { ", but not one of the nodes listed there" };
        let _ = write!(text, " (a node of partner \"{name}\"{not})");
    } else {
        text.push_str(" (a node of another fleet that no [[partner]] describes)");
    }
    text
}
