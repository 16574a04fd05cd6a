//! The request that a message belongs to: [`SampleIdentity`], and the two places where vendors put it.
//!
//! The module is pure. RPC over DDS 1.0 (7.8.2) puts the identity into the inline QoS of the RTPS DATA submessage, in
//! front of the payload; Fast DDS and RustDDS do that. rmw_cyclonedds puts 16 bytes into the payload, in front of the
//! body. [`Mapping`] distinguishes the two.

use sgc_ros::{Guid, KeyHash};

/// PID_RELATED_SAMPLE_IDENTITY of RPC over DDS 1.0 (7.8.2, table 7.11).
pub const PID_RELATED: u16 = 0x0083;

/// The former number of the same parameter in Fast DDS. Version 2.9 knows only this one, and newer versions write
/// both.
pub const PID_RELATED_FAST: u16 = 0x800f;

/// PID_KEY_HASH (RTPS 2.5, 9.6.4.8): the key of a sample, hashed.
pub const PID_KEY_HASH: u16 = 0x0070;

/// PID_STATUS_INFO (RTPS 2.5, 9.6.4.9): the end of an instance.
pub(crate) const PID_STATUS_INFO: u16 = 0x0071;

/// A vendor-specific parameter that must be understood and that no implementation knows (RTPS 2.5, 9.6.3.1). Cyclone
/// silently drops a sample of a Cyclone participant that carries it. This keeps a message in the other mapping from a
/// program that would read its first 16 bytes as an id. Other vendors skip parameters specific to Cyclone.
pub const PID_NOT_FOR_CYCLONE: u16 = 0xcfff;

/// End of a parameter list (RTPS 2.5, 9.4.2.11).
pub(crate) const PID_SENTINEL: u16 = 0x0001;

/// Length of a sample identity in a parameter, bytes: a GUID and a sequence number.
pub const IDENTITY_BYTES: usize = 24;

/// The sequence number that stands for an unknown one: high −1, low 0 (RTPS 2.5, 9.3.2.2).
pub const NUMBER_UNKNOWN: i64 = -1 << 32;

/// Vendor id of Cyclone DDS.
pub(crate) const CYCLONE: [u8; 2] = [0x01, 0x10];

/// The vendor id of Fast DDS (RTPS 2.5, 9.3.1.2; list of the OMG).
pub(crate) const FAST_DDS: [u8; 2] = [0x01, 0x0f];

/// The place where a program puts the identity of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Mapping {
    /// In front of the body, as in rmw_cyclonedds.
    Body,
    /// In the inline QoS, as in other implementations.
    InlineQos,
}

impl Mapping {
    /// Returns the mapping of a vendor's programs.
    pub fn for_vendor(vendor: [u8; 2]) -> Self {
        if vendor == CYCLONE { Self::Body } else { Self::InlineQos }
    }
}

/// The identity of a message: its writer, or the reader for the answer, and its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleIdentity {
    /// A writer, or the reader that the answer goes to.
    pub guid: Guid,
    /// The sequence number.
    pub number: i64,
}

impl SampleIdentity {
    /// Encodes the identity as a parameter, in the byte order of this machine.
    pub(crate) fn to_bytes(self) -> [u8; IDENTITY_BYTES] {
        let mut bytes = [0; IDENTITY_BYTES];
        bytes[..16].copy_from_slice(&self.guid.0);
        bytes[16..20].copy_from_slice(&((self.number >> 32) as u32).to_ne_bytes());
        bytes[20..].copy_from_slice(&(self.number as u32).to_ne_bytes());
        bytes
    }

    /// Returns the related identity in the inline QoS of a submessage, a list of parameters up to the sentinel.
    /// Returns `None` if there is none or the list is malformed.
    pub fn related(inline_qos: &[u8], big_endian: bool) -> Option<Self> {
        let u32_at = |b: [u8; 4]| if big_endian { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) };
        let mut older = None;
        for parameter in Parameters::new(inline_qos, big_endian) {
            let (pid, value) = parameter?;
            if matches!(pid, PID_RELATED | PID_RELATED_FAST)
                && let Some((guid, number)) = value.split_first_chunk::<16>()
                && let Some((high, low)) = number.split_first_chunk::<4>()
                && let Some(low) = low.first_chunk::<4>()
            {
                let number = i64::from(u32_at(*high) as i32) << 32 | i64::from(u32_at(*low));
                let identity = Self { guid: Guid(*guid), number };
                if pid == PID_RELATED {
                    return Some(identity);
                }
                older = Some(identity);
            }
        }
        older
    }
}

