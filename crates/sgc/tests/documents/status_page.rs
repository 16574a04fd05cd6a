//! `docs/reference/status.md` and `fleet-status.md`: the fields of `sgc status --json` and `sgc fleet status --json`, from
//! the types that are serialised and their doc comments.
//!
//! The types are read as source text, which needs no derive in the programs. An attribute of serde that is not understood
//! here fails the test.

use std::collections::VecDeque;
use std::fmt::Write as _;

use syn::{
    Attribute, Expr, Field, Fields, GenericArgument, Item, ItemEnum, ItemStruct, Lit, LitStr, Meta,
    PathArguments, Type,
};

use crate::generated::{self, cell, wrapped};
use crate::repository::{REPOSITORY, Repository};

/// A page about a JSON document.
struct DocumentPage {
    path: &'static str,
    title: &'static str,
    /// Words before the fields.
    about: &'static str,
    /// The type of the whole document.
    root: &'static str,
}

const STATUS: DocumentPage = DocumentPage {
    path: "docs/reference/status.md",
    title: "Status document",
    about: "`sgc status --json` prints one JSON object, which the node makes. Later versions may add fields.",
    root: "Status",
};

const FLEET_STATUS: DocumentPage = DocumentPage {
    path: "docs/reference/fleet-status.md",
    title: "Fleet status document",
    about: "`sgc fleet status --json` prints one JSON object. Each node makes its `report`; nodes of another version have \
            fewer fields or more.",
    root: "FleetStatus",
};

#[test]
fn pages_of_documents_are_what_the_types_say() {
    for document in [&STATUS, &FLEET_STATUS] {
        generated::check(document.path, &page(&REPOSITORY, document));
    }
}

#[test]
fn fields_types_and_kinds_are_those_that_serde_writes() {
    let source = "#[derive(Serialize)]\npub struct Status {\n/// One | two.\n#[serde(rename = \"type\")]\npub kind: Option<String>,\n\
                  /// Parts.\npub parts: Vec<Part>,\n/// Reason.\npub reason: Reason,\n/// Sizes.\n#[serde(skip_serializing_if = \"Option::is_none\")]\n\
                  pub sizes: Option<(u64, u64)>,\n/// Counts.\npub counts: BTreeMap<String, u64> }\n\
                  /// A part.\n#[derive(Serialize)]\n#[serde(tag = \"kind\", rename_all = \"snake_case\")]\npub enum Part {\n\
                  /// It is old.\nTooOld {\n/// Seconds.\nage_s: u64 } }\nstruct Part2;\n\
                  /// A reason.\n#[derive(Serialize)]\n#[serde(rename_all = \"snake_case\")]\npub enum Reason {\n/// No way.\nNoWay,\n\
                  /// Else.\n#[serde(other)]\nOther }";
    let page = page(&Repository::make(&[("crates/a/src/x.rs", source)]), &STATUS);
    for part in [
        "| `type` | string or null | One \\| two. |",
        "| `parts` | array of [`parts`](#parts) | Parts. |",
        "| `sizes` | array of 2 integers; absent if none | Sizes. |",
        "| `counts` | object of integers | Counts. |",
        "\n## `parts`\n\nA part.\n",
        "| `reason` | [`reason`](#reason) | Reason. |",
        "\n## `reason`\n\nA reason.\n\n| string | meaning |\n|---|---|\n| `\"no_way\"` | No way. |\n",
        "| `too_old` | It is old. | `age_s` (integer): Seconds. |",
    ] {
        assert!(page.contains(part), "{part}\nis not in\n{page}");
    }
}

/// A type that is serialised.
enum Serialised {
    Struct(ItemStruct),
    Enum(ItemEnum),
}

