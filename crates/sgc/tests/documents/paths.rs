//! Links lead to files and headings, and paths in code spans to files and folders. Documents that the code cites exist,
//! too.
//!
//! A path may be cited without its first folders, as `router.rs` or `sgc-router/src/router.rs`. Files of users, such as
//! `node.toml`, are not looked for.

use crate::markdown::{Document, Paragraph, Span};
use crate::report::Report;
use crate::repository::{REPOSITORY, Repository};

/// A line of a document that cites files and names of other projects: those that are not here are no faults.
pub(crate) const CITES_OTHERS: &str = "<!-- Cites files and names of other projects. -->";
/// Endings of files that only a repository has.
const OF_SOURCES: [&str; 5] = [".rs", ".py", ".sh", ".proto", ".md"];
/// Folders of a crate.
const OF_CRATES: [&str; 4] = ["src", "tests", "examples", "benches"];

#[test]
fn every_link_leads_somewhere() {
    let mut report = Report::default();
    for document in REPOSITORY.linked_documents() {
        check_links(&REPOSITORY, &document, &mut report);
    }
    report.finish(100, "these links lead nowhere:");
}

#[test]
fn every_cited_path_exists() {
    let mut report = Report::default();
    for document in REPOSITORY.documents() {
        check_paths(&REPOSITORY, &document, &mut report);
    }
    let advice = format!(
        "these paths, or the names that are said to be in them, do not exist. A document about other projects has the line \
         `{CITES_OTHERS}`:"
    );
    report.finish(100, &advice);
}

#[test]
fn every_document_that_the_code_cites_exists() {
    let mut report = Report::default();
    for path in REPOSITORY.sources() {
        check_source(&REPOSITORY, path, &REPOSITORY.read(path), &mut report);
    }
    report.finish(30, "the code cites documents that do not exist:");
}

fn check_links(repository: &Repository, document: &Document, report: &mut Report) {
    for link in document.links() {
        let (file, heading) =
            link.target.split_once('#').map_or((link.target.as_str(), None), |(f, h)| (f, Some(h)));
        let path = if file.is_empty() { Some(document.path.clone()) } else { resolve(&document.path, file) };
        let fault = match path.filter(|path| *path == document.path || repository.has(path)) {
            None => Some(format!("{} leads nowhere", link.target)),
            Some(path) if path == document.path => heading.and_then(|heading| fault_of(document, heading)),
            Some(path) => heading.and_then(|heading| fault_of(&page(repository, &path), heading)),
        };
        report.check(&document.path, link.line, fault.map_or(Ok(()), Err));
    }
}

fn page(repository: &Repository, path: &str) -> Document {
    Document::new(path, &repository.read(path))
}

/// Returns the fault of a citation of a heading that a page does not have. Other files have no headings.
fn fault_of(page: &Document, heading: &str) -> Option<String> {
    let is_there = !page.path.ends_with(".md") || page.anchors().iter().any(|anchor| anchor == heading);
    (!is_there).then(|| format!("{} has no heading #{heading}", page.path))
}

/// Looks for the pages below `docs/` that a source names.
fn check_source(repository: &Repository, path: &str, text: &str, report: &mut Report) {
    for (at, line) in text.lines().enumerate() {
        for (place, _) in line.match_indices("docs/") {
            let end = |text: &str, more: &str| {
                text.find(|c: char| !c.is_ascii_alphanumeric() && !more.contains(c)).unwrap_or(text.len())
            };
            let cited = &line[place..][..end(&line[place..], "/_.-")];
            let Some(cited) =
                cited.trim_end_matches('.').strip_suffix(".md").map(|name| format!("{name}.md"))
            else {
                continue;
            };
            let heading = line[place + cited.len()..].strip_prefix('#');
            let heading = heading.map(|text| &text[..end(text, "_-")]);
            let fault = match repository.has(&cited) {
                true => heading.and_then(|heading| fault_of(&page(repository, &cited), heading)),
                false => Some(format!("there is no {cited}")),
            };
            report.check(path, at + 1, fault.map_or(Ok(()), Err));
        }
    }
}

/// Returns the path from the root of what a link of a document names; none if it is outside of the repository.
fn resolve(document: &str, target: &str) -> Option<String> {
    let mut path: Vec<_> = document.split('/').collect();
    path.pop();
    for part in target.split('/') {
        match part {
            "" | "." => {}
            ".." => drop(path.pop()?),
            part => path.push(part),
        }
    }
    Some(path.join("/"))
}

fn check_paths(repository: &Repository, document: &Document, report: &mut Report) {
    let cites_others = document.has_line(CITES_OTHERS);
    for paragraph in document.paragraphs() {
        let spans = paragraph.spans();
        for span in spans.iter().filter(|span| is_path(repository, &span.text)) {
            let path = span.text.trim_end_matches('/');
            let is_there = repository.has_ending(path);
            let fault = (!is_there && !cites_others).then(|| format!("there is no {path}"));
            report.check(&document.path, span.line, fault.map_or(Ok(()), Err));
        }
        for (name, file) in spans.iter().zip(spans.iter().skip(1)) {
            let is_in_file = is_name(&name.text)
                && file.text.ends_with(".rs")
                && between(&paragraph, name, file) == " in "
                && repository.has_ending(&file.text);
            if is_in_file {
                let last = name.text.trim_end_matches("()").rsplit("::").next().unwrap_or_default();
                let is_there =
                    repository.files_ending(&file.text).any(|path| has_word(&repository.read(path), last));
                let fault =
                    (!is_there && !cites_others).then(|| format!("{} is not in {}", name.text, file.text));
                report.check(&document.path, name.line, fault.map_or(Ok(()), Err));
            }
        }
    }
}

