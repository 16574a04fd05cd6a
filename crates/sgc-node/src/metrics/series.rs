//! The metrics, and their text for Prometheus.
//!
//! Each metric is a row of [`METRICS`], from which `docs/reference/metrics.md` is made, too. No label has a value that
//! strangers choose, and the number of series is bounded by the configuration and
//! [`ROUTES_MAX`](super::readings::ROUTES_MAX).

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, MetricEncoder, prometheus_text};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Registry;
use sgc_transport::RefusalKind;

use super::process::Process;
use super::readings::{LinkReadings, Readings, RouteReading};
use crate::control::faults::alerts::Alert;
use crate::data::stats::DataDrop;
use crate::discovery::RouterStatus;
use crate::discovery::board::LINKED;
use crate::drops::NodeDrop;

/// The label that all series have.
pub(super) const NODE: &str = "node";
/// The end of the names of counters.
pub(super) const COUNTER_SUFFIX: &str = "_total";
/// The labels of a share or use.
const ROUTE: &[&str] = &["direction", "interface", "owner"];
/// The origin of routers that were found on the local network, in the status.
const FOUND_NEARBY: &str = "mdns";
/// The label of all routers on the local network.
const NEARBY: &str = "mdns://";

/// Kinds of metrics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MetricKind {
    /// A number that only grows until the node is restarted. Its name ends in `_total`.
    Counter,
    /// A number that rises and falls.
    Gauge,
}

/// A metric.
pub struct Metric {
    /// The name.
    pub name: &'static str,
    /// The kind.
    pub kind: MetricKind,
    /// The names of the labels, without `node`, which all metrics have.
    pub labels: &'static [&'static str],
    /// The meaning, with the unit.
    pub help: &'static str,
    read: fn(&Sample) -> Series,
}

impl fmt::Debug for Metric {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Metric").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Metric {
    /// Returns the values of the metric.
    pub(super) fn series(&self, sample: &Sample) -> Series {
        (self.read)(sample)
    }
}

/// A node and its process at one moment.
#[derive(Clone, Debug)]
pub(super) struct Sample {
    pub(super) readings: Readings,
    pub(super) process: Process,
    /// The start of the node.
    pub(super) started: SystemTime,
    /// The moment.
    #[cfg_attr(
        not(feature = "otlp"),
        expect(dead_code, reason = "only pushes say when their values were read")
    )]
    pub(super) at: SystemTime,
}

/// The values of a metric by their labels' values. Prometheus refuses two values with the same labels.
pub(super) type Series = BTreeMap<Vec<String>, f64>;

fn unlabelled(value: impl Into<Option<f64>>) -> Series {
    value.into().map(|value| (Vec::new(), value)).into_iter().collect()
}

fn as_f64(n: u64) -> f64 {
    n as f64
}

fn by_label<K: ToString>(values: impl IntoIterator<Item = (K, f64)>) -> Series {
    let mut series = Series::new();
    for (label, value) in values {
        *series.entry(vec![label.to_string()]).or_default() += value;
    }
    series
}

/// Returns the greatest value for each router of the configuration. Anybody on the local network can announce addresses, so
/// routers that were found there share a label.
fn by_router(sample: &Sample, value: fn(&RouterStatus, &LinkReadings) -> Option<f64>) -> Series {
    let mut series = Series::new();
    for row in &sample.readings.routers {
        let label = if row.found_by == FOUND_NEARBY { NEARBY } else { row.router.as_str() };
        if let Some(value) = value(row, &sample.readings.links) {
            let known = series.entry(vec![label.to_owned()]).or_insert(value);
            *known = f64::max(*known, value);
        }
    }
    series
}

/// Returns the counts by reason, from the beginning also those of `always`: Prometheus sees no increase in a series that
/// begins with 1.
fn by_reason(counts: &BTreeMap<String, u64>, always: impl IntoIterator<Item = &'static str>) -> Series {
    let always = always.into_iter().map(|reason| (reason.to_owned(), 0.0));
    by_label(always.chain(counts.iter().map(|(reason, n)| (reason.clone(), as_f64(*n)))))
}

/// Drops of the node at which messages are lost.
const LOSSES: [NodeDrop; 4] =
    [NodeDrop::SinkLost, NodeDrop::WriteTimeout, NodeDrop::WriteFailed, NodeDrop::WritePayload];

fn by_route(sample: &Sample, value: fn(&RouteReading) -> f64) -> Series {
    let labels =
        |route: &RouteReading| vec![route.direction.to_owned(), route.topic.clone(), route.owner.clone()];
    sample.readings.routes.iter().map(|route| (labels(route), value(route))).collect()
}

