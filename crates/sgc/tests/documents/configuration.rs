//! Configurations that documents show are valid, and keys that they name exist.
//!
//! A block of TOML may be a part of a file: it is then read with a node's name and routers in front, and under the
//! header of a table if it has none.

use std::path::Path;

use sgc_node::config::{self, ConfigError, Mistake, Origin, Table};

use crate::markdown::{Document, Paragraph};
use crate::report::Report;
use crate::repository::REPOSITORY;

/// Lines of a complete file, for parts that lack them: a name, and routers or a place to listen.
const NODES: [&str; 4] = [
    "",
    "[node]\nname = 'part'\nrouters = ['quic://router.example']\n",
    "identity = 'part.identity'\n[router]\nlisten = ['quic://0.0.0.0:7447']\n",
    "identity = 'part.identity'\n",
];

#[test]
fn every_cited_configuration_is_valid() {
    let mut report = Report::default();
    for document in REPOSITORY.documents() {
        check(&document, &mut report);
    }
    report.finish(80, "`sgc check` does not take these parts of configurations:");
}

fn check(document: &Document, report: &mut Report) {
    for block in document.blocks().into_iter().filter(|block| block.language == "toml") {
        let (line, fault) = match fault_of(&block.code) {
            Some((offset, fault)) => (block.line + offset, Some(fault)),
            None => (block.line, None),
        };
        report.check(&document.path, line, fault.map_or(Ok(()), Err));
    }
    for paragraph in document.paragraphs() {
        check_spans(document, &paragraph, report);
    }
}

/// Returns the line, from 0, and the first mistake of a configuration that no reading makes valid.
fn fault_of(code: &str) -> Option<(usize, String)> {
    let headers = Table::ALL.map(|table| if table == Table::Top { "" } else { table.header() });
    let read = |node: &str, header: &str| {
        let text = format!("{node}{header}\n{code}");
        let before = text.len() - code.len();
        let lines = text[..before].matches('\n').count();
        let environment = |_: &str| None;
        let errors = config::parse(&text, "page.toml", Path::new(""), &environment).err()?;
        // The table of a partner may stand elsewhere, and this build may lack what a page describes.
        let is_fault = |error: &ConfigError| {
            !matches!(*error.mistake, Mistake::UnknownPartner { .. } | Mistake::ZenohNotBuilt { .. })
        };
        errors.iter().any(is_fault).then_some((lines, errors))
    };
    let mut faults = Vec::new();
    for node in NODES {
        for header in headers {
            faults.push(read(node, header)?);
        }
    }
    // The reading with the fewest mistakes is the one that was meant, unless it has one table twice.
    let is_syntax = |error: &ConfigError| matches!(*error.mistake, Mistake::Syntax { .. });
    let (lines, errors) =
        faults.into_iter().min_by_key(|(_, errors)| (errors.iter().any(is_syntax), errors.iter().count()))?;
    let error = errors.iter().next()?;
    let line = match &error.origin {
        Origin::File { line: Some(line), .. } => line.saturating_sub(lines + 1),
        _ => 0,
    };
    Some((line, error.mistake.to_string()))
}

/// Looks for the tables and keys that code spans name: `[[share]]`, `key = value`, and `key` in `[table]`.
fn check_spans(document: &Document, paragraph: &Paragraph, report: &mut Report) {
    for span in paragraph.spans() {
        let mut check = |outcome: Option<Result<(), String>>| {
            if let Some(outcome) = outcome {
                report.check(&document.path, span.line, outcome);
            }
        };
        check(header_of(&span.text).map(|header| table_of(header).map(|_| ())));
        let key = span.text.split(" = ").next().unwrap_or_default();
        if !is_key(key) {
            continue;
        }
        let behind = paragraph.behind(&span).trim_start();
        let place = behind.strip_prefix("in ").and_then(|place| header_at(place.trim_start_matches('`')));
        check(match place {
            Some(header) => Some(table_of(header).and_then(|table| has_key(table, key))),
            None => (key.len() < span.text.len()).then(|| {
                let is_there = Table::ALL.iter().any(|table| table.keys().contains(&key));
                if is_there {
                    Ok(())
                } else {
                    Err(format!("no table of the configuration has the key {key}"))
                }
            }),
        });
    }
}

/// Returns the header that a text begins with.
fn header_at(text: &str) -> Option<&str> {
    let brackets = text.len() - text.trim_start_matches('[').len();
    let end = text.find(']')? + brackets;
    text.get(..end).and_then(header_of)
}

/// Returns the text if it is a header of a table. Headers with a dot are those of other files, too.
fn header_of(text: &str) -> Option<&str> {
    let name = text.trim_start_matches('[').trim_end_matches(']');
    let brackets = text.len() - name.len();
    let is_header =
        (brackets == 2 || brackets == 4) && text.starts_with('[') && text.ends_with(']') && is_key(name);
    let is_known = Table::ALL.iter().any(|table| table.header() == text);
    (is_header || is_known).then_some(text)
}

fn table_of(header: &str) -> Result<Table, String> {
    let found = Table::ALL.into_iter().find(|table| table.header() == header);
    found.ok_or_else(|| format!("the configuration has no table {header}"))
}

fn has_key(table: Table, key: &str) -> Result<(), String> {
    let is_there = table.keys().contains(&key);
    if is_there { Ok(()) } else { Err(format!("{} has no key {key}", table.header())) }
}

fn is_key(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_lowercase())
        && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

#[test]
fn a_wrong_configuration_is_found_in_each_form() {
    let faults = |text: &str| Report::faults_of(|report| check(&Document::new("page.md", text), report));
    for right in [
        "```toml\n[node]\nname = \"a\"\nrouters = [\"quic://b\"]\n\n[[share]]\ntopic = \"/a\"\nto = [\"b\"]\n```",
        "```toml\n[[share]]\ntopic = \"/a\"\nto = [\"b\"]\n```",
        "```toml\n[node]\nname = \"a\"\n```\n\n```toml\naccept = [\"a.pem\"]\n```",
        "`[[share]]`, `[router]`, `accept` in [router], `topic` in `[[use]]`, `publish = true`, `[0]`, `[a.b]`, `[key: value]`",
        "```ini\n[nothing]\n```",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("```toml\n[[share]]\ntopic = \"/a\"\n\nto = [\"b\"]\nrate = 3\n```", "page.md:6: "),
        ("```toml\n[[share]]\ntopic = \"/a\"\nto = [\"b\"]\nrate = 3\n```", "`rate`"),
        ("```toml\n[nod]\nname = \"a\"\n```", "page.md:2: "),
        ("```toml\n[ros]\ndomain_id = \"seven\"\n```", "domain_id"),
        ("```toml\n[[share]]\ntopic = \"/a\"\n```", "`to`"),
        ("`[[shares]]`", "the configuration has no table [[shares]]"),
        ("a\n`accept` in `[node]`", "page.md:2: [node] has no key accept"),
        ("`accepts` in [router]", "[router] has no key accepts"),
        ("`accept` in [routers]", "the configuration has no table [routers]"),
        ("`publishes = true`", "no table of the configuration has the key publishes"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}
