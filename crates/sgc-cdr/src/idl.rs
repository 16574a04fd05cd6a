//! Parses `.idl` files: the part of OMG IDL 4.2 that ROS 2 accepts (the ROS 2 design article "IDL - Interface
//! Definition Language"), which is modules, structures, constants, and type names for arrays.
//!
//! Annotations are skipped, except `@default`. `char`, `wchar` and `long double` have no type in `.msg` files, and none
//! here; ROS 2 has no unions, enumerations, maps or inheritance either.

use std::collections::BTreeMap;

use crate::definition::{
    Base, Constant, Definition, Field, FieldType, Primitive, Shape, TypeName, is_identifier,
};
use crate::fault::short;
use crate::parse::{
    DEFINITION_BYTES_MAX, MEMBERS_MAX, ParseError, ParseProblem, Part, action_definitions, suffixes,
};

/// Suffix of the module with the constants of a message.
const CONSTANTS: &str = "_Constants";
/// Greatest depth of modules.
const MODULES_MAX: usize = 8;

/// Parses the `.idl` file that defines `file`, as [`parse`](crate::parse) does others: with the same definitions, and
/// the messages that ROS 2 derives from an action.
pub fn parse_idl(file: &TypeName, text: &str) -> Result<Vec<Definition>, ParseError> {
    if text.len() > DEFINITION_BYTES_MAX {
        return Err(ParseError { name: file.clone(), line: 1, problem: ParseProblem::TooLong });
    }
    let mut parser = Parser {
        file,
        tokens: Tokens { text, at: 0 },
        modules: Vec::new(),
        types: BTreeMap::new(),
        constants: BTreeMap::new(),
        found: BTreeMap::new(),
        members: 0,
    };
    let parsed = parser.items().and_then(|()| parser.finish());
    parsed.map_err(|problem| {
        let line = text.get(..parser.tokens.at).unwrap_or(text).lines().count().max(1);
        ParseError { name: file.clone(), line, problem }
    })
}

/// Returns whether a definition is IDL: its first word is `module`, which is no type of a `.msg` file.
pub(crate) fn is_idl(text: &str) -> bool {
    matches!(Tokens { text, at: 0 }.next(), Ok(Some("module")))
}

struct Parser<'a> {
    file: &'a TypeName,
    tokens: Tokens<'a>,
    /// The open modules.
    modules: Vec<&'a str>,
    /// Names for types.
    types: BTreeMap<&'a str, FieldType>,
    /// Constants of whole numbers, which may be sizes.
    constants: BTreeMap<&'a str, u32>,
    /// Structures, and constants of some, by the name of the structure.
    found: BTreeMap<String, (Part, bool)>,
    members: usize,
}

impl<'a> Parser<'a> {
    /// Reads the whole file. Only modules may nest, so nothing here calls itself.
    fn items(&mut self) -> Result<(), ParseProblem> {
        loop {
            match self.tokens.next()? {
                None if self.modules.is_empty() => return Ok(()),
                None => return Err(expected("}", "the end")),
                Some("@") => drop(self.annotation()?),
                Some(";") => {}
                Some("}") => drop(self.modules.pop().ok_or_else(|| expected("an item", "}"))?),
                Some("module") => {
                    let name = self.name()?;
                    self.sign("{")?;
                    if self.modules.len() >= MODULES_MAX {
                        return Err(expected("fewer modules", name));
                    }
                    self.modules.push(name);
                }
                Some("const") => self.constant()?,
                Some("typedef") => self.type_name()?,
                Some("struct") => self.structure()?,
                Some(other) => return Err(expected("module, struct, const or typedef", other)),
            }
        }
    }

