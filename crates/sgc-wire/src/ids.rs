//! Identifiers: each a type of its own, fixed in size, shown as lower-case hexadecimal.

use std::fmt;
use std::str::FromStr;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident, $bytes:literal, $field:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(pub [u8; $bytes]);

        impl $name {
            /// Returns the raw bytes.
            pub fn as_bytes(&self) -> &[u8; $bytes] {
                &self.0
            }

            /// Returns the first eight hexadecimal digits: enough to tell apart in a log, never an identity.
            pub fn short(&self) -> String {
                hex(&self.0[..4])
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&hex(&self.0))
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!(stringify!($name), "({})"), self.short())
            }
        }

        impl FromStr for $name {
            type Err = ParseIdError;

            fn from_str(s: &str) -> Result<Self, Self::Err> {
                parse_hex(s).map(Self)
            }
        }

        impl Encode for $name {
            fn encode(&self, w: &mut Writer) {
                w.raw(&self.0);
            }
        }

        impl Decode for $name {
            fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
                r.array($field).map(Self)
            }
        }
    };
}

id!(
    /// The 256-bit, location-independent name of an interface (`docs/spec/names.md`).
    Name, 32, "name"
);
id!(
    /// The id of a node, and so of the owner of its names: `SHA-256(CA public key ‖ pseudonym)`. Survives key rotation
    /// and moving.
    NodeId, 32, "node id"
);
id!(
    /// The first bytes of a [`NodeId`]: enough to tell apart nodes that confirm the link themselves.
    NodeTag, 8, "node tag"
);
id!(
    /// The half of a name that proves knowledge of its topic secret without revealing it.
    Blind, 32, "blind"
);
id!(
    /// A node in its certificate: `HMAC(fleet secret, node name)`.
    Pseudonym, 32, "pseudonym"
);
id!(
    /// A group in a member's certificate: `HMAC(fleet secret, group name)`.
    GroupTag, 32, "group tag"
);
id!(
    /// One incarnation of one publisher on one name: the tag of the publisher, if its node gives it one, and else
    /// random; then 8 random bytes, so that no nonce repeats after a restart.
    SourceId, 16, "source id"
);
id!(
    /// One incarnation of one joiner of one name, random.
    SinkId, 16, "sink id"
);
id!(
    /// The token of a connection that was agreed on as a lane of a link; random, used once.
    LaneToken, 16, "lane token"
);

/// The second half of a publisher's listed id after its liveliness lease ran out.
const LAPSED: [u8; 8] = [0xff; 8];

impl SourceId {
    /// In a catalogue: all publishers that are not told apart.
    pub const OTHERS: Self = Self([0; 16]);

    /// Returns the source, unless it stands for all others.
    pub fn told_apart(self) -> Option<Self> {
        (self != Self::OTHERS).then_some(self)
    }

    /// Returns the id that lists a publisher after its liveliness lease ran out. Nothing is ever sent under it.
    pub fn lapsed(mut self) -> Self {
        self.0[8..].copy_from_slice(&LAPSED);
        self
    }

    /// Returns `true` if the publisher's lease ran out, so that it has no writer on other networks until it lives
    /// again.
    pub fn is_lapsed(&self) -> bool {
        self.0[8..] == LAPSED
    }

    /// Returns a source of the publisher with this tag.
    pub fn from_publisher(tag: [u8; 8], random: [u8; 8]) -> Self {
        let mut id = [0; 16];
        id[..8].copy_from_slice(&tag);
        id[8..].copy_from_slice(&random);
        Self(id)
    }

    /// Returns the common beginning of all sources of one publisher.
    pub fn publisher(&self) -> [u8; 8] {
        let mut publisher = [0; 8];
        publisher.copy_from_slice(&self.0[..8]);
        publisher
    }
}

impl NodeId {
    /// Returns its tag.
    pub fn tag(&self) -> NodeTag {
        let mut tag = [0; 8];
        tag.copy_from_slice(&self.0[..8]);
        NodeTag(tag)
    }
}

/// Names that may have a label on one link, each way: 2 MiB at the receiver.
pub const LABELS_MAX: u32 = 1 << 16;

/// A number for a name on one link, in one direction; below [`LABELS_MAX`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Label(u32);

impl Label {
    /// Returns the label with this number, if it is within the bound.
    pub fn new(index: u32) -> Option<Self> {
        (index < LABELS_MAX).then_some(Self(index))
    }

    /// Returns its number.
    pub fn index(self) -> u32 {
        self.0
    }
}

