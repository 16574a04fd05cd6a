//! `docs/reference/metrics.md` is made of the metrics that a node serves, and the dashboard and the alert rules use no
//! others.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use sgc_node::{METRICS, MetricKind};

use crate::generated::{self, cell, wrapped};
use crate::repository::REPOSITORY;

const PAGE: &str = "docs/reference/metrics.md";
/// Files with expressions of Prometheus.
const USERS: [&str; 3] =
    ["dist/grafana/sgc.json", "dist/prometheus/alerts.test.yml", "dist/prometheus/alerts.yml"];

#[test]
fn the_page_of_metrics_is_what_the_code_says() {
    generated::check(PAGE, &page());
}

#[test]
fn dashboard_and_alert_rules_use_metrics_that_exist() {
    let known: BTreeSet<_> = METRICS.iter().map(|metric| metric.name).collect();
    for file in USERS {
        let text = REPOSITORY.read(file);
        let used: BTreeSet<_> = text
            .split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'))
            .filter(|word| word.starts_with("sgc_") || word.starts_with("process_"))
            .collect();
        assert!(used.len() >= 5, "{file}: {used:?}");
        let unknown: Vec<_> = used.into_iter().filter(|word| !known.contains(*word)).collect();
        assert!(unknown.is_empty(), "{file} uses metrics that do not exist: {unknown:?}");
    }
}

fn page() -> String {
    let mut page = generated::note("the metrics that a node serves");
    page.push_str("# Metrics\n\n");
    for paragraph in [
        "A node with [`[metrics]`](configuration.md#metrics) serves these metrics for Prometheus, and pushes them to an \
         OpenTelemetry collector if `otlp` names one. [How to watch nodes with Prometheus](../how-to/monitoring.md) has the \
         first steps.",
        "All metrics have the label `node`, with the name of the node. A metric without values is left out, such as those of \
         a gateway that is not there. The number of series is bounded: there is none for each 256-bit name, peer or client, \
         and at most 1000 shares and uses have some.",
    ] {
        page.push_str(&wrapped(paragraph, 0));
        page.push('\n');
    }
    page.push_str("| metric | kind | labels | meaning |\n|---|---|---|---|\n");
    for metric in METRICS {
        let kind = match metric.kind {
            MetricKind::Counter => "counter",
            MetricKind::Gauge => "gauge",
        };
        let labels: Vec<_> = metric.labels.iter().map(|label| format!("`{label}`")).collect();
        let help = cell(metric.help);
        let _ = writeln!(page, "| `{}` | {kind} | {} | {help} |", metric.name, labels.join(", "));
    }
    page
}
