//! Durations, rates and sizes: numbers with a unit, from text and to text.

use std::time::Duration;

const RATE_UNITS: [(u64, &str); 3] = [(1_000_000_000, "Gbps"), (1_000_000, "Mbps"), (1000, "kbps")];
const SIZE_UNITS: [(u64, &str); 3] = [(1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")];

/// Parses a duration: `90s`, `15min`, `1h`, `30d`.
pub fn parse_duration(text: &str) -> Option<Duration> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let unit = match unit.trim_start() {
        "s" => 1,
        "m" | "min" => 60,
        "h" => 3600,
        "d" => 86_400,
        _ => return None,
    };
    number.parse::<u64>().ok()?.checked_mul(unit).map(Duration::from_secs)
}

/// Formats a duration in the largest unit that divides it.
pub(crate) fn duration_text(duration: Duration) -> String {
    let seconds = duration.as_secs();
    let units = [(86_400, "d"), (3600, "h"), (60, "min")];
    let unit = units.into_iter().find(|(unit, _)| seconds.is_multiple_of(*unit) && seconds > 0);
    unit.map_or_else(|| format!("{seconds}s"), |(unit, text)| format!("{}{text}", seconds / unit))
}

/// Parses a rate: `500kbps`, `50Mbps`, `1Gbps`. Returns bits a second.
pub fn parse_rate(text: &str) -> Option<u64> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let unit = RATE_UNITS.into_iter().find(|(_, name)| *name == unit.trim_start())?.0;
    number.parse::<u64>().ok()?.checked_mul(unit)
}

/// Formats a rate in the largest unit that divides it.
pub(crate) fn rate_text(rate: u64) -> String {
    let unit = RATE_UNITS.into_iter().find(|(unit, _)| rate.is_multiple_of(*unit));
    unit.map_or_else(|| format!("{rate}bps"), |(unit, name)| format!("{}{name}", rate / unit))
}

/// Parses a size: `512KiB`, `64MiB`, `1GiB`.
pub(crate) fn parse_size(text: &str) -> Option<u64> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let unit = SIZE_UNITS.into_iter().find(|(_, name)| *name == unit.trim_start())?.0;
    number.parse::<u64>().ok()?.checked_mul(unit)
}

/// Formats a size in the largest unit that divides it.
pub(crate) fn size_text(bytes: u64) -> String {
    let unit = SIZE_UNITS.into_iter().find(|(unit, _)| bytes.is_multiple_of(*unit) && bytes > 0);
    unit.map_or_else(|| format!("{bytes} bytes"), |(unit, name)| format!("{}{name}", bytes / unit))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_a_unit() {
        for (text, bytes) in [("64MiB", 64 << 20), ("1 GiB", 1 << 30), ("512KiB", 512 << 10)] {
            assert_eq!(parse_size(text), Some(bytes), "{text}");
        }
        for text in ["", "64", "64MB", "-1MiB", "MiB", "99999999999GiB", "1.5MiB"] {
            assert_eq!(parse_size(text), None, "{text}");
        }
        assert_eq!((size_text(64 << 20), size_text(1000)), ("64MiB".to_owned(), "1000 bytes".to_owned()));
    }
}
