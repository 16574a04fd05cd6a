//! [`Message`]: a message of a topic, converted once to each form for all clients.

use std::sync::OnceLock;

use bytes::Bytes;
use sgc_cdr::Layout;
use sgc_ros::Guid;

use crate::content::{Form, convert};
use crate::error::GatewayError;
use crate::offload::offload_if_long;

type CachedEncoding = OnceLock<Result<Bytes, GatewayError>>;

/// A message received on a topic.
#[derive(Debug)]
pub struct Message {
    /// The serialised message.
    pub payload: Bytes,
    /// The time of publication by the publisher's clock, in nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// The time of reception by this host's clock.
    pub received_ns: i64,
    /// The writer on the local network, if known.
    pub writer: Option<Guid>,
    json: CachedEncoding,
    cbor: CachedEncoding,
}

impl Message {
    pub(crate) fn new(payload: Bytes, writer: Option<Guid>, source_timestamp_ns: i64) -> Self {
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let received_ns = since.map_or(0, |since| since.as_nanos().try_into().unwrap_or(i64::MAX));
        let (json, cbor) = (CachedEncoding::new(), CachedEncoding::new());
        Self { payload, source_timestamp_ns, received_ns, writer, json, cbor }
    }

    /// Returns the message without its cached conversions.
    pub(crate) fn unwritten(&self) -> Self {
        let (json, cbor) = (CachedEncoding::new(), CachedEncoding::new());
        let payload = self.payload.clone();
        let (source_timestamp_ns, received_ns, writer) =
            (self.source_timestamp_ns, self.received_ns, self.writer);
        Self { payload, source_timestamp_ns, received_ns, writer, json, cbor }
    }

    /// Returns the message in a form. `layout` is the layout of the topic's type.
    pub fn written(&self, form: Form, layout: &Layout) -> Result<Bytes, GatewayError> {
        let written = match form {
            Form::Cdr => return Ok(self.payload.clone()),
            Form::Json => &self.json,
            Form::Cbor => &self.cbor,
        };
        if let Some(written) = written.get() {
            return written.clone();
        }
        // A second client that needs the same form waits here, and must not hold up others either.
        let make = || written.get_or_init(|| convert(layout, &self.payload, form));
        offload_if_long(self.payload.len(), make).clone()
    }
}
