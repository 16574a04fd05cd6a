//! The figures by protocol and size, and their tables.

use serde::Serialize;

use super::client::Way;
use super::measure::Flow;
use crate::report::{Spread, Table, digits, median};

/// All that was measured of a way and a size.
#[derive(Debug, Serialize)]
pub(super) struct Figure {
    pub(super) way: &'static str,
    /// Bytes of a message's content.
    pub(super) size: usize,
    /// From the client to the DDS program and back, all rounds together, µs.
    pub(super) round_trip_us: Spread,
    /// Number of timed round trips.
    round_trips: usize,
    /// From the DDS program to the client.
    pub(super) down: Rate,
    /// From the client to the DDS program.
    pub(super) up: Rate,
    #[serde(skip)]
    all_us: Vec<f64>,
    #[serde(skip)]
    flows: [Vec<Flow>; 2],
}

/// Medians of rounds.
#[derive(Debug, Default, Serialize)]
pub(super) struct Rate {
    /// Messages a second that arrived.
    pub(super) per_second: f64,
    /// Percentage of sent messages that did not arrive.
    lost_percent: f64,
    /// CPU time of the gateway's process by messages that arrived, µs.
    cpu_us: f64,
}

impl Rate {
    fn from_flows(flows: &[Flow]) -> Self {
        let each = |of: fn(&Flow) -> f64| median(flows.iter().map(of));
        let by = |sum: f64, count: f64| if count > 0.0 { sum / count } else { 0.0 };
        let received = |flow: &Flow| f64::from(flow.received);
        Self {
            per_second: each(
                |flow| if flow.seconds > 0.0 { f64::from(flow.received) / flow.seconds } else { 0.0 },
            ),
            lost_percent: median(flows.iter().map(|flow| {
                100.0 * by(f64::from(flow.sent.saturating_sub(flow.received)), f64::from(flow.sent))
            })),
            cpu_us: median(flows.iter().map(|flow| by(flow.cpu_seconds * 1e6, received(flow)))),
        }
    }
}

impl Figure {
    /// Adds what a round measured.
    pub(super) fn add(
        figures: &mut Vec<Self>,
        way: Way,
        size: usize,
        (trips_us, down, up): (Vec<f64>, Flow, Flow),
    ) {
        let known = figures.iter().position(|figure| figure.way == way.name() && figure.size == size);
        let at = known.unwrap_or_else(|| {
            figures.push(Self {
                way: way.name(),
                size,
                round_trip_us: Spread::default(),
                round_trips: 0,
                down: Rate::default(),
                up: Rate::default(),
                all_us: Vec::new(),
                flows: Default::default(),
            });
            figures.len() - 1
        });
        let figure = &mut figures[at];
        figure.all_us.extend(trips_us);
        figure.flows[0].push(down);
        figure.flows[1].push(up);
        figure.round_trips = figure.all_us.len();
        figure.round_trip_us = Spread::from_samples(figure.all_us.clone());
        figure.down = Rate::from_flows(&figure.flows[0]);
        figure.up = Rate::from_flows(&figure.flows[1]);
    }
}

/// Returns the tables of round trips and rates.
pub(super) fn tables(figures: &[Figure]) -> Vec<Table> {
    let trips = figures.iter().map(|figure| {
        let Spread { p50, p99, max, .. } = figure.round_trip_us;
        let mut row = head(figure);
        row.extend([p50, p99, max].map(digits));
        row
    });
    vec![
        Table {
            title: "Round trips: the client publishes, a Cyclone program sends it back on another topic, the client has it. µs"
                .into(),
            columns: vec!["by", "bytes", "p50", "p99", "max"],
            rows: trips.collect(),
        },
        rates(
            "To the client: a Cyclone program publishes as fast as DDS lets it. By gRPC up to 16384 messages or 64 MiB wait for the client \
             (`waits`), by the rosbridge protocol 1000; what is beyond is lost",
            figures,
            |figure| &figure.down,
        ),
        rates(
            "From the client: as fast as the gateway takes it, reliable and all kept, to a Cyclone program",
            figures,
            |figure| &figure.up,
        ),
    ]
}

fn head(figure: &Figure) -> Vec<String> {
    vec![figure.way.to_owned(), figure.size.to_string()]
}

fn rates(title: &str, figures: &[Figure], of: fn(&Figure) -> &Rate) -> Table {
    let rows = figures.iter().map(|figure| {
        let rate = of(figure);
        let mut row = head(figure);
        let megabytes = rate.per_second * figure.size as f64 / 1e6;
        row.extend([
            format!("{:.0}", rate.per_second),
            digits(megabytes),
            digits(rate.lost_percent),
            digits(rate.cpu_us),
        ]);
        row
    });
    Table {
        title: title.into(),
        columns: vec!["by", "bytes", "messages/s", "MB/s", "lost, %", "gateway CPU, µs a message"],
        rows: rows.collect(),
    }
}