/// Returns the kind of an alert, as the status document has it.
fn kind_of(alert: &Alert) -> String {
    let document = serde_json::to_value(alert).unwrap_or_default();
    document["kind"].as_str().unwrap_or("other").to_owned()
}

const fn gauge(
    name: &'static str,
    labels: &'static [&'static str],
    help: &'static str,
    read: fn(&Sample) -> Series,
) -> Metric {
    Metric { name, kind: MetricKind::Gauge, labels, help, read }
}

const fn counter(
    name: &'static str,
    labels: &'static [&'static str],
    help: &'static str,
    read: fn(&Sample) -> Series,
) -> Metric {
    Metric { name, kind: MetricKind::Counter, labels, help, read }
}

/// All metrics, in the order in which they are shown.
pub const METRICS: &[Metric] = &[
    gauge("sgc_build_info", &["version"], "Always 1; the label has the version of the program.", |_| {
        by_label([(env!("CARGO_PKG_VERSION"), 1.0)])
    }),
    gauge("sgc_uptime_seconds", &[], "Seconds since the node started.", |s| {
        unlabelled(s.readings.uptime.as_secs_f64())
    }),
    gauge(
        "sgc_certificate_expiry_timestamp_seconds",
        &[],
        "The end of the node's certificate, in seconds since the Unix epoch.",
        |s| unlabelled(as_f64(s.readings.certificate_until.0) / 1e3),
    ),
    gauge("sgc_links", &["side"], "Links that are up, `dialled` by this node or `accepted`.", |s| {
        let links = &s.readings.links;
        by_label([("dialled", as_f64(links.dialled)), ("accepted", as_f64(links.accepted))])
    }),
    gauge("sgc_links_silent", &[], "Links that are up, but whose peer does not answer.", |s| {
        unlabelled(as_f64(s.readings.links.silent))
    }),
    gauge("sgc_links_direct", &[], "Links that are up and lead directly to a peer, past the routers.", |s| {
        unlabelled(as_f64(s.readings.links.direct))
    }),
    counter(
        "sgc_links_established_total",
        &[],
        "Links that were made. If it grows all the time, links break.",
        |s| unlabelled(as_f64(s.readings.links.established)),
    ),
    counter("sgc_sent_bytes_total", &[], "Bytes sent over all links and their lanes.", |s| {
        unlabelled(as_f64(s.readings.links.sent_bytes))
    }),
    counter("sgc_received_bytes_total", &[], "Bytes received over all links and their lanes.", |s| {
        unlabelled(as_f64(s.readings.links.received_bytes))
    }),
    gauge(
        "sgc_router_linked",
        &["router"],
        "1 if linked, else 0, for each router, domain (`srv://…`) and the local network (`mdns://`) of the configuration \
         and of tokens.",
        |s| by_router(s, |row, _| Some(f64::from(u8::from(row.state == LINKED)))),
    ),
    gauge("sgc_router_failures", &["router"], "Failures in a row to link with the router.", |s| {
        by_router(s, |row, _| Some(f64::from(row.failures)))
    }),
    gauge(
        "sgc_router_round_trip_seconds",
        &["router"],
        "The smoothed round-trip time to the linked router, in seconds.",
        |s| {
            by_router(s, |row, links| {
                let at = row.at.as_ref().filter(|_| row.state == LINKED)?;
                links.round_trips.get(at).map(Duration::as_secs_f64)
            })
        },
    ),
    gauge(
        "sgc_route_ready",
        ROUTE,
        "1 if this end is ready: a local publisher or server is there for a share, the owner's grant for a use. `direction` is \
         `share`, `use`, `serve`, `call` or `publish`.",
        |s| by_route(s, |route| f64::from(u8::from(route.is_ready))),
    ),
    counter(
        "sgc_route_messages_total",
        ROUTE,
        "Messages that were published or delivered; for services, 0.",
        |s| by_route(s, |route| as_f64(route.messages)),
    ),
    gauge(
        "sgc_routes_omitted",
        &[],
        "Shares and uses that have no series here, because there are more than 1000.",
        |s| unlabelled(as_f64(s.readings.routes_omitted as u64)),
    ),
    counter(
        "sgc_drops_total",
        &["reason"],
        "Dropped or refused frames, packets and messages by [reason](drop-reasons.md).",
        |s| {
            let losses = DataDrop::ALL.into_iter().map(DataDrop::key).chain(LOSSES.map(NodeDrop::key));
            by_reason(&s.readings.drops, losses)
        },
    ),
    counter("sgc_refused_links_total", &["reason"], "Refused links by reason.", |s| {
        by_reason(&s.readings.refused, RefusalKind::ALL.into_iter().map(RefusalKind::label))
    }),
    gauge("sgc_alerts", &["kind"], "Present [alerts](status.md#alerts) by kind.", |s| {
        by_label(s.readings.alerts.iter().map(|alert| (kind_of(alert), 1.0)))
    }),
    gauge(
        "sgc_problems",
        &[],
        "Contradictions between local endpoints and the other side, as `sgc why` explains them.",
        |s| unlabelled(as_f64(s.readings.problems as u64)),
    ),
    counter(
        "sgc_local_network_reopened_total",
        &[],
        "The number of times that the local network was opened again because this host's addresses changed.",
        |s| unlabelled(as_f64(s.readings.reopened)),
    ),
    gauge("sgc_known_nodes", &[], "Nodes whose link states are known.", |s| {
        unlabelled(as_f64(s.readings.router.nodes as u64))
    }),
    gauge("sgc_known_names", &[], "Known names.", |s| unlabelled(as_f64(s.readings.router.names as u64))),
    gauge("sgc_routed_names", &[], "Names to whose owner a route leads.", |s| {
        unlabelled(as_f64(s.readings.router.routed_names as u64))
    }),
    gauge("sgc_tree_branches", &[], "Branches of trees of names.", |s| {
        unlabelled(as_f64(s.readings.router.branches as u64))
    }),
    gauge("sgc_store_answers", &[], "1 while the store of names answers, otherwise 0.", |s| {
        unlabelled(s.readings.store.map(|store| if store.answers { 1.0 } else { 0.0 }))
    }),
    counter("sgc_store_operations_total", &[], "Operations of the store of names.", |s| {
        unlabelled(s.readings.store.map(|store| as_f64(store.operations)))
    }),
    counter("sgc_store_failures_total", &[], "Operations of the store of names that failed.", |s| {
        unlabelled(s.readings.store.map(|store| as_f64(store.failures)))
    }),
    counter("sgc_store_look_ups_total", &["result"], "Look-ups of names in the store, by result.", |s| {
        let results = s.readings.store.iter().flat_map(|s| [("found", s.found), ("absent", s.absent)]);
        by_label(results.map(|(result, count)| (result, as_f64(count))))
    }),
    counter("sgc_store_refused_total", &[], "Values of the store that were not what their key says.", |s| {
        unlabelled(s.readings.store.map(|store| as_f64(store.refused)))
    }),
    counter(
        "sgc_store_healed_total",
        &[],
        "Names that the store had lost, and that were written again.",
        |s| unlabelled(s.readings.store.map(|store| as_f64(store.healed))),
    ),
    gauge("sgc_store_cached_bytes", &[], "Memory of values that were read from the store.", |s| {
        unlabelled(s.readings.store.map(|store| as_f64(store.cached_bytes as u64)))
    }),
    gauge("sgc_gateway_clients", &["protocol"], "Connected clients of the gateway.", |s| {
        let clients = s.readings.gateway.iter().flat_map(|gateway| &gateway.clients);
        by_label(clients.map(|client| (&client.protocol, 1.0)))
    }),
    gauge("sgc_gateway_readers", &[], "Readers of the gateway on the local network.", |s| {
        unlabelled(s.readings.gateway.as_ref().map(|gateway| as_f64(gateway.readers as u64)))
    }),
    counter(
        "sgc_gateway_refused_total",
        &["reason"],
        "Refused connections of the gateway, and messages and calls that it gave up, by reason.",
        |s| {
            let refused = s.readings.gateway.iter().flat_map(|gateway| &gateway.refused);
            by_label(refused.map(|(reason, n)| (reason, as_f64(*n))))
        },
    ),
    counter(
        "sgc_otlp_pushes_total",
        &["result"],
        "Pushes of metrics to a collector: `accepted`, or [why not](../how-to/monitoring.md#if-the-collector-takes-nothing).",
        |s| {
            let pushes = s.readings.pushes.iter();
            by_label(pushes.flat_map(|pushes| {
                let failed = pushes.failed.iter().map(|(reason, n)| (*reason, as_f64(*n)));
                failed.chain([("accepted", as_f64(pushes.accepted))])
            }))
        },
    ),
    counter("process_cpu_seconds_total", &[], "Time of the process on processors, in seconds.", |s| {
        unlabelled(s.process.cpu.as_secs_f64())
    }),
    gauge("process_resident_memory_bytes", &[], "Resident memory of the process.", |s| {
        unlabelled(s.process.resident_bytes.map(as_f64))
    }),
    gauge("process_threads", &[], "Threads of the process.", |s| unlabelled(s.process.threads.map(as_f64))),
    gauge("process_open_fds", &[], "Open file descriptors of the process.", |s| {
        unlabelled(s.process.open_fds.map(as_f64))
    }),
    gauge("process_max_fds", &[], "Most file descriptors that the process may open.", |s| {
        unlabelled(s.process.max_fds.map(as_f64))
    }),
    gauge(
        "process_start_time_seconds",
        &[],
        "The start of the node, in seconds since the Unix epoch.",
        |s| unlabelled(s.started.duration_since(UNIX_EPOCH).ok().map(|at| at.as_secs_f64())),
    ),
];

