//! Types as `rosapi` describes them: a list of members for each type, or the text of the definitions.

use std::collections::BTreeSet;

use serde::Serialize;
use sgc_cdr::{Base, DUMMY_MEMBER, Definition, Field, Library, Primitive, Shape, TypeName};

use crate::definitions::Types;
use crate::error::GatewayError;

/// The separator between definitions in one text.
const RULE: &str = "================================================================================";

/// `rosapi_msgs/msg/TypeDef`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct TypeDef {
    #[serde(rename = "type")]
    type_name: String,
    fieldnames: Vec<String>,
    fieldtypes: Vec<String>,
    /// -1 for a single element, 0 for a sequence, else the length of the array.
    fieldarraylen: Vec<i64>,
    examples: Vec<String>,
    constnames: Vec<String>,
    constvalues: Vec<String>,
}

/// Returns a type and the types that it contains, each once. May read files.
pub(super) fn typedefs(types: &Types, type_name: &str) -> Result<Vec<TypeDef>, GatewayError> {
    let (library, all) = within(types, type_name)?;
    Ok(all.iter().filter_map(|name| library.definition(name)).map(typedef).collect())
}

/// Returns the text of a type's definition and of the types that it contains, as in bag files.
pub(super) fn full_text(types: &Types, type_name: &str) -> String {
    let texts = || {
        let (_, all) = within(types, type_name)?;
        let mut text = String::new();
        for (index, name) in all.iter().enumerate() {
            if index > 0 {
                text.push_str(&format!("\n{RULE}\nMSG: {}\n", short_name(name)));
            }
            text.push_str(&types.text(&name.to_string())?);
        }
        Ok::<_, GatewayError>(text)
    };
    texts().unwrap_or_else(|error| format!("# {error}"))
}

/// Returns the definitions of a type and of the types that it contains, and their names, beginning with the type.
fn within(types: &Types, type_name: &str) -> Result<(Library, Vec<TypeName>), GatewayError> {
    let name: TypeName = type_name.parse().map_err(|_| GatewayError::TypeName {
        name: type_name.to_owned(),
        what: "message",
        example: "std_msgs/msg/String",
    })?;
    let mut library = Library::empty();
    let found = library.layout(&name, &mut |file| types.text(&file.to_string()).ok());
    found.map_err(GatewayError::Definition)?;
    let mut all = Vec::new();
    let mut seen = BTreeSet::new();
    let mut next = vec![name];
    while let Some(name) = next.pop() {
        if !seen.insert(name.clone()) {
            continue;
        }
        let fields = library.definition(&name).map(|definition| definition.fields.as_slice());
        let inner =
            fields.unwrap_or_default().iter().rev().filter_map(|field| match &field.field_type.base {
                Base::Message(inner) => Some(inner.clone()),
                _ => None,
            });
        next.extend(inner);
        all.push(name);
    }
    Ok((library, all))
}

fn typedef(definition: &Definition) -> TypeDef {
    let mut made = TypeDef { type_name: short_name(&definition.name), ..TypeDef::default() };
    for field in definition.fields.iter().filter(|field| field.name != DUMMY_MEMBER) {
        made.fieldnames.push(field.name.clone());
        made.fieldtypes.push(base_name(&field.field_type.base));
        made.fieldarraylen.push(match field.field_type.shape {
            Shape::One => -1,
            Shape::Array(length) => length.into(),
            Shape::Sequence { .. } => 0,
        });
        made.examples.push(example(field));
    }
    for constant in &definition.constants {
        made.constnames.push(constant.name.clone());
        made.constvalues.push(constant.value.clone());
    }
    made
}

/// Returns a type name in the form of `rosapi`: `std_msgs/String`.
fn short_name(name: &TypeName) -> String {
    format!("{}/{}", name.package(), name.name())
}

/// Returns the name of a base type as in the Python packages of ROS 2.
fn base_name(base: &Base) -> String {
    match base {
        Base::Primitive(Primitive::Bool) => "boolean".to_owned(),
        Base::Primitive(Primitive::Byte) => "octet".to_owned(),
        Base::Primitive(Primitive::Float32) => "float".to_owned(),
        Base::Primitive(Primitive::Float64) => "double".to_owned(),
        Base::Primitive(primitive) => primitive.name().to_owned(),
        Base::String { .. } => "string".to_owned(),
        Base::WString { .. } => "wstring".to_owned(),
        Base::Message(name) => short_name(name),
    }
}

fn example(field: &Field) -> String {
    if field.field_type.shape != Shape::One {
        return "[]".to_owned();
    }
    if let Some(default) = &field.default {
        return default.clone();
    }
    match &field.field_type.base {
        Base::Primitive(Primitive::Bool) => "False",
        Base::Primitive(Primitive::Float32 | Primitive::Float64) => "0.0",
        Base::Primitive(_) => "0",
        Base::String { .. } | Base::WString { .. } => "",
        Base::Message(_) => "{}",
    }
    .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::definitions::ShippedDefinitions;

    #[test]
    fn types_are_told_with_all_that_they_contain() {
        let types = Types::new(ShippedDefinitions);
        let all = typedefs(&types, "sensor_msgs/msg/BatteryState").unwrap();
        let names: Vec<_> = all.iter().map(|def| def.type_name.as_str()).collect();
        assert_eq!(names, ["sensor_msgs/BatteryState", "std_msgs/Header", "builtin_interfaces/Time"]);
        let battery = &all[0];
        let at = |name: &str| battery.fieldnames.iter().position(|field| field == name).unwrap();
        let (voltage, cells) = (at("voltage"), at("cell_voltage"));
        assert_eq!(
            (
                battery.fieldtypes[voltage].as_str(),
                battery.fieldarraylen[voltage],
                &battery.examples[voltage]
            ),
            ("float", -1, &"0.0".to_owned())
        );
        assert_eq!((battery.fieldarraylen[cells], battery.examples[cells].as_str()), (0, "[]"));
        let full = battery.constnames.iter().position(|name| name == "POWER_SUPPLY_STATUS_FULL").unwrap();
        assert_eq!(battery.constvalues[full], "4");
        let request = typedefs(&types, "std_srvs/srv/SetBool_Request").unwrap();
        assert_eq!(
            (request[0].type_name.as_str(), &request[0].fieldtypes[0][..]),
            ("std_srvs/SetBool_Request", "boolean")
        );
        assert!(typedefs(&types, "std_srvs/srv/Empty_Request").unwrap()[0].fieldnames.is_empty());
        assert!(typedefs(&types, "nobody/msg/Knows").is_err());
    }

    #[test]
    fn texts_are_as_in_bag_files() {
        let text = full_text(&Types::new(ShippedDefinitions), "geometry_msgs/msg/PointStamped");
        let parts: Vec<_> = text.split(RULE).collect();
        assert_eq!(parts.len(), 4);
        assert!(parts[1].starts_with("\nMSG: std_msgs/Header\n"), "{text}");
        assert!(
            full_text(&Types::new(ShippedDefinitions), "nobody/msg/Knows").starts_with("# no definition")
        );
    }
}
