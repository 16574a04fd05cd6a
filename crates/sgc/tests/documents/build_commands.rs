//! `make` targets and `cargo test` lines that documents cite exist.

use std::collections::BTreeSet;

use crate::markdown::Document;
use crate::report::Report;
use crate::repository::{REPOSITORY, Repository};
use crate::shell;
use crate::test_names::tests_in;

/// Options of `cargo` that take a value.
const WITH_VALUE: [&str; 8] =
    ["--bench", "--bin", "--example", "--features", "--manifest-path", "--package", "--target-dir", "-j"];

#[test]
fn every_cited_make_target_and_cargo_test_exists() {
    let mut report = Report::default();
    for document in REPOSITORY.documents() {
        check(&REPOSITORY, &document, &mut report);
    }
    report.finish(20, "these commands name what does not exist:");
}

fn check(repository: &Repository, document: &Document, report: &mut Report) {
    let targets = targets(&repository.read("Makefile"));
    for line in shell::command_lines(document) {
        for words in shell::commands(&line.text) {
            let words: Vec<_> = words.iter().map(String::as_str).collect();
            match words[..] {
                ["make", ref cited @ ..] => {
                    let is_target = |word: &&&str| !word.starts_with('-') && !word.contains('=');
                    for target in cited.iter().take_while(|word| is_plain(word)).filter(is_target) {
                        let is_there = targets.contains(*target);
                        let fault = (!is_there).then(|| format!("the Makefile has no target {target}"));
                        report.check(&document.path, line.line, fault.map_or(Ok(()), Err));
                    }
                }
                ["cargo", "test", ref options @ ..] => {
                    report.check(&document.path, line.line, cargo_test(repository, options));
                }
                // The short form.
                [package, "--test", ref options @ ..]
                    if repository.has(&format!("crates/{package}/Cargo.toml")) =>
                {
                    let options = [&["-p", package, "--test"], options].concat();
                    report.check(&document.path, line.line, cargo_test(repository, &options));
                }
                ["--test", ..] => report.check(&document.path, line.line, cargo_test(repository, &words)),
                _ => {}
            }
        }
    }
}

/// Returns `false` for placeholders, such as `…` and `TARGET`.
fn is_plain(word: &str) -> bool {
    word.is_ascii() && !word.contains("...") && !word.chars().all(|c| c.is_ascii_uppercase())
}

/// Returns the targets of a Makefile.
fn targets(makefile: &str) -> BTreeSet<String> {
    let rules = makefile.lines().filter(|line| !line.starts_with([' ', '\t', '#', '.']));
    let rules = rules.filter_map(|line| line.split_once(':')).filter(|(_, rest)| !rest.starts_with('='));
    rules.flat_map(|(names, _)| names.split_whitespace()).map(str::to_owned).collect()
}

/// Looks for the package, the test file and the tests that a `cargo test` names.
fn cargo_test(repository: &Repository, options: &[&str]) -> Result<(), String> {
    let (mut folder, mut file, mut filters) = (None, None, Vec::new());
    // `name…` stands for tests whose names begin so.
    let options = options.iter().map(|word| word.trim_end_matches('…'));
    let mut words = options.filter(|word| !word.is_empty() && is_plain(word));
    while let Some(word) = words.next() {
        match word {
            "-p" => {
                let package = words.next().unwrap_or_default();
                folder = Some(format!("crates/{package}"));
                if !repository.has(&format!("crates/{package}/Cargo.toml")) {
                    return Err(format!("there is no package {package}"));
                }
            }
            "--test" => file = words.next(),
            word if WITH_VALUE.contains(&word) => drop(words.next()),
            word if word.starts_with('-') => {}
            word => filters.push(word),
        }
    }
    let paths: Vec<&str> = match file {
        Some(name) => {
            let forms = [format!("tests/{name}.rs"), format!("tests/{name}/main.rs")];
            let is_it = |path: &&str| {
                let is_in_crate =
                    folder.as_ref().is_none_or(|folder| path.starts_with(&format!("{folder}/")));
                is_in_crate && forms.iter().any(|form| path.ends_with(&format!("/{form}")))
            };
            let found: Vec<_> = repository.files().filter(is_it).collect();
            if found.is_empty() {
                let place = folder.as_deref().unwrap_or("any crate");
                return Err(format!("{place} has no test file {name}"));
            }
            // Modules of the test are in its folder.
            let folders = found.iter().map(|path| path.trim_end_matches(".rs").trim_end_matches("/main"));
            let below = folders.flat_map(|folder| repository.files_below(folder));
            below.chain(found.iter().copied()).collect()
        }
        None => repository.files_below(folder.as_deref().unwrap_or("crates")).collect(),
    };
    for filter in filters {
        let name = filter.rsplit("::").next().unwrap_or(filter);
        let mut tests = paths.iter().flat_map(|path| tests_in(&repository.read(path)));
        let is_module = |path: &&str| path.split(['/', '.']).any(|part| part.contains(filter));
        if !tests.any(|test| test.contains(name)) && !paths.iter().any(is_module) {
            return Err(format!("no test there has {filter} in its name"));
        }
    }
    Ok(())
}

#[test]
fn a_wrong_target_or_test_is_found() {
    let repository = Repository::make(&[
        ("Makefile", "A := b\n.PHONY: test\ntest lint: deps\n\techo a: b\n"),
        ("crates/one/Cargo.toml", ""),
        ("crates/one/tests/x.rs", "#[test]\nfn it_works() {}\n"),
        ("crates/one/tests/y/main.rs", ""),
        ("crates/one/tests/y/part.rs", "#[tokio::test]\nasync fn it_runs() {}\n"),
    ]);
    let faults =
        |text: &str| Report::faults_of(|report| check(&repository, &Document::new("page.md", text), report));
    for right in [
        "`make test`, `make test ARGS=\"a b\"`, `A_B=1 make lint`, `make TARGET`, `make …`",
        "`cargo test -p one`, `cargo test --release -p one --test x it_works -- --nocapture`",
        "`cargo test --test y runs`, `cargo test -p one --test …`, `cargo test --test y part`, `one --test x it_works…`, `--test x`",
        "```sh\nmake lint test   # all\n```\n\n```\nmake nothing\n```",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("`make tests`", "page.md:1: the Makefile has no target tests"),
        ("`make echo`", "the Makefile has no target echo"),
        ("```sh\ncd x && make lint deps\n```", "page.md:2: the Makefile has no target deps"),
        ("`one --test x it_runs`", "no test there has it_runs in its name"),
        ("`--test z`", "any crate has no test file z"),
        ("`cargo test -p two`", "there is no package two"),
        ("`cargo test -p one --test z`", "crates/one has no test file z"),
        ("`SGC_X=1 cargo test -p one --test x it_runs`", "no test there has it_runs in its name"),
        ("`cargo test -p one -- --ignored it_stops`", "no test there has it_stops in its name"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}
