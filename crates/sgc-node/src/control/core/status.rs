//! The node's status, as `sgc status` and the metrics show it.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::time::Instant;

use sgc_ros::{RosNetwork, RouteStatus, Routes};
use sgc_router::LinkId;

use super::Core;
use crate::admin::not_direct::NOT_DIRECT_MAX;
use crate::admin::status::{
    LinkStatus, NameStatus, NotDirect, PortMappingStatus, RouteLine, RouterLine, Status, StoreLine,
};
use crate::control::parts::link_table::LinkEntry;
use crate::data::stats::CountDrops;
use crate::drops::NodeDrop;
use crate::link::roaming::source_towards;
use crate::metrics::readings::{LinkReadings, ROUTES_MAX, Readings, RouteReading};

/// An address of the IPv6 internet, to which nothing is sent: the first of the global unicast addresses (RFC 4291, 2.4).
const IPV6_INTERNET: SocketAddr =
    SocketAddr::new(IpAddr::V6(Ipv6Addr::new(0x2000, 0, 0, 0, 0, 0, 0, 1)), 443);

impl<N: RosNetwork> Core<N> {
    /// Returns the node's status.
    pub(super) fn status(&self) -> Status {
        let links = self.links.iter().map(|(id, entry)| self.link_status(id, entry));
        let names = self.forwards.stats().map(|(name, stats)| NameStatus::new(name, stats));
        Status {
            node: self.certificates.identity().node_name().to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            uptime_s: self.started.elapsed().as_secs(),
            links: links.collect(),
            routers: self.board.snapshot(),
            not_direct: self.not_direct().take(NOT_DIRECT_MAX).map(NotDirect::new).collect(),
            clocks: self.clock_lines(),
            port_mapping: PortMappingStatus::new(self.direct.mapping(), Instant::now()),
            ipv6: source_towards(IPV6_INTERNET).map(|ip| ip.to_string()),
            routes: self.routes.iter().flat_map(Routes::status).map(|route| self.route_line(route)).collect(),
            alerts: self.alerts(),
            problems: self.problems(),
            names: names.collect(),
            drops: self.all_drops(),
            refused: self.all_refused(),
            local_network_reopened: self.reopening.reopenings(),
            router: self.router_line(),
            store: self.store_line(),
            // The caller adds them, since the core knows nothing of the gateway and of metrics.
            gateway: None,
            metrics: None,
            otlp: None,
        }
    }

    /// Returns the values of metrics. The caller adds those of the gateway and of pushes.
    pub(super) fn readings(&self) -> Readings {
        let router = self.router_line();
        let routes = self.routes.iter().flat_map(Routes::status);
        let mut routes = routes
            .filter_map(|route| RouteReading::new(&route, self.messages_of(&route).unwrap_or_default()));
        let routes_shown = routes.by_ref().take(ROUTES_MAX).collect();
        Readings {
            node: self.certificates.identity().node_name().to_string(),
            uptime: self.started.elapsed(),
            certificate_until: self.certificates.identity().not_after(),
            links: self.link_readings(),
            routers: self.board.snapshot(),
            routes: routes_shown,
            routes_omitted: routes.count(),
            alerts: self.alerts(),
            problems: self.problems().len(),
            drops: self.drops_by_reason(),
            refused: self.all_refused(),
            reopened: self.reopening.reopenings(),
            router,
            store: self.store_line(),
            gateway: None,
            pushes: None,
        }
    }

    fn link_readings(&self) -> LinkReadings {
        let (sent_bytes, received_bytes) = self.links.total_bytes();
        let established = self.links.established();
        let mut readings =
            LinkReadings { sent_bytes, received_bytes, established, ..LinkReadings::default() };
        for (id, entry) in self.links.iter() {
            let (_, is_silent) = self.router.link_cost(id).unwrap_or_default();
            let is_direct = self.direct.is_direct(id);
            readings.silent += u64::from(is_silent);
            readings.direct += u64::from(is_direct);
            match entry.url() {
                Some(url) => {
                    readings.dialled += 1;
                    // Peers announce the addresses of direct links, and series are not for each of these.
                    if !is_direct {
                        readings.round_trips.insert(url.to_owned(), entry.stats().rtt);
                    }
                }
                None => readings.accepted += 1,
            }
        }
        readings
    }