fn between<'p>(paragraph: &'p Paragraph, one: &Span, other: &Span) -> &'p str {
    paragraph.text.get(one.place.end..other.place.start).unwrap_or_default()
}

/// Returns `true` for text that names a file or folder of a repository.
fn is_path(repository: &Repository, text: &str) -> bool {
    let is_plain = text.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c));
    if !is_plain || text.starts_with(['.', '/', '-']) || text.split('/').any(|part| part == "target") {
        return false;
    }
    let is_source = OF_SOURCES.iter().any(|end| text.len() > end.len() && text.ends_with(end));
    let Some((first, rest)) = text.split_once('/') else {
        return text.ends_with(".rs") && is_source;
    };
    let is_folder = rest.is_empty() || !first.contains('.');
    let second = rest.split('/').next().unwrap_or_default();
    let is_in_crate = repository.has(&format!("crates/{first}")) && OF_CRATES.contains(&second);
    let is_below_root = is_folder && repository.has(first) && repository.files_below(first).next().is_some();
    is_source || is_in_crate || is_below_root
}

/// Returns `true` for a name of the code.
fn is_name(text: &str) -> bool {
    !text.is_empty()
        && text.trim_end_matches("()").chars().all(|c| c.is_ascii_alphanumeric() || "_:".contains(c))
}

/// Returns `true` if a text has this word, with nothing that belongs to a name around it.
pub(crate) fn has_word(text: &str, word: &str) -> bool {
    let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
    text.match_indices(word)
        .any(|(at, _)| !text[..at].ends_with(is_part) && !text[at + word.len()..].starts_with(is_part))
}

#[test]
fn a_wrong_link_is_found() {
    let page = "# Head\n[a](spec/wire.md#labels), [b](#head), [c](../README.md), [d](spec/nothing.md), [e](#none),\n\
                [f](../../outside.md), [g](spec/wire.md#none)\n\n```\n[h](none.md)\n```\n";
    let mut report = Report::default();
    check_links(&own(), &Document::new("docs/page.md", page), &mut report);
    assert_eq!(
        report.faults(),
        "docs/page.md:2: spec/nothing.md leads nowhere; docs/page.md:2: docs/page.md has no heading #none; \
         docs/page.md:3: ../../outside.md leads nowhere; docs/page.md:3: docs/spec/wire.md has no heading #none"
    );
}

#[test]
fn a_wrong_document_in_the_code_is_found() {
    let source = "//! See `docs/spec/wire.md`, docs/spec/wire.md#labels.\nconst A: &str = \"../../docs/gone.md\";\n\
                  // (docs/spec/wire.md#gone), docs/NAME, mydocs/\n";
    let mut report = Report::default();
    check_source(&own(), "x.rs", source, &mut report);
    assert_eq!(
        report.faults(),
        "x.rs:2: there is no docs/gone.md; x.rs:3: docs/spec/wire.md has no heading #gone"
    );
}

#[test]
fn a_wrong_path_is_found_in_each_form() {
    let faults = |text: &str| {
        Report::faults_of(|report| check_paths(&own(), &Document::new("docs/page.md", text), report))
    };
    for right in [
        "`crates/one/src/x.rs`",
        "`one/src/x.rs`",
        "`one/src`",
        "`x.rs`",
        "`docs/`",
        "`Thing` in `x.rs`",
        "`Thing::new()` in `one/src/x.rs`",
        "`node.toml`, `DIR/PACKAGE/msg/NAME.msg`, `sensor_msgs/msg/Image`, `sgc/1`, `target/release/sgc`, `crates/…/x.rs`",
        "```\ncrates/none\n```",
        "<!-- Cites files and names of other projects. -->\n\n`none.rs`",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("`crates/one/src/y.rs`", "docs/page.md:1: there is no crates/one/src/y.rs"),
        ("a\n`one/src/\ny.rs`, `one/src/y.rs`", "docs/page.md:3: there is no one/src/y.rs"),
        ("`one/tests`", "there is no one/tests"),
        ("`y.rs`", "there is no y.rs"),
        ("`docs/gone`", "there is no docs/gone"),
        ("`docs/gone.md`", "there is no docs/gone.md"),
        ("`page/gone.md`", "there is no page/gone.md"),
        ("`Other` in `x.rs`", "Other is not in x.rs"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}

/// A repository with a document and a source.
fn own() -> Repository {
    Repository::make(&[
        ("README.md", ""),
        ("docs/spec/wire.md", "## Labels\n"),
        ("crates/one/src/x.rs", "struct Thing;\nstruct OtherThing;\nfn new() {}\n"),
    ])
}
