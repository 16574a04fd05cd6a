//! Parses rates, times, percentages and sizes as users write them: `5mbit`, `40ms`, `2%`, `64kb`.

use std::time::Duration;

use super::channel::QueueLimit;

/// The error of a text that is no such quantity.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no {what}: write {example}")]
pub struct UnitError {
    text: String,
    what: &'static str,
    example: &'static str,
}

/// Parses bits per second: `800kbit`, `5mbit`, `1gbit`.
pub fn parse_rate(text: &str) -> Result<u64, UnitError> {
    let units = [("gbit", 1e9), ("mbit", 1e6), ("kbit", 1e3), ("bit", 1.0)];
    let rate = scaled(text, &units).filter(|rate| *rate >= 1.0);
    rate.map(|rate| rate as u64).ok_or_else(|| error(text, "rate", "5mbit, 800kbit or 1gbit"))
}

/// Parses a time: `40ms`, `500us`, `2s`.
pub fn parse_duration(text: &str) -> Result<Duration, UnitError> {
    let seconds = scaled(text, &[("us", 1e-6), ("ms", 1e-3), ("s", 1.0)]);
    seconds
        .and_then(|seconds| Duration::try_from_secs_f64(seconds).ok())
        .ok_or_else(|| error(text, "time", "40ms, 500us or 2s"))
}

/// Parses a fraction of all packets: `2%`, `0.1%`.
pub fn parse_percent(text: &str) -> Result<f64, UnitError> {
    let share = scaled(text, &[("%", 0.01)]).filter(|share| *share <= 1.0);
    share.ok_or_else(|| error(text, "share", "2% (at most 100%)"))
}

/// Parses a number of bytes: `9000b`, `64kb`, `1mb`.
pub fn parse_bytes(text: &str) -> Result<u64, UnitError> {
    let bytes = scaled(text, &[("kb", 1e3), ("mb", 1e6), ("b", 1.0)]);
    bytes.map(|bytes| bytes as u64).ok_or_else(|| error(text, "size", "64kb, 1mb or 9000b"))
}

/// Parses the bound of a queue: a time at the rate, or bytes.
pub fn parse_queue(text: &str) -> Result<QueueLimit, UnitError> {
    let time = parse_duration(text).map(QueueLimit::Time);
    time.or_else(|_| parse_bytes(text).map(QueueLimit::Bytes))
        .map_err(|_| error(text, "queue", "200ms (of the rate) or 64kb"))
}

/// Returns the number before the first matching unit, times its factor.
fn scaled(text: &str, units: &[(&str, f64)]) -> Option<f64> {
    let text = text.to_ascii_lowercase();
    let (number, factor) =
        units.iter().find_map(|(unit, factor)| Some((text.strip_suffix(unit)?, factor)))?;
    let number: f64 = number.trim().parse().ok()?;
    (number.is_finite() && number >= 0.0).then_some(number * factor)
}

fn error(text: &str, what: &'static str, example: &'static str) -> UnitError {
    UnitError { text: text.chars().take(40).collect(), what, example }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantities_are_parsed() {
        assert_eq!(parse_rate("5mbit"), Ok(5_000_000));
        assert_eq!(parse_rate("1.5Mbit"), Ok(1_500_000));
        assert_eq!(parse_rate("800kbit"), Ok(800_000));
        assert_eq!(parse_duration("40ms"), Ok(Duration::from_millis(40)));
        assert_eq!(parse_duration("500us"), Ok(Duration::from_micros(500)));
        assert_eq!(parse_duration("2s"), Ok(Duration::from_secs(2)));
        assert_eq!(parse_percent("2%"), Ok(0.02));
        assert_eq!(parse_queue("200ms"), Ok(QueueLimit::Time(Duration::from_millis(200))));
        assert_eq!(parse_queue("64kb"), Ok(QueueLimit::Bytes(64_000)));
    }

    #[test]
    fn invalid_quantity_is_named() {
        for text in ["", "5", "mbit", "-1mbit", "0bit", "nanmbit", "5 furlongs"] {
            assert!(parse_rate(text).is_err(), "{text}");
        }
        for text in ["", "5", "-1ms", "1h"] {
            assert!(parse_duration(text).is_err(), "{text}");
        }
        for text in ["2", "101%", "-1%", "%"] {
            assert!(parse_percent(text).is_err(), "{text}");
        }
        let error = parse_rate("fast").unwrap_err().to_string();
        assert_eq!(error, "\"fast\" is no rate: write 5mbit, 800kbit or 1gbit");
    }
}