    fn constant(&mut self) -> Result<(), ParseProblem> {
        let FieldType { base, shape } = self.field_type()?;
        let name = self.name()?;
        self.sign("=")?;
        let value = self.tokens.until(&[";"])?;
        if shape != Shape::One || matches!(base, Base::Message(_)) {
            return Err(ParseProblem::Constant(short(name)));
        }
        if let Ok(number) = value.parse() {
            self.constants.insert(name, number);
        }
        // Constants outside of a structure serve as sizes.
        let of = self.modules.last().and_then(|module| module.strip_suffix(CONSTANTS));
        if let Some(of) = of {
            self.count()?;
            let of = self.part(of)?;
            if of.constants.iter().any(|constant| constant.name == name) {
                return Err(ParseProblem::Twice(short(name)));
            }
            of.constants.push(Constant { name: name.to_owned(), base, value: value.to_owned() });
        }
        Ok(())
    }

    fn type_name(&mut self) -> Result<(), ParseProblem> {
        let field_type = self.field_type()?;
        let name = self.name()?;
        let field_type = self.declared(field_type)?;
        self.sign(";")?;
        self.count()?;
        self.types.insert(name, field_type);
        Ok(())
    }

    fn structure(&mut self) -> Result<(), ParseProblem> {
        let name = self.name()?;
        self.sign("{")?;
        if self.modules != [self.file.package(), self.file.kind()] {
            let place = format!("a structure of {}::{}", self.file.package(), self.file.kind());
            return Err(expected(&place, &format!("{}::{name}", self.modules.join("::"))));
        }
        if self.found.get(name).is_some_and(|(_, defined)| *defined) {
            return Err(ParseProblem::Twice(short(name)));
        }
        let mut fields: Vec<Field> = Vec::new();
        let mut default = None;
        loop {
            if self.tokens.takes("}")? {
                break;
            }
            if self.tokens.takes("@")? {
                default = self.annotation()?.or(default);
                continue;
            }
            let plain = self.field_type()?;
            loop {
                let name = self.name()?;
                let field_type = self.declared(plain.clone())?;
                if fields.iter().any(|field| field.name == name) {
                    return Err(ParseProblem::Twice(short(name)));
                }
                self.count()?;
                // Defaults of arrays are texts.
                let default = default.map(|text: &str| match field_type.shape {
                    Shape::One => text.to_owned(),
                    _ => text.trim_matches('"').to_owned(),
                });
                fields.push(Field { name: name.to_owned(), field_type, default });
                if !self.tokens.takes(",")? {
                    break;
                }
            }
            self.sign(";")?;
            default = None;
        }
        self.part(name)?.fields = fields;
        if let Some((_, defined)) = self.found.get_mut(name) {
            *defined = true;
        }
        Ok(())
    }

    /// Reads the text behind a name: the size of an array, or nothing.
    fn declared(&mut self, plain: FieldType) -> Result<FieldType, ParseProblem> {
        if !self.tokens.takes("[")? {
            return Ok(plain);
        }
        let count = self.size()?;
        self.sign("]")?;
        match plain.shape {
            Shape::One => Ok(FieldType { base: plain.base, shape: Shape::Array(count) }),
            _ => Err(ParseProblem::Type("an array of arrays".to_owned())),
        }
    }

    fn field_type(&mut self) -> Result<FieldType, ParseProblem> {
        let one = |base| FieldType { base, shape: Shape::One };
        match self.word()? {
            "sequence" => {
                self.sign("<")?;
                let first = self.word()?;
                if first == "sequence" {
                    return Err(ParseProblem::Type("a sequence of sequences".to_owned()));
                }
                let FieldType { base, shape } = self.plain_type(first)?;
                if shape != Shape::One {
                    return Err(ParseProblem::Type("a sequence of arrays".to_owned()));
                }
                let bound = if self.tokens.takes(",")? { Some(self.size()?) } else { None };
                self.sign(">")?;
                Ok(FieldType { base, shape: Shape::Sequence { bound } })
            }
            word @ ("string" | "wstring") => {
                let bound = self.bound()?;
                Ok(one(if word == "string" { Base::String { bound } } else { Base::WString { bound } }))
            }
            word => self.plain_type(word),
        }
    }

    fn bound(&mut self) -> Result<Option<u32>, ParseProblem> {
        if !self.tokens.takes("<")? {
            return Ok(None);
        }
        let bound = self.size()?;
        self.sign(">")?;
        Ok(Some(bound))
    }

