//! [`Content`]: a message in the form in which a client gives or takes it.

use bytes::Bytes;
use sgc_cdr::{Encoding, Layout, Value};

use crate::aside::aside_if_long;
use crate::error::GatewayError;

/// How a message is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Form {
    /// As ROS 2 serialises it: encapsulation header and body (RTPS 2.5, 10.2).
    #[default]
    Cdr,
    /// As `docs/spec/json.md` has it.
    Json,
    /// As the same page has it.
    Cbor,
}

/// A message in one of the forms.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Content {
    /// Which.
    pub form: Form,
    /// The message.
    pub bytes: Bytes,
}

impl Content {
    /// A serialised message.
    pub fn cdr(bytes: impl Into<Bytes>) -> Self {
        Self { form: Form::Cdr, bytes: bytes.into() }
    }

    /// One in JSON.
    pub fn json(bytes: impl Into<Bytes>) -> Self {
        Self { form: Form::Json, bytes: bytes.into() }
    }

    /// One in CBOR.
    pub fn cbor(bytes: impl Into<Bytes>) -> Self {
        Self { form: Form::Cbor, bytes: bytes.into() }
    }

    /// What it says.
    pub fn value(&self, layout: &Layout) -> Result<Value, GatewayError> {
        aside_if_long(self.bytes.len(), || match self.form {
            Form::Cdr => layout.decode(&self.bytes).map_err(GatewayError::Decode),
            Form::Json => layout.from_json(&self.bytes).map_err(GatewayError::Value),
            Form::Cbor => layout.from_cbor(&self.bytes).map_err(GatewayError::Value),
        })
    }

    /// The same, serialised: what is serialised already is believed to be of its type, as it is of any ROS 2 publisher.
    pub fn to_cdr(&self, layout: &Layout) -> Result<Bytes, GatewayError> {
        match self.form {
            Form::Cdr => Ok(self.bytes.clone()),
            _ => aside_if_long(self.bytes.len(), || serialise(layout, &self.value(layout)?)),
        }
    }
}

/// A value, serialised as ROS 2 does by default.
pub(crate) fn serialise(layout: &Layout, value: &Value) -> Result<Bytes, GatewayError> {
    let bytes = layout.encode_as(value, Encoding::default()).map_err(GatewayError::Value)?;
    Ok(bytes.into())
}

/// A value in a form; `layout` is of its type.
pub(crate) fn write(layout: &Layout, value: &Value, form: Form) -> Result<Bytes, GatewayError> {
    Ok(match form {
        Form::Cdr => serialise(layout, value)?,
        Form::Json => value.to_json().into(),
        Form::Cbor => value.to_cbor().into(),
    })
}

/// A serialised message in a form.
pub(crate) fn convert(layout: &Layout, payload: &Bytes, form: Form) -> Result<Bytes, GatewayError> {
    match form {
        Form::Cdr => Ok(payload.clone()),
        _ => aside_if_long(payload.len(), || {
            write(layout, &layout.decode(payload).map_err(GatewayError::Decode)?, form)
        }),
    }
}
