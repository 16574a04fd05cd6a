//! Pages that are made of the code, and committed.

use std::fs;

use crate::repository::REPOSITORY;

/// The variable that has pages written anew.
const GENERATE: &str = "SGC_GENERATE";

/// The longest line of text.
const COLUMNS: usize = 100;

/// Compares a committed page with what the code says, or writes it.
#[track_caller]
pub(crate) fn check(path: &str, page: &str) {
    if std::env::var_os(GENERATE).is_some() {
        let file = REPOSITORY.at(path);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, page).unwrap();
        return;
    }
    let committed = REPOSITORY.read(path);
    let differs = committed.lines().zip(page.lines()).find(|(old, new)| old != new);
    assert!(
        committed == page,
        "{path} is not what the code says: `{GENERATE}=1 cargo test -p sgc --test documents` writes it anew. First difference: \
         {differs:?}"
    );
}

/// Returns the note at the top of a generated page.
pub(crate) fn note(of: &str) -> String {
    format!("<!-- Made of {of} by `{GENERATE}=1 cargo test -p sgc --test documents`. Do not edit. -->\n\n")
}

/// Wraps a paragraph. Lines after the first are indented by `indent` columns.
pub(crate) fn wrapped(text: &str, indent: usize) -> String {
    let (mut wrapped, mut columns) = (String::new(), 0);
    for word in words(text) {
        let length = word.chars().count();
        if columns > 0 && columns + 1 + length > COLUMNS {
            wrapped.push('\n');
            wrapped.extend(std::iter::repeat_n(' ', indent));
            columns = indent;
        } else if columns > 0 {
            wrapped.push(' ');
            columns += 1;
        }
        wrapped.push_str(&word);
        columns += length;
    }
    wrapped.push('\n');
    wrapped
}

/// Returns the words of a text, a code span as one of them.
fn words(text: &str) -> Vec<String> {
    let mut words: Vec<String> = Vec::new();
    for piece in text.split_whitespace() {
        match words.last_mut().filter(|last| last.matches('`').count() % 2 == 1) {
            Some(last) => {
                last.push(' ');
                last.push_str(piece);
            }
            None => words.push(piece.to_owned()),
        }
    }
    words
}

/// Returns text as a cell of a table has it.
pub(crate) fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

#[test]
fn lines_are_wrapped_between_words_and_not_in_code() {
    let text = format!("{} `a b` {}", "x".repeat(96), "y".repeat(10));
    assert_eq!(wrapped(&text, 2), format!("{}\n  `a b` {}\n", "x".repeat(96), "y".repeat(10)));
}
