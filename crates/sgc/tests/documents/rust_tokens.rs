//! The imports of a Rust file, read from its tokens.

use std::collections::{BTreeMap, BTreeSet};

/// The path of a module or item from the root of its crate.
pub(crate) type Path = Vec<String>;

/// Words that begin an item, which ends with a semicolon or a brace.
const ITEMS: [&str; 12] = [
    "fn",
    "impl",
    "mod",
    "struct",
    "enum",
    "trait",
    "use",
    "const",
    "static",
    "type",
    "unsafe",
    "macro_rules",
];

/// The imports of a file, without those of its tests.
#[derive(Debug, Default)]
pub(crate) struct Module {
    /// The paths with `crate::` or `super::`, in imports and elsewhere.
    pub(crate) uses: BTreeSet<Path>,
    /// The names that the file imports or re-exports from its crate, with their paths.
    pub(crate) imports: BTreeMap<String, Path>,
    /// The modules in files of their own that are tests.
    pub(crate) test_modules: Vec<Path>,
}

/// Reads a file. `path` is that of its module, `files` are the modules of its crate that have files.
pub(crate) fn modules(text: &str, path: &Path, files: &BTreeSet<Path>) -> Module {
    let tokens = tokens(text);
    let mut module = Module::default();
    // The path of the module at hand, and the depth of braces at which each of its inline modules ends.
    let (mut here, mut depth, mut ends) = (path.clone(), 0, Vec::new());
    let mut at = 0;
    while let Some(token) = tokens.get(at) {
        match *token {
            "#" if is_for_tests(&tokens[at..]) => {
                let item = tests_item(&tokens, at);
                if let ["mod", name, ";"] = item {
                    module.test_modules.push([here.as_slice(), &[(*name).to_owned()]].concat());
                }
                at = after(&tokens, item);
                continue;
            }
            "mod" if tokens.get(at + 2) == Some(&"{") => {
                here.push(tokens[at + 1].to_owned());
                ends.push(depth);
            }
            "{" => depth += 1,
            "}" => {
                depth -= 1;
                if ends.pop_if(|end| *end == depth).is_some() {
                    here.pop();
                }
            }
            "use" => {
                let mut reader = Reader { tokens: &tokens, at: at + 1 };
                let (start, is_counted) = reader.start(&here, files);
                let mut names = Vec::new();
                reader.tree(start.clone().unwrap_or_default(), &mut names);
                if start.is_some() {
                    module.uses.extend(names.iter().filter(|_| is_counted).map(|(_, path)| path.clone()));
                    module.imports.extend(names.into_iter().filter(|_| here == *path));
                }
                at = reader.at;
                continue;
            }
            "crate" | "super" if tokens.get(at + 1) == Some(&"::") => {
                let mut reader = Reader { tokens: &tokens, at };
                let (start, _) = reader.start(&here, files);
                let mut names = Vec::new();
                reader.tree(start.unwrap_or_default(), &mut names);
                module.uses.extend(names.into_iter().map(|(_, path)| path));
                at = reader.at;
                continue;
            }
            // A visibility is no use.
            "in" if tokens.get(at + 1).is_some_and(|next| ["crate", "super"].contains(next)) => {
                at += tokens[at..].iter().take_while(|token| **token != ")").count();
                continue;
            }
            _ => {}
        }
        at += 1;
    }
    module
}

/// A reader of paths.
struct Reader<'t> {
    tokens: &'t [&'t str],
    at: usize,
}

impl Reader<'_> {
    fn peek(&self) -> &str {
        self.tokens.get(self.at).copied().unwrap_or_default()
    }

    fn skip(&mut self, token: &str) -> bool {
        let is_there = self.peek() == token;
        self.at += usize::from(is_there);
        is_there
    }

    /// Reads the beginning of a path in the module `here`. Returns the module from which the rest leads, unless that is
    /// in another crate, and whether the path begins with `crate` or `super`.
    fn start(&mut self, here: &Path, files: &BTreeSet<Path>) -> (Option<Path>, bool) {
        if self.skip("crate") {
            self.skip("::");
            return (Some(Path::new()), true);
        }
        let mut start = here.clone();
        if self.peek() != "super" {
            let is_own = self.skip("self") && self.skip("::");
            let child = [here.as_slice(), &[self.peek().to_owned()]].concat();
            return ((is_own || files.contains(&child)).then_some(start), false);
        }
        while self.skip("super") {
            start.pop();
            self.skip("::");
        }
        (Some(start), true)
    }

    /// Reads the rest of a path, whose groups have several ends, and adds each end with its name.
    fn tree(&mut self, mut path: Path, names: &mut Vec<(String, Path)>) {
        loop {
            if self.skip("{") {
                while !self.skip("}") && self.at < self.tokens.len() {
                    self.tree(path.clone(), names);
                    self.skip(",");
                }
                return;
            }
            if self.skip("*") {
                return names.push(("*".into(), path));
            }
            if !is_word(self.peek()) {
                break;
            }
            if !self.skip("self") {
                path.push(self.peek().to_owned());
                self.at += 1;
            }
            if !self.skip("::") {
                break;
            }
        }
        let mut name = path.last().cloned().unwrap_or_default();
        if self.skip("as") {
            name = self.peek().to_owned();
            self.at += 1;
        } else if path.is_empty() && !is_word(self.peek()) {
            self.at += usize::from(![";", ")", "}", ","].contains(&self.peek()));
        }
        names.push((name, path));
    }
}

