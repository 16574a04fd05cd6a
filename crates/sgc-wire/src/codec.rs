//! The bounded codec: big-endian integers, length-prefixed bytes, no back references.
//!
//! A [`Reader`] never indexes past its input, takes an explicit bound for every length, and treats left-over bytes as
//! an error. A [`Writer`] only appends. The types that implement [`Encode`] and [`Decode`] give the bytes their
//! meaning.

use bytes::Bytes;

/// Reads a value from bounded input.
pub trait Decode: Sized {
    /// Decodes one value and leaves the reader behind it.
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError>;

    /// Decodes exactly `input`: left-over bytes are an error.
    fn from_slice(input: &[u8]) -> Result<Self, DecodeError> {
        let mut r = Reader::new(input);
        let value = Self::decode(&mut r)?;
        r.finish()?;
        Ok(value)
    }
}

/// Appends a value to a [`Writer`].
pub trait Encode {
    /// Appends the one canonical encoding of the value.
    fn encode(&self, w: &mut Writer);

    /// Returns the encoding on its own.
    fn to_vec(&self) -> Vec<u8> {
        let mut w = Writer::default();
        self.encode(&mut w);
        w.into_vec()
    }

    /// Returns the encoding on its own, shareable.
    fn to_bytes(&self) -> Bytes {
        Bytes::from(self.to_vec())
    }
}

/// The reason why bytes are not a value. The input is then dropped and counted, never guessed at.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The input ends inside a field.
    #[error("input ends inside {field}: {missing} bytes missing")]
    Truncated {
        /// The field.
        field: &'static str,
        /// Number of missing bytes.
        missing: usize,
    },
    /// Bytes follow the value.
    #[error("{extra} bytes follow the value")]
    Trailing {
        /// Their number.
        extra: usize,
    },
    /// A length or count exceeds its bound.
    #[error("{field} is {value} long, at most {max} allowed")]
    TooLong {
        /// The field.
        field: &'static str,
        /// The claimed value.
        value: usize,
        /// The bound.
        max: usize,
    },
    /// A value that the field cannot have.
    #[error("{field} cannot be {value}")]
    Value {
        /// The field.
        field: &'static str,
        /// The value.
        value: u64,
    },
    /// Text that is not UTF-8.
    #[error("{field} is not UTF-8")]
    Utf8 {
        /// The field.
        field: &'static str,
    },
    /// A format version that this build does not speak.
    #[error("version {found} of {what} is unknown here, {known} is")]
    Version {
        /// The kind of data.
        what: &'static str,
        /// The version found.
        found: u16,
        /// The version known.
        known: u16,
    },
    /// A packet under a label that the link has not given to a name.
    #[error("label {label} stands for no name on this link")]
    UnknownLabel {
        /// The label.
        label: u32,
    },
}

impl DecodeError {
    /// Returns the error of a field with a value out of its range.
    pub fn value(field: &'static str, value: u64) -> Self {
        Self::Value { field, value }
    }
}

