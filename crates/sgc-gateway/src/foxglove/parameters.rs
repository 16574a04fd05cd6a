//! Parameters of nodes, by the services that each node offers for them (`rcl_interfaces`). A parameter is named
//! `/node.name`, as in Foxglove's own bridge.
//!
//! A client may access the parameters of a node whose services it may call.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::StreamExt;
use futures_util::stream;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use sgc_sync::lock;
use tokio::time::Instant;

use crate::access::Right;
use crate::content::{Content, Form};
use crate::error::GatewayError;
use crate::session::Session;

use super::protocol::{Parameter, ParameterKind};
use super::refusal::Refusal;

/// The topic on which nodes announce changes, and its type.
pub(super) const EVENTS: (&str, &str) = ("/parameter_events", "rcl_interfaces/msg/ParameterEvent");
const LIST: (&str, &str) = ("/list_parameters", "rcl_interfaces/srv/ListParameters");
const GET: (&str, &str) = ("/get_parameters", "rcl_interfaces/srv/GetParameters");
const SET: (&str, &str) = ("/set_parameters", "rcl_interfaces/srv/SetParameters");

/// Time within which a node must answer.
const ANSWER_MAX: Duration = Duration::from_secs(3);
/// Time for all nodes together. Slower ones are left out.
const ALL_MAX: Duration = Duration::from_secs(8);
/// Time for which a node that did not answer is left out of requests for all parameters.
const SILENT_FOR: Duration = Duration::from_secs(60);
/// Most nodes that are asked at a time.
const NODES_AT_ONCE: usize = 8;
/// Most nodes of one request.
const NODES_MAX: usize = 1024;
/// Most parameters of one node.
const NODE_PARAMETERS_MAX: usize = 4096;
/// Most parameters of one request, and of one answer.
pub(super) const ASKED_MAX: usize = 16_384;
/// Most parameters asked of a node at once, because the answer holds all their values.
const ASKED_AT_ONCE: usize = 128;
/// Most failures of one request that are listed individually.
const FAILURES_MAX: usize = 16;
/// Longest name and longest reason of a failure, in characters.
const FAILURE_MAX: usize = 512;
/// Most parameters that a client may watch by name.
pub(super) const WATCHED_MAX: usize = 16_384;

/// Gets and sets parameters for one client.
#[derive(Debug)]
pub(super) struct Parameters {
    session: Arc<Session>,
    /// Nodes that did not answer, with the time of the attempt.
    silent: Mutex<BTreeMap<String, Instant>>,
}

/// The result of asking nodes.
#[derive(Debug, Default)]
pub(super) struct Answer {
    pub(super) parameters: Vec<Parameter>,
    /// Nodes that answered the request in full.
    pub(super) answered: Vec<String>,
    /// The failures.
    pub(super) failed: Failures,
}

/// Failures with their reasons: nodes that did not answer, invalid names, and values that a node refused.
#[derive(Debug, Default)]
pub(super) struct Failures {
    pub(super) shown: Vec<(String, String)>,
    /// The number of failures that are not listed.
    pub(super) more: usize,
}

impl Failures {
    fn push(&mut self, (what, why): (String, String)) {
        if self.shown.len() >= FAILURES_MAX {
            self.more += 1;
            return;
        }
        self.shown.push((clip(&what), clip(&why)));
    }

    fn extend(&mut self, failed: impl IntoIterator<Item = (String, String)>) {
        failed.into_iter().for_each(|failed| self.push(failed));
    }
}

/// Returns the beginning of a text.
fn clip(text: &str) -> String {
    match text.char_indices().nth(FAILURE_MAX) {
        Some((end, _)) => format!("{}…", text.get(..end).unwrap_or_default()),
        None => text.to_owned(),
    }
}

#[derive(Deserialize)]
struct ListResponse {
    result: ListResult,
}

#[derive(Deserialize)]
struct ListResult {
    names: Vec<String>,
}

#[derive(Deserialize)]
struct GetResponse {
    values: Vec<RosValue>,
}

#[derive(Deserialize)]
struct SetResponse {
    results: Vec<SetResult>,
}

#[derive(Deserialize)]
struct SetResult {
    successful: bool,
    reason: String,
}

#[derive(Clone, Debug, Deserialize)]
struct RosParameter {
    name: String,
    value: RosValue,
}

#[derive(Deserialize)]
struct RosEvent {
    node: String,
    new_parameters: Vec<RosParameter>,
    changed_parameters: Vec<RosParameter>,
    deleted_parameters: Vec<RosParameter>,
}

