//! The files of a crate import each other in one direction only.
//!
//! An edge leads from a file to the file that defines what a path with `crate::` or `super::` names; re-exports are
//! followed. The declaration of a module and its re-export by the parent are no edges. Code under `#[cfg(test)]` does
//! not count.

use std::collections::{BTreeMap, BTreeSet};

use crate::repository::{REPOSITORY, Repository};
use crate::rust_tokens::{Module, Path, modules};

/// Most re-exports between a path and its file.
const RE_EXPORTS_MAX: usize = 16;

/// The files of one crate, by their module paths. The path of `lib.rs` or `main.rs` is empty.
struct Sources(BTreeMap<Path, Module>);

impl Sources {
    fn read(repository: &Repository, krate: &str) -> Self {
        let folder = format!("{krate}/src");
        let mut sources = BTreeMap::new();
        for file in repository.files_below(&folder) {
            let Some(name) = file[folder.len() + 1..].strip_suffix(".rs") else { continue };
            let mut path: Path = name.split('/').map(str::to_owned).collect();
            path.pop_if(|last| ["lib", "main", "mod"].contains(&last.as_str()));
            sources.insert(path, repository.read(file));
        }
        let files: BTreeSet<Path> = sources.keys().cloned().collect();
        let mut read: BTreeMap<Path, Module> =
            sources.iter().map(|(path, text)| (path.clone(), modules(text, path, &files))).collect();
        let tests: Vec<Path> = read.values().flat_map(|module| module.test_modules.clone()).collect();
        read.retain(|path, _| !tests.iter().any(|test| path.starts_with(test)));
        Self(read)
    }

    /// Returns the module whose file defines what a path names.
    fn definition(&self, path: &[String]) -> Path {
        let mut path = path.to_vec();
        for _ in 0..RE_EXPORTS_MAX {
            let length = (0..=path.len()).rev().find(|n| self.0.contains_key(&path[..*n])).unwrap_or(0);
            let (module, rest) = path.split_at(length);
            let exported =
                rest.first().and_then(|name| self.0.get(module).and_then(|module| module.imports.get(name)));
            match exported {
                Some(exported) if !exported.starts_with(&path) => path = [exported, &rest[1..]].concat(),
                _ => return module.to_vec(),
            }
        }
        path
    }

    /// Returns the modules that each module uses.
    fn edges(&self) -> BTreeMap<Path, BTreeSet<Path>> {
        let of = |path: &Path, module: &Module| -> BTreeSet<Path> {
            module.uses.iter().map(|used| self.definition(used)).filter(|used| used != path).collect()
        };
        self.0.iter().map(|(path, module)| (path.clone(), of(path, module))).collect()
    }

    /// Returns each group of files that reach each other, with its edges.
    fn circles(&self) -> Vec<String> {
        let edges = self.edges();
        let reach: BTreeMap<&Path, BTreeSet<&Path>> =
            edges.keys().map(|path| (path, reached(&edges, path))).collect();
        let mut circles = BTreeSet::new();
        for (path, reached) in &reach {
            if reached.contains(path) {
                let group: BTreeSet<&Path> =
                    reached.iter().copied().filter(|other| reach[*other].contains(path)).collect();
                circles.insert(group);
            }
        }
        let line = |group: &BTreeSet<&Path>, path: &Path| {
            let used: Vec<String> =
                edges[path].iter().filter(|p| group.contains(p)).map(|p| name(p)).collect();
            format!("    {} uses {}", name(path), used.join(", "))
        };
        let describe = |group: BTreeSet<&Path>| {
            let lines: Vec<String> = group.iter().map(|path| line(&group, path)).collect();
            format!("a circle of {} files:\n{}", group.len(), lines.join("\n"))
        };
        circles.into_iter().map(describe).collect()
    }
}

fn name(path: &[String]) -> String {
    if path.is_empty() { "lib".into() } else { path.join("::") }
}

/// Returns the modules that one uses directly or through others.
fn reached<'e>(edges: &'e BTreeMap<Path, BTreeSet<Path>>, from: &Path) -> BTreeSet<&'e Path> {
    let (mut reached, mut open) = (BTreeSet::new(), vec![from]);
    while let Some(path) = open.pop() {
        for used in edges.get(path).into_iter().flatten() {
            if reached.insert(used) {
                open.push(used);
            }
        }
    }
    reached
}

