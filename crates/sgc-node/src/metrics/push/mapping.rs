//! The metrics of a sample as OTLP has them: the same names, labels and values as `/metrics`.

use sgc_otlp::{Kind, Metric, Origin, Point};
use sgc_trust::Identity;

use crate::metrics::series::{COUNTER_SUFFIX, METRICS, MetricKind, NODE, Sample, without_markup};

/// Describes a node by the semantic conventions of OpenTelemetry. They have no attributes for nodes and fleets.
pub(super) fn origin_of(identity: &Identity) -> Origin {
    let version = env!("CARGO_PKG_VERSION");
    Origin {
        attributes: vec![
            ("service.name", "sgc".to_owned()),
            ("service.instance.id", identity.node_id().to_string()),
            ("service.version", version.to_owned()),
            ("sgc.node.name", identity.node_name().to_string()),
            ("sgc.fleet.name", identity.fleet_name().to_string()),
        ],
        scope: "sgc",
        version,
    }
}

/// Returns the metrics of a sample. Counters have no start yet.
pub(super) fn metrics_of(sample: &Sample) -> Vec<Metric> {
    let with_points = METRICS.iter().map(|metric| {
        let point = |(values, value): (Vec<String>, f64)| {
            let node = (NODE, sample.readings.node.clone());
            let labels = metric.labels.iter().copied().zip(values);
            Point { attributes: std::iter::once(node).chain(labels).collect(), start: None, value }
        };
        Metric {
            name: metric.name,
            description: without_markup(metric.help),
            unit: unit_of(metric.name),
            kind: match metric.kind {
                MetricKind::Counter => Kind::Counter,
                MetricKind::Gauge => Kind::Gauge,
            },
            points: metric.series(sample).into_iter().map(point).collect(),
        }
    });
    with_points.filter(|metric| !metric.points.is_empty()).collect()
}

/// Returns the unit of a metric in UCUM, which its name ends with; empty for numbers of things.
fn unit_of(name: &str) -> &'static str {
    let name = name.strip_suffix(COUNTER_SUFFIX).unwrap_or(name);
    match name.rsplit('_').next() {
        Some("seconds") => "s",
        Some("bytes") => "By",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::collections::BTreeMap;

    use super::*;
    use crate::metrics::series::{sample, text};

    #[test]
    fn series_are_those_of_the_text_for_prometheus() {
        let sample = sample();
        let mut pushed = BTreeMap::new();
        for metric in metrics_of(&sample) {
            let is_counter = metric.name.ends_with(COUNTER_SUFFIX);
            assert_eq!(metric.kind, if is_counter { Kind::Counter } else { Kind::Gauge }, "{}", metric.name);
            for Point { attributes, value, .. } in metric.points {
                let labels: Vec<_> =
                    attributes.iter().map(|(key, value)| format!("{key}={value:?}")).collect();
                let series = format!("{}{{{}}}", metric.name, labels.join(","));
                assert!(pushed.insert(series, value).is_none());
            }
        }
        let text = text(sample).unwrap();
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        let scraped: BTreeMap<String, f64> = lines
            .map(|line| line.rsplit_once(' ').unwrap())
            .map(|(series, value)| (series.to_owned(), value.parse().unwrap()))
            .collect();
        assert_eq!(pushed, scraped);
        assert_eq!(pushed[r#"sgc_drops_total{node="robot",reason="sink_lost"}"#], 3.0);
        assert_eq!(pushed[r#"sgc_otlp_pushes_total{node="robot",result="busy"}"#], 2.0);
    }

    #[test]
    fn units_are_those_of_the_names() {
        for (name, unit) in [
            ("sgc_sent_bytes_total", "By"),
            ("process_resident_memory_bytes", "By"),
            ("sgc_uptime_seconds", "s"),
            ("sgc_certificate_expiry_timestamp_seconds", "s"),
            ("process_cpu_seconds_total", "s"),
            ("sgc_links", ""),
            ("sgc_drops_total", ""),
        ] {
            assert!(METRICS.iter().any(|metric| metric.name == name), "{name}");
            assert_eq!(unit_of(name), unit, "{name}");
        }
    }
}
