//! What the route machine knows, for who looks at it from outside. Nothing here changes anything.

use sgc_endpoint::RefusedBy;
use sgc_trust::{Policy, name_of};
use sgc_wire::{CatalogueEntry, Kind, Metadata, Name, NodeId, PayloadForm, Qos};

use super::{Direction, Routes};
use crate::names::ros_type;
use crate::network::{DiscoveredEndpoint, Guid};
use crate::qos::weakest;

/// A rule of what is shared, and what runs of it.
#[derive(Clone, Debug)]
pub struct ShareView<'a> {
    /// What the rule says.
    pub metadata: &'a Metadata,
    /// Who may join.
    pub policy: &'a Policy,
    /// What runs.
    pub routes: Vec<ShareRouteView>,
}

/// A shared interface.
#[derive(Clone, Debug)]
pub struct ShareRouteView {
    /// What it is called on the local network.
    pub local_name: String,
    /// ROS type.
    pub type_name: String,
    /// Its name.
    pub name: Name,
    /// Local publishers.
    pub writers: usize,
    /// Granted subscribers.
    pub sinks: usize,
    /// Whether the local publishers are read.
    pub is_read: bool,
    /// Whether what others publish is written here; whether others can call it, if it is a service.
    pub is_written: bool,
    /// What the local publishers offer together.
    pub qos: Option<Qos>,
    /// What their messages are written in on their way.
    pub form: PayloadForm,
}

/// A rule of what is used, and what runs of it.
#[derive(Clone, Debug)]
pub struct UseView<'a> {
    /// Which way.
    pub direction: Direction,
    /// What kind of interface.
    pub kind: Kind,
    /// What it asks for.
    pub topic: &'a str,
    /// What that is called on the local network.
    pub local_topic: String,
    /// The type that it asks for.
    pub wanted_type: Option<&'a str>,
    /// Whose.
    pub owner: NodeId,
    /// The owner's name, for people.
    pub owner_name: &'a str,
    /// What is wrong with the owner, if anything.
    pub owner_state: Option<&'a str>,
    /// Whether the owner's catalogue is here.
    pub has_catalogue: bool,
    /// The name that a token leads to, and why it was refused.
    pub token: Option<(Name, Option<RefusedBy>)>,
    /// What runs.
    pub routes: Vec<UseRouteView<'a>>,
}

/// An interface of another node.
#[derive(Clone, Debug)]
pub struct UseRouteView<'a> {
    /// What it is called on the local network.
    pub local_name: String,
    /// As its owner lists it.
    pub entry: &'a CatalogueEntry,
    /// Its name.
    pub name: Name,
    /// What this node's messages on it are written in, if it publishes.
    pub form: PayloadForm,
    /// Whether its owner granted it.
    pub is_granted: bool,
    /// Who refused it, and why.
    pub refused: Option<RefusedBy>,
    /// Writers for it on the local network; a server, if it is a service.
    pub writers: usize,
    /// Local publishers, if it publishes.
    pub publishers: usize,
    /// Whether those are read.
    pub is_read: bool,
}

/// What an owner lists for this node.
#[derive(Clone, Debug)]
pub struct OfferView<'a> {
    /// Whose.
    pub owner: NodeId,
    /// As listed.
    pub entry: &'a CatalogueEntry,
    /// Its name.
    pub name: Name,
    /// Whether a rule asks for it.
    pub is_used: bool,
}

impl<R> Routes<R> {
    /// What was discovered on the local network.
    pub fn local_endpoints(&self) -> impl Iterator<Item = &DiscoveredEndpoint> {
        self.endpoints.values()
    }

    /// The local participants of which nodes are known.
    pub fn local_participants(&self) -> impl Iterator<Item = Guid> {
        self.nodes.keys().copied()
    }

    /// The rule that shares a local interface, by its place among [`Self::share_views`].
    pub fn shared_by(&self, kind: Kind, local_name: &str, type_name: &str) -> Option<usize> {
        let by_type = self.share_rule(kind, local_name, Some(type_name));
        by_type.or_else(|| self.share_rule(kind, local_name, None))
    }

    /// An interface that is used, as its owner lists it, and the rule's word for whose it is.
    pub fn used_entry(&self, name: &Name) -> Option<(NodeId, &CatalogueEntry)> {
        let route = self.uses.get(name)?;
        Some((self.use_rules[route.rule].owner, &route.entry))
    }

    /// Every rule of what is shared.
    pub fn share_views(&self) -> Vec<ShareView<'_>> {
        let view = |(index, rule)| {
            let rule: &super::ShareRule = rule;
            let of_rule = self.shares.values().filter(move |share| share.rule == index);
            let routes = of_rule.map(|share| ShareRouteView {
                local_name: share.local_name.clone(),
                type_name: ros_type(&share.type_name),
                name: share.name,
                writers: share.writers.len(),
                sinks: share.sinks.len(),
                is_read: share.reader.is_some(),
                is_written: share.writer.is_some() || share.client.is_some(),
                qos: weakest(share.writers.values().map(|w| &w.qos)),
                form: rule.shaping.form,
            });
            ShareView { metadata: &rule.metadata, policy: &rule.policy, routes: routes.collect() }
        };
        self.share_rules.iter().enumerate().map(view).collect()
    }

    /// Every rule of what is used.
    pub fn use_views(&self) -> Vec<UseView<'_>> {
        let view = |(index, rule)| {
            let rule: &super::UseRule = rule;
            let of_rule = self.uses.iter().filter(move |(_, route)| route.rule == index);
            let routes = of_rule.map(|(name, route)| UseRouteView {
                local_name: route.local_name.clone(),
                entry: &route.entry,
                name: *name,
                form: rule.shaping.form,
                is_granted: route.granted,
                refused: route.refused,
                writers: route.writers.len() + usize::from(route.server.is_some()),
                publishers: route.local.len(),
                is_read: route.reader.is_some(),
            });
            let token = rule
                .token
                .as_ref()
                .map(|(name, _)| (*name, self.tokens.get(name).and_then(|token| token.refused)));
            UseView {
                direction: rule.direction,
                kind: rule.kind,
                topic: &rule.topic,
                local_topic: rule.naming.renamed(&rule.topic, &rule.topic),
                wanted_type: rule.type_name.as_deref(),
                owner: rule.owner,
                owner_name: &rule.owner_name,
                owner_state: self.owners.get(&rule.owner).map(String::as_str),
                has_catalogue: self.catalogues.contains_key(&rule.owner),
                token,
                routes: routes.collect(),
            }
        };
        self.use_rules.iter().enumerate().map(view).collect()
    }

    /// What the owners that are followed list for this node.
    pub fn offers(&self) -> impl Iterator<Item = OfferView<'_>> {
        self.catalogues.iter().flat_map(|(owner, catalogue)| {
            catalogue.entries.iter().map(|entry| OfferView {
                owner: *owner,
                entry,
                name: name_of(owner, &entry.blind),
                is_used: self.use_rule(owner, entry).is_some(),
            })
        })
    }
}
