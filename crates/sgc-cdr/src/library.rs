//! The known definitions, and the lookup of others.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::definition::{Base, Definition, Field, FieldType, Shape, TypeName};
use crate::idl::{is_idl, parse_idl};
use crate::layout::{Element, LAYOUT_DEPTH_MAX, LAYOUT_STRUCTS_MAX, Layout, Member, MemberDefault, Struct};
use crate::parse::{ParseError, parse};

/// The interfaces that ship inside: `common.txt`, written by `scripts/make-interfaces.py`.
const COMMON: &str = include_str!("common.txt");
/// Beginning of a file in it.
const COMMON_HEAD: &str = "== ";

/// Finds the text of the file that defines a type, `.idl` or not: `std_srvs/srv/SetBool` for
/// `std_srvs/srv/SetBool_Request`.
pub type LookUp<'a> = dyn FnMut(&TypeName) -> Option<String> + 'a;

/// The reason why a type cannot be decoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TypeError {
    /// No definition of the type is known.
    #[error("no definition of {name}{}", within(.needed_by))]
    Unknown {
        /// The type.
        name: TypeName,
        /// The type that contains it, if it is not the requested one.
        needed_by: Option<Box<TypeName>>,
    },
    /// The definition is wrong.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// The type contains itself.
    #[error("{name} contains itself")]
    Circle {
        /// The type.
        name: TypeName,
    },
    /// The type contains types too deeply.
    #[error("{name} is nested deeper than {LAYOUT_DEPTH_MAX} types")]
    TooDeep {
        /// The type.
        name: TypeName,
    },
    /// The type contains too many types.
    #[error("{name} consists of more than {LAYOUT_STRUCTS_MAX} types")]
    TooLarge {
        /// The type.
        name: TypeName,
    },
}

fn within(needed_by: &Option<Box<TypeName>>) -> String {
    needed_by.as_ref().map(|name| format!(", which {name} contains")).unwrap_or_default()
}

/// Definitions by name.
#[derive(Clone, Debug, Default)]
pub struct Library {
    definitions: BTreeMap<TypeName, Definition>,
}

impl Library {
    /// Returns a library without definitions.
    pub fn empty() -> Self {
        Self::default()
    }

    /// Returns the text of the shipped file that defines this type.
    pub fn shipped(file: &TypeName) -> Option<String> {
        let head = format!("{COMMON_HEAD}{file}\n");
        let begin = match COMMON.find(&format!("\n{head}")) {
            Some(before) => before + 1 + head.len(),
            None if COMMON.starts_with(&head) => head.len(),
            None => return None,
        };
        let text = COMMON.get(begin..)?;
        let end = text.find(&format!("\n{COMMON_HEAD}")).map_or(text.len(), |end| end + 1);
        text.get(..end).filter(|text| !text.starts_with(COMMON_HEAD)).or(Some("")).map(str::to_owned)
    }

    /// Iterates over the shipped files: `std_msgs/msg/String`, `std_srvs/srv/SetBool`.
    pub fn shipped_files() -> impl Iterator<Item = TypeName> {
        COMMON.lines().filter_map(|line| line.strip_prefix(COMMON_HEAD)?.parse().ok())
    }

    /// Adds the definitions of a file, in place of known ones with their names.
    pub fn add(&mut self, file: &TypeName, text: &str) -> Result<(), ParseError> {
        for definition in parse(file, text)? {
            self.define(definition);
        }
        Ok(())
    }

    /// Adds the definitions of an `.idl` file, in place of known ones with their names.
    pub fn add_idl(&mut self, file: &TypeName, text: &str) -> Result<(), ParseError> {
        parse_idl(file, text)?.into_iter().for_each(|definition| self.define(definition));
        Ok(())
    }

    /// Adds a definition, in place of a known one with its name.
    pub(crate) fn define(&mut self, definition: Definition) {
        self.definitions.insert(definition.name.clone(), definition);
    }

    /// Returns the definition of a type, if it is known.
    pub fn definition(&self, name: &TypeName) -> Option<&Definition> {
        self.definitions.get(name)
    }

