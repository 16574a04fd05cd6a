//! Read-only views of the route machine.

use sgc_endpoint::RefusedBy;
use sgc_trust::{Policy, name_of};
use sgc_wire::{CatalogueEntry, Kind, Metadata, Name, NodeId, PayloadForm, Qos};

use super::Routes;
use crate::network::{DiscoveredEndpoint, Guid};
use crate::routes::owners::OwnerState;
use crate::routes::rules::{Direction, ShareRule, ShareRuleId, UseRule};
use crate::routes::token_join::TokenJoin;

/// A share rule and its routes.
#[derive(Clone, Debug)]
pub struct ShareView<'a> {
    /// The metadata of the rule.
    pub metadata: &'a Metadata,
    /// The policy of the rule.
    pub policy: &'a Policy,
    /// The running routes.
    pub routes: Vec<ShareRouteView>,
}

/// A shared interface.
#[derive(Clone, Debug)]
pub struct ShareRouteView {
    /// The name on the local network.
    pub local_name: String,
    /// The name under which other nodes find it.
    pub shared_as: String,
    /// The ROS type.
    pub type_name: String,
    /// The name on the wire.
    pub name: Name,
    /// The number of local publishers.
    pub writers: usize,
    /// The number of granted subscribers.
    pub sinks: usize,
    /// `true` if the local publishers are read.
    pub is_read: bool,
    /// `true` if messages of others are written here; for a service, if others can call it.
    pub is_written: bool,
    /// The combined offer of the local publishers.
    pub qos: Option<Qos>,
    /// The form of their messages on the way.
    pub form: PayloadForm,
}

/// A use rule and its routes.
#[derive(Clone, Debug)]
pub struct UseView<'a> {
    /// The direction of messages.
    pub direction: Direction,
    /// The kind of interface.
    pub kind: Kind,
    /// The topic or pattern.
    pub topic: &'a str,
    /// The topic or pattern by local names.
    pub local_topic: String,
    /// The required type.
    pub wanted_type: Option<&'a str>,
    /// The owner.
    pub owner: NodeId,
    /// The owner's name, for people.
    pub owner_name: &'a str,
    /// The problem with the owner, if any.
    pub owner_state: Option<OwnerState>,
    /// `true` if the owner's catalogue has arrived.
    pub has_catalogue: bool,
    /// The name from a token, and the reason if it was refused.
    pub token: Option<(Name, Option<RefusedBy>)>,
    /// The running routes.
    pub routes: Vec<UseRouteView<'a>>,
}

/// An interface of another node.
#[derive(Clone, Debug)]
pub struct UseRouteView<'a> {
    /// The name on the local network.
    pub local_name: String,
    /// The entry in the owner's catalogue.
    pub entry: &'a CatalogueEntry,
    /// The name on the wire.
    pub name: Name,
    /// The form of this node's messages, if it publishes.
    pub form: PayloadForm,
    /// `true` if the owner granted it.
    pub is_granted: bool,
    /// The refusal, if any.
    pub refused: Option<RefusedBy>,
    /// The number of local writers, or servers of a service.
    pub writers: usize,
    /// The number of local publishers, if the route publishes.
    pub publishers: usize,
    /// `true` if the local publishers are read.
    pub is_read: bool,
}

/// An entry of an owner's catalogue.
#[derive(Clone, Debug)]
pub struct OfferView<'a> {
    /// The owner.
    pub owner: NodeId,
    /// The entry.
    pub entry: &'a CatalogueEntry,
    /// The name on the wire.
    pub name: Name,
    /// `true` if a rule asks for it.
    pub is_used: bool,
}

impl<R> Routes<R> {
    /// Returns the endpoints discovered on the local network.
    pub fn local_endpoints(&self) -> impl Iterator<Item = &DiscoveredEndpoint> {
        self.local.endpoints()
    }

    /// Returns the local participants whose nodes are known.
    pub fn local_participants(&self) -> impl Iterator<Item = Guid> {
        self.local.participants()
    }

    /// Returns the rule that shares a local interface, whose place is its index in [`Self::share_views`].
    pub fn shared_by(&self, kind: Kind, local_name: &str, type_name: &str) -> Option<ShareRuleId> {
        let by_type = self.share_rule(kind, local_name, Some(type_name));
        by_type.or_else(|| self.share_rule(kind, local_name, None))
    }

    /// Returns the entry of a used interface, and its owner.
    pub fn used_entry(&self, name: &Name) -> Option<(NodeId, &CatalogueEntry)> {
        let route = self.uses.get(name)?;
        Some((self.use_rules[route.rule()].owner, route.entry()))
    }

    /// Returns the names of the owners in use rules.
    pub fn used_owners(&self) -> impl Iterator<Item = &str> {
        self.use_rules.iter().map(|rule| rule.owner_name.as_str())
    }

    /// Returns all share rules.
    pub fn share_views(&self) -> Vec<ShareView<'_>> {
        let view = |(index, rule)| {
            let rule: &ShareRule = rule;
            let of_rule = self.shares.values().filter(move |share| share.rule() == index);
            let routes = of_rule.map(|share| ShareRouteView {
                local_name: share.local_name().to_owned(),
                shared_as: rule.naming.renamed(&rule.metadata.ros_name, share.local_name()),
                type_name: share.type_name(),
                name: share.name(),
                writers: share.writers().len(),
                sinks: share.sink_count(),
                is_read: share.is_read(),
                is_written: share.is_written(),
                qos: share.offer(),
                form: rule.shaping.form,
            });
            ShareView { metadata: &rule.metadata, policy: &rule.policy, routes: routes.collect() }
        };
        self.share_rules.with_ids().map(view).collect()
    }

    /// Returns all use rules.
    pub fn use_views(&self) -> Vec<UseView<'_>> {
        let view = |(index, rule)| {
            let rule: &UseRule = rule;
            let of_rule = self.uses.iter().filter(move |(_, route)| route.rule() == index);
            let routes = of_rule.map(|(name, route)| UseRouteView {
                local_name: route.local_name().to_owned(),
                entry: route.entry(),
                name: *name,
                form: rule.shaping.form,
                is_granted: route.is_granted(),
                refused: route.refused(),
                writers: route.writer_count() + usize::from(route.is_served()),
                publishers: route.publisher_count(),
                is_read: route.is_read(),
            });
            let token = rule
                .token
                .as_ref()
                .map(|(name, _)| (*name, self.tokens.get(name).and_then(TokenJoin::refused)));
            UseView {
                direction: rule.direction,
                kind: rule.kind,
                topic: &rule.topic,
                local_topic: rule.naming.renamed(&rule.topic, &rule.topic),
                wanted_type: rule.type_name.as_deref(),
                owner: rule.owner,
                owner_name: &rule.owner_name,
                owner_state: self.owners.state(&rule.owner),
                has_catalogue: self.owners.catalogue(&rule.owner).is_some(),
                token,
                routes: routes.collect(),
            }
        };
        self.use_rules.with_ids().map(view).collect()
    }

    /// Returns the entries of all followed owners.
    pub fn offers(&self) -> impl Iterator<Item = OfferView<'_>> {
        self.owners.catalogues().flat_map(|(owner, catalogue)| {
            catalogue.entries.iter().map(|entry| OfferView {
                owner: *owner,
                entry,
                name: name_of(owner, &entry.blind),
                is_used: self.use_rule(owner, entry).is_some(),
            })
        })
    }
}