fn is_word(token: &str) -> bool {
    token.starts_with(|c: char| c == '_' || c.is_alphanumeric())
}

/// Returns `true` if the tokens begin with an attribute that is true in tests only.
fn is_for_tests(tokens: &[&str]) -> bool {
    let attribute: Vec<&str> = tokens.iter().take_while(|token| **token != "]").copied().collect();
    attribute.starts_with(&["#", "[", "cfg", "("])
        && attribute.contains(&"test")
        && !attribute.contains(&"not")
        && !attribute.contains(&"any")
}

/// Returns the item, field or statement behind the attributes at a place.
fn tests_item<'t, 's>(tokens: &'t [&'s str], mut at: usize) -> &'t [&'s str] {
    while tokens.get(at) == Some(&"#") {
        at += 1 + bracketed(&tokens[at + 1..]);
    }
    let item = &tokens[at..];
    let is_item = item.iter().take(6).any(|token| ITEMS.contains(token));
    let mut length = 0;
    while let Some(token) = item.get(length) {
        match *token {
            ";" => return &item[..=length],
            "," if !is_item => return &item[..=length],
            ")" | "]" | "}" => return &item[..length],
            "(" | "[" => length += bracketed(&item[length..]),
            "{" => {
                length += bracketed(&item[length..]);
                if item.first() != Some(&"use") && item.get(length) != Some(&";") {
                    return &item[..length];
                }
            }
            _ => length += 1,
        }
    }
    item
}

/// Returns the number of tokens up to the end of the brackets that begin here.
fn bracketed(tokens: &[&str]) -> usize {
    let mut depth = 0;
    for (n, token) in tokens.iter().enumerate() {
        match *token {
            "(" | "[" | "{" => depth += 1,
            ")" | "]" | "}" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return n + 1;
        }
    }
    tokens.len()
}

/// Returns the place behind a part of the tokens.
fn after(tokens: &[&str], part: &[&str]) -> usize {
    let bytes = part.as_ptr_range().end as usize - tokens.as_ptr() as usize;
    bytes / size_of::<&str>()
}

/// Divides Rust into words, `::` and other characters, without comments, texts and lifetimes.
fn tokens(text: &str) -> Vec<&str> {
    let mut tokens = Vec::new();
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let length = match first {
            _ if rest.starts_with("//") => rest.find('\n').unwrap_or(rest.len()),
            _ if rest.starts_with("/*") => block_comment(rest),
            '"' => quoted(rest),
            '\'' => character(rest),
            _ if is_word(rest) => {
                let word = rest.find(|c: char| c != '_' && !c.is_alphanumeric()).unwrap_or(rest.len());
                match (&rest[..word], rest[word..].chars().next()) {
                    ("r" | "br" | "cr", Some('"' | '#')) if raw(&rest[word..]).is_some() => {
                        word + raw(&rest[word..]).unwrap_or(0)
                    }
                    _ => {
                        tokens.push(&rest[..word]);
                        word
                    }
                }
            }
            _ => {
                let length = if rest.starts_with("::") { 2 } else { first.len_utf8() };
                if !first.is_whitespace() {
                    tokens.push(&rest[..length]);
                }
                length
            }
        };
        rest = &rest[length..];
    }
    tokens
}

/// Returns the length of the comment that begins a text, with those inside.
fn block_comment(text: &str) -> usize {
    let (mut depth, mut at) = (0, 0);
    while at < text.len() {
        if text.as_bytes()[at..].starts_with(b"/*") {
            (depth, at) = (depth + 1, at + 2);
        } else if text.as_bytes()[at..].starts_with(b"*/") {
            (depth, at) = (depth - 1, at + 2);
        } else {
            at += 1;
        }
        if depth == 0 {
            return at;
        }
    }
    text.len()
}

/// Returns the length of the literal in quotes that begins a text.
fn quoted(text: &str) -> usize {
    let quote = text.as_bytes()[0];
    let mut at = 1;
    while let Some(byte) = text.as_bytes().get(at) {
        at += if *byte == b'\\' { 2 } else { 1 };
        if *byte == quote {
            return at;
        }
    }
    text.len()
}

/// Returns the length of the character that begins a text, or of the quote of a lifetime.
fn character(text: &str) -> usize {
    let mut chars = text.chars().skip(1);
    match (chars.next(), chars.next()) {
        (Some('\\'), _) | (_, Some('\'')) => quoted(text),
        _ => 1,
    }
}

/// Returns the length of a raw text behind its `r`.
fn raw(text: &str) -> Option<usize> {
    let hashes = text.bytes().take_while(|byte| *byte == b'#').count();
    let inner = text[hashes..].strip_prefix('"')?;
    let end = format!("\"{}", "#".repeat(hashes));
    Some(hashes + 1 + inner.find(&end)? + end.len())
}