    /// Returns the layout of a type's CDR. Asks `look_up` for unknown definitions, and takes shipped ones where it has
    /// none.
    ///
    /// A service is a type, too, as in type hashes and descriptions: it contains its messages, and is never serialised.
    /// [`Layout::part`] returns their layouts.
    pub fn layout(&mut self, name: &TypeName, look_up: &mut LookUp<'_>) -> Result<Layout, TypeError> {
        let mut resolver = Resolver { library: self, look_up, structs: Vec::new(), places: BTreeMap::new() };
        resolver.resolve(name, None, &mut BTreeSet::new())?;
        Ok(Layout { structs: resolver.structs })
    }

    fn known(
        &mut self,
        name: &TypeName,
        needed_by: Option<&TypeName>,
        look_up: &mut LookUp<'_>,
    ) -> Result<&Definition, TypeError> {
        let unknown =
            || TypeError::Unknown { name: name.clone(), needed_by: needed_by.cloned().map(Box::new) };
        if !self.definitions.contains_key(name) {
            let file = TypeName::new(name.package(), name.kind(), name.file_stem()).ok_or_else(unknown)?;
            let text = look_up(&file).or_else(|| Self::shipped(&file)).ok_or_else(unknown)?;
            if is_idl(&text) {
                self.add_idl(&file, &text)?;
            } else {
                self.add(&file, &text)?;
            }
            self.define_service(&name.service().unwrap_or_else(|| name.clone()));
        }
        self.definitions.get(name).ok_or_else(unknown)
    }

    /// Adds the definitions that ROS 2 derives from a service's two messages (REP 2012, and
    /// `rosidl_generator_type_description`), if they are known: the event message, and the service as a type.
    fn define_service(&mut self, service: &TypeName) {
        let (request, response) = (service.request(), service.response());
        let is_known = |name| self.definitions.contains_key(name);
        if service.kind() == "msg" || !is_known(&request) || !is_known(&response) {
            return;
        }
        let Some(info) = TypeName::new("service_msgs", "msg", "ServiceEventInfo") else { return };
        let field = |name: &str, of: &TypeName, shape| Field {
            name: name.to_owned(),
            field_type: FieldType { base: Base::Message(of.clone()), shape },
            default: None,
        };
        let (event, at_most_one) = (service.event(), Shape::Sequence { bound: Some(1) });
        let fields = vec![
            field("info", &info, Shape::One),
            field("request", &request, at_most_one),
            field("response", &response, at_most_one),
        ];
        self.define(Definition { name: event.clone(), fields, constants: Vec::new() });
        let fields = vec![
            field("request_message", &request, Shape::One),
            field("response_message", &response, Shape::One),
            field("event_message", &event, Shape::One),
        ];
        self.define(Definition { name: service.clone(), fields, constants: Vec::new() });
    }
}

struct Resolver<'a, 'b> {
    library: &'a mut Library,
    look_up: &'a mut LookUp<'b>,
    structs: Vec<Struct>,
    places: BTreeMap<TypeName, usize>,
}

