//! The stage that gives a message the form in which it travels: converts it to JSON, prepends the hash of its key, and
//! compresses it, as configured.
//!
//! [`crate::data::conversion`] converts, and `sgc-endpoint` compresses. The stage in front of this one holds messages
//! whose type may still become known ([`EncodeStage::awaits_type`]).

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst};

use bytes::Bytes;
use sgc_endpoint::Compressor;
use sgc_ros::{KeyHash, SampleKind};
use sgc_sync::lock;
use sgc_wire::{Name, PayloadEncoding, PayloadForm};
use tracing::debug;

use crate::data::conversion::{self, KnownType, TypeSlot};
use crate::data::stats::{DataDrop, Dropped};

/// Converts and compresses the messages of one name.
pub(crate) struct EncodeStage {
    name: Name,
    /// Whether messages leave as JSON.
    is_json: AtomicBool,
    /// Whether compression is configured, readable without the lock.
    is_compressed: AtomicBool,
    types: TypeSlot,
    compression: Mutex<(PayloadEncoding, Compressor)>,
    bytes_before: AtomicU64,
    bytes_after: AtomicU64,
}

impl EncodeStage {
    /// Creates a stage that changes no message.
    pub(crate) fn new(name: Name) -> Self {
        Self {
            name,
            is_json: AtomicBool::new(false),
            is_compressed: AtomicBool::new(false),
            types: TypeSlot::default(),
            compression: Mutex::default(),
            bytes_before: AtomicU64::new(0),
            bytes_after: AtomicU64::new(0),
        }
    }

    /// Sets compression and form. Returns `true` if messages left as JSON before.
    pub(crate) fn configure(&self, compression: PayloadEncoding, form: PayloadForm) -> bool {
        lock(&self.compression).0 = compression;
        self.is_compressed.store(compression != PayloadEncoding::Plain, SeqCst);
        self.is_json.swap(form == PayloadForm::Json, SeqCst)
    }

    /// Returns `true` if messages are converted or compressed, which takes time.
    pub(crate) fn is_active(&self) -> bool {
        self.is_json() || self.is_compressed.load(Relaxed)
    }

    /// Returns `true` if messages leave as JSON.
    pub(crate) fn is_json(&self) -> bool {
        self.is_json.load(Relaxed)
    }

    /// Sets the state of the type.
    pub(crate) fn set_type(&self, known: KnownType) {
        self.types.set(known);
    }

    /// Returns `true` if messages leave as JSON and their type may still become known.
    pub(crate) fn awaits_type(&self) -> bool {
        self.is_json() && self.types.now().is_awaited()
    }

    /// Returns `true` if messages have to leave as JSON and their type is unknown.
    pub(crate) fn lacks_definition(&self) -> bool {
        self.is_json() && self.types.now().is_lacking()
    }

    /// Converts and compresses a payload.
    pub(crate) fn encode(
        &self,
        kind: SampleKind,
        key_hash: Option<KeyHash>,
        payload: Bytes,
    ) -> Result<EncodedPayload, Dropped> {
        let is_data = kind == SampleKind::Write;
        if is_data && self.is_json() {
            let payload = self.convert(&payload)?;
            return Ok(self.compress(PayloadForm::Json, payload));
        }
        let (form, payload) = match key_hash {
            None => (PayloadForm::Cdr, payload),
            Some(hash) => (PayloadForm::KeyedCdr, [&hash[..], &payload].concat().into()),
        };
        if !is_data {
            return Ok(EncodedPayload { form, encoding: PayloadEncoding::Plain, payload });
        }
        Ok(self.compress(form, payload))
    }

    fn convert(&self, payload: &Bytes) -> Result<Bytes, Dropped> {
        let known = self.types.now();
        let layout = known.layout().ok_or(Dropped::one(DataDrop::NoDefinition))?;
        conversion::to_json(layout, payload).map_err(|error| {
            debug!(name = %self.name.short(), %error, "a message is not sent");
            Dropped::one(DataDrop::NotConverted)
        })
    }

    fn compress(&self, form: PayloadForm, payload: Bytes) -> EncodedPayload {
        let plain = PayloadEncoding::Plain;
        if !self.is_compressed.load(Relaxed) {
            return EncodedPayload { form, encoding: plain, payload };
        }
        let mut compression = lock(&self.compression);
        let (encoding, compressor) = &mut *compression;
        if *encoding == plain {
            return EncodedPayload { form, encoding: plain, payload };
        }
        let packed = compressor.compress(*encoding, &payload);
        let encoding = if packed.is_some() { *encoding } else { plain };
        drop(compression);
        self.bytes_before.fetch_add(payload.len() as u64, Relaxed);
        let payload = packed.unwrap_or(payload);
        self.bytes_after.fetch_add(payload.len() as u64, Relaxed);
        EncodedPayload { form, encoding, payload }
    }

