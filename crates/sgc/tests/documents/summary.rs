//! The summary of the book names every page below its folder, each once.
//!
//! The book's program leaves out pages that the summary does not name.

use std::collections::BTreeSet;

use crate::markdown::Document;
use crate::repository::{REPOSITORY, Repository};

const SUMMARY: &str = "SUMMARY.md";

#[test]
fn the_summary_names_every_page_once() {
    let faults = faults(&REPOSITORY);
    assert!(
        faults.is_empty(),
        "these pages are wrong in the summary of the book:\n  {}",
        faults.join("\n  ")
    );
}

#[test]
fn a_page_that_is_missing_or_named_twice_is_found() {
    let repository = |summary: &str| {
        Repository::make(&[
            ("docs/SUMMARY.md", summary),
            ("docs/a.md", ""),
            ("docs/b/c.md", ""),
            ("d.md", ""),
        ])
    };
    assert_eq!(faults(&repository("- [A](a.md)\n- [C](b/c.md)\n")), [""; 0]);
    let faults = faults(&repository("- [A](a.md)\n- [A](a.md)\n- [E](e.md)\n"));
    assert_eq!(
        faults,
        ["docs/a.md: named twice", "docs/b/c.md: not named", "docs/e.md: named, and not there"]
    );
}

fn faults(repository: &Repository) -> Vec<String> {
    let summary = repository.files_ending(SUMMARY).next().unwrap();
    let folder = summary.trim_end_matches(SUMMARY).trim_end_matches('/');
    let links = Document::new(summary, &repository.read(summary)).links();
    let named: Vec<_> = links.into_iter().map(|link| format!("{folder}/{}", link.target)).collect();
    let pages = repository.files_below(folder).filter(|page| page.ends_with(".md") && *page != summary);
    let pages: BTreeSet<_> = pages.map(str::to_owned).collect();
    let mut faults = Vec::new();
    for page in pages.iter().chain(&named).collect::<BTreeSet<_>>() {
        match (pages.contains(page), named.iter().filter(|other| *other == page).count()) {
            (true, 1) => {}
            (true, 0) => faults.push(format!("{page}: not named")),
            (true, _) => faults.push(format!("{page}: named twice")),
            (false, _) => faults.push(format!("{page}: named, and not there")),
        }
    }
    faults
}