/// Returns the folders of the repository's crates.
fn crates(repository: &Repository) -> BTreeSet<&str> {
    repository.files_ending("Cargo.toml").filter_map(|file| file.strip_suffix("/Cargo.toml")).collect()
}

/// Returns the circles of each crate that has some.
fn circles(repository: &Repository) -> BTreeMap<&str, Vec<String>> {
    let all = crates(repository).into_iter().map(|krate| (krate, Sources::read(repository, krate).circles()));
    all.filter(|(_, circles)| !circles.is_empty()).collect()
}

#[test]
fn files_of_a_crate_import_each_other_in_one_direction() {
    assert!(crates(&REPOSITORY).len() > 10, "few crates are found");
    let list = |(krate, circles): (&str, Vec<String>)| format!("{krate}: {}", circles.join("\n"));
    let found: Vec<String> = circles(&REPOSITORY).into_iter().map(list).collect();
    assert!(found.is_empty(), "move what the files share into a file below them\n{}", found.join("\n"));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circles_of(files: &[(&str, &str)]) -> String {
        let files: Vec<(String, &str)> =
            files.iter().map(|(name, text)| (format!("crates/a/src/{name}.rs"), *text)).collect();
        let mut all = vec![("crates/a/Cargo.toml", "")];
        all.extend(files.iter().map(|(name, text)| (name.as_str(), *text)));
        let repository = Repository::make(&all);
        circles(&repository).remove("crates/a").unwrap_or_default().join("\n")
    }

    #[test]
    fn circles_are_found_in_imports_and_in_code() {
        let circles = circles_of(&[
            ("lib", "mod a; mod b; mod c; mod d;"),
            ("a", "use crate::{b::{self, B}, d::D};"),
            ("b", "fn b() -> u8 { let _ = \"// no comment {\"; super::c::number::<u8>() }"),
            ("c/mod", "pub mod inner;"),
            ("c/inner", "use super::super::a;"),
            ("d", ""),
        ]);
        assert_eq!(circles, "", "`c` itself uses nothing");
        let circles = circles_of(&[
            ("lib", "mod a; mod b; mod c; mod d;"),
            ("a", "use crate::{d::D, b::{self, B}};"),
            ("b", "fn b() -> u8 { let _ = ('\"', \"// no comment {\"); super::c::number::<u8>() }"),
            ("c", "impl<'a> C<'a> { pub(in crate::a) fn c(&'a self) { crate::a::f(); } }"),
            ("d", "pub struct D;"),
        ]);
        assert_eq!(circles, "a circle of 3 files:\n    a uses b\n    b uses c\n    c uses a");
    }

    #[test]
    fn re_exports_lead_to_the_file_that_defines_the_name() {
        let lib = "mod a; mod b;\npub use a::A;\npub use b::{B as Bee, C};";
        assert_eq!(circles_of(&[("lib", lib), ("a", "use crate::C;"), ("b", "pub struct C;")]), "");
        let circles = circles_of(&[("lib", lib), ("a", "use crate::Bee;"), ("b", "use crate::A as X;")]);
        assert_eq!(circles, "a circle of 2 files:\n    a uses b\n    b uses a");
    }

    #[test]
    fn tests_and_comments_are_no_imports() {
        let a = "// use crate::b;\n/* crate::b /* */ crate::b */\n#[cfg(test)]\nuse crate::b::B;\n\
                 struct A { #[cfg(test)] b: crate::b::B, c: u8 }\n\
                 #[cfg(test)]\nimpl<T, U> A { fn a() { crate::b::b(); } }\n#[cfg(test)]\nmod tests { use crate::b; }\n\
                 #[cfg(test)]\nmod lab;\nmod inner { use super::c; }";
        let b = "use crate::a::A; const TEXT: &str = r#\"crate::\"a\"\"#;";
        let files = [("lib", "mod a; mod b;"), ("a", a), ("b", b), ("a/lab", "use crate::b;")];
        assert_eq!(circles_of(&files), "");
        let counted = "#[cfg(not(test))]\nuse crate::b::B;";
        assert!(!circles_of(&[("lib", "mod a; mod b;"), ("a", counted), ("b", b)]).is_empty());
    }
}