/// Returns the page of a document: its type, and all types in it.
fn page(repository: &Repository, document: &DocumentPage) -> String {
    let mut page = generated::note("the types of the status document");
    let _ = write!(page, "# {}\n\n{}", document.title, wrapped(document.about, 0));
    let mut waiting = VecDeque::from([(String::new(), document.root.to_owned())]);
    while let Some((path, name)) = waiting.pop_front() {
        let found = find(repository, &name).unwrap_or_else(|| panic!("no type {name} that is serialised"));
        let attributes = match &found {
            Serialised::Struct(item) => &item.attrs,
            Serialised::Enum(item) => &item.attrs,
        };
        if !path.is_empty() {
            let _ = write!(page, "\n## `{path}`\n\n{}", wrapped(&docs(attributes), 0));
        }
        match &found {
            Serialised::Struct(item) => {
                page.push_str("\n| field | type | meaning |\n|---|---|---|\n");
                for field in item.fields.iter().filter(|field| !has_serde(&field.attrs, "skip")) {
                    let (field, shown, inner) = describe(field, &path);
                    let _ = writeln!(page, "| `{field}` | {shown} |",);
                    waiting.extend(inner);
                }
            }
            Serialised::Enum(item) => {
                let tag = serde(&item.attrs, "tag");
                match &tag {
                    Some(tag) => {
                        let _ = write!(page, "\n| `{tag}` | meaning | further fields |\n|---|---|---|\n");
                    }
                    None => page.push_str("\n| string | meaning |\n|---|---|\n"),
                }
                for variant in &item.variants {
                    // Stands for kinds of later versions, and is never written.
                    if has_serde(&variant.attrs, "other") {
                        continue;
                    }
                    if tag.is_none() {
                        assert!(variant.fields.is_empty(), "{name} has no tag");
                        let meaning = cell(&docs(&variant.attrs));
                        let _ = writeln!(page, "| `\"{}\"` | {meaning} |", snake(&variant.ident.to_string()));
                        continue;
                    }
                    let fields = match &variant.fields {
                        Fields::Named(fields) => fields.named.iter().collect(),
                        Fields::Unit => Vec::new(),
                        Fields::Unnamed(_) => panic!("{name}::{} has no names", variant.ident),
                    };
                    let fields = fields.into_iter().map(|field| {
                        let (field_name, shown, inner) = describe(field, &path);
                        assert!(inner.is_none(), "{name}::{}: a type in a variant", variant.ident);
                        let (kind, meaning) = shown.split_once(" | ").unwrap_or_default();
                        format!("`{field_name}` ({kind}): {meaning}")
                    });
                    let fields: Vec<_> = fields.collect();
                    let meaning = cell(&docs(&variant.attrs));
                    let _ = writeln!(
                        page,
                        "| `{}` | {meaning} | {} |",
                        snake(&variant.ident.to_string()),
                        fields.join(" ")
                    );
                }
            }
        }
    }
    page
}

/// Returns a field's name, its type and meaning, and the type in it that has a section of its own, with its path.
fn describe(field: &Field, path: &str) -> (String, String, Option<(String, String)>) {
    let name = field.ident.as_ref().unwrap().to_string();
    let name = serde(&field.attrs, "rename").unwrap_or(name);
    let skips = serde(&field.attrs, "skip_serializing_if").is_some();
    let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
    let (mut kind, inner) = kind_of(&field.ty, &path);
    if skips {
        kind = format!("{}; absent if none", kind.trim_end_matches(" or null"));
    }
    (name, format!("{kind} | {}", cell(&docs(&field.attrs))), inner.map(|inner| (path, inner)))
}

/// Returns what JSON has for a Rust type, and the type of this workspace in it.
fn kind_of(kind: &Type, path: &str) -> (String, Option<String>) {
    match kind {
        Type::Reference(reference) => kind_of(&reference.elem, path),
        Type::Tuple(tuple) => {
            let (first, _) = kind_of(tuple.elems.first().unwrap(), path);
            (format!("array of {} {first}s", tuple.elems.len()), None)
        }
        Type::Path(named) => {
            let last = named.path.segments.last().unwrap();
            let inner: Vec<&Type> = match &last.arguments {
                PathArguments::AngleBracketed(all) => {
                    let types = all.args.iter().filter_map(|arg| {
                        if let GenericArgument::Type(inner) = arg { Some(inner) } else { None }
                    });
                    types.collect()
                }
                _ => Vec::new(),
            };
            match (last.ident.to_string().as_str(), &inner[..]) {
                ("String" | "str", []) => ("string".to_owned(), None),
                ("bool", []) => ("boolean".to_owned(), None),
                ("u8" | "u16" | "u32" | "u64" | "usize" | "i32" | "i64", []) => ("integer".to_owned(), None),
                ("f32" | "f64", []) => ("number".to_owned(), None),
                ("Option", [inner]) => {
                    let (kind, inner) = kind_of(inner, path);
                    (format!("{kind} or null"), inner)
                }
                ("Vec", [inner]) => {
                    let (kind, inner) = kind_of(inner, path);
                    (format!("array of {}", if inner.is_some() { kind } else { format!("{kind}s") }), inner)
                }
                ("BTreeMap", [_, inner]) => {
                    let (kind, inner) = kind_of(inner, path);
                    (format!("object of {kind}s"), inner)
                }
                (name, []) => {
                    let anchor: String = path.chars().filter(|c| *c != '.').collect();
                    (format!("[`{path}`](#{anchor})"), Some(name.to_owned()))
                }
                (name, _) => panic!("{path}: {name} is not understood"),
            }
        }
        _ => panic!("{path}: a type that is not understood"),
    }
}

