//! Tests that documents cite exist, and so do names of the code that are as long as those of tests.
//!
//! A test is cited as `NAME: test`, where NAME is in a table of names that a document has, the name of one file, or a
//! path below `crates/`;
//! further tests of the same file follow without NAME, and `…end` stands for a test whose name ends so, and
//! `module::` for all tests of a module. In tables whose
//! last column is headed "shown by" each code span of that column must be a citation.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use crate::markdown::{Document, Paragraph};
use crate::paths::CITES_OTHERS;
use crate::report::Report;
use crate::repository::{REPOSITORY, Repository};

/// The head of the last column of tables that cite tests.
const SHOWN_BY: &str = "shown by";
/// The head of a table that says which files a name stands for.
const NAMES_HEAD: &str = "| name | file |";
/// A name of so many words is one of a test, or of something else in the code.
const WORDS_MIN: usize = 4;
/// The names in the code that have several words.
static NAMES: LazyLock<BTreeSet<String>> = LazyLock::new(|| {
    let mut names = BTreeSet::new();
    for path in REPOSITORY.sources() {
        names.extend(words(&REPOSITORY.read(path)).filter(|word| word.contains('_')).map(str::to_owned));
    }
    names
});

/// Returns the names in the code that have several words.
pub(crate) fn all_names() -> &'static BTreeSet<String> {
    &NAMES
}

#[test]
fn every_cited_test_and_name_exists() {
    let documents = REPOSITORY.documents();
    let mut citations = Citations::new(&REPOSITORY, &documents);
    for document in &documents {
        citations.check(document);
    }
    let known: Vec<_> = citations.files.keys().map(String::as_str).collect();
    let advice = format!(
        "these tests or names cannot be found. Correct the citation, or the test's name. The forms are `NAME: test`, then \
         `test` for more of the same file, `…end_of_a_name`, and `NAME` (all). NAME is a path below crates/, the name of one file, or one of {}:",
        known.join(", ")
    );
    citations.report.finish(150, &advice);
}

/// Looks up the citations of documents.
struct Citations<'r> {
    repository: &'r Repository,
    /// The files that a name stands for.
    files: BTreeMap<String, Vec<String>>,
    /// Tests by file or folder.
    tests: BTreeMap<String, BTreeSet<String>>,
    report: Report,
}

impl<'r> Citations<'r> {
    /// Reads the tables of names.
    fn new(repository: &'r Repository, documents: &[Document]) -> Self {
        let (files, tests, report) = (BTreeMap::new(), BTreeMap::new(), Report::default());
        let mut citations = Self { repository, files, tests, report };
        for document in documents {
            let mut is_in_table = false;
            for row in document.paragraphs() {
                is_in_table = row.text == NAMES_HEAD || is_in_table && row.text.starts_with('|');
                let cells = row.cells().filter(|_| is_in_table).unwrap_or_default();
                let [names, paths] = &cells[..] else { continue };
                let paths: Vec<_> = paths.spans().into_iter().map(|span| span.text).collect();
                for path in paths.iter().filter(|path| !repository.has(path)) {
                    citations.report.check(&document.path, row.line(), Err(format!("there is no {path}")));
                }
                for name in names.spans() {
                    citations.files.insert(name.text, paths.clone());
                }
            }
        }
        citations
    }

    fn check(&mut self, document: &Document) {
        let mut cites = false;
        for paragraph in document.paragraphs() {
            let Some(mut cells) = paragraph.cells() else {
                cites = false;
                self.check_text(document, &paragraph);
                continue;
            };
            let last = cells.last().map(|cell| cell.text.as_str()).unwrap_or_default();
            cites |= last == SHOWN_BY;
            if cites && let Some(last) = cells.pop() {
                self.check_cell(document, &last);
            }
            for cell in cells {
                self.check_text(document, &cell);
            }
        }
    }

    /// Every code span of a cell that cites tests must be a citation.
    fn check_cell(&mut self, document: &Document, cell: &Paragraph) {
        let mut file: Option<String> = None;
        for span in cell.spans() {
            let is_all = cell.behind(&span).trim_start().starts_with("(all)");
            let outcome = match span.text.split_once(": ") {
                Some((name, test)) => {
                    file = Some(name.to_owned());
                    self.look_up(name, Some(test))
                }
                None if is_all || self.files.contains_key(&span.text) => self.look_up(&span.text, None),
                // The rule of paths looks for it.
                None if span.text.contains('/') => Ok(()),
                None => match &file {
                    Some(name) => self.look_up(&name.clone(), Some(&span.text)),
                    None => Err(format!("`{0}` names no file: write `NAME: {0}`", span.text)),
                },
            };
            self.report.check(&document.path, span.line, outcome);
        }
    }

