//! [`Readings`]: the state of a node at one moment, as far as metrics show it.

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_gateway::GatewayStatus;
use sgc_ros::{RouteState, RouteStatus};
use sgc_wire::UnixMillis;

use crate::admin::status::{RouterLine, StoreLine};
use crate::control::faults::alerts::Alert;
use crate::discovery::RouterStatus;
use crate::metrics::push::PushStatus;

/// Most shares and uses that metrics show one by one. A pattern may bring any number of topics.
pub(crate) const ROUTES_MAX: usize = 1000;

/// The state of a node at one moment. Unlike the status it has nothing for each name or each accepted link, of which a
/// router may have very many.
#[derive(Clone, Debug)]
pub(crate) struct Readings {
    /// The node's name.
    pub(crate) node: String,
    /// The time since the start.
    pub(crate) uptime: Duration,
    /// The end of the node's certificate.
    pub(crate) certificate_until: UnixMillis,
    pub(crate) links: LinkReadings,
    /// The searches for routers.
    pub(crate) routers: Vec<RouterStatus>,
    /// The first [`ROUTES_MAX`] shares and uses.
    pub(crate) routes: Vec<RouteReading>,
    /// The number of further ones.
    pub(crate) routes_omitted: usize,
    pub(crate) alerts: Vec<Alert>,
    /// The number of contradictions between local endpoints and the other side.
    pub(crate) problems: usize,
    /// Drops and refusals by reason.
    pub(crate) drops: BTreeMap<String, u64>,
    /// Refused links by reason.
    pub(crate) refused: BTreeMap<String, u64>,
    /// The number of times that the local network was opened again.
    pub(crate) reopened: u64,
    pub(crate) router: RouterLine,
    pub(crate) store: Option<StoreLine>,
    /// The gateway, if there is one.
    pub(crate) gateway: Option<GatewayStatus>,
    /// Pushes of metrics, if there are some.
    pub(crate) pushes: Option<PushStatus>,
}

/// The links of a node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct LinkReadings {
    /// Links that this node dialled.
    pub(crate) dialled: u64,
    /// Links that peers dialled.
    pub(crate) accepted: u64,
    /// Direct links of these.
    pub(crate) direct: u64,
    /// Links whose peer does not answer.
    pub(crate) silent: u64,
    /// Links since the start.
    pub(crate) established: u64,
    /// Bytes over all links since the start.
    pub(crate) sent_bytes: u64,
    pub(crate) received_bytes: u64,
    /// The smoothed round trip of each link that this node dialled to a router, by its URL.
    pub(crate) round_trips: BTreeMap<String, Duration>,
}

/// A share or a use.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RouteReading {
    pub(crate) direction: &'static str,
    /// The name on the local network.
    pub(crate) topic: String,
    /// The name of the owner's node.
    pub(crate) owner: String,
    pub(crate) is_ready: bool,
    pub(crate) messages: u64,
}

impl RouteReading {
    /// Returns `None` for a pattern that matches nothing: it may be meant for topics that come later.
    pub(crate) fn new(route: &RouteStatus, messages: u64) -> Option<Self> {
        let is_ready = match route.state {
            RouteState::Shared { .. } | RouteState::Served { .. } | RouteState::Granted { .. } => true,
            RouteState::NotListed { is_pattern: true } => return None,
            RouteState::AwaitsLocal
            | RouteState::Owner(_)
            | RouteState::NotListed { .. }
            | RouteState::AwaitsGrant
            | RouteState::Refused(_) => false,
        };
        let (topic, owner) = (route.topic.clone(), route.owner.clone());
        Some(Self { direction: route.kind.key(), topic, owner, is_ready, messages })
    }
}

impl Readings {
    /// Returns the reasons why the node carries nothing, none if it is ready.
    pub(crate) fn obstacles(&self) -> Vec<String> {
        // A router that was looked for may have dialled this node.
        let unlinked = !self.routers.is_empty() && self.links.dialled + self.links.accepted == 0;
        let no_link = unlinked.then(|| "no router is linked".to_owned());
        let alerts = self.alerts.iter().filter(|alert| alert.stops_all()).map(ToString::to_string);
        no_link.into_iter().chain(alerts).collect()
    }
}