impl Resolver<'_, '_> {
    /// Puts a type behind its parts, and returns its index. `above` are the types that contain it.
    fn resolve(
        &mut self,
        name: &TypeName,
        needed_by: Option<&TypeName>,
        above: &mut BTreeSet<TypeName>,
    ) -> Result<usize, TypeError> {
        if let Some(place) = self.places.get(name) {
            return Ok(*place);
        }
        if above.len() >= LAYOUT_DEPTH_MAX {
            return Err(TypeError::TooDeep { name: name.clone() });
        }
        if !above.insert(name.clone()) {
            return Err(TypeError::Circle { name: name.clone() });
        }
        let definition = self.library.known(name, needed_by, self.look_up)?.clone();
        let mut members = Vec::with_capacity(definition.fields.len());
        for field in definition.fields {
            let element = match &field.field_type.base {
                Base::Primitive(primitive) => Element::Primitive(*primitive),
                Base::String { bound } => Element::String { bound: *bound },
                Base::WString { bound } => Element::WString { bound: *bound },
                Base::Message(inner) => Element::Struct(self.resolve(inner, Some(name), above)?),
            };
            let shape = field.field_type.shape;
            let default = field.default.map(|text| MemberDefault::new(&field.field_type, text));
            members.push(Member {
                name: Arc::from(field.name),
                element,
                shape,
                field_type: field.field_type,
                default,
            });
        }
        above.remove(name);
        if self.structs.len() >= LAYOUT_STRUCTS_MAX {
            return Err(TypeError::TooLarge { name: name.clone() });
        }
        self.structs.push(Struct { name: name.clone(), members, constants: definition.constants });
        self.places.insert(name.clone(), self.structs.len() - 1);
        Ok(self.structs.len() - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_ships_can_be_laid_out() {
        let mut files = 0;
        let mut library = Library::empty();
        for file in Library::shipped_files() {
            files += 1;
            for definition in parse(&file, &Library::shipped(&file).unwrap()).unwrap() {
                let layout = library.layout(&definition.name, &mut |_| None).unwrap();
                assert_eq!(layout.name(), Some(&definition.name));
            }
        }
        assert!(files > 200, "{files}");
    }

    #[test]
    fn a_service_is_a_type_that_contains_its_messages() {
        for (service, request, response) in [
            ("std_srvs/srv/SetBool", "std_srvs/srv/SetBool_Request", "std_srvs/srv/SetBool_Response"),
            (
                "example_interfaces/action/Fibonacci_SendGoal",
                "example_interfaces/action/Fibonacci_SendGoal_Request",
                "example_interfaces/action/Fibonacci_SendGoal_Response",
            ),
        ] {
            let [service, request, response] =
                [service, request, response].map(|n| n.parse::<TypeName>().unwrap());
            let of = |name| Library::empty().layout(name, &mut |_| None).unwrap();
            let layout = of(&service);
            for message in [&request, &response] {
                let part = layout.part(message).unwrap();
                assert_eq!((part.name(), message.service()), (Some(message), Some(service.clone())));
                assert_eq!(part.type_hash(), of(message).type_hash());
            }
            assert!(layout.part(&"std_msgs/msg/String".parse().unwrap()).is_none());
        }
    }

    #[test]
    fn given_definitions_come_before_shipped_ones() {
        let name = "std_msgs/msg/String".parse().unwrap();
        let layout = Library::empty().layout(&name, &mut |_| Some("int8 a\nint8 b\n".into())).unwrap();
        assert_eq!(layout.structs[0].members.len(), 2);
        let idl = "module std_msgs { module msg { struct String { int8 a; int8 b; int8 c; }; }; };";
        let layout = Library::empty().layout(&name, &mut |_| Some(idl.into())).unwrap();
        assert_eq!(layout.structs[0].members.len(), 3);
    }

    #[test]
    fn types_without_a_layout_are_reported() {
        let name = |text: &str| text.parse::<TypeName>().unwrap();
        let mut texts = |file: &TypeName| match file.name() {
            "A" => Some("B b".to_owned()),
            "B" => Some("A[] a".to_owned()),
            "Lacks" => Some("Nobody[2] x".to_owned()),
            "Wrong" => Some("int33".to_owned()),
            deep => deep.strip_prefix("D")?.parse::<u32>().ok().map(|n| format!("D{} d", n + 1)),
        };
        let mut of = |text: &str| Library::empty().layout(&name(text), &mut texts).map(|_| ()).unwrap_err();
        assert_eq!(of("p/msg/A"), TypeError::Circle { name: name("p/msg/A") });
        assert!(matches!(of("p/msg/D0"), TypeError::TooDeep { .. }));
        assert!(matches!(of("p/msg/Wrong"), TypeError::Parse(_)));
        assert_eq!(of("p/msg/Nobody").to_string(), "no definition of p/msg/Nobody");
        let lacks = of("p/msg/Lacks").to_string();
        assert_eq!(lacks, "no definition of p/msg/Nobody, which p/msg/Lacks contains");
        let mut wide = |file: &TypeName| match file.name() {
            "W" => Some((0..=LAYOUT_STRUCTS_MAX).map(|n| format!("N{n} n{n}\n")).collect()),
            _ => Some("int8 a".to_owned()),
        };
        let too_large = Library::empty().layout(&name("p/msg/W"), &mut wide).map(|_| ()).unwrap_err();
        assert!(matches!(too_large, TypeError::TooLarge { .. }), "{too_large}");
    }
}
