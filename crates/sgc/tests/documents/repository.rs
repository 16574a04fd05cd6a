//! The files of the repository, by a walk of its tree, and its documents among them.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use tempfile::TempDir;

use crate::markdown::Document;

/// Folders that builds and package managers make. Hidden folders are left out, too.
const MADE: [&str; 3] = ["target", "node_modules", "__pycache__"];
/// The list of changes tells what was, and cites what is gone since.
const CHANGES: &str = "CHANGELOG.md";
/// A decision stands as it was taken. Only its links are checked.
const DECISIONS: &str = "docs/adr/";

/// Endings of files with code.
const SOURCES: [&str; 11] =
    [".rs", ".py", ".sh", ".js", ".proto", ".c", ".cpp", ".hpp", ".toml", ".txt", "Makefile"];
/// The rules' own tests, which cite what does not exist.
const OWN: &str = "crates/sgc/tests/documents/";

/// This repository, walked once.
pub(crate) static REPOSITORY: LazyLock<Repository> =
    LazyLock::new(|| Repository::walk(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")));

/// The files below a root.
#[derive(Debug)]
pub(crate) struct Repository {
    root: PathBuf,
    /// Paths from the root.
    files: BTreeSet<String>,
    /// Every path of a file or folder from the root, and each of its endings that begins with a whole name.
    endings: BTreeSet<String>,
    /// Set for a repository that a test made.
    _made: Option<TempDir>,
}

impl Repository {
    /// Lists the files below `root`.
    pub(crate) fn walk(root: &Path) -> Self {
        let (mut files, mut endings) = (BTreeSet::new(), BTreeSet::new());
        let mut folders = vec![String::new()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(root.join(&folder)).unwrap() {
                let entry = entry.unwrap();
                let name = entry.file_name().into_string().unwrap();
                if name.starts_with('.') || MADE.contains(&name.as_str()) {
                    continue;
                }
                let path = if folder.is_empty() { name } else { format!("{folder}/{name}") };
                endings.insert(path.clone());
                endings.extend(path.match_indices('/').map(|(at, _)| path[at + 1..].to_owned()));
                match entry.path().is_dir() {
                    true => folders.push(path),
                    false => drop(files.insert(path)),
                }
            }
        }
        Self { root: root.to_owned(), files, endings, _made: None }
    }

    /// Makes a repository of these files, for tests of the rules themselves.
    pub(crate) fn make(files: &[(&str, &str)]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let repository = Self::walk(dir.path());
        Self { _made: Some(dir), ..repository }
    }

    /// Returns the documents whose every citation is checked.
    pub(crate) fn documents(&self) -> Vec<Document> {
        let is_checked = |path: &&String| *path != CHANGES && !path.starts_with(DECISIONS);
        self.pages().filter(is_checked).map(|path| self.document(path)).collect()
    }

    /// Returns the paths of all files with code.
    pub(crate) fn sources(&self) -> impl Iterator<Item = &str> {
        let is_source = |path: &&str| SOURCES.iter().any(|end| path.ends_with(end)) && !path.starts_with(OWN);
        self.files().filter(is_source)
    }

    /// Returns the documents whose links are checked.
    pub(crate) fn linked_documents(&self) -> Vec<Document> {
        self.pages().map(|path| self.document(path)).collect()
    }

    fn pages(&self) -> impl Iterator<Item = &String> {
        self.files.iter().filter(|path| path.ends_with(".md"))
    }

    fn document(&self, path: &str) -> Document {
        Document::new(path, &self.read(path))
    }

    /// Returns the text of a file. A file that is not UTF-8 is empty.
    pub(crate) fn read(&self, path: &str) -> String {
        fs::read_to_string(self.root.join(path)).unwrap_or_default()
    }

    /// Returns the files whose paths end so, by whole names.
    pub(crate) fn files_ending<'r>(&'r self, ending: &'r str) -> impl Iterator<Item = &'r str> {
        let is_it = move |path: &&str| {
            path.strip_suffix(ending).is_some_and(|before| before.is_empty() || before.ends_with('/'))
        };
        self.files().filter(is_it)
    }

    /// Returns the files in a folder and in the folders below it.
    pub(crate) fn files_below<'r>(&'r self, folder: &'r str) -> impl Iterator<Item = &'r str> {
        let is_below = move |path: &&str| path.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/'));
        self.files().filter(is_below)
    }

    /// Returns the paths of all files.
    pub(crate) fn files(&self) -> impl Iterator<Item = &str> {
        self.files.iter().map(String::as_str)
    }

    /// Returns `true` if there is a file or folder at this path.
    pub(crate) fn has(&self, path: &str) -> bool {
        self.root.join(path).exists()
    }

    /// Returns `true` if the path of a file or folder ends so, by whole names.
    pub(crate) fn has_ending(&self, ending: &str) -> bool {
        self.endings.contains(ending)
    }

    /// Returns where a generated file is written.
    pub(crate) fn at(&self, path: &str) -> PathBuf {
        self.root.join(path)
    }
}
