//! Spans of time on the command line: one syntax for all commands.

use std::time::Duration;

use sgc_node::config;

/// Parses a span of time: `90d`, `12h`, `30min` or `2s`. A number without a unit is refused with its unit.
pub(crate) fn parse_span(text: &str) -> Result<Duration, String> {
    match config::parse_duration(text) {
        Some(Duration::ZERO) => Err("it has to be longer than nothing".into()),
        Some(span) => Ok(span),
        None if is_number(text) => Err(format!("a time has a unit: {text}s")),
        None => Err("a time is a number with its unit: 90d, 12h, 30min or 2s".into()),
    }
}

/// Parses a span of time that is no longer than `max`, which is whole days.
pub(crate) fn parse_span_within(text: &str, max: Duration) -> Result<Duration, String> {
    let span = parse_span(text)?;
    match span <= max {
        true => Ok(span),
        false => Err(format!("at most {}d", max.as_secs() / 86_400)),
    }
}

/// Parses a span of whole seconds that is no longer than `max`.
pub(crate) fn parse_seconds(text: &str, max: u32) -> Result<u32, String> {
    let seconds = u32::try_from(parse_span(text)?.as_secs()).ok().filter(|seconds| *seconds <= max);
    seconds.ok_or_else(|| format!("at most {max}s"))
}

/// Returns a span in milliseconds, or as many as there can be.
pub(crate) fn millis(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit())
}
