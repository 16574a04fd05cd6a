//! Lines whose parts have a tone, which a terminal shows as a colour.
//!
//! Only states and severities have a tone. Pipes, files and terminals without colours get the same characters, so no
//! program that reads them has to know of colours.

use std::fmt;
use std::io;

use anstream::{AutoStream, ColorChoice};
use anstyle::{AnsiColor, Color, Style};

use crate::error::ProcessError;
use crate::output;

/// The tone of a text.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tone {
    /// Neither good nor bad.
    #[default]
    Plain,
    /// As it should be.
    Good,
    /// An operator should look at it.
    Attention,
    /// Nothing works because of it.
    Bad,
}

impl Tone {
    fn style(self) -> Style {
        let colour = match self {
            Self::Plain => return Style::new(),
            Self::Good => AnsiColor::Green,
            Self::Attention => AnsiColor::Yellow,
            Self::Bad => AnsiColor::Red,
        };
        Style::new().fg_color(Some(Color::Ansi(colour)))
    }
}

/// A text with a tone: a cell of a table, or a part of a line.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Toned {
    text: String,
    tone: Tone,
}

impl Toned {
    /// Returns a text with a tone.
    pub fn new(tone: Tone, text: impl Into<String>) -> Self {
        Self { text: text.into(), tone }
    }
}

impl<T: Into<String>> From<T> for Toned {
    fn from(text: T) -> Self {
        Self::new(Tone::Plain, text)
    }
}

impl fmt::Display for Toned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// A line of toned texts. It displays as plain text.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Line(Vec<Toned>);

impl Line {
    /// Returns a line of these parts.
    pub fn new(parts: impl IntoIterator<Item = Toned>) -> Self {
        Self(parts.into_iter().collect())
    }

    /// Returns the line with an indentation.
    #[must_use]
    pub fn indented(mut self, by: &str) -> Self {
        self.0.insert(0, by.into());
        self
    }

    /// Returns the line without control characters of other machines in its texts.
    #[must_use]
    pub fn cleaned(mut self) -> Self {
        self.0.iter_mut().for_each(|part| part.text = output::clean(&part.text));
        self
    }

    /// Returns the line with the escape sequences of its tones.
    fn coloured(&self) -> String {
        let part = |Toned { text, tone }: &Toned| {
            let style = tone.style();
            format!("{}{text}{}", style.render(), style.render_reset())
        };
        self.0.iter().map(part).collect()
    }

    /// Writes the line to standard output, in colours where it shows them.
    pub fn print(&self) -> Result<(), ProcessError> {
        if has_colours() { output::line(self.coloured()) } else { output::line(self) }
    }
}

impl<T: Into<String>> From<T> for Line {
    fn from(text: T) -> Self {
        Self(vec![text.into().into()])
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|part| f.write_str(&part.text))
    }
}

/// Formats rows as columns, each as wide as its widest cell. The last column is not padded.
pub fn columns(rows: &[Vec<Toned>]) -> Vec<Line> {
    const GAP: usize = 2;
    let count = rows.iter().map(Vec::len).max().unwrap_or(0);
    let chars = |cell: &Toned| cell.text.chars().count();
    let widths: Vec<usize> =
        (0..count).map(|i| rows.iter().filter_map(|row| row.get(i)).map(chars).max().unwrap_or(0)).collect();
    let line = |row: &Vec<Toned>| {
        let mut parts = Vec::new();
        // Padding comes before the next cell that has a text, so that no line ends with it.
        let mut padding = 0;
        for (cell, width) in row.iter().zip(&widths) {
            if !cell.text.is_empty() {
                parts.push(" ".repeat(padding).into());
                parts.push(cell.clone());
                padding = 0;
            }
            padding += width - chars(cell) + GAP;
        }
        Line(parts)
    };
    rows.iter().map(line).collect()
}

/// Returns `true` if standard output shows colours: a terminal whose `TERM` is not `dumb`. `NO_COLOR`, `CLICOLOR` and
/// `CLICOLOR_FORCE` overrule that (<https://no-color.org>, <https://bixense.com/clicolors>).
fn has_colours() -> bool {
    AutoStream::choice(&io::stdout()) != ColorChoice::Never
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_whatever_their_tones_are() {
        let rows = [
            vec!["a".into(), Toned::new(Tone::Bad, "bb"), "c".into()],
            vec!["".into(), Toned::new(Tone::Good, "ö"), "".into()],
            vec!["äöü".into(), "".into(), "d".into()],
        ];
        let lines = columns(&rows);
        let plain: Vec<_> = lines.iter().map(ToString::to_string).collect();
        assert_eq!(plain, ["a    bb  c", "     ö", "äöü      d"]);
        let coloured: Vec<_> = lines.iter().map(Line::coloured).collect();
        assert_eq!(coloured, ["a    \u{1b}[31mbb\u{1b}[0m  c", "     \u{1b}[32mö\u{1b}[0m", "äöü      d"]);
    }

    #[test]
    fn text_of_another_machine_brings_no_colours() {
        let line = Line::new([Toned::new(Tone::Attention, "a\u{1b}[31mb")]).cleaned().indented("  ");
        assert_eq!(line.to_string(), "  a\u{fffd}[31mb");
        assert_eq!(line.coloured(), "  \u{1b}[33ma\u{fffd}[31mb\u{1b}[0m");
    }
}
