//! The messages of the Foxglove WebSocket protocol, version 1: JSON texts with an `op`, and binary messages with an
//! opcode, little endian. This module knows no socket and no topic.

use bytes::{BufMut, Bytes, BytesMut};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Longest accepted text, in bytes. Long data travels in binary messages.
const TEXT_BYTES_MAX: usize = 1 << 20;
/// Longest name of a parameter, in bytes.
const PARAMETER_NAME_BYTES_MAX: usize = 1024;
/// Opcodes of binary messages from the server.
const MESSAGE_DATA: u8 = 1;
const SERVICE_CALL_RESPONSE: u8 = 3;
const FETCH_ASSET_RESPONSE: u8 = 4;
/// Opcodes of binary messages from clients.
const CLIENT_MESSAGE_DATA: u8 = 1;
const SERVICE_CALL_REQUEST: u8 = 2;
/// The status of an answer without an asset.
const ASSET_ERROR: u8 = 1;

/// The reason why a client's message is invalid.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum ProtocolError {
    /// The text is not a message of the protocol.
    #[error("not a message of this protocol: {0}")]
    Json(String),
    /// The text is too long.
    #[error("a text of {bytes} bytes: at most {TEXT_BYTES_MAX}")]
    TooLong {
        /// The length in bytes.
        bytes: usize,
    },
    /// The name of a parameter is too long.
    #[error("the name of a parameter has {bytes} bytes: at most {PARAMETER_NAME_BYTES_MAX}")]
    ParameterName {
        /// The length in bytes.
        bytes: usize,
    },
    /// The opcode is unknown.
    #[error(
        "no binary message has opcode {0}: clients send {CLIENT_MESSAGE_DATA} (a message) and {SERVICE_CALL_REQUEST} (a call)"
    )]
    Opcode(u8),
    /// The binary message is truncated.
    #[error("a binary message of {bytes} bytes, which says that there are more")]
    TooShort {
        /// The length in bytes.
        bytes: usize,
    },
    /// The name of an encoding is not UTF-8.
    #[error("the name of an encoding is not UTF-8")]
    Encoding,
}

/// A request in a text message of a client.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(super) enum Command {
    Subscribe { subscriptions: Vec<SubscribeRequest> },
    Unsubscribe { subscription_ids: Vec<u32> },
    Advertise { channels: Vec<ClientChannel> },
    Unadvertise { channel_ids: Vec<u32> },
    GetParameters { parameter_names: Vec<String>, id: Option<String> },
    SetParameters { parameters: Vec<Parameter>, id: Option<String> },
    SubscribeParameterUpdates { parameter_names: Vec<String> },
    UnsubscribeParameterUpdates { parameter_names: Vec<String> },
    SubscribeConnectionGraph,
    UnsubscribeConnectionGraph,
    FetchAsset { uri: String, request_id: u32 },
}

impl Command {
    /// Returns the parameter names in the request.
    fn parameter_names(&self) -> impl Iterator<Item = &str> {
        let (names, parameters): (&[String], &[Parameter]) = match self {
            Self::GetParameters { parameter_names, .. }
            | Self::SubscribeParameterUpdates { parameter_names }
            | Self::UnsubscribeParameterUpdates { parameter_names } => (parameter_names, &[]),
            Self::SetParameters { parameters, .. } => (&[], parameters),
            _ => (&[], &[]),
        };
        names.iter().map(String::as_str).chain(parameters.iter().map(|parameter| parameter.name.as_str()))
    }
}

/// A requested subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SubscribeRequest {
    pub(super) id: u32,
    pub(super) channel_id: u32,
}

/// A channel on which a client will publish.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct ClientChannel {
    pub(super) id: u32,
    pub(super) topic: String,
    pub(super) encoding: String,
    pub(super) schema_name: String,
}

/// A parameter, in either direction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Parameter {
    pub(super) name: String,
    /// The value; `None` if the parameter is not set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) value: Option<Value>,
    /// The type, where JSON leaves it open.
    #[serde(rename = "type", default, skip_serializing_if = "Option::is_none")]
    pub(super) kind: Option<ParameterKind>,
}

/// The types of parameters that JSON does not distinguish.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum ParameterKind {
    /// Bytes as text in base64.
    ByteArray,
    /// A number, with or without a fraction.
    Float64,
    /// Numbers, with or without fractions.
    Float64Array,
}

/// A binary message from a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum BinaryMessage {
    Message { channel: u32, payload: Bytes },
    Call { service: u32, call: u32, encoding: String, payload: Bytes },
}