/// Finds the one type of this name that is serialised.
fn find(repository: &Repository, name: &str) -> Option<Serialised> {
    let mut found = Vec::new();
    for path in
        repository.files_below("crates").filter(|path| path.ends_with(".rs") && path.contains("/src/"))
    {
        let source = repository.read(path);
        if !source.contains(&format!("pub struct {name} {{"))
            && !source.contains(&format!("pub enum {name} {{"))
        {
            continue;
        }
        for item in syn::parse_file(&source).unwrap().items {
            match item {
                Item::Struct(item) if item.ident == name && is_serialised(&item.attrs) => {
                    found.push(Serialised::Struct(item))
                }
                Item::Enum(item) if item.ident == name && is_serialised(&item.attrs) => {
                    found.push(Serialised::Enum(item))
                }
                _ => {}
            }
        }
    }
    assert!(found.len() <= 1, "{name} is the name of {} types", found.len());
    found.pop()
}

fn is_serialised(attributes: &[Attribute]) -> bool {
    let mut derives = attributes.iter().filter(|attribute| attribute.path().is_ident("derive"));
    derives.any(|derive| {
        let mut is_there = false;
        let _ = derive.parse_nested_meta(|meta| {
            is_there |= meta.path.is_ident("Serialize");
            Ok(())
        });
        is_there
    })
}

/// Returns the doc comment, its first paragraph on one line.
fn docs(attributes: &[Attribute]) -> String {
    let mut text = String::new();
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("doc")) {
        if let Meta::NameValue(value) = &attribute.meta
            && let Expr::Lit(literal) = &value.value
            && let Lit::Str(line) = &literal.lit
        {
            let _ = writeln!(text, "{}", line.value().trim());
        }
    }
    let first = text.split("\n\n").next().unwrap_or_default().trim().replace('\n', " ");
    // Links to other items lead nowhere in a page.
    first.replace("[`", "`").replace("`]", "`")
}

/// Returns the value of a serde attribute.
fn serde(attributes: &[Attribute], name: &str) -> Option<String> {
    serde_attributes(attributes).into_iter().find(|(found, _)| found == name).and_then(|(_, value)| value)
}

fn has_serde(attributes: &[Attribute], name: &str) -> bool {
    serde_attributes(attributes).iter().any(|(found, _)| found == name)
}

/// Returns all serde attributes with their values, each of which is known here.
fn serde_attributes(attributes: &[Attribute]) -> Vec<(String, Option<String>)> {
    let known = [
        "rename",
        "tag",
        "rename_all",
        "skip",
        "skip_serializing_if",
        "default",
        "deserialize_with",
        "other",
    ];
    let mut found = Vec::new();
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("serde")) {
        let read = attribute.parse_nested_meta(|meta| {
            let name = meta.path.require_ident()?.to_string();
            assert!(known.contains(&name.as_str()), "an attribute of serde that is not understood: {name}");
            let value = if meta.input.peek(syn::Token![=]) {
                Some(meta.value()?.parse::<LitStr>()?.value())
            } else {
                None
            };
            let is_snake = name != "rename_all" || value.as_deref() == Some("snake_case");
            assert!(is_snake, "names that are not written in snake_case");
            found.push((name, value));
            Ok(())
        });
        read.unwrap();
    }
    found
}

/// Returns the name of a variant as serde writes it.
fn snake(name: &str) -> String {
    let mut snake = String::new();
    for (at, c) in name.chars().enumerate() {
        if c.is_ascii_uppercase() && at > 0 {
            snake.push('_');
        }
        snake.push(c.to_ascii_lowercase());
    }
    snake
}
