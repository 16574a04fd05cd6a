//! [`Content`]: a message in the form that a client sends or receives.

use bytes::Bytes;
use sgc_cdr::{Encoding, Layout, Value};

use crate::error::GatewayError;
use crate::offload::offload_if_long;

/// The form of a message.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Form {
    /// The serialisation of ROS 2: encapsulation header and body (RTPS 2.5, 10.2).
    #[default]
    Cdr,
    /// JSON as in `docs/spec/json.md`.
    Json,
    /// CBOR as in `docs/spec/json.md`.
    Cbor,
}

/// A message in one of the forms.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Content {
    /// The form.
    pub form: Form,
    /// The message.
    pub bytes: Bytes,
}

impl Content {
    /// Creates content from a serialised message.
    pub fn cdr(bytes: impl Into<Bytes>) -> Self {
        Self { form: Form::Cdr, bytes: bytes.into() }
    }

    /// Creates content from JSON.
    pub fn json(bytes: impl Into<Bytes>) -> Self {
        Self { form: Form::Json, bytes: bytes.into() }
    }

    /// Creates content from CBOR.
    pub fn cbor(bytes: impl Into<Bytes>) -> Self {
        Self { form: Form::Cbor, bytes: bytes.into() }
    }

    /// Decodes the message.
    pub fn value(&self, layout: &Layout) -> Result<Value, GatewayError> {
        offload_if_long(self.bytes.len(), || match self.form {
            Form::Cdr => layout.decode(&self.bytes).map_err(GatewayError::Decode),
            Form::Json => layout.from_json(&self.bytes).map_err(GatewayError::Value),
            Form::Cbor => layout.from_cbor(&self.bytes).map_err(GatewayError::Value),
        })
    }

    /// Serialises the message. A message in CDR is passed on unchecked, like that of any ROS 2 publisher.
    pub fn to_cdr(&self, layout: &Layout) -> Result<Bytes, GatewayError> {
        match self.form {
            Form::Cdr => Ok(self.bytes.clone()),
            _ => offload_if_long(self.bytes.len(), || serialise(layout, &self.value(layout)?)),
        }
    }
}

/// Serialises a value in the default encoding of ROS 2.
pub(crate) fn serialise(layout: &Layout, value: &Value) -> Result<Bytes, GatewayError> {
    let bytes = layout.encode_as(value, Encoding::default()).map_err(GatewayError::Value)?;
    Ok(bytes.into())
}

/// Converts a value to a form. `layout` is the layout of its type.
pub(crate) fn write(layout: &Layout, value: &Value, form: Form) -> Result<Bytes, GatewayError> {
    Ok(match form {
        Form::Cdr => serialise(layout, value)?,
        Form::Json => value.to_json().into(),
        Form::Cbor => value.to_cbor().into(),
    })
}

/// Converts a serialised message to a form.
pub(crate) fn convert(layout: &Layout, payload: &Bytes, form: Form) -> Result<Bytes, GatewayError> {
    match form {
        Form::Cdr => Ok(payload.clone()),
        _ => offload_if_long(payload.len(), || {
            write(layout, &layout.decode(payload).map_err(GatewayError::Decode)?, form)
        }),
    }
}