/// `rcl_interfaces/msg/ParameterValue`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default)]
struct RosValue {
    #[serde(rename = "type")]
    kind: u8,
    bool_value: bool,
    integer_value: i64,
    double_value: Value,
    string_value: String,
    byte_array_value: String,
    bool_array_value: Vec<bool>,
    integer_array_value: Vec<i64>,
    double_array_value: Vec<Value>,
    string_array_value: Vec<String>,
}

// Values of `rcl_interfaces/msg/ParameterType`.
const NOT_SET: u8 = 0;
const BOOL: u8 = 1;
const INTEGER: u8 = 2;
const DOUBLE: u8 = 3;
const STRING: u8 = 4;
const BYTE_ARRAY: u8 = 5;
const BOOL_ARRAY: u8 = 6;
const INTEGER_ARRAY: u8 = 7;
const DOUBLE_ARRAY: u8 = 8;
const STRING_ARRAY: u8 = 9;

/// Splits a full name into node and parameter.
pub(super) fn split(full: &str) -> Option<(&str, &str)> {
    full.split_once('.').filter(|(node, name)| node.starts_with('/') && node.len() > 1 && !name.is_empty())
}

fn full(node: &str, name: &str) -> String {
    format!("{node}.{name}")
}

impl Parameters {
    pub(super) fn new(session: Arc<Session>) -> Self {
        Self { session, silent: Mutex::default() }
    }

    /// Returns `true` if the client may access the parameters of a node.
    fn may_get(&self, node: &str) -> bool {
        self.session.check(Right::Call, &format!("{node}{}", GET.0)).is_ok()
    }

    async fn ask<T: DeserializeOwned>(
        &self,
        node: &str,
        (suffix, type_name): (&str, &str),
        request: &Value,
    ) -> Result<T, Refusal> {
        let (service, request) = (format!("{node}{suffix}"), Content::json(request.to_string()));
        let reply = self.session.call(&service, Some(type_name), &request, Form::Json, ANSWER_MAX).await?;
        // The text is valid JSON of this type, except for strings that are not UTF-8.
        serde_json::from_slice(&reply).map_err(|_| Refusal::Text)
    }

    /// Returns the nodes that have parameters and are not known to be silent.
    fn nodes(&self) -> Vec<String> {
        let services = self.session.hub().graph();
        let names =
            services.services.iter().filter(|(_, info)| info.type_name == LIST.1 && !info.servers.is_empty());
        let nodes = names.filter_map(|(name, _)| name.strip_suffix(LIST.0));
        let has_get = |node: &&str| services.services.contains_key(&full_service(node, GET.0));
        let mut silent = lock(&self.silent);
        silent.retain(|_, since| since.elapsed() < SILENT_FOR);
        let may = |node: &&str| {
            self.may_get(node) && self.session.check(Right::Call, &full_service(node, LIST.0)).is_ok()
        };
        let nodes = nodes.filter(has_get).filter(may).filter(|node| !silent.contains_key(*node));
        nodes.take(NODES_MAX).map(str::to_owned).collect()
    }

    /// Gets parameters by name, or all that the client may access if no name is given.
    pub(super) async fn get(&self, names: &[String]) -> Answer {
        let mut answer = Answer::default();
        let mut nodes: BTreeMap<String, Option<Vec<String>>> = BTreeMap::new();
        if names.is_empty() {
            nodes.extend(self.nodes().into_iter().map(|node| (node, None)));
        }
        for name in names {
            match split(name) {
                Some((node, name)) => {
                    let of = nodes.entry(node.to_owned()).or_default().get_or_insert_default();
                    of.push(name.to_owned());
                }
                None => answer.failed.push((name.clone(), not_a_parameter(name))),
            }
        }
        let until = Instant::now() + ALL_MAX;
        let mut left: BTreeSet<String> = nodes.keys().cloned().collect();
        let ask = |(node, names): (String, Option<Vec<String>>)| async move {
            let got = self.get_of_node(&node, names).await;
            (node, got)
        };
        let mut asked = stream::iter(nodes).map(ask).buffer_unordered(NODES_AT_ONCE);
        while let Ok(Some((node, got))) = tokio::time::timeout_at(until, asked.next()).await {
            left.remove(&node);
            match got {
                Ok(parameters) if answer.parameters.len() + parameters.len() > ASKED_MAX => {
                    answer.failed.push((node, format!("there are more than {ASKED_MAX} parameters")));
                }
                Ok(parameters) => {
                    answer.parameters.extend(parameters);
                    answer.answered.push(node);
                }
                Err(error) => {
                    if matches!(
                        error,
                        Refusal::Gateway(GatewayError::Timeout { .. } | GatewayError::NoServer { .. })
                    ) {
                        let mut silent = lock(&self.silent);
                        // A client can invent any number of nodes, so the table is bounded.
                        if silent.len() < NODES_MAX {
                            silent.insert(node.clone(), Instant::now());
                        }
                    }
                    answer.failed.push((node, error.to_string()));
                }
            }
        }
        let late = |node| (node, "others took too long, so it was not waited for".to_owned());
        answer.failed.extend(left.into_iter().map(late));
        answer
    }