    /// Reads a type that begins with a word, and is no sequence.
    fn plain_type(&mut self, first: &'a str) -> Result<FieldType, ParseProblem> {
        let one = |base| Ok(FieldType { base, shape: Shape::One });
        let primitive = match first {
            "string" => {
                let bound = self.bound()?;
                return one(Base::String { bound });
            }
            "wstring" => {
                let bound = self.bound()?;
                return one(Base::WString { bound });
            }
            "boolean" => Primitive::Bool,
            "octet" => Primitive::Byte,
            "float" => Primitive::Float32,
            "double" => Primitive::Float64,
            "short" => Primitive::Int16,
            "long" => {
                if self.tokens.takes("double")? {
                    return Err(ParseProblem::Type("long double".to_owned()));
                }
                if self.tokens.takes("long")? { Primitive::Int64 } else { Primitive::Int32 }
            }
            "unsigned" => match self.word()? {
                "short" => Primitive::Uint16,
                "long" if self.tokens.takes("long")? => Primitive::Uint64,
                "long" => Primitive::Uint32,
                other => return Err(ParseProblem::Type(format!("unsigned {}", short(other)))),
            },
            "int8" | "int16" | "int32" | "int64" | "uint8" | "uint16" | "uint32" | "uint64" => {
                Primitive::parse(first).ok_or_else(|| ParseProblem::Type(short(first)))?
            }
            "char" | "wchar" | "any" | "fixed" | "map" | "enum" | "union" => {
                return Err(ParseProblem::Type(short(first)));
            }
            name => return self.named_type(name),
        };
        one(Base::Primitive(primitive))
    }

    /// Reads a type by its name: of this file, or `package::msg::Name`.
    fn named_type(&mut self, first: &'a str) -> Result<FieldType, ParseProblem> {
        let mut parts = vec![first];
        while self.tokens.takes("::")? {
            if parts.len() > MODULES_MAX {
                return Err(ParseProblem::Type(short(&parts.join("::"))));
            }
            parts.push(self.name()?);
        }
        let name = match parts[..] {
            [name] => match self.types.get(name) {
                Some(known) => return Ok(known.clone()),
                None => TypeName::new(self.file.package(), self.file.kind(), name),
            },
            [package, kind, name] => TypeName::new(package, kind, name),
            _ => None,
        };
        let base = Base::Message(name.ok_or_else(|| ParseProblem::Type(short(&parts.join("::"))))?);
        Ok(FieldType { base, shape: Shape::One })
    }

    /// Skips an annotation whose sign was read, and returns the value of `@default(value=…)`.
    fn annotation(&mut self) -> Result<Option<&'a str>, ParseProblem> {
        let mut name = self.name()?;
        while self.tokens.takes("::")? {
            name = self.name()?;
        }
        if !self.tokens.takes("(")? {
            return Ok(None);
        }
        let inner = self.tokens.until(&[")"])?;
        let value = inner.strip_prefix("value").map(str::trim_start).and_then(|rest| rest.strip_prefix('='));
        Ok(value.filter(|_| name == "default").map(str::trim))
    }

    fn part(&mut self, name: &str) -> Result<&mut Part, ParseProblem> {
        let known = self.file.name();
        // Constants for no structure of this file are ignored.
        if !name.starts_with(known) {
            return Err(expected(known, name));
        }
        Ok(&mut self.found.entry(name.to_owned()).or_default().0)
    }

    fn count(&mut self) -> Result<(), ParseProblem> {
        self.members += 1;
        if self.members > MEMBERS_MAX { Err(ParseProblem::TooManyMembers) } else { Ok(()) }
    }

    fn size(&mut self) -> Result<u32, ParseProblem> {
        let word = self.word()?;
        let size = word.parse().ok().or_else(|| self.constants.get(word).copied());
        size.filter(|size| *size > 0).ok_or_else(|| expected("a size", word))
    }

    fn word(&mut self) -> Result<&'a str, ParseProblem> {
        self.tokens.next()?.ok_or_else(|| expected("a name", "the end"))
    }

    fn name(&mut self) -> Result<&'a str, ParseProblem> {
        let word = self.word()?;
        if is_identifier(word) { Ok(word) } else { Err(ParseProblem::Name(short(word))) }
    }

    fn sign(&mut self, sign: &str) -> Result<(), ParseProblem> {
        match self.tokens.next()? {
            Some(found) if found == sign => Ok(()),
            Some(found) => Err(expected(sign, found)),
            None => Err(expected(sign, "the end")),
        }
    }

    fn finish(&mut self) -> Result<Vec<Definition>, ParseProblem> {
        let mut all = Vec::new();
        for suffix in suffixes(self.file.kind()) {
            let name = format!("{}{suffix}", self.file.name());
            let Some((part, true)) = self.found.remove(&name) else {
                return Err(expected(&format!("struct {name}"), "none"));
            };
            let named = TypeName::new(self.file.package(), self.file.kind(), &name);
            all.push(part.finish(named.ok_or(ParseProblem::Type(name))?));
        }
        if let Some(other) = self.found.keys().next() {
            return Err(expected(self.file.name(), other));
        }
        all.extend(action_definitions(self.file).ok_or_else(|| ParseProblem::Type(self.file.to_string()))?);
        Ok(all)
    }
}