    /// Elsewhere a code span is a citation if a name and a test are in it, or a long name alone.
    fn check_text(&mut self, document: &Document, text: &Paragraph) {
        let cites_others = document.has_line(CITES_OTHERS);
        for span in text.spans() {
            let pair = span.text.split_once(": ").filter(|(_, test)| is_snake(test) && test.contains('_'));
            let pair = pair.filter(|(name, test)| is_long(test) || self.files.contains_key(*name));
            if let Some((name, test)) = pair {
                let outcome = self.look_up(name, Some(test));
                self.report.check(&document.path, span.line, outcome);
                continue;
            }
            if let Some(module) = span.text.strip_suffix("::").filter(|module| is_snake(module)) {
                let is_there =
                    self.repository.has_ending(&format!("{module}.rs")) || self.repository.has_ending(module);
                let fault = (!is_there && !cites_others).then(|| format!("no file is a module {module}"));
                self.report.check(&document.path, span.line, fault.map_or(Ok(()), Err));
                continue;
            }
            let name = span.text.split(['=', '(', ' ']).next().unwrap_or_default();
            let end = name.trim_start_matches('…');
            if is_checked(end) && (span.text.len() == name.len() || end.starts_with("SGC_")) {
                let is_there = match name == end {
                    true => NAMES.contains(name),
                    false => NAMES.iter().any(|name| name.ends_with(end)),
                };
                let fault =
                    (!is_there && !cites_others).then(|| format!("nothing in the code is named {name}"));
                self.report.check(&document.path, span.line, fault.map_or(Ok(()), Err));
            }
        }
    }

    /// Looks for a test, or for any.
    fn look_up(&mut self, name: &str, test: Option<&str>) -> Result<(), String> {
        let below = format!("crates/{name}");
        let paths = match self.files.get(name) {
            Some(paths) => paths.clone(),
            None if name.ends_with(".rs") && self.repository.has(&below) => vec![below],
            None => {
                let ending = format!("{name}.rs");
                let files: Vec<_> = self.repository.files_ending(&ending).map(str::to_owned).collect();
                match files.len() {
                    0 => return Err(format!("`{name}` stands for no file")),
                    1 => files,
                    _ => return Err(format!("`{name}` stands for several files: {}", files.join(", "))),
                }
            }
        };
        let mut found = BTreeSet::new();
        for path in &paths {
            let read = || {
                let below = self.repository.files_below(path).filter(|path| path.ends_with(".rs"));
                below.chain([path.as_str()]).flat_map(|path| tests_in(&self.repository.read(path))).collect()
            };
            found.extend(self.tests.entry(path.clone()).or_insert_with(read).iter().cloned());
        }
        let is_there = match test.map(|test| (test, test.strip_prefix('…'))) {
            None => !found.is_empty(),
            Some((_, Some(end))) => found.iter().any(|test| test.ends_with(end)),
            Some((test, None)) => found.contains(test),
        };
        if is_there {
            return Ok(());
        }
        let test = test.unwrap_or("(all)");
        let near = found.iter().max_by_key(|found| likeness(found, test));
        let near = near.map(|near| format!("; the nearest is {near}")).unwrap_or_default();
        Err(format!("`{name}` has no test {test}{near}"))
    }
}

/// Returns the names of all tests in a source: functions with a test's attribute, and functions whose names stand alone
/// in a line, as a macro that makes tests of them takes them.
pub(crate) fn tests_in(source: &str) -> BTreeSet<String> {
    let (mut tests, mut functions, mut alone) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
    let mut is_test = false;
    for line in source.lines().map(str::trim) {
        if line == "#[test]" || line.starts_with("#[tokio::test") {
            is_test = true;
        } else if let Some((before, rest)) = line.split_once("fn ") {
            let name = rest.split(['(', '<']).next().unwrap_or_default();
            if is_test {
                tests.insert(name.to_owned());
            } else if before.is_empty() || before == "async " {
                functions.insert(name.to_owned());
            }
            is_test = false;
        } else if line.contains('_') && is_snake(line) {
            alone.insert(line.to_owned());
        }
    }
    tests.extend(functions.intersection(&alone).cloned());
    tests
}

