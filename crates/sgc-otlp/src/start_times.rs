//! [`StartTimes`]: since when each counter counts.

use std::collections::BTreeMap;
use std::time::SystemTime;

use crate::request::{Kind, Metric};

/// The beginnings of counters. OTLP lets a counter start anew only with a later start, else its fall would look like an
/// error. It holds the series of the last values, which the caller bounds.
#[derive(Clone, Debug)]
pub struct StartTimes {
    /// The beginning of all counters that are there from the first values on.
    started: SystemTime,
    /// The moment of the last values.
    last: Option<SystemTime>,
    series: BTreeMap<Series, Count>,
}

/// A metric's name and labels.
type Series = (&'static str, Vec<(&'static str, String)>);

#[derive(Clone, Copy, Debug)]
struct Count {
    start: SystemTime,
    value: f64,
}

impl StartTimes {
    /// Creates the start times of counters that count since `started`.
    pub fn new(started: SystemTime) -> Self {
        Self { started, last: None, series: BTreeMap::new() }
    }

    /// Sets the starts of the counters in `metrics`, the values of the moment `at`.
    ///
    /// A series that was not among the values before, or whose value is smaller now, began after those.
    pub fn set(&mut self, metrics: &mut [Metric], at: SystemTime) {
        let begun = self.last.unwrap_or(self.started);
        let mut series = BTreeMap::new();
        for metric in metrics.iter_mut().filter(|metric| metric.kind == Kind::Counter) {
            for point in &mut metric.points {
                let key = (metric.name, point.attributes.clone());
                let known = self.series.get(&key).filter(|known| known.value <= point.value);
                let start = known.map_or(begun, |known| known.start);
                point.start = Some(start);
                series.insert(key, Count { start, value: point.value });
            }
        }
        (self.series, self.last) = (series, Some(at));
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::time::{Duration, UNIX_EPOCH};

    use super::*;
    use crate::request::Point;

    fn at(second: u64) -> SystemTime {
        UNIX_EPOCH + Duration::from_secs(second)
    }

    /// Returns the seconds at which counters with these values at `second` began.
    fn starts(times: &mut StartTimes, second: u64, values: &[(&str, f64)]) -> Vec<u64> {
        let point = |(label, value): &(&str, f64)| Point {
            attributes: vec![("reason", (*label).to_owned())],
            start: None,
            value: *value,
        };
        let points = values.iter().map(point).collect();
        let (name, description, unit) = ("sgc_drops_total", String::new(), "");
        let mut metrics = [Metric { name, description, unit, kind: Kind::Counter, points }];
        times.set(&mut metrics, at(second));
        let start = |point: &Point| point.start.unwrap().duration_since(UNIX_EPOCH).unwrap().as_secs();
        metrics[0].points.iter().map(start).collect()
    }

    #[test]
    fn counter_that_fell_or_came_back_begins_at_the_values_before() {
        let mut times = StartTimes::new(at(1));
        assert_eq!(starts(&mut times, 10, &[("a", 5.0), ("b", 1.0)]), [1, 1]);
        assert_eq!(starts(&mut times, 20, &[("a", 5.0), ("b", 2.0), ("late", 1.0)]), [1, 1, 10]);
        assert_eq!(starts(&mut times, 30, &[("a", 4.0), ("late", 9.0)]), [20, 10]);
        // It grew past its old value while it was away.
        assert_eq!(starts(&mut times, 40, &[("a", 4.5), ("b", 7.0), ("late", 9.0)]), [20, 30, 10]);
        assert_eq!(starts(&mut times, 50, &[("a", 4.5), ("b", 7.0), ("late", 9.0)]), [20, 30, 10]);
    }

    #[test]
    fn gauges_have_no_start_and_take_no_room() {
        let mut times = StartTimes::new(at(1));
        let point = Point { attributes: Vec::new(), start: None, value: 1.0 };
        let (name, description, unit) = ("sgc_links", String::new(), "");
        let mut metrics = [Metric { name, description, unit, kind: Kind::Gauge, points: vec![point] }];
        times.set(&mut metrics, at(2));
        assert!(metrics[0].points[0].start.is_none() && times.series.is_empty());
    }
}