fn expected(expected: &str, found: &str) -> ParseProblem {
    ParseProblem::Expected { expected: expected.to_owned(), found: short(found) }
}

/// Words, signs and texts in sequence; comments and preprocessor lines are left out.
struct Tokens<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Tokens<'a> {
    fn next(&mut self) -> Result<Option<&'a str>, ParseProblem> {
        self.skip()?;
        let rest = self.rest();
        let Some(first) = rest.chars().next() else { return Ok(None) };
        let length = match first {
            '"' | '\'' => quoted(rest, first).ok_or_else(|| expected(&first.to_string(), "the end"))?,
            ':' if rest.starts_with("::") => 2,
            c if is_word(c) => rest.find(|c| !is_word(c)).unwrap_or(rest.len()),
            c => c.len_utf8(),
        };
        self.at += length;
        Ok(rest.get(..length))
    }

    /// Takes the next token if it is this one.
    fn takes(&mut self, token: &str) -> Result<bool, ParseProblem> {
        let before = self.at;
        if self.next()? == Some(token) {
            return Ok(true);
        }
        self.at = before;
        Ok(false)
    }

    /// Reads everything up to a sign, which is read, too; text in parentheses belongs together.
    fn until(&mut self, signs: &[&str]) -> Result<&'a str, ParseProblem> {
        self.skip()?;
        let begin = self.at;
        let mut open = 0_usize;
        loop {
            let end = self.at;
            match self.next()? {
                None => return Err(expected(&signs.concat(), "the end")),
                Some(sign) if open == 0 && signs.contains(&sign) => {
                    return Ok(self.text.get(begin..end).unwrap_or_default().trim());
                }
                Some("(") => open += 1,
                Some(")") => open = open.saturating_sub(1),
                Some(_) => {}
            }
        }
    }

    fn skip(&mut self) -> Result<(), ParseProblem> {
        loop {
            let rest = self.rest();
            let shown = rest.trim_start();
            self.at += rest.len() - shown.len();
            let end = if shown.starts_with("//") || shown.starts_with('#') {
                shown.find('\n').unwrap_or(shown.len())
            } else if let Some(comment) = shown.strip_prefix("/*") {
                comment.find("*/").ok_or_else(|| expected("*/", "the end"))? + 4
            } else {
                return Ok(());
            };
            self.at += end;
        }
    }

    fn rest(&self) -> &'a str {
        self.text.get(self.at..).unwrap_or_default()
    }
}

fn is_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_' || c == '.'
}

