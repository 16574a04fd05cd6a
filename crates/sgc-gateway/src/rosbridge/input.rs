//! Conversion of messages as rosbridge clients write them: times of ROS 1, arguments as a list, headers without a
//! stamp.
//!
//! The form of `docs/spec/json.md` is tried first. Only a message that does not match it is converted.

use std::fmt;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, SeqAccess, Visitor};
use serde_json::value::RawValue;
use serde_json::{Map, Value as Json};
use sgc_cdr::{Layout, Value};

use crate::content::Content;
use crate::error::GatewayError;
use crate::offload::offload_if_long;

/// Most values of a text that is converted, estimated by its commas and brackets, because a parsed value takes far
/// more memory than its text.
const VALUES_MAX: usize = 1 << 20;

/// Reads a message of a topic. If its type begins with a header and the stamp is missing, the stamp is set to the
/// current time.
pub(super) fn message(layout: &Layout, raw: &str) -> Result<Value, GatewayError> {
    let read = |raw: &str| layout.from_json(raw.as_bytes()).map_err(GatewayError::Value);
    let mut value = offload_if_long(raw.len(), || tolerate(raw, read))?;
    if layout.begins_with_header() && !has_stamp(raw) {
        stamp(&mut value, now());
    }
    Ok(value)
}

/// Reads a message, and on failure once more as ROS 1 would have written it.
fn tolerate<T>(raw: &str, read: impl Fn(&str) -> Result<T, GatewayError>) -> Result<T, GatewayError> {
    match read(raw) {
        Err(error @ GatewayError::Value(_)) => match from_ros_1(raw) {
            Some(other) => read(&other),
            None => Err(error),
        },
        result => result,
    }
}

/// Reads a message asynchronously, and on failure once more as ROS 1 would have written it.
pub(super) async fn tolerate_later<T, F>(raw: &str, read: impl Fn(Content) -> F) -> Result<T, GatewayError>
where
    F: Future<Output = Result<T, GatewayError>>,
{
    match read(Content::json(raw.to_owned())).await {
        Err(error @ GatewayError::Value(_)) => match offload_if_long(raw.len(), || from_ros_1(raw)) {
            Some(other) => read(Content::json(other)).await,
            None => Err(error),
        },
        result => result,
    }
}

/// Returns arguments as an object. They may be an object, a list of its members in order, or missing.
pub(super) fn arguments(
    raw: Option<&str>,
    layout: impl FnOnce() -> Result<Arc<Layout>, GatewayError>,
) -> Result<String, GatewayError> {
    let Some(raw) = raw else { return Ok("{}".to_owned()) };
    let Some(list) = raw.strip_prefix('[') else { return Ok(raw.to_owned()) };
    if list.trim_start().starts_with(']') {
        return Ok("{}".to_owned());
    }
    let empty = layout()?.from_json(b"{}").map_err(GatewayError::Value)?;
    let names = match &empty {
        Value::Record(members) => members.iter().map(|(name, _)| name.to_string()).collect(),
        _ => Vec::new(),
    };
    let object = ArgumentList { names }.deserialize(&mut serde_json::Deserializer::from_str(raw));
    Ok(object.unwrap_or_else(|_| raw.to_owned()))
}

/// A list of arguments, which is read as an object with these names. A surplus argument gets a name that the type does
/// not have, so that reading refuses it. Further ones are left out, because a list takes far more memory than its text.
struct ArgumentList {
    names: Vec<String>,
}

impl<'de> DeserializeSeed<'de> for ArgumentList {
    type Value = String;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<String, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for ArgumentList {
    type Value = String;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<String, A::Error> {
        let surplus = format!("[{}]", self.names.len());
        let mut members = Vec::with_capacity(self.names.len() + 1);
        for name in self.names.into_iter().chain([surplus]) {
            let Some(raw) = list.next_element::<&RawValue>()? else { break };
            members.push(format!("{}:{raw}", Json::from(name)));
        }
        while list.next_element::<IgnoredAny>()?.is_some() {}
        Ok(format!("{{{}}}", members.join(",")))
    }
}

/// Returns the JSON with ROS 2's names for `secs` and `nsecs` and without null stamps, or `None` if there are none or
/// it has more than [`VALUES_MAX`] values.
fn from_ros_1(raw: &str) -> Option<String> {
    if raw.bytes().filter(|byte| matches!(byte, b',' | b'[' | b'{')).nth(VALUES_MAX).is_some() {
        return None;
    }
    let mut value: Json = serde_json::from_str(raw).ok()?;
    rename(&mut value).then(|| value.to_string())
}

fn rename(value: &mut Json) -> bool {
    let mut any = false;
    match value {
        Json::Array(all) => all.iter_mut().for_each(|value| any |= rename(value)),
        Json::Object(members) => {
            any = rename_time(members);
            if members.get("stamp").is_some_and(Json::is_null) {
                members.remove("stamp");
                any = true;
            }
            members.values_mut().for_each(|value| any |= rename(value));
        }
        _ => {}
    }
    any
}

fn rename_time(members: &mut Map<String, Json>) -> bool {
    let is_time = members.len() <= 2 && members.keys().all(|key| key == "secs" || key == "nsecs");
    if !is_time || members.is_empty() {
        return false;
    }
    for (from_ros_1, of_ros_2) in [("secs", "sec"), ("nsecs", "nanosec")] {
        if let Some(value) = members.remove(from_ros_1) {
            members.insert(of_ros_2.to_owned(), value);
        }
    }
    true
}

#[derive(Deserialize)]
struct WithHeader<'a> {
    #[serde(borrow)]
    header: Option<&'a RawValue>,
}

