//! Parses the text of `.msg`, `.srv` and `.action` files.

use crate::definition::{
    Base, Constant, DUMMY_MEMBER, Definition, Field, FieldType, Primitive, Shape, TypeName, is_identifier,
};
use crate::fault::short;

/// Longest text that is parsed, bytes.
pub const DEFINITION_BYTES_MAX: usize = 256 * 1024;
/// Most members and constants of one message.
pub(crate) const MEMBERS_MAX: usize = 4096;
/// Separator of request and response, and of goal, result and feedback.
const SEPARATOR: &str = "---";

/// A mistake in a definition.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name}, line {line}: {problem}")]
pub struct ParseError {
    /// The type.
    pub name: TypeName,
    /// The line, from 1.
    pub line: usize,
    /// The problem.
    pub problem: ParseProblem,
}

/// A problem in a line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ParseProblem {
    /// The text is too long.
    #[error("the definition has more than {DEFINITION_BYTES_MAX} bytes")]
    TooLong,
    /// Too many members.
    #[error("the definition has more than {MEMBERS_MAX} members")]
    TooManyMembers,
    /// An invalid type.
    #[error("{0:?} is not a type")]
    Type(String),
    /// An invalid name.
    #[error("{0:?} is not a name of a member")]
    Name(String),
    /// A name twice.
    #[error("{0:?} is there twice")]
    Twice(String),
    /// An invalid constant.
    #[error("{0:?} cannot be a constant: its type is neither a primitive nor a string")]
    Constant(String),
    /// Unexpected text, in IDL.
    #[error("{found:?} stands where {expected} should")]
    Expected {
        /// The expected text.
        expected: String,
        /// The text found.
        found: String,
    },
    /// A wrong number of parts for the kind.
    #[error("the definition has {found} parts separated by ---, not {expected}")]
    Parts {
        /// Number found.
        found: usize,
        /// Number expected.
        expected: usize,
    },
}

/// Parses the file that defines `file`: a message, both messages of a service, or all of an action, with the messages
/// that ROS 2 derives from it.
pub fn parse(file: &TypeName, text: &str) -> Result<Vec<Definition>, ParseError> {
    let fail = |line, problem| ParseError { name: file.clone(), line, problem };
    if text.len() > DEFINITION_BYTES_MAX {
        return Err(fail(1, ParseProblem::TooLong));
    }
    let suffixes = suffixes(file.kind());
    let mut parts = vec![Part::default()];
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if line == SEPARATOR && file.kind() != "msg" {
            if parts.len() == suffixes.len() {
                let found = parts.len() + 1;
                return Err(fail(index + 1, ParseProblem::Parts { found, expected: suffixes.len() }));
            }
            parts.push(Part::default());
        } else if let Some(part) = parts.last_mut() {
            part.take(file.package(), line).map_err(|problem| fail(index + 1, problem))?;
        }
    }
    if parts.len() != suffixes.len() {
        let problem = ParseProblem::Parts { found: parts.len(), expected: suffixes.len() };
        return Err(fail(text.lines().count().max(1), problem));
    }
    let named =
        |suffix: &str| TypeName::new(file.package(), file.kind(), &format!("{}{suffix}", file.name()));
    let no_name = || fail(1, ParseProblem::Type(file.to_string()));
    let mut all = Vec::new();
    for (part, suffix) in parts.into_iter().zip(suffixes) {
        all.push(part.finish(named(suffix).ok_or_else(no_name)?));
    }
    all.extend(action_definitions(file).ok_or_else(no_name)?);
    Ok(all)
}

/// Returns the name suffixes of the definitions in a file of this kind.
pub(crate) fn suffixes(kind: &str) -> &'static [&'static str] {
    match kind {
        "srv" => &["_Request", "_Response"],
        "action" => &["_Goal", "_Result", "_Feedback"],
        _ => &[""],
    }
}

/// Returns the messages that ROS 2 derives from an action; none for other kinds. `None` if its name is too long.
pub(crate) fn action_definitions(file: &TypeName) -> Option<Vec<Definition>> {
    let named =
        |suffix: &str| TypeName::new(file.package(), file.kind(), &format!("{}{suffix}", file.name()));
    let mut all = Vec::new();
    let made = if file.kind() == "action" { action_messages() } else { Vec::new() };
    for (suffix, fields) in made {
        let mut definition = Definition { name: named(suffix)?, fields: Vec::new(), constants: Vec::new() };
        for (name, field) in fields {
            let base = match field {
                FieldSource::Known(base) => base,
                FieldSource::Part(suffix) => Base::Message(named(suffix)?),
            };
            let field_type = FieldType { base, shape: Shape::One };
            definition.fields.push(Field { name: name.to_owned(), field_type, default: None });
        }
        all.push(definition);
    }
    Some(all)
}

