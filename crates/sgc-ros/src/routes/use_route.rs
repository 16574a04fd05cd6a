//! [`UseRoute`]: one used interface of another node, and [`TokenJoin`], the name that a token gives.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_endpoint::RefusedBy;
use sgc_wire::{CatalogueEntry, RosNode, SourceId};

use super::rules::UseRuleId;
use crate::network::{DiscoveredEndpoint, EndpointSpec, Guid, ServiceSpec};

/// Time for which a local writer outlives the path to its owner, so that the far network stays in the local graph
/// when a router restarts.
pub const UNREACHABLE_HOLD: Duration = Duration::from_secs(10);

/// A use route.
#[derive(Debug)]
pub(super) struct UseRoute {
    pub(super) rule: UseRuleId,
    /// The name on the local network.
    pub(super) local_name: String,
    pub(super) entry: CatalogueEntry,
    pub(super) granted: bool,
    /// `false` while the owner, whose node restarted, does not list the entry yet.
    pub(super) is_listed: bool,
    pub(super) refused: Option<RefusedBy>,
    /// Open writers and their specs.
    pub(super) writers: BTreeMap<Option<SourceId>, EndpointSpec>,
    /// The nodes that the writers were announced as.
    pub(super) nodes: BTreeMap<Option<SourceId>, RosNode>,
    /// The local writers and the reader of their messages, if the route publishes.
    pub(super) local: BTreeMap<Guid, DiscoveredEndpoint>,
    pub(super) reader: Option<EndpointSpec>,
    /// The server that local clients call, if it is a service.
    pub(super) server: Option<ServiceSpec>,
    pub(super) unreachable_until: Option<Instant>,
}

impl UseRoute {
    pub(super) fn new(rule: UseRuleId, local_name: String, entry: CatalogueEntry) -> Self {
        Self {
            rule,
            local_name,
            entry,
            granted: false,
            is_listed: true,
            refused: None,
            writers: BTreeMap::new(),
            nodes: BTreeMap::new(),
            local: BTreeMap::new(),
            reader: None,
            server: None,
            unreachable_until: None,
        }
    }
}

/// A joined name from a token.
#[derive(Debug)]
pub(super) struct TokenJoin {
    pub(super) rule: UseRuleId,
    pub(super) transient_local: bool,
    pub(super) refused: Option<RefusedBy>,
}
