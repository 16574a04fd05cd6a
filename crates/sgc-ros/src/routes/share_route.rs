//! [`ShareRoute`]: one shared interface with one type.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use sgc_endpoint::ShareSpec;
use sgc_wire::{Name, Qos, SinkId, SourceId};

use super::problem::Problem;
use super::rules::{ShareRule, ShareRuleId};
use crate::names::ros_type;
use crate::network::{DiscoveredEndpoint, EndpointSpec, Guid, ServiceSpec};

/// Time for which a share outlives its last local writer, so that a restarted program finds its subscribers.
pub const WRITERLESS_HOLD: Duration = Duration::from_secs(2);
/// Time for which a local reader outlives its last remote sink, so that a router restart costs no sample.
pub const SINKLESS_HOLD: Duration = Duration::from_secs(10);

/// A share route.
#[derive(Debug)]
pub(super) struct ShareRoute {
    pub(super) name: Name,
    pub(super) rule: ShareRuleId,
    /// The name on the local network.
    pub(super) local_name: String,
    pub(super) type_name: String,
    pub(super) keyless: bool,
    pub(super) writers: BTreeMap<Guid, DiscoveredEndpoint>,
    pub(super) own: BTreeMap<Guid, OwnSource>,
    pub(super) sinks: BTreeSet<SinkId>,
    pub(super) reader: Option<EndpointSpec>,
    /// The writer for messages that others publish on the share.
    pub(super) writer: Option<EndpointSpec>,
    /// The client that calls local servers, if it is a service. The servers are the route's writers.
    pub(super) client: Option<ServiceSpec>,
    pub(super) writerless_until: Option<Instant>,
    pub(super) sinkless_until: Option<Instant>,
}

/// The source that publishes for a local writer.
#[derive(Clone, Debug)]
pub(super) struct OwnSource {
    pub(super) source: SourceId,
    /// The writer's offer, as far as it is carried.
    pub(super) qos: Qos,
    /// The time at which the writer vanished. The source of a volatile writer is kept for a while: for its last
    /// messages, and so that subscribers of a restarted program notice nothing.
    pub(super) gone: Option<Instant>,
    /// `true` if the writer's liveliness lease has expired.
    pub(super) is_lapsed: bool,
}

impl ShareRoute {
    /// Returns `true` if writers of this topic and DDS type belong to the route.
    pub(super) fn fits(&self, local_name: &str, type_name: &str) -> bool {
        self.local_name == local_name && self.type_name == type_name
    }

    /// Returns a problem if two local publishers have different definitions of the type.
    pub(super) fn hashes_differ(&self) -> Option<Problem> {
        let mut hashes = self.writers.values().filter_map(|writer| writer.type_hash.as_ref());
        let one = hashes.next()?;
        let other = hashes.find(|hash| *hash != one)?;
        let (mut first, mut second) = (one.clone(), other.clone());
        // The order does not depend on which publisher came first.
        if first > second {
            std::mem::swap(&mut first, &mut second);
        }
        let (topic, type_name) = (self.local_name.clone(), ros_type(&self.type_name));
        Some(Problem::ShareHash { topic, type_name, first, second })
    }

    /// Creates a share with a first writer, or without one.
    pub(super) fn begin(
        name: Name,
        rule: ShareRuleId,
        share: &ShareRule,
        local_name: &str,
        type_name: &str,
        keyless: bool,
        writer: Option<DiscoveredEndpoint>,
    ) -> (ShareSpec, Self) {
        let spec = ShareSpec {
            metadata: share.metadata_of(local_name, &ros_type(type_name)),
            policy: share.policy.clone(),
            suite: share.suite,
            class: share.class,
            keyless,
            type_hash: writer.as_ref().and_then(|w| w.type_hash.clone()),
            qos: writer.as_ref().map(|w| share.qos.apply(&w.qos)).unwrap_or_default(),
            sources: Vec::new(),
        };
        let route = Self {
            name,
            rule,
            local_name: local_name.to_owned(),
            type_name: type_name.to_owned(),
            keyless,
            own: BTreeMap::new(),
            writers: writer.into_iter().map(|w| (w.guid, w)).collect(),
            sinks: BTreeSet::new(),
            reader: None,
            writer: None,
            client: None,
            writerless_until: None,
            sinkless_until: None,
        };
        (spec, route)
    }
}