    /// Returns the bytes before and after compression; `None` before the first message.
    pub(crate) fn compressed(&self) -> Option<(u64, u64)> {
        let before = self.bytes_before.load(Relaxed);
        (before > 0).then(|| (before, self.bytes_after.load(Relaxed)))
    }
}

/// A payload as it travels.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct EncodedPayload {
    /// Its form before compression.
    pub form: PayloadForm,
    /// Its compression.
    pub encoding: PayloadEncoding,
    /// The bytes.
    pub payload: Bytes,
}

impl EncodedPayload {
    /// Returns a payload that does not travel: the source only numbers the message.
    pub(crate) fn unchanged(payload: Bytes) -> Self {
        Self { form: PayloadForm::Cdr, encoding: PayloadEncoding::Plain, payload }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{NAME, text_type};

    const PLAIN: PayloadEncoding = PayloadEncoding::Plain;
    const WRITE: SampleKind = SampleKind::Write;
    const HASH: KeyHash = [9; 16];

    fn encoded(
        stage: &EncodeStage,
        kind: SampleKind,
        key_hash: Option<KeyHash>,
        payload: &Bytes,
    ) -> (PayloadForm, PayloadEncoding, Bytes) {
        let encoded = stage.encode(kind, key_hash, payload.clone()).unwrap();
        (encoded.form, encoded.encoding, encoded.payload)
    }

    #[test]
    fn payload_without_a_key_is_sent_in_the_memory_it_came_in() {
        let (stage, payload) = (EncodeStage::new(NAME), Bytes::from(vec![7; 100]));
        assert!(!stage.is_active());
        for kind in [WRITE, SampleKind::Dispose] {
            let (form, encoding, sent) = encoded(&stage, kind, None, &payload);
            assert_eq!((form, encoding, sent.as_ptr()), (PayloadForm::Cdr, PLAIN, payload.as_ptr()));
            let (form, encoding, sent) = encoded(&stage, kind, Some(HASH), &payload);
            assert_eq!((form, encoding), (PayloadForm::KeyedCdr, PLAIN));
            assert_eq!(sent, [&HASH[..], &payload].concat());
        }
    }

    #[test]
    fn data_is_compressed_where_that_shortens_it() {
        let stage = EncodeStage::new(NAME);
        assert!(!stage.configure(PayloadEncoding::Lz4, PayloadForm::Cdr) && stage.is_active());
        assert_eq!(stage.compressed(), None);
        let (long, short) = (Bytes::from(vec![7; 4000]), Bytes::from_static(b"\0\x01\0\0data"));
        let (form, encoding, sent) = encoded(&stage, WRITE, Some(HASH), &long);
        assert_eq!((form, encoding), (PayloadForm::KeyedCdr, PayloadEncoding::Lz4));
        let (before, after) = stage.compressed().unwrap();
        assert_eq!((before, after), (4016, sent.len() as u64));
        assert_eq!(encoded(&stage, WRITE, None, &short), (PayloadForm::Cdr, PLAIN, short.clone()));
        assert_eq!(stage.compressed(), Some((before + 8, after + 8)));
        // The end of an instance has no data.
        assert_eq!(encoded(&stage, SampleKind::Dispose, None, &long), (PayloadForm::Cdr, PLAIN, long));
        assert_eq!(stage.compressed(), Some((before + 8, after + 8)));
    }

    #[test]
    fn data_is_converted_once_its_type_is_known() {
        let (stage, (layout, payload)) = (EncodeStage::new(NAME), text_type());
        stage.configure(PLAIN, PayloadForm::Json);
        let dropped = |reason| Err(Dropped::one(reason));
        for (known, is_awaited, is_lacking) in [
            (KnownType::Awaited, true, false),
            (KnownType::Asked, true, true),
            (KnownType::Lacking, false, true),
        ] {
            stage.set_type(known);
            assert_eq!((stage.awaits_type(), stage.lacks_definition()), (is_awaited, is_lacking));
            assert_eq!(stage.encode(WRITE, None, payload.clone()), dropped(DataDrop::NoDefinition));
        }
        stage.set_type(KnownType::Known(layout));
        assert!(!stage.awaits_type() && !stage.lacks_definition());
        // JSON has the fields of the key itself.
        let (form, encoding, sent) = encoded(&stage, WRITE, Some(HASH), &payload);
        assert_eq!((form, encoding, &sent[..]), (PayloadForm::Json, PLAIN, &br#"{"a":"text"}"#[..]));
        let broken = payload.slice(..payload.len() - 3);
        assert_eq!(stage.encode(WRITE, None, broken.clone()), dropped(DataDrop::NotConverted));
        // The end of an instance is not converted.
        assert_eq!(encoded(&stage, SampleKind::Dispose, None, &broken).0, PayloadForm::Cdr);
        assert!(stage.configure(PLAIN, PayloadForm::Cdr) && !stage.is_active());
    }
}
