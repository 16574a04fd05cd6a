//! Parameters of nodes, by the services that every node offers for them. Clients name them `/node:parameter`.

use std::time::Duration;

use futures_util::future::join_all;
use serde_json::{Value as Json, json};

use crate::content::{Content, Form};
use crate::error::GatewayError;
use crate::session::Session;

/// Time within which a node must answer; clients wait for 3 s.
const ANSWER_MAX: Duration = Duration::from_secs(2);
/// Most nodes that are asked at a time.
const NODES_AT_ONCE: usize = 32;
/// The members of a value by `rcl_interfaces/msg/ParameterType`.
const TYPES: [&str; 10] = [
    "",
    "bool_value",
    "integer_value",
    "double_value",
    "string_value",
    "byte_array_value",
    "bool_array_value",
    "integer_array_value",
    "double_array_value",
    "string_array_value",
];
const DOUBLE: usize = 3;
const DOUBLES: usize = 8;

/// The reason why a parameter cannot be read or set.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(super) enum ParamError {
    #[error("{0:?} is no name of a parameter: write /node:parameter")]
    Name(String),
    #[error("{0} is not declared, or the node does not tell")]
    NotDeclared(String),
    #[error("{0}: no parameter can have such a value")]
    Kind(String),
    #[error("{name}: the node refuses: {why}")]
    Refused { name: String, why: String },
    #[error(transparent)]
    Gateway(#[from] GatewayError),
}

/// Splits a name into node and parameter.
fn split(name: &str) -> Result<(String, &str), ParamError> {
    let wrong = || ParamError::Name(name.to_owned());
    let (node, parameter) = name.split_once(':').filter(|(node, _)| !node.is_empty()).ok_or_else(wrong)?;
    let node = if node.starts_with('/') { node.to_owned() } else { format!("/{node}") };
    Ok((node, parameter))
}

async fn ask(session: &Session, node: &str, what: &str, of: &str, request: Json) -> Result<Json, ParamError> {
    let (service, type_name) = (format!("{node}/{what}"), format!("rcl_interfaces/srv/{of}"));
    let request = Content::json(request.to_string());
    let reply = session.call(&service, Some(&type_name), &request, Form::Json, ANSWER_MAX).await?;
    Ok(serde_json::from_slice(&reply).unwrap_or_default())
}

/// Returns all parameters of all nodes that the client may ask.
pub(super) async fn names(session: &Session) -> Vec<String> {
    let graph = session.graph();
    let is_listing = |service: &str| service.strip_suffix("/list_parameters").map(str::to_owned);
    let served = graph.services.iter().filter(|(_, info)| !info.servers.is_empty());
    let nodes: Vec<String> = served.filter_map(|(service, _)| is_listing(service)).collect();
    let mut names = Vec::new();
    for nodes in nodes.chunks(NODES_AT_ONCE) {
        let asked = nodes.iter().map(|node| async move {
            let listed = ask(session, node, "list_parameters", "ListParameters", json!({})).await;
            let listed = listed.unwrap_or_default();
            let names = listed["result"]["names"].as_array().cloned().unwrap_or_default();
            names.iter().filter_map(Json::as_str).map(|name| format!("{node}:{name}")).collect::<Vec<_>>()
        });
        names.extend(join_all(asked).await.into_iter().flatten());
    }
    names
}

/// Returns the type of a parameter and its value.
async fn look_up(session: &Session, name: &str) -> Result<(usize, Json), ParamError> {
    let (node, parameter) = split(name)?;
    let reply =
        ask(session, &node, "get_parameters", "GetParameters", json!({ "names": [parameter] })).await?;
    let value = &reply["values"][0];
    let kind = value["type"].as_u64().and_then(|kind| usize::try_from(kind).ok()).unwrap_or(0);
    match TYPES.get(kind).filter(|member| !member.is_empty()) {
        Some(member) => Ok((kind, value[*member].clone())),
        None => Err(ParamError::NotDeclared(name.to_owned())),
    }
}

/// Returns the value of a parameter.
pub(super) async fn get(session: &Session, name: &str) -> Result<Json, ParamError> {
    look_up(session, name).await.map(|(_, value)| value)
}