#[derive(Deserialize)]
struct WithStamp<'a> {
    #[serde(borrow)]
    stamp: Option<&'a RawValue>,
}

fn has_stamp(raw: &str) -> bool {
    let header = serde_json::from_str::<WithHeader<'_>>(raw).ok().and_then(|headed| headed.header);
    let stamped = header.and_then(|header| serde_json::from_str::<WithStamp<'_>>(header.get()).ok());
    stamped.is_some_and(|stamped| stamped.stamp.is_some())
}

fn stamp(value: &mut Value, now: Duration) {
    let Value::Record(members) = value else { return };
    let Some((_, Value::Record(header))) = members.first_mut() else { return };
    let Some((_, stamp)) = header.iter_mut().find(|(name, _)| &**name == "stamp") else { return };
    *stamp = Value::Record(vec![
        (Arc::from("sec"), Value::Int(now.as_secs().try_into().unwrap_or(i64::MAX))),
        (Arc::from("nanosec"), Value::Uint(now.subsec_nanos().into())),
    ]);
}

/// Returns this host's time since the Unix epoch.
pub(super) fn now() -> Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::definitions::{ShippedDefinitions, Types};

    fn layout(name: &str) -> Arc<Layout> {
        Types::new(ShippedDefinitions).layout(name, None).unwrap()
    }

    #[test]
    fn times_of_ros_1_are_taken() {
        let layout = layout("geometry_msgs/msg/PointStamped");
        let raw = r#"{"header":{"stamp":{"secs":3,"nsecs":4},"frame_id":"base"}}"#;
        let read = message(&layout, raw).unwrap();
        assert_eq!(read.at("header.stamp.sec"), Some(Value::Int(3)));
        assert_eq!(read.at("header.stamp.nanosec"), Some(Value::Uint(4)));
        // A text with very many values is not converted.
        let many = format!(r#"{{"secs":3,"a":[0{}]}}"#, ",0".repeat(VALUES_MAX));
        assert_eq!((from_ros_1(&many), from_ros_1(r#"{"secs":3}"#)), (None, Some(r#"{"sec":3}"#.to_owned())));
        // A member that only looks like a time stays wrong.
        let wrong = message(&layout, r#"{"point":{"secs":1,"x":2}}"#).unwrap_err();
        assert_eq!(wrong.to_string(), "not a message of that type: point: there is no member \"secs\"");
    }

    #[test]
    fn stamps_that_are_left_out_are_now() {
        let layout = layout("geometry_msgs/msg/PointStamped");
        let sec = |raw: &str| match message(&layout, raw).unwrap().at("header.stamp.sec") {
            Some(Value::Int(sec)) => sec,
            other => panic!("{other:?}"),
        };
        let begun = now().as_secs().cast_signed();
        for raw in [
            "{}",
            r#"{"header":{}}"#,
            r#"{"header":{"frame_id":"base","stamp":null}}"#,
            r#"{"point":{"x":1}}"#,
        ] {
            assert!((begun..begun + 60).contains(&sec(raw)), "{raw}");
        }
        assert_eq!(sec(r#"{"header":{"stamp":{}}}"#), 0);
        assert_eq!(sec(r#"{"header":{"stamp":{"sec":0,"nanosec":0}}}"#), 0);
    }

    #[test]
    fn arguments_may_be_a_list() {
        let layout = || Ok(layout("std_srvs/srv/SetBool_Request"));
        let read = |raw| arguments(raw, layout).unwrap();
        assert_eq!(read(None), "{}");
        assert_eq!(read(Some("[]")), "{}");
        assert_eq!(read(Some(r#"{"data":true}"#)), r#"{"data":true}"#);
        assert_eq!(read(Some("[true]")), r#"{"data":true}"#);
        assert_eq!(read(Some("[true, 3]")), r#"{"data":true,"[1]":3}"#);
        assert_eq!(read(Some("[ ]")), "{}");
        // Many surplus arguments take no memory.
        let many = format!("[true{}]", ",3".repeat(100_000));
        assert_eq!(read(Some(many.as_str())), r#"{"data":true,"[1]":3}"#);
    }
}
