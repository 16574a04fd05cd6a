//! The only place where this program prints: results to standard output, everything else to standard error.
//!
//! Unlike `println!`, no function here panics when the reader has closed the pipe.

use std::fmt::Display;
use std::io::{self, Write};

use crate::error::ProcessError;

/// Writes a line of the result.
pub fn line(text: impl Display) -> Result<(), ProcessError> {
    let mut out = io::stdout().lock();
    writeln!(out, "{text}").and_then(|()| out.flush()).map_err(ProcessError::Output)
}

/// Replaces control characters, and marks that change the direction of text, in a text of another machine.
pub fn clean(text: &str) -> String {
    text.chars().map(|c| if is_harmful(c) { '\u{fffd}' } else { c }).collect()
}

/// Returns `true` for a control character, or a mark that changes the direction of text.
pub fn is_harmful(c: char) -> bool {
    c.is_control() || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Returns a count with its noun: `1 node`, `3 nodes`.
pub fn several(count: u64, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// Writes a part of the result unchanged, control sequences included.
pub fn raw(text: &str) -> Result<(), ProcessError> {
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(ProcessError::Output)
}

/// Writes a line that is no result. Ignores failures, because they could not be reported.
pub fn diagnostic(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}

/// Formats rows as columns, each as wide as its widest cell. The last column is not padded.
pub fn columns(rows: &[Vec<String>]) -> Vec<String> {
    let count = rows.iter().map(Vec::len).max().unwrap_or(0);
    let cell_chars = |cell: &String| cell.chars().count();
    let widths: Vec<usize> = (0..count)
        .map(|i| rows.iter().filter_map(|row| row.get(i)).map(cell_chars).max().unwrap_or(0))
        .collect();
    rows.iter()
        .map(|row| {
            let cells = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}"));
            cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
        })
        .collect()
}

/// Formats bytes in powers of ten: `999 B`, `1.2 MB`.
pub fn bytes(n: u64) -> String {
    const UNITS: [&str; 5] = ["kB", "MB", "GB", "TB", "PB"];
    if n < 1000 {
        return format!("{n} B");
    }
    let mut value = n as f64 / 1000.0;
    let mut unit = 0;
    while value >= 999.95 && unit + 1 < UNITS.len() {
        value /= 1000.0;
        unit += 1;
    }
    format!("{value:.1} {}", UNITS[unit])
}

/// Formats microseconds as milliseconds: `1.24 ms`.
pub fn millis(us: u64) -> String {
    let ms = us as f64 / 1000.0;
    if ms < 10.0 { format!("{ms:.2} ms") } else { format!("{ms:.0} ms") }
}

/// Formats microseconds as milliseconds, with the greatest error if it is known: `-1.24 ms ± 0.50 ms`.
pub fn signed_millis(us: i64, error_us: Option<i64>) -> String {
    let sign = if us < 0 { "-" } else { "" };
    let error = error_us.map_or(String::new(), |error| format!(" ± {}", millis(error.unsigned_abs())));
    format!("{sign}{}{error}", millis(us.unsigned_abs()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned() {
        let row = |cells: &[&str]| cells.iter().map(|c| (*c).to_owned()).collect();
        assert_eq!(columns(&[row(&["a", "bb", "c"]), row(&["äöü", "d"])]), ["a    bb  c", "äöü  d"]);
        assert!(columns(&[]).is_empty());
    }

    #[test]
    fn text_of_another_machine_neither_commands_the_terminal_nor_turns_around() {
        assert_eq!(clean("a\u{1b}[2J\u{202e}b\nä"), "a\u{fffd}[2J\u{fffd}b\u{fffd}ä");
    }

    #[test]
    fn quantities_have_short_units() {
        for (n, text) in
            [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (999_960, "1.0 MB"), (1 << 50, "1.1 PB")]
        {
            assert_eq!(bytes(n), text);
        }
        assert_eq!((millis(1239).as_str(), millis(12_390).as_str()), ("1.24 ms", "12 ms"));
        assert_eq!(signed_millis(-1239, Some(500)), "-1.24 ms ± 0.50 ms");
        assert_eq!(signed_millis(12_390, None), "12 ms");
    }
}