/// Sets a parameter. The value is JSON, possibly as text, as clients send it.
pub(super) async fn set(session: &Session, name: &str, value: &Json) -> Result<(), ParamError> {
    let (node, parameter) = split(name)?;
    let value = match value {
        Json::String(text) => serde_json::from_str(text).unwrap_or_else(|_| value.clone()),
        value => value.clone(),
    };
    // JavaScript writes 1 for 1.0, so the current type decides.
    let kind = look_up(session, name).await.map_or(0, |(kind, _)| kind);
    let value = as_parameter(kind, value).ok_or_else(|| ParamError::Kind(name.to_owned()))?;
    write(session, &node, parameter, value).await
}

/// Undeclares a parameter if the node permits it.
pub(super) async fn delete(session: &Session, name: &str) -> Result<(), ParamError> {
    let (node, parameter) = split(name)?;
    look_up(session, name).await?;
    write(session, &node, parameter, json!({ "type": 0 })).await
}

async fn write(session: &Session, node: &str, parameter: &str, value: Json) -> Result<(), ParamError> {
    let parameters = json!({ "parameters": [{ "name": parameter, "value": value }] });
    let reply = ask(session, node, "set_parameters", "SetParameters", parameters).await?;
    let result = &reply["results"][0];
    match result["successful"].as_bool() {
        Some(true) => Ok(()),
        _ => Err(ParamError::Refused {
            name: format!("{node}:{parameter}"),
            why: result["reason"].as_str().unwrap_or("no reason given").to_owned(),
        }),
    }
}

/// Converts JSON to `rcl_interfaces/msg/ParameterValue`. `kind` is the current type of the parameter, or 0 if
/// unknown.
fn as_parameter(kind: usize, value: Json) -> Option<Json> {
    let all = |values: &[Json], is: fn(&Json) -> bool| values.iter().all(is);
    let guess = match &value {
        Json::Bool(_) => 1,
        Json::Number(number) if number.is_f64() || kind == DOUBLE => DOUBLE,
        Json::Number(_) => 2,
        Json::String(_) => 4,
        // An empty list has no type of its own.
        Json::Array(values) if values.is_empty() && kind >= 5 => kind,
        Json::Array(values) if all(values, Json::is_boolean) && !values.is_empty() => 6,
        Json::Array(values) if kind == 5 && all(values, Json::is_u64) => 5,
        Json::Array(values) if all(values, |v| v.is_i64() || v.is_u64()) && kind != DOUBLES => 7,
        Json::Array(values) if all(values, Json::is_number) => DOUBLES,
        Json::Array(values) if all(values, Json::is_string) => 9,
        _ => return None,
    };
    let member = TYPES.get(guess)?;
    Some(json!({ "type": guess, *member: value }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_become_parameters_of_the_kind_they_have() {
        let of = |kind, value: Json| as_parameter(kind, value);
        assert_eq!(of(0, json!(true)), Some(json!({"type": 1, "bool_value": true})));
        assert_eq!(of(0, json!(1)), Some(json!({"type": 2, "integer_value": 1})));
        assert_eq!(of(DOUBLE, json!(1)), Some(json!({"type": 3, "double_value": 1})));
        assert_eq!(of(2, json!(1.5)), Some(json!({"type": 3, "double_value": 1.5})));
        assert_eq!(of(0, json!("a")), Some(json!({"type": 4, "string_value": "a"})));
        assert_eq!(of(0, json!([1, 2])), Some(json!({"type": 7, "integer_array_value": [1, 2]})));
        assert_eq!(of(DOUBLES, json!([1, 2])), Some(json!({"type": 8, "double_array_value": [1, 2]})));
        assert_eq!(of(5, json!([1, 2])), Some(json!({"type": 5, "byte_array_value": [1, 2]})));
        assert_eq!(of(9, json!([])), Some(json!({"type": 9, "string_array_value": []})));
        assert_eq!(of(0, json!([1, "a"])), None);
        assert_eq!(of(0, json!({"a": 1})), None);
    }
}