/// A text message from the server.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(super) enum ServerMessage<'a> {
    ServerInfo {
        name: &'a str,
        capabilities: &'a [&'static str],
        supported_encodings: &'a [&'static str],
        metadata: Metadata<'a>,
        session_id: &'a str,
    },
    Status {
        level: u8,
        message: &'a str,
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<&'a str>,
    },
    RemoveStatus {
        status_ids: &'a [&'a str],
    },
    Advertise {
        channels: &'a [Channel],
    },
    Unadvertise {
        channel_ids: &'a [u32],
    },
    AdvertiseServices {
        services: &'a [Service],
    },
    UnadvertiseServices {
        service_ids: &'a [u32],
    },
    ParameterValues {
        parameters: &'a [Parameter],
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<&'a str>,
    },
    ConnectionGraphUpdate {
        published_topics: &'a [Publishers],
        subscribed_topics: &'a [Subscribers],
        advertised_services: &'a [Providers],
        removed_topics: &'a [String],
        removed_services: &'a [String],
    },
    ServiceCallFailure {
        service_id: u32,
        call_id: u32,
        message: &'a str,
    },
}

impl ServerMessage<'_> {
    pub(super) fn to_json(&self) -> String {
        // Serialisation cannot fail, because all keys are strings.
        serde_json::to_string(self).unwrap_or_default()
    }
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Metadata<'a> {
    #[serde(rename = "ROS_DISTRO")]
    pub(super) ros_distro: &'a str,
}

/// A channel: a topic that clients may subscribe to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Channel {
    pub(super) id: u32,
    pub(super) topic: String,
    pub(super) encoding: &'static str,
    pub(super) schema_name: String,
    pub(super) schema: String,
    pub(super) schema_encoding: &'static str,
}

/// A service that clients may call.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Service {
    pub(super) id: u32,
    pub(super) name: String,
    #[serde(rename = "type")]
    pub(super) type_name: String,
    pub(super) request: Half,
    pub(super) response: Half,
}

