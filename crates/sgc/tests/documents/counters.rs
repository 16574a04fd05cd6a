//! Counters that documents cite are in the table by which `sgc why` and `sgc status` explain them, every counter of the
//! table is in a document, and the code counts under no other.
//!
//! `docs/reference/drop-reasons.md` is made of that table.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use sgc::COUNTERS;

use crate::generated::{self, cell, wrapped};
use crate::markdown::{Document, Paragraph, Span};
use crate::report::Report;
use crate::repository::{REPOSITORY, Repository};

const PAGE: &str = "docs/reference/drop-reasons.md";
const SPECIFICATION: &str = "spec/routing.md";
/// Rows of the specification whose counters are in another table than the first, and which one.
const PLACES: [(&str, usize); 3] = [("data path", 1), ("sink", 2), ("links refused", 3)];
/// Text in front of a code span that makes it the name of a counter.
const COUNTED: [&str; 8] =
    ["counted", "counted as", "counts as", "counter", "counter is", "drop reason", "counts", "counted under"];
/// The heads of columns that list counters.
const HEADS: [&str; 2] = ["keys", "counter"];
/// So many counters that begin with one word are a family: whatever begins so is one of them.
const FAMILY_MIN: usize = 3;

#[test]
fn every_cited_counter_exists_and_each_is_documented() {
    let mut report = Report::default();
    let mut cited = BTreeSet::new();
    for document in REPOSITORY.documents() {
        check(&document, &mut report);
        if document.path != PAGE {
            let spans = document.paragraphs().into_iter().flat_map(|paragraph| paragraph.spans());
            cited.extend(spans.map(|span| span.text));
        }
    }
    report.finish(150, "these counters are not among those that `sgc why` explains:");
    // Reasons in words, of the gateway, stand in the generated page alone.
    let missing: Vec<_> = keys().into_iter().filter(|key| is_key(key) && !cited.contains(*key)).collect();
    assert!(missing.is_empty(), "no document but {PAGE} names these counters: {missing:?}");
}

#[test]
fn the_code_counts_under_no_unknown_name() {
    let counted = counted_in(&REPOSITORY);
    assert!(counted.len() > 60, "only {} counters were recognised in the code", counted.len());
    let unknown: Vec<_> = counted.iter().filter(|key| !keys().contains(key.as_str())).collect();
    assert!(unknown.is_empty(), "`sgc why` does not explain these counters: {unknown:?}");
}

#[test]
fn the_specification_lists_the_counters_of_each_place_and_no_others() {
    let documents = REPOSITORY.documents();
    let specification = documents.iter().find(|document| document.path.ends_with(SPECIFICATION)).unwrap();
    let mut specified = vec![BTreeSet::new(); COUNTERS.len()];
    let rows = specification.paragraphs().into_iter().filter_map(|row| row.cells());
    let mut rows = rows.skip_while(|cells| cells[0].text != "where" || cells[1].text != "keys").skip(2);
    while let Some([place, keys]) = rows.next().as_deref() {
        let table = PLACES.iter().find(|(name, _)| *name == place.text).map_or(0, |(_, table)| *table);
        specified[table].extend(listed_in(keys));
    }
    for (table, specified) in COUNTERS.iter().zip(specified) {
        let keys = table.counters.iter().map(|counter| counter.key).filter(|key| is_key(key));
        assert_eq!(specified, keys.map(str::to_owned).collect(), "{}", table.title);
    }
}

#[test]
fn the_page_of_drop_reasons_is_what_the_table_says() {
    generated::check(PAGE, &page());
}

/// Returns the names of all counters.
fn keys() -> BTreeSet<&'static str> {
    COUNTERS.iter().flat_map(|table| table.counters).map(|counter| counter.key).collect()
}

fn check(document: &Document, report: &mut Report) {
    let keys = keys();
    let mut families: BTreeMap<&str, usize> = BTreeMap::new();
    for first in keys.iter().filter_map(|key| key.split_once('_')).map(|(first, _)| first) {
        *families.entry(first).or_default() += 1;
    }
    let is_family = |text: &str| {
        let first = text.split_once('_').map(|(first, _)| first);
        first.is_some_and(|first| families.get(first).is_some_and(|count| *count >= FAMILY_MIN))
    };
    let mut table: Option<Vec<usize>> = None;
    for paragraph in document.paragraphs() {
        let cells = paragraph.cells();
        table = match (&cells, table) {
            (None, _) => None,
            (Some(head), None) => Some(columns_of(head)),
            (Some(_), table) => table,
        };
        let columns = table.iter().flatten().filter_map(|column| cells.as_ref()?.get(*column));
        let listed: BTreeSet<_> = columns.flat_map(listed_in).collect();
        for span in paragraph.spans().into_iter().filter(|span| is_key(&span.text)) {
            let before = paragraph.before(&span).trim_end().trim_end_matches('(').trim_end();
            let is_counter =
                COUNTED.iter().any(|words| before.ends_with(words)) || listed.contains(&span.text);
            let is_known = keys.contains(span.text.as_str());
            let is_of_code = || is_family(&span.text) && !names_of_code().contains(&span.text);
            if is_known || is_counter || is_of_code() {
                let fault = (!is_known).then(|| format!("there is no counter {}", span.text));
                report.check(&document.path, span.line, fault.map_or(Ok(()), Err));
            }
        }
    }
}