/// Returns the key hash in the inline QoS of a submessage, or `None` if there is none or the list is malformed before
/// it.
pub fn key_hash(inline_qos: &[u8], big_endian: bool) -> Option<KeyHash> {
    Parameters::new(inline_qos, big_endian)
        .map_while(|parameter| parameter)
        .find_map(|(pid, value)| value.first_chunk().filter(|_| pid == PID_KEY_HASH).copied())
}

/// The parameters of a list up to its sentinel (RTPS 2.5, 9.4.2.11). A malformed list yields `None` and then ends.
pub(crate) struct Parameters<'a> {
    rest: Option<&'a [u8]>,
    big_endian: bool,
}

impl<'a> Parameters<'a> {
    pub(crate) fn new(list: &'a [u8], big_endian: bool) -> Self {
        Self { rest: Some(list), big_endian }
    }
}

impl<'a> Iterator for Parameters<'a> {
    type Item = Option<(u16, &'a [u8])>;

    fn next(&mut self) -> Option<Self::Item> {
        let big_endian = self.big_endian;
        let number = |b: [u8; 2]| if big_endian { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) };
        let mut rest = self.rest.take()?;
        let mut next = || {
            let (pid, after) = rest.split_first_chunk::<2>()?;
            let (length, after) = after.split_first_chunk::<2>()?;
            if number(*pid) == PID_SENTINEL {
                return Some(None);
            }
            let (value, after) = after.split_at_checked(usize::from(number(*length)))?;
            rest = after;
            Some(Some((number(*pid), value)))
        };
        match next() {
            Some(Some(parameter)) => {
                self.rest = Some(rest);
                Some(Some(parameter))
            }
            Some(None) => None,
            None => Some(None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameter(pid: u16, value: &[u8]) -> Vec<u8> {
        [&pid.to_le_bytes()[..], &(value.len() as u16).to_le_bytes(), value].concat()
    }

    fn identity(last: u8, number: i64) -> SampleIdentity {
        SampleIdentity { guid: Guid([last; 16]), number }
    }

    fn little(identity: SampleIdentity) -> Vec<u8> {
        let (high, low) = ((identity.number >> 32) as u32, identity.number as u32);
        [&identity.guid.0[..], &high.to_le_bytes(), &low.to_le_bytes()].concat()
    }

    #[test]
    fn the_standard_parameter_wins_over_the_older() {
        let (new, old) = (identity(1, 7), identity(2, 8));
        let end = parameter(PID_SENTINEL, &[]);
        let both =
            [parameter(PID_RELATED_FAST, &little(old)), parameter(PID_RELATED, &little(new)), end.clone()];
        assert_eq!(SampleIdentity::related(&both.concat(), false), Some(new));
        let one =
            [parameter(0x0070, &[9; 16]), parameter(PID_RELATED_FAST, &little(old)), end.clone()].concat();
        assert_eq!(SampleIdentity::related(&one, false), Some(old));
        assert_eq!(SampleIdentity::related(&end, false), None);
    }

    #[test]
    fn numbers_use_both_halves_and_either_byte_order() {
        for number in [1, 0x1_2345_6789, i64::MAX, NUMBER_UNKNOWN] {
            let list =
                [parameter(PID_RELATED, &little(identity(3, number))), parameter(PID_SENTINEL, &[])].concat();
            assert_eq!(SampleIdentity::related(&list, false), Some(identity(3, number)));
            let mut big = list;
            for at in [0, 2, 28, 30] {
                big.swap(at, at + 1);
            }
            big[20..24].reverse();
            big[24..28].reverse();
            assert_eq!(SampleIdentity::related(&big, true), Some(identity(3, number)));
        }
        let native = SampleIdentity::related(
            &[
                &PID_RELATED.to_ne_bytes()[..],
                &24u16.to_ne_bytes(),
                &identity(4, 0x2_0000_0001).to_bytes(),
                &PID_SENTINEL.to_ne_bytes(),
                &[0, 0],
            ]
            .concat(),
            cfg!(target_endian = "big"),
        );
        assert_eq!(native, Some(identity(4, 0x2_0000_0001)));
    }

    #[test]
    fn broken_lists_have_no_identity() {
        let whole = parameter(PID_RELATED, &little(identity(1, 7)));
        for cut in 0..whole.len() {
            assert_eq!(SampleIdentity::related(&whole[..cut], false), None, "{cut}");
        }
        let short = [parameter(PID_RELATED, &[1; 20]), parameter(PID_SENTINEL, &[])].concat();
        assert_eq!(SampleIdentity::related(&short, false), None);
    }
}