    fn store_line(&self) -> Option<StoreLine> {
        Some(StoreLine::new(Instant::now(), self.router.store_stats()?))
    }

    fn router_line(&self) -> RouterLine {
        let router = self.router.stats();
        RouterLine {
            nodes: router.nodes,
            names: router.names,
            routed_names: router.routed_names,
            branches: router.branches,
        }
    }

    fn link_status(&self, id: LinkId, entry: &LinkEntry) -> LinkStatus {
        let (stats, (lanes, bulk_lanes)) = (entry.stats(), entry.lanes());
        let (cost, silent) = self.router.link_cost(id).unwrap_or_default();
        let over = self.data.rates().over(&entry.peer().node_id);
        LinkStatus {
            id: id.0,
            peer: entry.peer().node_id.to_string(),
            name: self.names.get(&entry.peer().node_id),
            peer_until: entry.peer().not_after.to_string(),
            remote: entry.remote().to_string(),
            url: entry.url().map(str::to_owned),
            local: entry.url().and_then(|_| source_towards(entry.remote())).map(|ip| ip.to_string()),
            observed: entry.observed().map(|address| address.to_string()),
            direct: self.direct.is_direct(id),
            kex: stats.key_exchange.label(),
            rtt_us: stats.rtt.as_micros().try_into().unwrap_or(u64::MAX),
            cost,
            silent,
            keep_alive_ms: entry.keep_alive_interval().as_millis().try_into().unwrap_or(u64::MAX),
            sent_bytes: stats.sent_bytes,
            received_bytes: stats.received_bytes,
            lanes,
            bulk_lanes,
            labels_sent: entry.labels_sent(),
            labels_received: entry.labels_received(),
            peer_slowed: over.slowed,
            peer_dropped: over.dropped,
        }
    }

    pub(super) fn route_line(&self, route: RouteStatus) -> RouteLine {
        let calls = self.describe_calls(&route);
        let messages = self.messages_of(&route);
        let share = route.name.and_then(|n| self.shares.get(&n));
        let compressed = share.and_then(|s| s.compressed());
        let age = route.name.and_then(|name| self.sinks.get(&name)?.last_age());
        let line = RouteLine::new(route, calls, messages, share.map_or(0, |s| s.signatures()), compressed);
        RouteLine {
            age_us: age.map(|age| age.age_us),
            age_error_us: age.and_then(|age| age.error_us),
            ..line
        }
    }

    /// Returns the number of messages that were published or delivered.
    fn messages_of(&self, route: &RouteStatus) -> Option<u64> {
        let name = route.name?;
        let published = self.shares.get(&name).map(|s| s.published());
        published.or_else(|| self.sinks.get(&name).map(|s| s.delivered()))
    }

    /// Returns everything that was dropped or refused, by kind alone.
    pub(super) fn drops_by_reason(&self) -> BTreeMap<String, u64> {
        let mut drops = self.all_drops();
        // No name of a kind has spaces, and rows of culprits have.
        drops.retain(|key, _| !key.contains(' '));
        drops
    }

    /// Returns everything that was dropped or refused, by kind and culprit. Control frames and packets share some
    /// kinds.
    pub(super) fn all_drops(&self) -> BTreeMap<String, u64> {
        let kept = [
            (NodeDrop::AuditLost, self.audit.lost_total()),
            (NodeDrop::AuditSummedUp, self.audit.summed_up_total()),
        ];
        let kept = kept
            .into_iter()
            .chain(self.direct.refusals())
            .filter(|(_, n)| *n > 0)
            .map(|(kind, n)| (kind.key().to_owned(), n));
        let mut all: BTreeMap<String, u64> = kept.collect();
        for counts in [
            self.control_drops.snapshot_by_name(&self.names),
            self.data.drops().snapshot(),
            self.data.rates().drops(),
            self.ros_failures.snapshot(),
            self.board.drops().snapshot(),
        ] {
            counts.into_iter().for_each(|(key, n)| *all.entry(key).or_default() += n);
        }
        all
    }

    /// Returns the peers that were refused a link, by kind.
    pub(super) fn all_refused(&self) -> BTreeMap<String, u64> {
        let all = sgc_transport::RefusalKind::ALL.into_iter();
        let all = all.map(|kind| (kind.label().to_owned(), self.transport.refused(kind)));
        all.filter(|(_, n)| *n > 0).collect()
    }
}