    async fn get_of_node(&self, node: &str, names: Option<Vec<String>>) -> Result<Vec<Parameter>, Refusal> {
        let mut names = match names {
            Some(names) => names,
            None => {
                let request = json!({"prefixes": [], "depth": 0});
                let listed: ListResponse = self.ask(node, LIST, &request).await?;
                listed.result.names
            }
        };
        names.truncate(NODE_PARAMETERS_MAX);
        let mut parameters = Vec::with_capacity(names.len());
        for names in names.chunks(ASKED_AT_ONCE) {
            let values = self.values(node, names).await?;
            let pairs = names.iter().zip(values);
            parameters.extend(pairs.map(|(name, value)| to_parameter(full(node, name), value)));
        }
        Ok(parameters)
    }

    /// Returns values in the order of their names. A missing parameter counts as not set.
    async fn values(&self, node: &str, names: &[String]) -> Result<Vec<RosValue>, Refusal> {
        let got: GetResponse = self.ask(node, GET, &json!({"names": names})).await?;
        if got.values.len() == names.len() {
            return Ok(got.values);
        }
        // A node answers with an empty list if one of the names is not declared.
        let mut values = Vec::with_capacity(names.len());
        for name in names {
            let got: GetResponse = self.ask(node, GET, &json!({"names": [name]})).await?;
            values.push(got.values.into_iter().next().unwrap_or_default());
        }
        Ok(values)
    }

    /// Sets parameters and returns their values afterwards.
    pub(super) async fn set(&self, wanted: Vec<Parameter>) -> Answer {
        let mut answer = Answer::default();
        let mut nodes: BTreeMap<String, Vec<(String, Parameter)>> = BTreeMap::new();
        let mut names = Vec::new();
        for parameter in wanted {
            match split(&parameter.name) {
                Some((node, name)) => {
                    names.push(parameter.name.clone());
                    nodes.entry(node.to_owned()).or_default().push((name.to_owned(), parameter));
                }
                None => {
                    let why = not_a_parameter(&parameter.name);
                    answer.failed.push((parameter.name, why));
                }
            }
        }
        for (node, parameters) in nodes {
            match self.set_of_node(&node, parameters).await {
                Ok(refused) => {
                    answer.failed.extend(refused.shown);
                    answer.failed.more += refused.more;
                }
                Err(error) => answer.failed.push((node, error.to_string())),
            }
        }
        if !names.is_empty() {
            answer.parameters = self.get(&names).await.parameters;
        }
        answer
    }

    /// Sets parameters of one node and returns the refused ones with the reasons.
    async fn set_of_node(
        &self,
        node: &str,
        parameters: Vec<(String, Parameter)>,
    ) -> Result<Failures, Refusal> {
        let names: Vec<_> = parameters.iter().map(|(name, _)| name.clone()).collect();
        // JSON has one kind of number, so the current value decides between integer and double.
        let present = self.values(node, &names).await.unwrap_or_default();
        let (mut refused, mut sent, mut request) = (Failures::default(), Vec::new(), Vec::new());
        for (at, (name, parameter)) in parameters.into_iter().enumerate() {
            match to_ros(parameter, present.get(at).map(|value| value.kind)) {
                Ok(value) => {
                    request.push(json!({"name": name, "value": value}));
                    sent.push(full(node, &name));
                }
                Err(why) => refused.push((full(node, &name), why)),
            }
        }
        if !request.is_empty() {
            let set: SetResponse = self.ask(node, SET, &json!({"parameters": request})).await?;
            let results = sent.into_iter().zip(set.results).filter(|(_, result)| !result.successful);
            refused.extend(results.map(|(name, result)| (name, result.reason)));
        }
        Ok(refused)
    }

