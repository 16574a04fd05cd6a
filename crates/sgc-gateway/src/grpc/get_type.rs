//! `GetType`: the definition of a type as text, with the definitions that it needs.

use sgc_cdr::{Library, TypeName};

use super::fault::Fault;
use super::proto::GetTypeResponse;
use super::proto::get_type_response::Definition;
use crate::definitions::Types;
use crate::error::GatewayError;

/// The parts of services and actions.
const SERVICE: [&str; 2] = ["_Request", "_Response"];
const ACTION: [&str; 3] = ["_Goal", "_Result", "_Feedback"];

/// Returns the definitions of a type. May read files.
pub(super) fn describe(types: &Types, type_name: &str) -> Result<GetTypeResponse, Fault> {
    let name: TypeName = type_name.parse().map_err(|_| GatewayError::TypeName {
        name: type_name.to_owned(),
        what: "message, service or action",
        example: "std_msgs/msg/String",
    })?;
    let is_whole = name.file_stem() == name.name();
    let parts = match name.kind() {
        "srv" if is_whole => &SERVICE[..],
        "action" if is_whole => &ACTION,
        _ => &[""],
    };
    let mut definitions: Vec<Definition> = Vec::new();
    let mut library = Library::empty();
    let mut type_hash = String::new();
    for part in parts {
        let part = format!("{type_name}{part}");
        let layout = types.layout(&part, None)?;
        if part == type_name {
            type_hash = layout.type_hash();
        }
        let Ok(part) = part.parse() else { continue };
        let mut look_up = |file: &TypeName| {
            let file = file.to_string();
            let text = types.text(&file).ok()?;
            definitions.push(Definition { r#type: file, text: text.clone() });
            Some(text)
        };
        // A type known only by its description has no text.
        let _ = library.layout(&part, &mut look_up);
    }
    Ok(GetTypeResponse { type_hash, definitions })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::definitions::ShippedDefinitions;

    #[test]
    fn a_type_comes_with_all_that_it_needs() {
        let types = Types::new(ShippedDefinitions);
        let twist = describe(&types, "geometry_msgs/msg/TwistStamped").unwrap();
        let names: Vec<_> = twist.definitions.iter().map(|definition| &*definition.r#type).collect();
        assert_eq!(names[0], "geometry_msgs/msg/TwistStamped");
        for needed in ["std_msgs/msg/Header", "builtin_interfaces/msg/Time", "geometry_msgs/msg/Vector3"] {
            assert_eq!(names.iter().filter(|name| **name == needed).count(), 1, "{needed} in {names:?}");
        }
        assert!(twist.type_hash.starts_with("RIHS01_"));

        let service = describe(&types, "std_srvs/srv/SetBool").unwrap();
        assert_eq!((service.definitions.len(), &*service.type_hash), (1, ""));
        assert!(service.definitions[0].text.contains("---"));
        assert!(describe(&types, "none/msg/None").is_err() && describe(&types, "../../etc/passwd").is_err());
    }
}