/// A cursor over input from the network.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    /// Reads from the start of `input`.
    pub fn new(input: &'a [u8]) -> Self {
        Self { rest: input }
    }

    /// Takes `n` bytes.
    pub fn take(&mut self, field: &'static str, n: usize) -> Result<&'a [u8], DecodeError> {
        match self.rest.split_at_checked(n) {
            Some((head, tail)) => {
                self.rest = tail;
                Ok(head)
            }
            None => Err(DecodeError::Truncated { field, missing: n - self.rest.len() }),
        }
    }

    /// Takes an array.
    pub fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], DecodeError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(field, N)?);
        Ok(out)
    }

    /// Takes one byte.
    pub fn u8(&mut self) -> Result<u8, DecodeError> {
        Ok(self.array::<1>("integer")?[0])
    }

    /// Takes a boolean; only 0 and 1 are legal.
    pub fn bool(&mut self, field: &'static str) -> Result<bool, DecodeError> {
        match self.u8()? {
            0 => Ok(false),
            1 => Ok(true),
            v => Err(DecodeError::value(field, v.into())),
        }
    }

    /// Takes a 16-bit integer.
    pub fn u16(&mut self) -> Result<u16, DecodeError> {
        Ok(u16::from_be_bytes(self.array("integer")?))
    }

    /// Takes a 32-bit integer.
    pub fn u32(&mut self) -> Result<u32, DecodeError> {
        Ok(u32::from_be_bytes(self.array("integer")?))
    }

    /// Takes a 64-bit integer.
    pub fn u64(&mut self) -> Result<u64, DecodeError> {
        Ok(u64::from_be_bytes(self.array("integer")?))
    }

    /// Takes length-prefixed bytes of at most `max`.
    pub fn bytes(&mut self, field: &'static str, max: usize) -> Result<&'a [u8], DecodeError> {
        let n = self.length(field, max)?;
        self.take(field, n)
    }

    /// Takes a length-prefixed string of at most `max` bytes.
    pub fn str(&mut self, field: &'static str, max: usize) -> Result<String, DecodeError> {
        let bytes = self.bytes(field, max)?;
        std::str::from_utf8(bytes).map(str::to_owned).map_err(|_| DecodeError::Utf8 { field })
    }

    /// Takes a counted list of at most `max` items. Memory grows with the input, not with the claim.
    pub fn list<T>(
        &mut self,
        field: &'static str,
        max: usize,
        mut item: impl FnMut(&mut Self) -> Result<T, DecodeError>,
    ) -> Result<Vec<T>, DecodeError> {
        let n = self.length(field, max)?;
        let mut out = Vec::new();
        for _ in 0..n {
            out.push(item(self)?);
        }
        Ok(out)
    }

    /// Takes an option: a presence byte, then the value.
    pub fn option<T>(
        &mut self,
        field: &'static str,
        item: impl FnOnce(&mut Self) -> Result<T, DecodeError>,
    ) -> Result<Option<T>, DecodeError> {
        if self.bool(field)? { item(self).map(Some) } else { Ok(None) }
    }

    /// Ends: left-over bytes are an error.
    pub fn finish(self) -> Result<(), DecodeError> {
        match self.rest.len() {
            0 => Ok(()),
            extra => Err(DecodeError::Trailing { extra }),
        }
    }

    /// Returns the number of bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.rest.len()
    }

    fn length(&mut self, field: &'static str, max: usize) -> Result<usize, DecodeError> {
        let value = self.u32()? as usize;
        if value > max { Err(DecodeError::TooLong { field, value, max }) } else { Ok(value) }
    }
}

/// Appends encoded values.
#[derive(Clone, Debug, Default)]
pub struct Writer {
    out: Vec<u8>,
}

impl Writer {
    /// Appends raw bytes, no length.
    pub fn raw(&mut self, bytes: &[u8]) {
        self.out.extend_from_slice(bytes);
    }

    /// Appends one byte.
    pub fn u8(&mut self, v: u8) {
        self.out.push(v);
    }

    /// Appends a boolean.
    pub fn bool(&mut self, v: bool) {
        self.u8(v.into());
    }

    /// Appends a 16-bit integer.
    pub fn u16(&mut self, v: u16) {
        self.raw(&v.to_be_bytes());
    }

    /// Appends a 32-bit integer.
    pub fn u32(&mut self, v: u32) {
        self.raw(&v.to_be_bytes());
    }

    /// Appends a 64-bit integer.
    pub fn u64(&mut self, v: u64) {
        self.raw(&v.to_be_bytes());
    }

    /// Appends length-prefixed bytes.
    ///
    /// # Panics
    /// If `bytes` is 4 GiB or longer; every caller's bound is far below.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.length(bytes.len());
        self.raw(bytes);
    }

    /// Appends a length-prefixed string.
    pub fn str(&mut self, s: &str) {
        self.bytes(s.as_bytes());
    }

    /// Appends a counted list.
    pub fn list<T>(&mut self, items: &[T], mut item: impl FnMut(&mut Self, &T)) {
        self.length(items.len());
        for i in items {
            item(self, i);
        }
    }

    /// Appends an option: a presence byte, then the value.
    pub fn option<T>(&mut self, value: Option<&T>, item: impl FnOnce(&mut Self, &T)) {
        self.bool(value.is_some());
        if let Some(v) = value {
            item(self, v);
        }
    }

    /// Returns the written bytes.
    pub fn into_vec(self) -> Vec<u8> {
        self.out
    }

    fn length(&mut self, n: usize) {
        self.u32(u32::try_from(n).expect("lengths are bounded far below 4 GiB by their callers"));
    }
}
