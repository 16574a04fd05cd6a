//! The addresses in participants' announcements: RTPS messages with a DATA submessage of the participant writer (RTPS
//! 2.5, 8.5.3).
//!
//! The module is pure. It finds and replaces addresses in place, in messages of Cyclone, and does nothing else with
//! them.

use std::net::Ipv4Addr;

/// Length of the beginning by which [`is_announcement`] recognises a message: the header, INFO_DST, INFO_TS, and the
/// beginning of DATA.
pub(crate) const HEAD_BYTES: usize = 80;

const HEADER_BYTES: usize = 20;
const SUBMESSAGES_MAX: usize = 8;
const DATA: u8 = 0x15;
const LITTLE_ENDIAN: u8 = 1;
const INLINE_QOS: u8 = 1 << 1;
const PARTICIPANT_WRITER: [u8; 4] = [0, 1, 0, 0xc2];
const PL_CDR_BE: [u8; 2] = [0, 2];
const PL_CDR_LE: [u8; 2] = [0, 3];
const PID_SENTINEL: u16 = 1;
/// `PID_DEFAULT_UNICAST_LOCATOR` and `PID_METATRAFFIC_UNICAST_LOCATOR`.
const PIDS_UNICAST: [u16; 2] = [0x31, 0x32];
const UDP_V4: u32 = 1;
/// Position of the four bytes of an IPv4 address in a locator, behind its kind, its port and twelve zeros.
const IPV4_AT: usize = 20;

/// Returns `true` if a message with this beginning announces a participant.
pub(crate) fn is_announcement(head: &[u8]) -> bool {
    data(head).is_some()
}

/// Replaces the IPv4 addresses of an announced participant.
pub(crate) fn replace(message: &mut [u8], with: impl Fn(Ipv4Addr) -> Ipv4Addr) {
    for at in addresses(message) {
        if let Some(bytes) = message.get_mut(at..at + 4)
            && let Ok(octets) = <[u8; 4]>::try_from(&*bytes)
        {
            bytes.copy_from_slice(&with(octets.into()).octets());
        }
    }
}

/// Returns the position of the submessage's content, and its flags.
fn data(message: &[u8]) -> Option<(usize, u8)> {
    let mut at = HEADER_BYTES;
    for _ in 0..SUBMESSAGES_MAX {
        let [id, flags] = bytes(message, at)?;
        let content = at + 4;
        if id == DATA {
            return (bytes(message, content + 8)? == PARTICIPANT_WRITER).then_some((content, flags));
        }
        at = content + usize::from(number(message, at + 2, flags & LITTLE_ENDIAN != 0)?);
    }
    None
}

fn addresses(message: &[u8]) -> Vec<usize> {
    let mut found = Vec::new();
    let _ = find_addresses(message, &mut found);
    found
}

fn find_addresses(message: &[u8], found: &mut Vec<usize>) -> Option<()> {
    let (content, flags) = data(message)?;
    let little = flags & LITTLE_ENDIAN != 0;
    let mut at = content + 4 + usize::from(number(message, content + 2, little)?);
    if flags & INLINE_QOS != 0 {
        at = parameters(message, at, little, |_, _| {})?;
    }
    let little = match bytes(message, at)? {
        PL_CDR_LE => true,
        PL_CDR_BE => false,
        _ => return None,
    };
    parameters(message, at + 4, little, |id, value| {
        let is_ipv4 = long(message, value, little) == Some(UDP_V4);
        if PIDS_UNICAST.contains(&id) && is_ipv4 {
            found.push(value + IPV4_AT);
        }
    })?;
    Some(())
}

/// Visits the parameters of a list with the positions of their values, and returns the list's end.
fn parameters(
    message: &[u8],
    mut at: usize,
    little: bool,
    mut visit: impl FnMut(u16, usize),
) -> Option<usize> {
    loop {
        let (id, length) = (number(message, at, little)?, number(message, at + 2, little)?);
        at += 4;
        if id == PID_SENTINEL {
            return Some(at);
        }
        visit(id, at);
        at += usize::from(length);
    }
}

fn bytes<const N: usize>(message: &[u8], at: usize) -> Option<[u8; N]> {
    message.get(at..at.checked_add(N)?)?.try_into().ok()
}

fn number(message: &[u8], at: usize, little: bool) -> Option<u16> {
    bytes(message, at).map(if little { u16::from_le_bytes } else { u16::from_be_bytes })
}

fn long(message: &[u8], at: usize, little: bool) -> Option<u32> {
    bytes(message, at).map(if little { u32::from_le_bytes } else { u32::from_be_bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOST: [u8; 4] = [10, 0, 0, 2];

    /// An announcement with two addresses, behind INFO_DST and INFO_TS.
    fn announcement(writer: [u8; 4]) -> Vec<u8> {
        let locator = |pid: u8, kind: u8| {
            [&[pid, 0, 24, 0, kind, 0, 0, 0, 0xf3, 0x1c, 0, 0][..], &[0; 12], &HOST].concat()
        };
        let mut data = [&[0, 0, 16, 0, 0, 1, 0, 0xc7][..], &writer, &[0, 0, 0, 0, 1, 0, 0, 0]].concat();
        data.extend([0, 3, 0, 0]);
        data.extend(locator(0x31, 1));
        data.extend([0x2c, 0, 4, 0, 1, 2, 3, 4]);
        data.extend(locator(0x32, 1));
        data.extend(locator(0x32, 2));
        data.extend([1, 0, 0, 0]);
        let mut message = b"RTPS\x02\x05\x01\x10".to_vec();
        message.extend([7; 12]);
        message.extend([&[0x0e, 1, 12, 0][..], &[8; 12], &[0x09, 1, 8, 0], &[9; 8]].concat());
        message.extend([DATA, 5]);
        message.extend(u16::try_from(data.len()).unwrap_or(0).to_le_bytes());
        message.extend(data);
        message
    }

    #[test]
    fn addresses_of_participants_are_replaced() {
        let before = announcement(PARTICIPANT_WRITER);
        assert!(is_announcement(&before[..HEAD_BYTES]));
        let mut after = before.clone();
        replace(&mut after, |address| {
            assert_eq!(address, Ipv4Addr::from(HOST));
            Ipv4Addr::LOCALHOST
        });
        let changed: Vec<_> = (0..before.len()).filter(|at| before[*at] != after[*at]).collect();
        assert_eq!(changed.len(), 2 * 2, "10 and 2 became 127 and 1, twice: {changed:?}");
    }

    #[test]
    fn other_messages_stay_as_they_are() {
        let data = announcement([0, 0, 1, 3]);
        assert!(!is_announcement(&data));
        let mut same = data.clone();
        replace(&mut same, |_| Ipv4Addr::LOCALHOST);
        assert_eq!(same, data);
    }

    #[test]
    fn cut_messages_do_no_harm() {
        let whole = announcement(PARTICIPANT_WRITER);
        for length in 0..whole.len() {
            replace(&mut whole[..length].to_vec(), |_| Ipv4Addr::LOCALHOST);
        }
    }
}