enum FieldSource {
    Known(Base),
    Part(&'static str),
}

/// Returns the messages of an action's services and topics (the ROS 2 design article "Actions").
fn action_messages() -> Vec<(&'static str, Vec<(&'static str, FieldSource)>)> {
    let known = |package, name| {
        TypeName::new(package, "msg", name).map(|name| FieldSource::Known(Base::Message(name)))
    };
    let (Some(id), Some(result_id), Some(feedback_id), Some(stamp)) = (
        known("unique_identifier_msgs", "UUID"),
        known("unique_identifier_msgs", "UUID"),
        known("unique_identifier_msgs", "UUID"),
        known("builtin_interfaces", "Time"),
    ) else {
        return Vec::new();
    };
    let primitive = |primitive| FieldSource::Known(Base::Primitive(primitive));
    vec![
        ("_SendGoal_Request", vec![("goal_id", id), ("goal", FieldSource::Part("_Goal"))]),
        ("_SendGoal_Response", vec![("accepted", primitive(Primitive::Bool)), ("stamp", stamp)]),
        ("_GetResult_Request", vec![("goal_id", result_id)]),
        (
            "_GetResult_Response",
            vec![("status", primitive(Primitive::Int8)), ("result", FieldSource::Part("_Result"))],
        ),
        ("_FeedbackMessage", vec![("goal_id", feedback_id), ("feedback", FieldSource::Part("_Feedback"))]),
    ]
}

/// A message while it is read.
#[derive(Default)]
pub(crate) struct Part {
    pub(crate) fields: Vec<Field>,
    pub(crate) constants: Vec<Constant>,
}

impl Part {
    fn take(&mut self, package: &str, line: &str) -> Result<(), ParseProblem> {
        let (type_text, rest) = match line.split_once(char::is_whitespace) {
            _ if line.is_empty() || line.starts_with('#') => return Ok(()),
            Some((type_text, rest)) => (type_text, rest.trim_start()),
            None => return Err(ParseProblem::Name(String::new())),
        };
        if self.fields.len() + self.constants.len() >= MEMBERS_MAX {
            return Err(ParseProblem::TooManyMembers);
        }
        let field_type =
            field_type(package, type_text).ok_or_else(|| ParseProblem::Type(short(type_text)))?;
        let end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(rest.len());
        let (name, rest) = rest.split_at(end);
        let rest = rest.trim_start();
        if !is_identifier(name) {
            return Err(ParseProblem::Name(short(name)));
        }
        let known = self.fields.iter().map(|f| &f.name).chain(self.constants.iter().map(|c| &c.name));
        if known.into_iter().any(|known| known == name) {
            return Err(ParseProblem::Twice(short(name)));
        }
        let name = name.to_owned();
        if let Some(value) = rest.strip_prefix('=') {
            let base = match field_type {
                FieldType { base: Base::Message(_), .. } => return Err(ParseProblem::Constant(name)),
                FieldType { base, shape: Shape::One } => base,
                FieldType { .. } => return Err(ParseProblem::Constant(name)),
            };
            let value = literal(&base, value);
            self.constants.push(Constant { name, base, value });
        } else {
            let default = literal(&field_type.base, rest);
            let default = (!default.is_empty()).then_some(default);
            self.fields.push(Field { name, field_type, default });
        }
        Ok(())
    }

    pub(crate) fn finish(mut self, name: TypeName) -> Definition {
        if self.fields.is_empty() {
            let field_type = FieldType { base: Base::Primitive(Primitive::Uint8), shape: Shape::One };
            self.fields.push(Field { name: DUMMY_MEMBER.to_owned(), field_type, default: None });
        }
        Definition { name, fields: self.fields, constants: self.constants }
    }
}

/// Returns the value in the rest of a line. A `#` outside of quotes begins a comment.
fn literal(base: &Base, rest: &str) -> String {
    let rest = rest.trim();
    let quote = rest.chars().next().filter(|c| matches!(c, '"' | '\''));
    if let (Base::String { .. } | Base::WString { .. }, Some(quote)) = (base, quote) {
        let mut escaped = false;
        let end = rest.char_indices().skip(1).find(|(_, c)| {
            let ends = *c == quote && !escaped;
            escaped = *c == '\\' && !escaped;
            ends
        });
        if let Some((end, _)) = end {
            return rest.get(..=end).unwrap_or(rest).to_owned();
        }
    }
    rest.split('#').next().unwrap_or_default().trim_end().to_owned()
}