    /// Returns the changes in an event that the client watches and may see.
    pub(super) fn changes_in_event(&self, event: &[u8], watched: &WatchList) -> Vec<Parameter> {
        let Ok(event) = serde_json::from_slice::<RosEvent>(event) else { return Vec::new() };
        if !self.may_get(&event.node) {
            return Vec::new();
        }
        let set = event.new_parameters.into_iter().chain(event.changed_parameters);
        let gone = event.deleted_parameters.into_iter();
        let gone = gone.map(|parameter| RosParameter { value: RosValue::default(), ..parameter });
        let all = set.chain(gone).map(|parameter| (full(&event.node, &parameter.name), parameter.value));
        let heard = all.filter(|(name, _)| watched.has(name));
        heard.map(|(name, value)| to_parameter(name, value)).collect()
    }
}

fn full_service(node: &str, suffix: &str) -> String {
    format!("{node}{suffix}")
}

fn not_a_parameter(name: &str) -> String {
    format!("{name:?} is no parameter: write one such as /camera.exposure")
}

/// The parameters that a client watches.
#[derive(Debug, Default)]
pub(super) struct WatchList {
    names: BTreeSet<String>,
    all: bool,
}

impl WatchList {
    /// Adds names; an empty list means all parameters. Fails beyond [`WATCHED_MAX`].
    pub(super) fn add(&mut self, names: Vec<String>) -> Result<(), GatewayError> {
        self.all |= names.is_empty();
        for name in names {
            if self.names.len() >= WATCHED_MAX && !self.names.contains(&name) {
                return Err(GatewayError::TooMany {
                    what: "parameters that are listened to",
                    max: WATCHED_MAX,
                });
            }
            self.names.insert(name);
        }
        Ok(())
    }