impl Collector for Sample {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        for metric in METRICS {
            let series = metric.series(self);
            if series.is_empty() {
                continue;
            }
            let kind = match metric.kind {
                MetricKind::Counter => MetricType::Counter,
                MetricKind::Gauge => MetricType::Gauge,
            };
            let help = without_markup(metric.help);
            // The encoder adds the ending.
            let name = metric.name.strip_suffix(COUNTER_SUFFIX).unwrap_or(metric.name);
            let mut family = encoder.encode_descriptor(name, &help, None, kind)?;
            for (values, value) in series {
                let labels: Vec<_> = metric.labels.iter().copied().zip(values).collect();
                let row = family.encode_family(&labels)?;
                encode(row, metric.kind, value)?;
            }
        }
        Ok(())
    }
}

fn encode(encoder: MetricEncoder<'_>, kind: MetricKind, value: f64) -> fmt::Result {
    match kind {
        MetricKind::Counter => ConstCounter::new(value).encode(encoder),
        MetricKind::Gauge => ConstGauge::new(value).encode(encoder),
    }
}

/// Returns the help without quotation marks and links of Markdown.
pub(super) fn without_markup(help: &str) -> String {
    let (mut plain, mut rest) = (String::new(), help);
    while let Some((before, (shown, after))) =
        rest.split_once('[').and_then(|(before, link)| Some((before, link.split_once("](")?)))
    {
        plain.push_str(before);
        plain.push_str(shown);
        rest = after.split_once(')').map_or("", |(_, after)| after);
    }
    plain.push_str(rest);
    plain.replace('`', "")
}