fn field_type(package: &str, text: &str) -> Option<FieldType> {
    let (base, shape) = match text.strip_suffix(']') {
        None => (text, Shape::One),
        Some(text) => {
            let (base, count) = text.rsplit_once('[')?;
            let shape = match count.strip_prefix("<=") {
                Some(bound) => Shape::Sequence { bound: Some(positive(bound)?) },
                None if count.is_empty() => Shape::Sequence { bound: None },
                None => Shape::Array(positive(count)?),
            };
            (base, shape)
        }
    };
    let (plain, bound) = match base.split_once("<=") {
        Some((plain, bound)) => (plain, Some(positive(bound)?)),
        None => (base, None),
    };
    let base = match (plain, Primitive::parse(plain)) {
        ("string", _) => Base::String { bound },
        ("wstring", _) => Base::WString { bound },
        _ if bound.is_some() => return None,
        (_, Some(primitive)) => Base::Primitive(primitive),
        _ => Base::Message(match plain.split('/').collect::<Vec<_>>()[..] {
            [name] => TypeName::new(package, "msg", name)?,
            [package, name] => TypeName::new(package, "msg", name)?,
            [package, kind, name] => TypeName::new(package, kind, name)?,
            _ => return None,
        }),
    };
    Some(FieldType { base, shape })
}

fn positive(text: &str) -> Option<u32> {
    let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    text.parse().ok().filter(|n| digits && *n > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(text: &str) -> Result<Definition, ParseProblem> {
        let name = "pkg/msg/M".parse().unwrap();
        parse(&name, text).map(|mut all| all.remove(0)).map_err(|e| e.problem)
    }

    #[test]
    fn every_kind_of_line_is_understood() {
        let text = "# comment\nint32 X=-3 # why\nstring NAME=\"a # b\"\nuint8[<=3] few\nstring<=5[2] names ['a','b']\n\
                    other_msgs/Thing[] things\nLocal here\nfloat64 rate 1.5 # Hz\nwstring wide\nchar c\n";
        let m = one(text).unwrap();
        assert_eq!((m.constants[0].value.as_str(), m.constants[1].value.as_str()), ("-3", "\"a # b\""));
        let shapes: Vec<_> = m.fields.iter().map(|f| f.field_type.shape).collect();
        assert_eq!(shapes[0], Shape::Sequence { bound: Some(3) });
        assert_eq!(shapes[1], Shape::Array(2));
        assert_eq!(m.fields[1].field_type.base, Base::String { bound: Some(5) });
        assert_eq!(m.fields[1].default.as_deref(), Some("['a','b']"));
        assert_eq!(m.fields[2].field_type.base, Base::Message("other_msgs/msg/Thing".parse().unwrap()));
        assert_eq!(m.fields[3].field_type.base, Base::Message("pkg/msg/Local".parse().unwrap()));
        assert_eq!(m.fields[4].default.as_deref(), Some("1.5"));
        assert_eq!(m.fields[6].field_type.base, Base::Primitive(Primitive::Uint8));
    }

    #[test]
    fn mistakes_are_named() {
        for (text, problem) in [
            ("int32", ParseProblem::Name(String::new())),
            ("int32 9x", ParseProblem::Name("9x".into())),
            ("int32[0] x", ParseProblem::Type("int32[0]".into())),
            ("int32<=4 x", ParseProblem::Type("int32<=4".into())),
            ("a/b/c/d x", ParseProblem::Type("a/b/c/d".into())),
            ("int32 x\nint8 x", ParseProblem::Twice("x".into())),
            ("Thing X=1", ParseProblem::Constant("X".into())),
            ("int8[] X=1", ParseProblem::Constant("X".into())),
        ] {
            assert_eq!(one(text), Err(problem), "{text}");
        }
        let many: String = (0..=MEMBERS_MAX).map(|n| format!("int8 m{n}\n")).collect();
        assert_eq!(one(&many), Err(ParseProblem::TooManyMembers));
        assert_eq!(one(&"#".repeat(DEFINITION_BYTES_MAX + 1)), Err(ParseProblem::TooLong));
    }

    #[test]
    fn services_and_actions_have_their_parts() {
        let names = |file: &str, text| {
            let all = parse(&file.parse().unwrap(), text);
            all.map(|all| all.into_iter().map(|d| d.name.name().to_owned()).collect::<Vec<_>>())
        };
        assert_eq!(names("p/srv/S", "int8 a\n---\n").unwrap(), ["S_Request", "S_Response"]);
        let action = names("p/action/A", "int8 a\n---\nint8 b\n---\n").unwrap();
        assert_eq!(action.len(), 8);
        assert!(action.iter().all(|name| TypeName::new("p", "action", name).unwrap().file_stem() == "A"));
        let parts = |found, expected| ParseProblem::Parts { found, expected };
        assert_eq!(names("p/srv/S", "int8 a").unwrap_err().problem, parts(1, 2));
        assert_eq!(names("p/srv/S", "---\n---\n").unwrap_err().problem, parts(3, 2));
        assert_eq!(names("p/action/A", "---\n").unwrap_err().problem, parts(2, 3));
    }
}
