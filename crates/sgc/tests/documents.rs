//! The documents cite what exists: each test that `docs/explanation/security.md` names is in the repository, and each link and path of
//! every document leads somewhere. The summary of the book names every page below `docs/`.
//!
//! The security document says before its first table how tests are cited. A citation that cannot be checked is a fault.

#![allow(clippy::unwrap_used)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// The head of the last column of tables that cite tests.
const SHOWN_BY: &str = "shown by";
/// The head of the table that says which file a name stands for.
const NAMES_HEAD: &str = "| name | file |";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

#[test]
fn every_test_that_the_security_document_cites_exists() {
    let text = fs::read_to_string(root().join("docs/explanation/security.md")).unwrap();
    let mut checker = Checker::new(&text, &root());
    checker.check(&text);
    assert!(
        checker.faults.is_empty(),
        "docs/explanation/security.md cites tests that cannot be found:\n  {}\nCorrect the citation, or the test's name. \
         The forms are `NAME: test`, then `test` for more of the same file, `…end_of_a_name`, and `NAME` (all). \
         NAME is in the table at the top, or a path below crates/.",
        checker.faults.join("\n  ")
    );
    assert!(checker.cited > 150, "only {} citations were recognised", checker.cited);
}

/// Folders of the repository that documents name paths in.
const FOLDERS: [&str; 7] = ["bench/", "benchmarks/", "clients/", "crates/", "docs/", "fuzz/", "scripts/"];

#[test]
fn every_link_and_path_of_a_document_leads_somewhere() {
    let root = root();
    let mut documents: Vec<_> =
        ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md"].map(|d| root.join(d)).into();
    documents.extend(["benchmarks", "docs"].iter().flat_map(|folder| pages_below(&root.join(folder))));
    let (mut faults, mut checked) = (Vec::new(), 0);
    for document in &documents {
        let text = fs::read_to_string(document).unwrap();
        let mut is_code = false;
        for (at, line) in text.lines().enumerate() {
            is_code ^= line.trim_start().starts_with("```");
            if is_code {
                continue;
            }
            let links = line.split("](").skip(1).filter_map(|rest| rest.split(')').next());
            let links = links.filter(|link| !link.contains("://"));
            let links = links.map(|link| (link, leads_somewhere(document, link)));
            let is_path = |span: &&str| {
                FOLDERS.iter().any(|folder| span.starts_with(folder)) && !span.contains([' ', '*', '…'])
            };
            let paths = spans(line).into_iter().filter(is_path).map(|path| (path, root.join(path).exists()));
            for (cited, exists) in links.chain(paths) {
                checked += 1;
                if !exists {
                    faults.push(format!("{}:{}: {cited}", document.display(), at + 1));
                }
            }
        }
    }
    assert!(faults.is_empty(), "these links and paths lead nowhere:\n  {}", faults.join("\n  "));
    assert!(checked > 100, "only {checked} links and paths were recognised");
}

/// Returns the Markdown files below a folder.
fn pages_below(folder: &Path) -> Vec<PathBuf> {
    let (mut pages, mut folders) = (Vec::new(), vec![folder.to_owned()]);
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            match path.is_dir() {
                true => folders.push(path),
                false if path.extension().is_some_and(|extension| extension == "md") => pages.push(path),
                false => {}
            }
        }
    }
    pages
}

#[test]
fn the_summary_of_the_book_names_every_page_once() {
    let docs = root().join("docs");
    let summary = fs::read_to_string(docs.join("SUMMARY.md")).unwrap();
    let mut named = BTreeSet::new();
    for page in summary.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
        assert!(named.insert(PathBuf::from(page)), "docs/SUMMARY.md names {page} twice");
    }
    let mut pages: BTreeSet<_> =
        pages_below(&docs).iter().map(|page| page.strip_prefix(&docs).unwrap().to_owned()).collect();
    pages.remove(Path::new("SUMMARY.md"));
    let unnamed: Vec<_> = pages.difference(&named).collect();
    assert!(unnamed.is_empty(), "docs/SUMMARY.md does not name {unnamed:?}");
    let absent: Vec<_> = named.difference(&pages).collect();
    assert!(absent.is_empty(), "docs/SUMMARY.md names {absent:?}, which are not below docs/");
}

