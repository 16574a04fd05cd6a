//! A type with everything that it contains as text: definitions of `.msg` files in sequence, as in MCAP and Foxglove
//! (`ros2msg`).
//!
//! It is for programs that read messages: comments and defaults are left out. Constants are included where a definition
//! has them; transmitted descriptions have none.

use std::fmt::Write as _;

use crate::definition::{Base, Constant, DUMMY_MEMBER, FieldType, Primitive, Shape, TypeName};
use crate::layout::{Layout, Struct};

/// Line between two definitions.
const RULE: &str = "================================================================================";
/// Text of a message without members: readers take an empty text for a missing definition.
const NO_MEMBERS: &str = "# no members\n";

impl Layout {
    /// Returns the definition of the type, then those of all parts, each behind a line of `=` and a line `MSG:
    /// package/Name`.
    pub fn to_ros2msg(&self) -> String {
        let mut text = String::new();
        let Some(this) = self.structs.last() else { return text };
        write_struct(&mut text, this);
        for inner in self.referenced().into_values() {
            let _ = writeln!(text, "{RULE}\nMSG: {}", short_name(&inner.name));
            write_struct(&mut text, inner);
        }
        text
    }
}

fn write_struct(text: &mut String, this: &Struct) {
    // Foxglove takes a definition with only constants for no message.
    if this.members.iter().all(|member| &*member.name == DUMMY_MEMBER) {
        return text.push_str(NO_MEMBERS);
    }
    for constant in &this.constants {
        write_constant(text, constant);
    }
    for member in &this.members {
        let _ = writeln!(text, "{} {}", type_text(&member.field_type), member.name);
    }
}

/// Leaves out constants that programs might not read: unusual number spellings, and texts with more than letters.
fn write_constant(text: &mut String, constant: &Constant) {
    let Constant { name, base, value } = constant;
    let value = value.trim();
    let value = match base {
        Base::Primitive(Primitive::Bool) => match value {
            "true" | "True" | "TRUE" | "1" => "true".to_owned(),
            "false" | "False" | "FALSE" | "0" => "false".to_owned(),
            _ => return,
        },
        Base::Primitive(Primitive::Float32 | Primitive::Float64) => match value.parse::<f64>() {
            Ok(number) if number.is_finite() => number.to_string(),
            _ => return,
        },
        Base::Primitive(_) => match value.parse::<i128>() {
            Ok(number) => number.to_string(),
            Err(_) => return,
        },
        Base::String { .. } => {
            let quoted = |quote| value.strip_prefix(quote).and_then(|rest| rest.strip_suffix(quote));
            let plain = quoted('"').or_else(|| quoted('\'')).unwrap_or(value);
            if !plain
                .chars()
                .all(|c| c == ' ' || (c.is_ascii_graphic() && !matches!(c, '"' | '\'' | '\\' | '#')))
            {
                return;
            }
            format!("\"{plain}\"")
        }
        Base::WString { .. } | Base::Message(_) => return,
    };
    let _ = writeln!(text, "{} {name}={value}", base_text(base));
}

fn type_text(of: &FieldType) -> String {
    let base = base_text(&of.base);
    match of.shape {
        Shape::One => base,
        Shape::Array(count) => format!("{base}[{count}]"),
        Shape::Sequence { bound: None } => format!("{base}[]"),
        Shape::Sequence { bound: Some(bound) } => format!("{base}[<={bound}]"),
    }
}

fn base_text(base: &Base) -> String {
    let bounded = |plain: &str, bound: &Option<u32>| match bound {
        Some(bound) => format!("{plain}<={bound}"),
        None => plain.to_owned(),
    };
    match base {
        Base::Primitive(primitive) => primitive.name().to_owned(),
        Base::String { bound } => bounded("string", bound),
        Base::WString { bound } => bounded("wstring", bound),
        Base::Message(name) => short_name(name),
    }
}