impl Encode for Label {
    fn encode(&self, w: &mut Writer) {
        w.u32(self.0);
    }
}

impl Decode for Label {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let index = r.u32()?;
        Self::new(index).ok_or(DecodeError::value("label", index.into()))
    }
}

/// 256 secret bits: a key, or the input of a key derivation. Wiped when dropped, compared in constant time, never
/// printed.
#[derive(Clone, zeroize::Zeroize, zeroize::ZeroizeOnDrop)]
pub struct SecretBytes([u8; 32]);

impl SecretBytes {
    /// Takes the bytes.
    pub fn new(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// Returns the bytes, for deriving from them. They belong in no log, and on no wire but sealed.
    pub fn expose(&self) -> &[u8; 32] {
        &self.0
    }
}

impl PartialEq for SecretBytes {
    fn eq(&self, other: &Self) -> bool {
        use subtle::ConstantTimeEq;
        self.0.ct_eq(&other.0).into()
    }
}

impl Eq for SecretBytes {}

impl fmt::Debug for SecretBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretBytes(..)")
    }
}

impl Encode for SecretBytes {
    fn encode(&self, w: &mut Writer) {
        w.raw(&self.0);
    }
}

impl Decode for SecretBytes {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        r.array("secret").map(Self)
    }
}

/// Text that is not an identifier.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{found:?} is not {expected} hexadecimal digits")]
pub struct ParseIdError {
    found: String,
    expected: usize,
}

fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    bytes
        .iter()
        .flat_map(|b| [DIGITS[usize::from(b >> 4)], DIGITS[usize::from(b & 15)]])
        .map(char::from)
        .collect()
}

fn parse_hex<const N: usize>(s: &str) -> Result<[u8; N], ParseIdError> {
    let error = || ParseIdError { found: s.chars().take(80).collect(), expected: 2 * N };
    if s.len() != 2 * N || !s.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Err(error());
    }
    let mut out = [0; N];
    for (byte, pair) in out.iter_mut().zip(s.as_bytes().chunks_exact(2)) {
        let digits = std::str::from_utf8(pair).map_err(|_| error())?;
        *byte = u8::from_str_radix(digits, 16).map_err(|_| error())?;
    }
    Ok(out)
}

/// Wall-clock time: milliseconds since the Unix epoch, UTC. Certificates and signed objects use it; timers use
/// `std::time::Instant`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct UnixMillis(pub u64);

impl UnixMillis {
    /// Returns whole seconds.
    pub fn secs(self) -> u64 {
        self.0 / 1000
    }
}

impl fmt::Display for UnixMillis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (y, mo, d) = civil_from_days((self.secs() / 86_400) as i64);
        let s = self.secs() % 86_400;
        write!(f, "{y:04}-{mo:02}-{d:02}T{:02}:{:02}:{:02}Z", s / 3600, s / 60 % 60, s % 60)
    }
}

impl Encode for UnixMillis {
    fn encode(&self, w: &mut Writer) {
        w.u64(self.0);
    }
}

impl Decode for UnixMillis {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        r.u64().map(Self)
    }
}

/// Returns the proleptic Gregorian date of a day counted from 1970-01-01, by eras of 400 years that start in March.
fn civil_from_days(days: i64) -> (i64, u32, u32) {
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let day_of_era = z.rem_euclid(146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = (day_of_year - (153 * month_from_march + 2) / 5 + 1) as u32;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 } as u32;
    (year_of_era + era * 400 + i64::from(month <= 2), month, day)
}

/// The present, as the driver saw it when it called a machine: both clocks at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Now {
    /// Monotonic; for timers.
    pub instant: std::time::Instant,
    /// Wall clock; for certificates and signed objects.
    pub unix: UnixMillis,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_round_trip_through_text() {
        let id = SourceId(*b"0123456789abcdef");
        assert_eq!(id.to_string().parse::<SourceId>(), Ok(id));
        assert!("30".parse::<SourceId>().is_err());
        assert!("+0313233343536373839616263646566".parse::<SourceId>().is_err());
    }

    #[test]
    fn dates_are_civil() {
        assert_eq!(UnixMillis(0).to_string(), "1970-01-01T00:00:00Z");
        assert_eq!(UnixMillis(951_782_400_000).to_string(), "2000-02-29T00:00:00Z");
        assert_eq!(UnixMillis(1_795_391_999_000).to_string(), "2026-11-22T23:59:59Z");
    }
}
