//! Messages that travel as JSON: CDR becomes JSON before sealing, and JSON becomes CDR after opening.
//!
//! Both directions need the type, which may become known after the first message. Until then the ends of the topic hold
//! the messages (`pending.rs`). `sgc-cdr` defines the JSON (docs/spec/json.md).

use std::sync::{Arc, Mutex, MutexGuard};

use bytes::Bytes;
use sgc_cdr::{CdrVersion, DecodeError, Encoding, Layout, ValueError};
use sgc_sync::lock;
use sgc_wire::Representations;

/// State of the search for a type.
#[derive(Clone, Debug, Default)]
pub(crate) enum KnownType {
    /// The search is under way.
    #[default]
    Awaited,
    /// There is no local definition. The owner is asked and may not know the type either.
    Asked,
    /// The type is known.
    Known(Arc<Layout>),
    /// There is no local definition, and no node is asked.
    Lacking,
}

impl KnownType {
    /// Returns the layout of a known type.
    pub(crate) fn layout(&self) -> Option<&Arc<Layout>> {
        match self {
            Self::Known(layout) => Some(layout),
            Self::Awaited | Self::Asked | Self::Lacking => None,
        }
    }

    /// Returns `true` if the type may still become known.
    pub(crate) fn is_awaited(&self) -> bool {
        matches!(self, Self::Awaited | Self::Asked)
    }

    /// Returns `true` if the type is unknown and stays so.
    pub(crate) fn is_lacking(&self) -> bool {
        matches!(self, Self::Asked | Self::Lacking)
    }
}

/// State of the type of an interface at its end on this node.
#[derive(Debug, Default)]
pub(crate) struct TypeSlot(Mutex<KnownType>);

impl TypeSlot {
    /// Sets the state.
    pub(crate) fn set(&self, known: KnownType) {
        *self.lock() = known;
    }

    /// Returns the state.
    pub(crate) fn now(&self) -> KnownType {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, KnownType> {
        lock(&self.0)
    }
}

/// Reasons why a message was not converted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ConversionError {
    /// A local publisher wrote bytes that do not match the type.
    #[error("the message is not what its type says: {0}")]
    FromCdr(#[from] DecodeError),
    /// The received text is no JSON of the type.
    #[error("the JSON is none of the type: {0}")]
    FromJson(#[from] ValueError),
}

/// Converts a CDR payload to JSON.
pub(crate) fn to_json(layout: &Layout, payload: &Bytes) -> Result<Bytes, ConversionError> {
    Ok(layout.decode(payload)?.to_json().into())
}

/// Converts JSON to a CDR payload in a representation that the writer offers.
pub(crate) fn from_json(
    layout: &Layout,
    json: &[u8],
    offered: Representations,
) -> Result<Bytes, ConversionError> {
    let version = if Representations::XCDR1.meets(offered) { CdrVersion::One } else { CdrVersion::Two };
    let value = layout.from_json(json)?;
    Ok(layout.encode_as(&value, Encoding { version, ..Encoding::default() })?.into())
}

#[cfg(test)]
mod tests {
    use sgc_cdr::Library;

    use super::*;

    fn layout() -> Layout {
        let mut text = |_: &sgc_cdr::TypeName| Some("string a\nfloat64 b".to_owned());
        Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut text).unwrap()
    }

    #[test]
    fn a_message_comes_back_in_the_representation_of_the_writer() {
        let layout = layout();
        let cdr = |version, text: &str| -> Bytes {
            let value = layout.from_json(text.as_bytes()).unwrap();
            layout.encode_as(&value, Encoding { version, ..Encoding::default() }).unwrap().into()
        };
        let text = r#"{"a":"é","b":"NaN"}"#;
        let (one, two) = (cdr(CdrVersion::One, text), cdr(CdrVersion::Two, text));
        assert_ne!(one, two);
        for written in [&one, &two] {
            let json = to_json(&layout, written).unwrap();
            assert_eq!(json, text);
            for (offered, expected) in [
                (Representations::XCDR1, &one),
                (Representations::BOTH, &one),
                (Representations::XCDR2, &two),
            ] {
                assert_eq!(&from_json(&layout, &json, offered).unwrap(), expected, "{offered:?}");
            }
        }
    }

    #[test]
    fn message_that_does_not_match_its_type_is_refused() {
        let layout = layout();
        let cut = to_json(&layout, &Bytes::from_static(b"\0\x01\0\0\x09\0\0\0abc")).unwrap_err();
        assert!(matches!(cut, ConversionError::FromCdr(_)), "{cut}");
        for json in [&b"{\"c\": 1}"[..], b"{", b"[]", b"\0\x01\0\0"] {
            let refused = from_json(&layout, json, Representations::XCDR1).unwrap_err();
            assert!(matches!(refused, ConversionError::FromJson(_)), "{refused}");
        }
    }
}