/// Returns the words of a source.
fn words(source: &str) -> impl Iterator<Item = &str> {
    source.split(|c: char| !c.is_ascii_alphanumeric() && c != '_')
}

fn is_snake(text: &str) -> bool {
    text.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit())
}

/// Returns `true` for a name of several words.
fn is_long(name: &str) -> bool {
    is_snake(name) && name.split('_').filter(|word| !word.is_empty()).count() >= WORDS_MIN
}

/// Returns `true` for a name that must be in the code: a long one, a variable of this project, a bound.
fn is_checked(name: &str) -> bool {
    let is_constant = name.chars().all(|c| c.is_ascii_uppercase() || c == '_' || c.is_ascii_digit());
    let is_own =
        (name.starts_with("SGC_") && name.len() > 4) || name.ends_with("_MAX") || name.ends_with("_MIN");
    is_long(name) || is_constant && is_own
}

/// Counts the words that two names have in common.
fn likeness(a: &str, b: &str) -> usize {
    let words: BTreeSet<_> = a.split('_').collect();
    b.split('_').filter(|word| words.contains(word)).count()
}

#[test]
fn a_wrong_citation_is_found_in_each_form() {
    let source = "#[test]\n#[ignore = \"slow\"]\nfn one_is_refused() {}\n#[tokio::test(flavor = \"multi_thread\")]\n\
                  async fn two_is_refused() {}\nfn no_test() {}\n\
                  each!(\n    three_is_refused\n);\nasync fn three_is_refused(scheme: &str) {}\n";
    let repository = Repository::make(&[
        ("crates/a/src/x.rs", source),
        ("crates/a/src/empty.rs", ""),
        ("crates/a/tests/other.rs", source),
    ]);
    let faults = |cell: &str| {
        let text = format!(
            "{NAMES_HEAD}\n|---|---|\n| `x`, `y` | `crates/a/src/x.rs` |\n| `none` | `crates/a/src/empty.rs` |\n\n\
             | tries | outcome | shown by |\n|---|---|---|\n| a | `no_test` | {cell} |\n"
        );
        let document = Document::new("page.md", &text);
        let mut citations = Citations::new(&repository, std::slice::from_ref(&document));
        citations.check(&document);
        citations.report.faults()
    };
    for right in [
        "`x: one_is_refused`, `two_is_refused`",
        "`y: …two_is_refused`, `three_is_refused`",
        "`a/src/x.rs: one_is_refused`; `crates/a`; `other: …is_refused`",
        "`x` (all)",
        "no test",
        "–",
        "|\n\n`SGC_GENERATE=1 x`, `…_bit_of_a_list_is_accepted`, `no_flipped_bit_of_a_list_is_accepted`, `SGC_…`",
        "|\n\n`frame: base_link`, `empty::`, `a::`, `/a/b_c_d_e`, `A_B_MAX…`",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("`x: three`", "page.md:8: `x` has no test three"),
        ("`x: one_is_refused`, `three`", "page.md:8: `x` has no test three"),
        ("`x: one_was_refused`", "`x` has no test one_was_refused; the nearest is one_is_refused"),
        ("`x: no_test`", "has no test no_test"),
        ("`x: …three`", "has no test …three"),
        ("`z: one_is_refused`", "`z` stands for no file"),
        ("`one_is_refused`", "names no file"),
        ("`none` (all)", "has no test (all)"),
        ("|\n\nIn a text: `x: no_such_test`.", "page.md:10: `x` has no test no_such_test"),
        ("|\n\nIn a text: `z: no_such_test_at_all`.", "page.md:10: `z` stands for no file"),
        ("|\n\nThe test `a_name_that_no_test_`\n`has` and `SGC_NO_SUCH=1 x`", "named SGC_NO_SUCH"),
        ("|\n\n`no_module::`", "no file is a module no_module"),
        ("|\n\n`a_name_that_no_source_has`", "nothing in the code is named a_name_that_no_source_has"),
        ("|\n\n`NOTHING_LIKE_IT_MAX`", "nothing in the code is named NOTHING_LIKE_IT_MAX"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}