/// The schema of a request or reply.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Half {
    pub(super) encoding: &'static str,
    pub(super) schema_name: String,
    pub(super) schema_encoding: &'static str,
    pub(super) schema: String,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Publishers {
    pub(super) name: String,
    pub(super) publisher_ids: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Subscribers {
    pub(super) name: String,
    pub(super) subscriber_ids: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Providers {
    pub(super) name: String,
    pub(super) provider_ids: Vec<String>,
}

/// Parses a text.
pub(super) fn read_text(text: &str) -> Result<Command, ProtocolError> {
    if text.len() > TEXT_BYTES_MAX {
        return Err(ProtocolError::TooLong { bytes: text.len() });
    }
    let command: Command =
        serde_json::from_str(text).map_err(|error| ProtocolError::Json(error.to_string()))?;
    let too_long = command.parameter_names().map(str::len).find(|bytes| *bytes > PARAMETER_NAME_BYTES_MAX);
    match too_long {
        Some(bytes) => Err(ProtocolError::ParameterName { bytes }),
        None => Ok(command),
    }
}

/// Parses a binary message without copying its payload.
pub(super) fn read_binary(mut bytes: Bytes) -> Result<BinaryMessage, ProtocolError> {
    let length = bytes.len();
    let too_short = ProtocolError::TooShort { bytes: length };
    let mut take = |count: usize| {
        if bytes.len() < count { Err(too_short.clone()) } else { Ok(bytes.split_to(count)) }
    };
    let opcode = take(1)?;
    let mut word = || {
        let word = take(4)?;
        word.as_ref().try_into().map(u32::from_le_bytes).map_err(|_| too_short.clone())
    };
    match opcode.first().copied() {
        Some(CLIENT_MESSAGE_DATA) => Ok(BinaryMessage::Message { channel: word()?, payload: bytes }),
        Some(SERVICE_CALL_REQUEST) => {
            let (service, call, length) = (word()?, word()?, word()?);
            let encoding = take(usize::try_from(length).unwrap_or(usize::MAX))?;
            let encoding = String::from_utf8(encoding.into()).map_err(|_| ProtocolError::Encoding)?;
            Ok(BinaryMessage::Call { service, call, encoding, payload: bytes })
        }
        Some(other) => Err(ProtocolError::Opcode(other)),
        None => Err(too_short),
    }
}

/// Encodes a message for a subscription. `received_ns` is in nanoseconds since the Unix epoch.
pub(super) fn message_data(subscription: u32, received_ns: i64, payload: &[u8]) -> Bytes {
    let mut bytes = BytesMut::with_capacity(13 + payload.len());
    bytes.put_u8(MESSAGE_DATA);
    bytes.put_u32_le(subscription);
    bytes.put_u64_le(u64::try_from(received_ns).unwrap_or(0));
    bytes.put_slice(payload);
    bytes.freeze()
}

/// Encodes the reply to a call, in the encoding of the call.
pub(super) fn service_call_response(service: u32, call: u32, encoding: &str, payload: &[u8]) -> Bytes {
    let mut bytes = BytesMut::with_capacity(13 + encoding.len() + payload.len());
    bytes.put_u8(SERVICE_CALL_RESPONSE);
    bytes.put_u32_le(service);
    bytes.put_u32_le(call);
    bytes.put_u32_le(u32::try_from(encoding.len()).unwrap_or(0));
    bytes.put_slice(encoding.as_bytes());
    bytes.put_slice(payload);
    bytes.freeze()
}

/// Encodes the refusal of an asset.
pub(super) fn asset_refusal(request: u32, message: &str) -> Bytes {
    let mut bytes = BytesMut::with_capacity(10 + message.len());
    bytes.put_u8(FETCH_ASSET_RESPONSE);
    bytes.put_u32_le(request);
    bytes.put_u8(ASSET_ERROR);
    bytes.put_u32_le(u32::try_from(message.len()).unwrap_or(0));
    bytes.put_slice(message.as_bytes());
    bytes.freeze()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_read_as_clients_send_them() {
        let read = |text: &str| read_text(text).unwrap();
        assert_eq!(
            read(r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":7}]}"#),
            Command::Subscribe { subscriptions: vec![SubscribeRequest { id: 0, channel_id: 7 }] }
        );
        assert_eq!(
            read(r#"{"op":"getParameters","parameterNames":[]}"#),
            Command::GetParameters { parameter_names: Vec::new(), id: None }
        );
        let Command::SetParameters { parameters, .. } = read(
            r#"{"op":"setParameters","parameters":[{"name":"/n.a","value":3,"type":"float64"},{"name":"/n.b"}]}"#,
        ) else {
            panic!("it should set parameters");
        };
        assert_eq!((parameters[0].kind, &parameters[1].value), (Some(ParameterKind::Float64), &None));
        assert_eq!(read(r#"{"op":"subscribeConnectionGraph","more":1}"#), Command::SubscribeConnectionGraph);
        for wrong in
            ["", "{", "[]", "{}", r#"{"op":"fly"}"#, r#"{"op":"unsubscribe","subscriptionIds":[-1]}"#]
        {
            assert!(matches!(read_text(wrong), Err(ProtocolError::Json(_))), "{wrong}");
        }
    }

    #[test]
    fn texts_and_names_are_no_longer_than_they_may_be() {
        let set = |name: &str| format!(r#"{{"op":"setParameters","parameters":[{{"name":"{name}"}}]}}"#);
        let get = |name: &str| format!(r#"{{"op":"getParameters","parameterNames":["/n.a","{name}"]}}"#);
        let (fits, long) = ("a".repeat(PARAMETER_NAME_BYTES_MAX), "a".repeat(PARAMETER_NAME_BYTES_MAX + 1));
        for (fits, long) in [(set(&fits), set(&long)), (get(&fits), get(&long))] {
            assert!(read_text(&fits).is_ok());
            assert_eq!(read_text(&long), Err(ProtocolError::ParameterName { bytes: 1025 }));
        }
        let mut fits = set("/n.a");
        fits.push_str(&" ".repeat(TEXT_BYTES_MAX - fits.len()));
        assert!(read_text(&fits).is_ok());
        let long = ProtocolError::TooLong { bytes: TEXT_BYTES_MAX + 1 };
        assert_eq!(read_text(&format!("{fits} ")), Err(long));
    }

    #[test]
    fn binary_messages_are_read_to_their_last_byte() {
        let read = |bytes: &[u8]| read_binary(Bytes::copy_from_slice(bytes));
        assert_eq!(
            read(&[1, 2, 0, 0, 0, 9, 9]).unwrap(),
            BinaryMessage::Message { channel: 2, payload: vec![9, 9].into() }
        );
        let call = [2, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, b'c', b'd', b'r', 5];
        assert_eq!(
            read(&call).unwrap(),
            BinaryMessage::Call { service: 1, call: 2, encoding: "cdr".into(), payload: vec![5].into() }
        );
        for end in 0..call.len() - 1 {
            assert_eq!(read(&call[..end]), Err(ProtocolError::TooShort { bytes: end }));
        }
        let mut lies = call;
        lies[9..13].fill(255);
        assert!(matches!(read(&lies), Err(ProtocolError::TooShort { .. })));
        assert_eq!(read(&[7]), Err(ProtocolError::Opcode(7)));
        assert_eq!(read(&[2, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 255]), Err(ProtocolError::Encoding));
    }

    #[test]
    fn messages_are_encoded_as_specified() {
        let status = ServerMessage::Status { level: 1, message: "slow", id: Some("dropped:/a") };
        assert_eq!(status.to_json(), r#"{"op":"status","level":1,"message":"slow","id":"dropped:/a"}"#);
        let gone = ServerMessage::Unadvertise { channel_ids: &[1, 2] };
        assert_eq!(gone.to_json(), r#"{"op":"unadvertise","channelIds":[1,2]}"#);
        assert_eq!(message_data(1, 2, &[3])[..], [1, 1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 3]);
        assert_eq!(
            service_call_response(1, 2, "a", &[3])[..],
            [3, 1, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, b'a', 3]
        );
        assert_eq!(asset_refusal(1, "n")[..], [4, 1, 0, 0, 0, 1, 1, 0, 0, 0, b'n']);
    }
}