/// Returns `true` if a link of a document names a file that exists, and a heading of it.
fn leads_somewhere(document: &Path, link: &str) -> bool {
    let (file, heading) = link.split_once('#').map_or((link, None), |(file, heading)| (file, Some(heading)));
    let target = if file.is_empty() { document.to_owned() } else { document.parent().unwrap().join(file) };
    let Some(heading) = heading else { return target.exists() };
    let text = fs::read_to_string(target).unwrap_or_default();
    text.lines().filter(|line| line.starts_with('#')).any(|line| {
        // As GitHub makes them.
        let line = line.trim_start_matches('#').trim().to_lowercase();
        let anchor = line.chars().filter(|c| c.is_alphanumeric() || matches!(c, '-' | '_' | ' '));
        anchor.map(|c| if c == ' ' { '-' } else { c }).eq(heading.chars())
    })
}

/// Looks up the citations of a document.
struct Checker {
    root: PathBuf,
    /// The files and folders that a name stands for.
    names: BTreeMap<String, Vec<PathBuf>>,
    /// Tests by file or folder.
    tests: BTreeMap<PathBuf, BTreeSet<String>>,
    faults: Vec<String>,
    cited: usize,
}

impl Checker {
    /// Reads the table of names.
    fn new(text: &str, root: &Path) -> Self {
        let (names, tests, faults) = (BTreeMap::new(), BTreeMap::new(), Vec::new());
        let mut checker = Self { root: root.to_owned(), names, tests, faults, cited: 0 };
        let rows = text.lines().enumerate().skip_while(|(_, line)| !line.starts_with(NAMES_HEAD)).skip(2);
        for (at, row) in rows.take_while(|(_, line)| line.starts_with('|')) {
            let Some((name, paths)) = row.trim_matches('|').split_once('|') else { continue };
            let paths: Vec<_> = spans(paths).into_iter().map(|path| root.join(path)).collect();
            for path in paths.iter().filter(|path| !path.exists()) {
                checker.fault(at, &format!("there is no {}", path.display()));
            }
            for name in spans(name) {
                checker.names.insert(name.to_owned(), paths.clone());
            }
        }
        checker
    }

    fn check(&mut self, text: &str) {
        let mut cites = false;
        for (at, line) in text.lines().enumerate() {
            let cells: Vec<_> = line.trim().trim_matches('|').split('|').collect();
            let last = cells.last().copied().unwrap_or_default().trim();
            let is_row = line.starts_with('|');
            cites = is_row && (cites || last == SHOWN_BY);
            if cites {
                self.check_cell(at, last);
                self.check_text(at, &cells[..cells.len() - 1].concat());
            } else {
                self.check_text(at, line);
            }
        }
    }

    /// Every code span of a cell that cites tests must be a citation.
    fn check_cell(&mut self, at: usize, cell: &str) {
        let mut file: Option<&str> = None;
        let mut rest = cell;
        for span in spans(cell) {
            rest = rest.split_once(&format!("`{span}`")).map_or("", |(_, rest)| rest);
            let is_all = rest.trim_start().starts_with("(all)");
            match span.split_once(": ") {
                Some((name, test)) => {
                    file = Some(name);
                    self.look_up(at, name, Some(test));
                }
                None if is_all => self.look_up(at, span, None),
                None if span.contains('/') => {
                    self.cited += 1;
                    if !self.root.join(span).exists() {
                        self.fault(at, &format!("there is no {span}"));
                    }
                }
                // `name` and `name` (all)
                None if self.names.contains_key(span) => self.look_up(at, span, None),
                None => match file {
                    Some(name) => self.look_up(at, name, Some(span)),
                    None => self.fault(at, &format!("`{span}` names no file: write `NAME: {span}`")),
                },
            }
        }
    }