/// The type of [`text`], for HTTP.
pub(super) const CONTENT_TYPE: &str = prometheus_text::CONTENT_TYPE;

/// Returns a sample in the text format of Prometheus, version 0.0.4.
pub(super) fn text(sample: Sample) -> Result<String, fmt::Error> {
    let node = Cow::Owned(sample.readings.node.clone());
    let mut registry = Registry::with_labels([(Cow::Borrowed(NODE), node)].into_iter());
    registry.register_collector(Box::new(sample));
    let mut text = String::new();
    prometheus_text::encode(&mut text, &registry)?;
    Ok(text)
}

/// Returns a sample with some values of most metrics.
#[cfg(all(test, feature = "otlp"))]
pub(super) fn sample() -> Sample {
    use crate::metrics::push::PushStatus;
    use crate::metrics::readings::RouteReading;

    let route = RouteReading {
        direction: "share",
        topic: "/topic \"x\"".to_owned(),
        owner: "robot".to_owned(),
        is_ready: true,
        messages: 7,
    };
    let pushes = PushStatus {
        to: "http://127.0.0.1:4318/v1/metrics".to_owned(),
        accepted: 5,
        failed: BTreeMap::from([("busy", 2)]),
        accepted_ago_s: None,
        fault: None,
    };
    let readings = Readings {
        node: "robot".to_owned(),
        uptime: Duration::from_millis(1500),
        certificate_until: sgc_wire::UnixMillis(1_900_000_000_123),
        links: LinkReadings { dialled: 2, sent_bytes: 1 << 40, ..LinkReadings::default() },
        routers: Vec::new(),
        routes: vec![route],
        routes_omitted: 0,
        alerts: vec![Alert::LocalNetworkAlone],
        problems: 1,
        drops: BTreeMap::from([("sink_lost".to_owned(), 3)]),
        refused: BTreeMap::new(),
        reopened: 0,
        router: crate::admin::status::RouterLine { nodes: 1, names: 2, routed_names: 2, branches: 0 },
        store: None,
        gateway: None,
        pushes: Some(pushes),
    };
    let started = UNIX_EPOCH + Duration::from_secs(1_800_000_000);
    Sample { readings, process: Process::read(), started, at: started + Duration::from_millis(1500) }
}