    /// Removes names; an empty list means all parameters.
    pub(super) fn remove(&mut self, names: &[String]) {
        if names.is_empty() {
            *self = Self::default();
        }
        for name in names {
            self.names.remove(name);
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.names.is_empty() && !self.all
    }

    fn has(&self, name: &str) -> bool {
        self.all || self.names.contains(name)
    }
}

fn to_parameter(name: String, value: RosValue) -> Parameter {
    let (value, kind) = match value.kind {
        BOOL => (Some(value.bool_value.into()), None),
        INTEGER => (Some(value.integer_value.into()), None),
        DOUBLE => (Some(value.double_value), Some(ParameterKind::Float64)),
        STRING => (Some(value.string_value.into()), None),
        BYTE_ARRAY => (Some(value.byte_array_value.into()), Some(ParameterKind::ByteArray)),
        BOOL_ARRAY => (Some(value.bool_array_value.into()), None),
        INTEGER_ARRAY => (Some(value.integer_array_value.into()), None),
        DOUBLE_ARRAY => (Some(value.double_array_value.into()), Some(ParameterKind::Float64Array)),
        STRING_ARRAY => (Some(value.string_array_value.into()), None),
        _ => (None, None),
    };
    Parameter { name, value, kind }
}

/// Converts a value to the form that nodes take. The client's type, else the current type, resolves what JSON leaves
/// open.
fn to_ros(parameter: Parameter, present: Option<u8>) -> Result<Value, String> {
    let Parameter { name, value, kind } = parameter;
    let wrong = |what: &str| Err(format!("{name} cannot be {what}"));
    let of = |kind: u8, member: &str, value: Value| Ok(json!({"type": kind, member: value}));
    let is_double = kind == Some(ParameterKind::Float64) || (kind.is_none() && present == Some(DOUBLE));
    let are_doubles =
        kind == Some(ParameterKind::Float64Array) || (kind.is_none() && present == Some(DOUBLE_ARRAY));
    match value {
        None | Some(Value::Null) => Ok(json!({"type": NOT_SET})),
        Some(value @ Value::Bool(_)) => of(BOOL, "bool_value", value),
        Some(value @ Value::Number(_)) if is_double || !value.is_i64() => of(DOUBLE, "double_value", value),
        Some(value @ Value::Number(_)) => of(INTEGER, "integer_value", value),
        Some(value @ Value::String(_)) => match kind {
            Some(ParameterKind::ByteArray) => of(BYTE_ARRAY, "byte_array_value", value),
            // A value such as `NaN` is a string in JSON.
            Some(ParameterKind::Float64) => of(DOUBLE, "double_value", value),
            _ => of(STRING, "string_value", value),
        },
        Some(Value::Object(_)) => wrong("an object: no parameter of ROS 2 is"),
        Some(Value::Array(all)) => {
            let value = |all| Value::Array(all);
            if are_doubles {
                return of(DOUBLE_ARRAY, "double_array_value", value(all));
            }
            match all.first() {
                None => match present {
                    Some(BYTE_ARRAY) => of(BYTE_ARRAY, "byte_array_value", value(all)),
                    Some(BOOL_ARRAY) => of(BOOL_ARRAY, "bool_array_value", value(all)),
                    Some(INTEGER_ARRAY) => of(INTEGER_ARRAY, "integer_array_value", value(all)),
                    _ => of(STRING_ARRAY, "string_array_value", value(all)),
                },
                Some(Value::Bool(_)) if all.iter().all(Value::is_boolean) => {
                    of(BOOL_ARRAY, "bool_array_value", value(all))
                }
                Some(Value::String(_)) if all.iter().all(Value::is_string) => {
                    of(STRING_ARRAY, "string_array_value", value(all))
                }
                Some(_) if all.iter().all(Value::is_i64) => {
                    of(INTEGER_ARRAY, "integer_array_value", value(all))
                }
                Some(_) if all.iter().all(Value::is_number) => {
                    of(DOUBLE_ARRAY, "double_array_value", value(all))
                }
                Some(_) => wrong("an array of several types"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_names_have_a_node_and_a_name() {
        assert_eq!(split("/arm/camera.exposure.auto"), Some(("/arm/camera", "exposure.auto")));
        for wrong in ["exposure", "camera.exposure", "/camera", "/camera.", "/.x"] {
            assert_eq!(split(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn values_are_the_same_when_they_come_back() {
        let values = [
            json!({"type": 0}),
            json!({"type": 1, "bool_value": true}),
            json!({"type": 2, "integer_value": i64::MAX}),
            json!({"type": 3, "double_value": 3.0}),
            json!({"type": 3, "double_value": "NaN"}),
            json!({"type": 4, "string_value": "x"}),
            json!({"type": 5, "byte_array_value": "QUJD"}),
            json!({"type": 6, "bool_array_value": [true, false]}),
            json!({"type": 7, "integer_array_value": [1, -2]}),
            json!({"type": 8, "double_array_value": [1, 2.5]}),
            json!({"type": 9, "string_array_value": ["a", ""]}),
        ];
        for value in values {
            let ros: RosValue = serde_json::from_value(value.clone()).unwrap();
            let there = to_parameter("/n.p".into(), ros);
            let travelled: Parameter = serde_json::from_str(&serde_json::to_string(&there).unwrap()).unwrap();
            assert_eq!(to_ros(travelled, None), Ok(value));
        }
    }

    #[test]
    fn numbers_are_what_is_there_already() {
        let of = |value: Value, kind: Option<ParameterKind>, present: u8| {
            let parameter = Parameter { name: "/n.p".into(), value: Some(value), kind };
            to_ros(parameter, Some(present)).map(|value| value["type"].as_u64().unwrap() as u8)
        };
        assert_eq!(of(json!(3), None, DOUBLE), Ok(DOUBLE));
        assert_eq!(of(json!(3), None, INTEGER), Ok(INTEGER));
        assert_eq!(of(json!(3), Some(ParameterKind::Float64), NOT_SET), Ok(DOUBLE));
        assert_eq!(of(json!(3.5), None, NOT_SET), Ok(DOUBLE));
        assert_eq!(of(json!([1, 2]), None, DOUBLE_ARRAY), Ok(DOUBLE_ARRAY));
        assert_eq!(of(json!([1, 2.5]), None, NOT_SET), Ok(DOUBLE_ARRAY));
        assert_eq!(of(json!([]), None, INTEGER_ARRAY), Ok(INTEGER_ARRAY));
        assert!(of(json!([1, "a"]), None, NOT_SET).is_err() && of(json!({}), None, NOT_SET).is_err());
    }

    #[test]
    fn failures_beyond_those_said_are_counted_and_none_is_long() {
        let mut failed = Failures::default();
        let why = "é".repeat(1 << 20);
        failed.extend((0..20).map(|n| (format!("{n}{why}"), why.clone())));
        failed.push(("last".into(), "late".into()));
        assert_eq!((failed.shown.len(), failed.more), (FAILURES_MAX, 5));
        let longest = failed.shown.iter().map(|(what, why)| what.chars().count().max(why.chars().count()));
        assert_eq!(longest.max(), Some(FAILURE_MAX + 1));
    }

    #[test]
    fn watch_list_is_bounded_and_an_empty_one_means_all() {
        let mut watched = WatchList::default();
        watched.add(vec!["/n.a".into()]).unwrap();
        assert!(watched.has("/n.a") && !watched.has("/n.b"));
        watched.add(Vec::new()).unwrap();
        assert!(watched.has("/n.b"));
        watched.remove(&[]);
        assert!(watched.is_empty());
        let many = (0..=WATCHED_MAX).map(|n| format!("/n.{n}")).collect();
        assert!(matches!(watched.add(many), Err(GatewayError::TooMany { .. })));
    }
}
