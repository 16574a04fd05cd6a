//! [`encode`]: metrics to the body of a request.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prost::Message as _;

use crate::messages::proto::collector::metrics::v1::ExportMetricsServiceRequest;
use crate::messages::proto::common::v1::{AnyValue, InstrumentationScope, KeyValue, any_value};
use crate::messages::proto::metrics::v1::metric::Data;
use crate::messages::proto::metrics::v1::{
    AggregationTemporality, Gauge, Metric as MetricMessage, NumberDataPoint, ResourceMetrics, ScopeMetrics,
    Sum, number_data_point,
};
use crate::messages::proto::resource::v1::Resource;

/// The content type of requests, and of the answers to them.
pub const CONTENT_TYPE: &str = "application/x-protobuf";

/// The source of metrics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    /// Attributes of the resource, by the semantic conventions of OpenTelemetry.
    pub attributes: Vec<(&'static str, String)>,
    /// The program's name, as the scope of all metrics.
    pub scope: &'static str,
    /// The program's version.
    pub version: &'static str,
}

/// Kinds of metrics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A number that only grows: a cumulative monotonic sum.
    Counter,
    /// A number that rises and falls.
    Gauge,
}

/// A metric and its values at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Metric {
    /// The name.
    pub name: &'static str,
    /// The meaning, for people.
    pub description: String,
    /// The unit as UCUM writes it; empty for numbers of things.
    pub unit: &'static str,
    /// The kind.
    pub kind: Kind,
    /// The values.
    pub points: Vec<Point>,
}

/// A value of a metric.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// The labels.
    pub attributes: Vec<(&'static str, String)>,
    /// The beginning of the count; `None` for gauges.
    pub start: Option<SystemTime>,
    /// The value.
    pub value: f64,
}

/// Returns the body of a request with the values of one moment, `at`.
pub fn encode(origin: &Origin, metrics: Vec<Metric>, at: SystemTime) -> Vec<u8> {
    let attributes = attributes(origin.attributes.iter().cloned());
    let scope = InstrumentationScope {
        name: origin.scope.to_owned(),
        version: origin.version.to_owned(),
        ..InstrumentationScope::default()
    };
    let scope_metrics = ScopeMetrics {
        scope: Some(scope),
        metrics: metrics.into_iter().map(|metric| message(metric, at)).collect(),
        ..ScopeMetrics::default()
    };
    let resource_metrics = ResourceMetrics {
        resource: Some(Resource { attributes, ..Resource::default() }),
        scope_metrics: vec![scope_metrics],
        ..ResourceMetrics::default()
    };
    ExportMetricsServiceRequest { resource_metrics: vec![resource_metrics] }.encode_to_vec()
}

fn message(metric: Metric, at: SystemTime) -> MetricMessage {
    let Metric { name, description, unit, kind, points } = metric;
    let data_points = points.into_iter().map(|point| data_point(point, at)).collect();
    let data = match kind {
        Kind::Gauge => Data::Gauge(Gauge { data_points }),
        Kind::Counter => Data::Sum(Sum {
            data_points,
            aggregation_temporality: AggregationTemporality::Cumulative.into(),
            is_monotonic: true,
        }),
    };
    MetricMessage {
        name: name.to_owned(),
        description,
        unit: unit.to_owned(),
        data: Some(data),
        ..MetricMessage::default()
    }
}

fn data_point(point: Point, at: SystemTime) -> NumberDataPoint {
    NumberDataPoint {
        attributes: attributes(point.attributes),
        // A clock that was set back must not make the end of a count precede its beginning.
        start_time_unix_nano: point.start.map_or(0, |start| unix_nanos(start.min(at))),
        time_unix_nano: unix_nanos(at),
        value: Some(number_data_point::Value::AsDouble(point.value)),
        ..NumberDataPoint::default()
    }
}

fn attributes(pairs: impl IntoIterator<Item = (&'static str, String)>) -> Vec<KeyValue> {
    let attribute = |(key, value): (&'static str, String)| KeyValue {
        key: key.to_owned(),
        value: Some(AnyValue { value: Some(any_value::Value::StringValue(value)) }),
        ..KeyValue::default()
    };
    pairs.into_iter().map(attribute).collect()
}

fn unix_nanos(at: SystemTime) -> u64 {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    since.as_nanos().try_into().unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    fn sent(points: Vec<Point>, kind: Kind, at: SystemTime) -> MetricMessage {
        let metric = Metric { name: "sgc_links", description: "Links.".to_owned(), unit: "By", kind, points };
        let origin =
            Origin { attributes: vec![("service.name", "sgc".to_owned())], scope: "sgc", version: "1.2.3" };
        let body = encode(&origin, vec![metric], at);
        let mut request = ExportMetricsServiceRequest::decode(&body[..]).unwrap();
        let mut of_resource = request.resource_metrics.pop().unwrap();
        let resource = of_resource.resource.unwrap();
        assert_eq!(resource.attributes, attributes([("service.name", "sgc".to_owned())]));
        let mut of_scope = of_resource.scope_metrics.pop().unwrap();
        let scope = of_scope.scope.unwrap();
        assert_eq!((scope.name.as_str(), scope.version.as_str()), ("sgc", "1.2.3"));
        of_scope.metrics.pop().unwrap()
    }

    #[test]
    fn counter_is_a_cumulative_monotonic_sum_since_its_start() {
        let at = UNIX_EPOCH + Duration::from_nanos(7_000_000_009);
        let start = Some(UNIX_EPOCH + Duration::from_nanos(3));
        let labels = vec![("side", "dialled".to_owned())];
        let point = Point { attributes: labels.clone(), start, value: 2.5 };
        let message = sent(vec![point], Kind::Counter, at);
        assert_eq!((message.name.as_str(), message.unit.as_str()), ("sgc_links", "By"));
        assert_eq!(message.description, "Links.");
        let Some(Data::Sum(sum)) = message.data else { panic!("{:?}", message.data) };
        assert!(sum.is_monotonic && sum.aggregation_temporality() == AggregationTemporality::Cumulative);
        let [point] = &sum.data_points[..] else { panic!("{:?}", sum.data_points) };
        assert_eq!((point.start_time_unix_nano, point.time_unix_nano), (3, 7_000_000_009));
        assert_eq!(point.value, Some(number_data_point::Value::AsDouble(2.5)));
        assert_eq!(point.attributes, attributes(labels));
    }

    #[test]
    fn gauge_has_no_start() {
        let point = Point { attributes: Vec::new(), start: None, value: -1.0 };
        let message = sent(vec![point], Kind::Gauge, UNIX_EPOCH + Duration::from_secs(1));
        let Some(Data::Gauge(gauge)) = message.data else { panic!("{:?}", message.data) };
        assert_eq!(gauge.data_points[0].start_time_unix_nano, 0);
        assert_eq!(gauge.data_points[0].value, Some(number_data_point::Value::AsDouble(-1.0)));
    }

    #[test]
    fn start_never_follows_the_moment_of_the_value() {
        let at = UNIX_EPOCH + Duration::from_nanos(5);
        let point =
            Point { attributes: Vec::new(), start: Some(UNIX_EPOCH + Duration::from_secs(9)), value: 1.0 };
        let Some(Data::Sum(sum)) = sent(vec![point], Kind::Counter, at).data else { panic!("no sum") };
        assert_eq!(sum.data_points[0].start_time_unix_nano, 5);
    }
}
