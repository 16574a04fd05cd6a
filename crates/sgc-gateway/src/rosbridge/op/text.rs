//! Texts for clients, which are bounded because they echo what a client sent.

use std::fmt;

/// Longest error text for a client, in bytes. Several names fit.
const TOLD_BYTES_MAX: usize = 4096;
/// Most characters of input that are shown in an error.
const SHOWN_MAX: usize = 80;

/// Returns the text of an error for a client.
pub(crate) fn told(error: &impl fmt::Display) -> String {
    clip(&error.to_string(), TOLD_BYTES_MAX)
}

/// Returns the beginning of a text.
pub(super) fn clip(text: &str, bytes_max: usize) -> String {
    if text.len() <= bytes_max {
        return text.to_owned();
    }
    let end = (0..=bytes_max).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0);
    format!("{}…", text.get(..end).unwrap_or_default())
}

/// Returns the beginning of an input that an error shows.
pub(crate) fn short(text: &str) -> String {
    let mut shown: String = text.chars().take(SHOWN_MAX).collect();
    if shown.len() < text.len() {
        shown.push('…');
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_end_between_characters() {
        let long = "ä".repeat(10_000);
        assert!(told(&long).len() <= TOLD_BYTES_MAX + "…".len());
        assert_eq!((clip("äää", 3), clip("äää", 6)), ("ä…".to_owned(), "äää".to_owned()));
        assert_eq!(short(&long), format!("{}…", "ä".repeat(SHOWN_MAX)));
    }
}
