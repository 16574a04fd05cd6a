//! Ids of Zenoh sessions, and the mark by which SGC's are recognised.

use std::fmt;
use std::num::NonZeroU128;
use std::str::FromStr;

use crate::error::CodecError;

/// The bytes with which the ids of all SGC's sessions begin: `SGC`, and three that no name of anything is likely to have.
/// Programs that leave their id to Zenoh get a random one, which has this mark once in 2⁴⁸.
pub const SGC_MARK: [u8; 6] = [b'S', b'G', b'C', 0xa7, 0x5e, 0x1d];

/// Most hexadecimal digits of an id.
const DIGITS_MAX: usize = 32;

/// The id of a Zenoh session: a number of 128 bits other than 0, in lower-case hexadecimal digits without leading zeros
/// (uhlc 0.8.2 `src/id.rs`).
///
/// It is a part of each liveliness token, and of the time stamps that the session makes.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ZenohId(NonZeroU128);

impl ZenohId {
    /// Returns the id of a session of SGC: the [`SGC_MARK`] and these random bytes.
    pub fn of_sgc(random: [u8; 10]) -> Self {
        let mut bytes = [0; 16];
        let (mark, rest) = bytes.split_at_mut(SGC_MARK.len());
        mark.copy_from_slice(&SGC_MARK);
        rest.copy_from_slice(&random);
        Self(NonZeroU128::new(u128::from_be_bytes(bytes)).expect("the mark is not zero"))
    }

    /// Returns the id of an ordinary program's session with the same random bytes.
    pub fn without_mark(self) -> Self {
        // The other bytes keep the number from being 0, unless all of them are; then the last bit does.
        let rest = self.0.get() & (u128::MAX >> (8 * SGC_MARK.len()));
        Self(NonZeroU128::new(rest).unwrap_or(NonZeroU128::MIN))
    }

    /// Returns the id with these bytes, the lowest first, as time stamps have it. There is none of zeros.
    pub fn from_le_bytes(bytes: [u8; 16]) -> Option<Self> {
        NonZeroU128::new(u128::from_le_bytes(bytes)).map(Self)
    }

    /// Returns `true` if the session is one of SGC, in this process or another, on this host or another. What it
    /// announces and publishes came through SGC already.
    pub fn is_of_sgc(self) -> bool {
        self.0.get().to_be_bytes().starts_with(&SGC_MARK)
    }
}

impl fmt::Display for ZenohId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:x}", self.0)
    }
}

impl fmt::Debug for ZenohId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for ZenohId {
    type Err = CodecError;

    fn from_str(text: &str) -> Result<Self, CodecError> {
        let is_digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        Some(text)
            .filter(|text| text.len() <= DIGITS_MAX && !text.starts_with('0') && text.bytes().all(is_digit))
            .and_then(|digits| u128::from_str_radix(digits, 16).ok())
            .and_then(NonZeroU128::new)
            .map(Self)
            .ok_or(CodecError::ZenohId)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_text_as_zenoh_writes_it() {
        for text in ["1", "abc1", "aac3178e146ba6f1fc6e6a4085e77f21", &"f".repeat(32)] {
            assert_eq!(text.parse::<ZenohId>().unwrap().to_string(), text);
        }
        for text in ["", "0", "0abc1", "ABC1", "+1", "-1", "g", "1 ", "ä", &"f".repeat(33)] {
            assert_eq!(text.parse::<ZenohId>(), Err(CodecError::ZenohId), "{text:?}");
        }
    }

    #[test]
    fn sessions_of_sgc_have_its_mark() {
        let id = ZenohId::of_sgc([0x0f; 10]);
        assert_eq!(id.to_string(), "534743a75e1d0f0f0f0f0f0f0f0f0f0f");
        assert!(id.is_of_sgc() && id.to_string().parse::<ZenohId>().unwrap().is_of_sgc());
        assert!(ZenohId::of_sgc([0; 10]).is_of_sgc() && ZenohId::of_sgc([0xff; 10]).is_of_sgc());
        // The second has the digits of the mark, but is another number.
        for other in ["534743a75e1e0f0f0f0f0f0f0f0f0f0f", "534743a75e1d0f0f", "1"] {
            assert!(!other.parse::<ZenohId>().unwrap().is_of_sgc(), "{other}");
        }
    }
}