/// Returns the columns of a table that list counters.
fn columns_of(head: &[Paragraph]) -> Vec<usize> {
    let lists = |cell: &Paragraph| HEADS.contains(&cell.text.as_str());
    head.iter().enumerate().filter(|(_, cell)| lists(cell)).map(|(column, _)| column).collect()
}

/// Returns the code spans of a cell that are not in parentheses, which explain.
fn listed_in(cell: &Paragraph) -> BTreeSet<String> {
    let is_outside = |span: &Span| {
        let before = cell.before(span);
        before.matches('(').count() == before.matches(')').count()
    };
    cell.spans().into_iter().filter(is_outside).map(|span| span.text).collect()
}

/// Returns the words of the code.
fn names_of_code() -> &'static BTreeSet<String> {
    crate::test_names::all_names()
}

fn is_key(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

/// Returns the names that the code counts under: what methods return as the names of reasons for drops. Nothing is
/// counted under a bare text.
fn counted_in(repository: &Repository) -> BTreeSet<String> {
    let mut counted = BTreeSet::new();
    for path in
        repository.files_below("crates").filter(|path| path.ends_with(".rs") && path.contains("/src/"))
    {
        let source = repository.read(path);
        let source = source.split("\n#[cfg(test)]\nmod tests").next().unwrap_or_default();
        for method in source.split("name for counters").skip(1) {
            let body = method.split("\n    }\n").next().unwrap_or_default();
            let names: BTreeSet<_> = body.split('"').skip(1).step_by(2).map(str::to_owned).collect();
            // Names of which not one is known are of something else than drops.
            if names.iter().any(|name| keys().contains(name.as_str())) {
                counted.extend(names);
            }
        }
    }
    counted
}

/// Returns the page of all counters.
fn page() -> String {
    let mut page = generated::note("the counters' explanations");
    page.push_str("# Drop reasons\n\n");
    page.push_str(&wrapped(
        "A node counts everything that it drops or refuses under one of these names. `sgc status` shows the counts with \
         their meanings. Where one link or peer is the cause, a further row names it, such as `limit from link 3`.",
        0,
    ));
    page.push('\n');
    page.push_str(&wrapped(
        "A counter in bold points at a fault, an attack or a task for an operator: `sgc why` names it whatever topic it is \
         asked about. The other counters also grow where nothing is wrong.",
        0,
    ));
    for table in &COUNTERS {
        let _ = write!(
            page,
            "\n## {}\n\n{}\n| counter | meaning | remedy |\n|---|---|---|\n",
            table.title,
            wrapped(table.place, 0)
        );
        for counter in table.counters {
            let mark = if counter.is_named { "**" } else { "" };
            let fix = if counter.fix.is_empty() { "–" } else { counter.fix };
            let _ =
                writeln!(page, "| {mark}`{}`{mark} | {} | {} |", counter.key, cell(counter.means), cell(fix));
        }
    }
    page
}

#[test]
fn a_wrong_counter_is_found_in_each_form() {
    let faults = |text: &str| Report::faults_of(|report| check(&Document::new("page.md", text), report));
    for right in [
        "counted (`crl_flood`), counted as `thinned`, `sink_replayed`, `link_state`, `sink_…`, `max_rate`",
        "| where | keys |\n|---|---|\n| `another_name` | **`stale`**, `limit` (`peer_rate`) |\n\n`another_name`",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("is counted as\n`thined`", "page.md:2: there is no counter thined"),
        ("counted (`crl_floods`)", "there is no counter crl_floods"),
        ("`sink_replay_no`", "there is no counter sink_replay_no"),
        ("| where | keys |\n|---|---|\n| a | `stale`, `no_such` |", "page.md:3: there is no counter no_such"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}

#[test]
fn names_under_which_the_code_counts_are_found() {
    let source = |first: &str, second: &str| {
        format!(
            "/// A short, stable name for counters.\nfn key(self) -> &str {{\n match self {{ A => \"{first}\", \
             B => \"{second}\" }}\n    }}\nfn b() {{ told(\"c\") }}\n"
        )
    };
    let tests = format!("#[cfg(test)]\nmod tests {{\n{}}}", source("stale", "of_test"));
    let (drops, others) = (source("stale", "no_such") + &tests, source("red", "green"));
    let repository = Repository::make(&[("crates/a/src/x.rs", &drops), ("crates/a/src/y.rs", &others)]);
    assert_eq!(counted_in(&repository).into_iter().collect::<Vec<_>>(), ["no_such", "stale"]);
}