/// Returns the length of a text in quotes, with them.
fn quoted(text: &str, quote: char) -> Option<usize> {
    let mut escaped = false;
    let end = text.char_indices().skip(1).find(|(_, c)| {
        let ends = *c == quote && !escaped;
        escaped = *c == '\\' && !escaped;
        ends
    });
    end.map(|(at, _)| at + 1)
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::*;
    use crate::library::Library;
    use crate::parse::parse;

    fn name_of(base: &Base) -> String {
        let bounded = |name: &str, bound: &Option<u32>| match bound {
            Some(bound) => format!("{name}<{bound}>"),
            None => name.to_owned(),
        };
        match base {
            Base::Primitive(Primitive::Bool) => "boolean".to_owned(),
            Base::Primitive(Primitive::Byte) => "octet".to_owned(),
            Base::Primitive(Primitive::Float32) => "float".to_owned(),
            Base::Primitive(Primitive::Float64) => "double".to_owned(),
            Base::Primitive(Primitive::Int64) => "long long".to_owned(),
            Base::Primitive(Primitive::Uint16) => "unsigned short".to_owned(),
            Base::Primitive(primitive) => primitive.name().to_owned(),
            Base::String { bound } => bounded("string", bound),
            Base::WString { bound } => bounded("wstring", bound),
            Base::Message(name) => format!("{}::{}::{}", name.package(), name.kind(), name.name()),
        }
    }

    /// Writes IDL as `rosidl_adapter` does.
    fn idl(file: &TypeName, definitions: &[Definition]) -> String {
        let mut text = format!(
            "// generated\n#include \"x.idl\"\nmodule {} {{\n  module {} {{\n",
            file.package(),
            file.kind()
        );
        for definition in definitions {
            let comment = "    @verbatim (language=\"comment\", text=\n      \"it; is } so\" \"\\n\")\n";
            let mut structure = comment.to_owned();
            let _ = writeln!(structure, "    struct {} {{", definition.name.name());
            for field in &definition.fields {
                let base = name_of(&field.field_type.base);
                let field_type = match field.field_type.shape {
                    Shape::One => base,
                    Shape::Sequence { bound: None } => format!("sequence<{base}>"),
                    Shape::Sequence { bound: Some(bound) } => format!("sequence<{base}, {bound}>"),
                    Shape::Array(count) => {
                        let plain = base.replace("::", "__").replace([' ', '<', '>'], "_");
                        let _ = writeln!(text, "    typedef {base} {plain}_;");
                        let _ = writeln!(text, "    typedef {plain}_ {plain}__{count}[{count}];");
                        format!("{plain}__{count}")
                    }
                };
                if let Some(default) = &field.default {
                    let _ = writeln!(structure, "      @default (value={default})");
                }
                let _ = writeln!(
                    structure,
                    "      @unit (value=\"m (s)\")\n      {field_type} {};\n",
                    field.name
                );
            }
            if !definition.constants.is_empty() {
                let _ = writeln!(text, "    module {}_Constants {{", definition.name.name());
                for constant in &definition.constants {
                    let (base, value) = (name_of(&constant.base), &constant.value);
                    let _ = writeln!(text, "      const {base} {} = {value};", constant.name);
                }
                text.push_str("    };\n");
            }
            text.push_str(&structure);
            text.push_str("    };\n");
        }
        text + "  };\n};\n"
    }

    #[test]
    fn shipped_types_are_the_same_as_idl() {
        let (mut ours, mut theirs) = (Library::empty(), Library::empty());
        for file in Library::shipped_files() {
            let definitions = parse(&file, &Library::shipped(&file).unwrap()).unwrap();
            let written = &definitions[..suffixes(file.kind()).len()];
            let text = idl(&file, written);
            assert_eq!(parse_idl(&file, &text).unwrap(), definitions, "{text}");
            assert!(is_idl(&text) && !is_idl(&Library::shipped(&file).unwrap()));
            theirs.add_idl(&file, &text).unwrap();
        }
        for file in Library::shipped_files().filter(|file| file.kind() == "msg") {
            let none = &mut |_: &TypeName| None;
            let hash = ours.layout(&file, none).unwrap().type_hash();
            assert_eq!(theirs.layout(&file, none).unwrap().type_hash(), hash, "{file}");
        }
    }

    fn one(inner: &str) -> Result<Definition, ParseProblem> {
        let file = "p/msg/M".parse().unwrap();
        let text = format!("module p {{ module msg {{ {inner} }}; }};");
        parse_idl(&file, &text).map(|mut all| all.remove(0)).map_err(|error| error.problem)
    }

    #[test]
    fn handwritten_idl_is_understood() {
        let text = "const unsigned long SIZE = 3; typedef sequence<string<SIZE>, 2> Names;\n\
                    module M_Constants { const string NAME = \"a; b\"; const long LOW = -1; };\n\
                    /* why */ @extensibility(FINAL) struct M { @key long a, b[SIZE]; Names names; // so\n\
                    @default(value=\"(1, 2)\") sequence<octet> o; @default (value=TRUE) boolean t; M_Constants::x y; };";
        assert_eq!(one(text).unwrap_err(), ParseProblem::Type("M_Constants::x".into()));
        let m = one(&text.replace("M_Constants::x y;", "p::msg::N n; N k;")).unwrap();
        let constants: Vec<_> = m.constants.iter().map(|c| (c.name.as_str(), c.value.as_str())).collect();
        assert_eq!(constants, [("NAME", "\"a; b\""), ("LOW", "-1")]);
        let shapes: Vec<_> = m.fields.iter().map(|f| f.field_type.shape).collect();
        let (one, bounded) = (Shape::One, Shape::Sequence { bound: Some(2) });
        let free = Shape::Sequence { bound: None };
        assert_eq!(shapes, [one, Shape::Array(3), bounded, free, one, one, one]);
        assert_eq!(m.fields[2].field_type.base, Base::String { bound: Some(3) });
        assert_eq!(
            (m.fields[3].default.as_deref(), m.fields[4].default.as_deref()),
            (Some("(1, 2)"), Some("TRUE"))
        );
        assert_eq!(m.fields[5].field_type, m.fields[6].field_type);
    }

    #[test]
    fn mistakes_are_named() {
        let expected = |expected: &str, found: &str| super::expected(expected, found);
        for (text, problem) in [
            ("struct M { long a; long a; };", ParseProblem::Twice("a".into())),
            ("struct M { }; struct M { };", ParseProblem::Twice("M".into())),
            ("struct M { char a; };", ParseProblem::Type("char".into())),
            ("struct M { long double a; };", ParseProblem::Type("long double".into())),
            (
                "struct M { sequence<sequence<long>> a; };",
                ParseProblem::Type("a sequence of sequences".into()),
            ),
            ("struct M { string<0> a; };", expected("a size", "0")),
            ("struct M { long 9; };", ParseProblem::Name("9".into())),
            ("struct M { long a }; ", expected(";", "}")),
            ("struct M : N { };", expected("{", ":")),
            ("union M { };", expected("module, struct, const or typedef", "union")),
            ("struct N { };", expected("M", "N")),
            ("", expected("struct M", "none")),
            ("/*", expected("*/", "the end")),
            ("@a(b", expected(")", "the end")),
        ] {
            assert_eq!(one(text), Err(problem), "{text}");
        }
        let file: TypeName = "p/msg/M".parse().unwrap();
        let error = parse_idl(&file, "module q {\nmodule msg {\nstruct M { };").unwrap_err();
        assert_eq!(
            error.to_string(),
            "p/msg/M, line 3: \"q::msg::M\" stands where a structure of p::msg should"
        );
        let problem = |text: &str| parse_idl(&file, text).unwrap_err().problem;
        assert_eq!(problem(&"module a {".repeat(1000)), expected("fewer modules", "a"));
        assert_eq!(problem(&" ".repeat(DEFINITION_BYTES_MAX + 1)), ParseProblem::TooLong);
        let many: String = (0..=MEMBERS_MAX).map(|n| format!("long m{n};")).collect();
        assert_eq!(one(&format!("struct M {{ {many} }};")), Err(ParseProblem::TooManyMembers));
    }
}
