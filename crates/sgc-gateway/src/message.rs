//! [`Message`]: what came on a topic, written once in each form however many clients want it.

use std::sync::OnceLock;

use bytes::Bytes;
use sgc_cdr::Layout;
use sgc_ros::Guid;

use crate::aside::aside_if_long;
use crate::content::{Form, convert};
use crate::error::GatewayError;

type Written = OnceLock<Result<Bytes, GatewayError>>;

/// A message that came on a topic.
#[derive(Debug)]
pub struct Message {
    /// Its serialised form.
    pub payload: Bytes,
    /// When it was published, nanoseconds since the Unix epoch, by its publisher's clock.
    pub source_timestamp_ns: i64,
    /// When it came here, by this host's clock.
    pub received_ns: i64,
    /// Its writer on the local network, if that tells.
    pub writer: Option<Guid>,
    json: Written,
    cbor: Written,
}

impl Message {
    pub(crate) fn new(payload: Bytes, writer: Option<Guid>, source_timestamp_ns: i64) -> Self {
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let received_ns = since.map_or(0, |since| since.as_nanos().try_into().unwrap_or(i64::MAX));
        let (json, cbor) = (Written::new(), Written::new());
        Self { payload, source_timestamp_ns, received_ns, writer, json, cbor }
    }

    /// Returns the message without the forms in which it was written.
    pub(crate) fn unwritten(&self) -> Self {
        let (json, cbor) = (Written::new(), Written::new());
        let payload = self.payload.clone();
        let (source_timestamp_ns, received_ns, writer) =
            (self.source_timestamp_ns, self.received_ns, self.writer);
        Self { payload, source_timestamp_ns, received_ns, writer, json, cbor }
    }

    /// The message in a form; `layout` is of its topic's type.
    pub fn written(&self, form: Form, layout: &Layout) -> Result<Bytes, GatewayError> {
        let written = match form {
            Form::Cdr => return Ok(self.payload.clone()),
            Form::Json => &self.json,
            Form::Cbor => &self.cbor,
        };
        if let Some(written) = written.get() {
            return written.clone();
        }
        // Who wants the same meanwhile waits for it, and is to hold up nobody either.
        let make = || written.get_or_init(|| convert(layout, &self.payload, form));
        aside_if_long(self.payload.len(), make).clone()
    }
}