/// Returns `std_msgs/Header` for `std_msgs/msg/Header`; parts of services and actions keep their full names.
fn short_name(name: &TypeName) -> String {
    match name.kind() {
        "msg" => format!("{}/{}", name.package(), name.name()),
        _ => name.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::Library;
    use crate::parse::parse;
    use crate::testing::layout;

    /// Reads such a text as the definition of `name`.
    fn read(name: &TypeName, text: &str) -> Layout {
        let rule = format!("{RULE}\nMSG: ");
        let mut parts = text.split(&rule);
        let mut texts = vec![(name.clone(), parts.next().unwrap().to_owned())];
        for part in parts {
            let (name, text) = part.split_once('\n').unwrap();
            texts.push((name.parse().unwrap(), text.to_owned()));
        }
        // Parts of services and actions are in files of several messages: here each has a name of its own.
        let plain = |name: &TypeName| {
            let package = format!("{}_{}", name.package(), name.kind());
            TypeName::new(&package, "msg", name.name()).unwrap()
        };
        let flat = |text: &str| {
            let lines = text.lines().map(|line| match line.split_once(' ') {
                Some((of, rest)) if of.contains('/') => {
                    let end = of.find('[').unwrap_or(of.len());
                    format!("{}{} {rest}\n", plain(&of[..end].parse().unwrap()), &of[end..])
                }
                _ => format!("{line}\n"),
            });
            lines.collect::<String>()
        };
        let texts: Vec<_> = texts.iter().map(|(name, text)| (plain(name), flat(text))).collect();
        let find =
            |file: &TypeName| texts.iter().find(|(name, _)| name == file).map(|(_, text)| text.clone());
        Library::empty().layout(&plain(name), &mut |file| find(file)).unwrap()
    }

    fn members(of: &Layout) -> Vec<(String, String, String)> {
        let mut all: Vec<_> = of
            .structs
            .iter()
            .flat_map(|this| {
                let own = this.name.name().to_owned();
                this.members.iter().map(move |m| {
                    let text = type_text(&m.field_type);
                    let last = text.rsplit('/').next().unwrap_or_default().to_owned();
                    (own.clone(), last, m.name.to_string())
                })
            })
            .collect();
        all.sort();
        all
    }

    #[test]
    fn each_kind_of_member_is_written() {
        let of = layout(
            "int8 LOW=-1\nstring NAME=\"a b\"\nbool YES=True\nfloat32 HALF=.5\nwstring W=\"x\"\nTwo two\nTwo[<=3] few\n\
             char[4] c\nstring<=5[] s\nwstring w \"default\"\nEmpty e\nbuiltin_interfaces/Time t",
        );
        assert_eq!(
            of.to_ros2msg(),
            format!(
                "int8 LOW=-1\nstring NAME=\"a b\"\nbool YES=true\nfloat32 HALF=0.5\np/Two two\np/Two[<=3] few\n\
                 uint8[4] c\nstring<=5[] s\nwstring w\np/Empty e\nbuiltin_interfaces/Time t\n\
                 {RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n\
                 {RULE}\nMSG: p/Empty\n# no members\n{RULE}\nMSG: p/Two\nuint8 a\nuint16 b\n"
            )
        );
    }

    #[test]
    fn all_that_ships_is_the_same_when_it_is_read_again() {
        let mut library = Library::empty();
        let mut types = 0;
        for file in Library::shipped_files() {
            for definition in parse(&file, &Library::shipped(&file).unwrap()).unwrap() {
                let of = library.layout(&definition.name, &mut |_| None).unwrap();
                let again = read(&definition.name, &of.to_ros2msg());
                assert_eq!(members(&again), members(&of), "{}", definition.name);
                let constants = again.structs.last().unwrap().constants.len();
                let is_empty = definition.fields[0].name == DUMMY_MEMBER;
                let expected = if is_empty { 0 } else { definition.constants.len() };
                assert_eq!(constants, expected, "{}", definition.name);
                types += 1;
            }
        }
        assert!(types > 200, "{types}");
    }

    #[test]
    fn described_types_are_written_as_well() {
        let of = layout("int8 LOW=-1\nTwo[2] two\nstring<=7 s");
        let described = Layout::from_description(&of.describe().unwrap().into(), &of.type_hash()).unwrap();
        assert_eq!(described.to_ros2msg(), of.to_ros2msg().replace("int8 LOW=-1\n", ""));
    }
}