    /// Elsewhere a code span is a citation if a name and a test are in it.
    fn check_text(&mut self, at: usize, text: &str) {
        for (name, test) in spans(text).into_iter().filter_map(|span| span.split_once(": ")) {
            let is_test = test.contains('_')
                && test.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit());
            if is_test {
                self.look_up(at, name, Some(test));
            }
        }
    }

    /// Looks for a test, or for any.
    fn look_up(&mut self, at: usize, name: &str, test: Option<&str>) {
        self.cited += 1;
        let below = self.root.join("crates").join(name);
        let paths = match self.names.get(name) {
            Some(paths) => paths.clone(),
            None if name.ends_with(".rs") && below.exists() => vec![below],
            None => {
                let known: Vec<_> = self.names.keys().map(String::as_str).collect();
                let known = known.join(", ");
                return self.fault(at, &format!("`{name}` stands for no file; the names are {known}"));
            }
        };
        let mut found = BTreeSet::new();
        for path in &paths {
            let tests = self.tests.entry(path.clone()).or_insert_with(|| tests_in(path));
            found.extend(tests.iter().cloned());
        }
        let is_there = match test.map(|test| (test, test.strip_prefix('…'))) {
            None => !found.is_empty(),
            Some((_, Some(end))) => found.iter().any(|test| test.ends_with(end)),
            Some((test, None)) => found.contains(test),
        };
        if !is_there {
            let test = test.unwrap_or("(all)");
            let near = found.iter().max_by_key(|found| likeness(found, test));
            let near = near.map(|near| format!("; the nearest is {near}")).unwrap_or_default();
            self.fault(at, &format!("`{name}` has no test {test}{near}"));
        }
    }

    fn fault(&mut self, at: usize, what: &str) {
        self.faults.push(format!("line {}: {what}", at + 1));
    }
}

/// The code spans of a line.
fn spans(text: &str) -> Vec<&str> {
    text.split('`').skip(1).step_by(2).collect()
}

/// The names of all tests in a file, or below a folder: functions with a test's attribute, and functions whose names stand
/// alone in a line, as a macro that makes tests of them takes them.
fn tests_in(path: &Path) -> BTreeSet<String> {
    if path.is_dir() {
        let entries = fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path());
        return entries.flat_map(|path| tests_in(&path)).collect();
    }
    if path.extension().is_none_or(|extension| extension != "rs") {
        return BTreeSet::new();
    }
    let (mut tests, mut functions, mut alone) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
    let mut is_test = false;
    for line in fs::read_to_string(path).unwrap_or_default().lines().map(str::trim) {
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
        } else if line.contains('_')
            && line.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit())
        {
            alone.insert(line.to_owned());
        }
    }
    tests.extend(functions.intersection(&alone).cloned());
    tests
}

/// Counts the words that two names have in common.
fn likeness(a: &str, b: &str) -> usize {
    let words: BTreeSet<_> = a.split('_').collect();
    b.split('_').filter(|word| words.contains(word)).count()
}

#[test]
fn a_wrong_citation_is_found_in_each_form() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir_all(dir.path().join("crates/a/src")).unwrap();
    let source = "#[test]\n#[ignore = \"slow\"]\nfn one_is_refused() {}\n#[tokio::test(flavor = \"x\")]\nasync fn two_is_refused() {}\nfn no_test() {}\n\
                  each!(\n    three_is_refused\n);\nasync fn three_is_refused(scheme: &str) {}\n";
    fs::write(dir.path().join("crates/a/src/x.rs"), source).unwrap();
    fs::write(dir.path().join("crates/a/src/empty.rs"), "").unwrap();
    let faults = |cell: &str| {
        let text = format!(
            "{NAMES_HEAD}\n|---|---|\n| `x`, `y` | `crates/a/src/x.rs` |\n| `none` | `crates/a/src/empty.rs` |\n\n\
             | tries | outcome | shown by |\n|---|---|---|\n| a | `no_test` | {cell} |\n"
        );
        let mut checker = Checker::new(&text, dir.path());
        checker.check(&text);
        checker.faults.join("; ")
    };
    for right in [
        "`x: one_is_refused`, `two_is_refused`",
        "`y: …two_is_refused`, `three_is_refused`",
        "`a/src/x.rs: one_is_refused`; `crates/a`",
        "`x` (all)",
        "no test",
        "–",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("`x: three`", "line 8: `x` has no test three"),
        ("`x: one_is_refused`, `three`", "line 8: `x` has no test three"),
        ("`x: one_was_refused`", "`x` has no test one_was_refused; the nearest is one_is_refused"),
        ("`x: no_test`", "has no test no_test"),
        ("`x: …three`", "has no test …three"),
        ("`z: one_is_refused`", "`z` stands for no file; the names are none, x, y"),
        ("`one_is_refused`", "names no file"),
        ("`none` (all)", "has no test (all)"),
        ("`crates/b`", "there is no crates/b"),
        ("|\n\nIn a text: `x: no_such_test`.", "line 10: `x` has no test no_such_test"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}
