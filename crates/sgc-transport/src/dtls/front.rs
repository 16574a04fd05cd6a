//! The bytes in front of DTLS records on the wire, and the messages beside QUIC inside of them.
//!
//! This module sorts datagrams and makes them. [`super::association`] and [`super::mux`] check their claims.

/// In front of a record: the association that it belongs to, wherever it comes from. DTLS records begin with none of
/// these bytes (RFC 7983, RFC 9443).
const ID: u8 = 0xc1;
/// Asks the peer to prove that it receives at its address.
const CHALLENGE: u8 = 0xc2;
/// In front of a record: the token that proves the address.
const TICKET: u8 = 0xc3;
/// The association is not known here.
const RESET: u8 = 0xc4;
/// Too many are connecting.
const BUSY: u8 = 0xc5;
/// The certificate is refused, in a handshake that is not over.
const REFUSAL: u8 = 0xc6;

/// First byte of a message inside of records: QUIC never begins a packet with it.
const INSIDE: u8 = 0;
const HELLO: u8 = 1;
const REFUSED: u8 = 2;
const PROBE: u8 = 3;
const PROOF: u8 = 4;
/// Version of the protocol inside.
pub(super) const INSIDE_VERSION: u8 = 1;

pub(super) const ID_BYTES: usize = 8;
pub(super) const TOKEN_BYTES: usize = 16;
/// Bytes of a ClientHello's random that an answer repeats, so that only nodes that saw the hello can answer.
pub(super) const ECHO_BYTES: usize = 16;

const RECORD_HEAD_BYTES: usize = 13;
const HANDSHAKE_HEAD_BYTES: usize = 12;
const CONTENT_HANDSHAKE: u8 = 22;
const CLIENT_HELLO: u8 = 1;
const SERVER_HELLO: u8 = 2;
const HELLO_VERIFY_REQUEST: u8 = 3;
const SUPPORTED_VERSIONS: u16 = 43;

pub(super) type Token = [u8; TOKEN_BYTES];
pub(super) type Echo = [u8; ECHO_BYTES];

/// A datagram, by its first bytes.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum DatagramKind<'a> {
    /// Plain DTLS records.
    Plain(&'a [u8]),
    /// Records of an association.
    Id(u64, &'a [u8]),
    /// Records of a peer that received a challenge.
    Ticket(Token, &'a [u8]),
    Challenge(Token, Echo),
    Reset(Token),
    Busy(Echo),
    /// A refusal with an alert (RFC 8446, 6.2).
    Refusal(u8, Echo),
}

/// Sorts a datagram; `None` if it is unknown.
pub(super) fn sort(datagram: &[u8]) -> Option<DatagramKind<'_>> {
    let (first, rest) = datagram.split_first()?;
    match *first {
        20..=63 => Some(DatagramKind::Plain(datagram)),
        ID => rest.split_first_chunk().map(|(id, record)| DatagramKind::Id(u64::from_be_bytes(*id), record)),
        TICKET => rest.split_first_chunk().map(|(token, record)| DatagramKind::Ticket(*token, record)),
        CHALLENGE => {
            let (token, echo) = rest.split_first_chunk()?;
            Some(DatagramKind::Challenge(*token, echo.try_into().ok()?))
        }
        RESET => rest.try_into().ok().map(DatagramKind::Reset),
        BUSY => rest.try_into().ok().map(DatagramKind::Busy),
        REFUSAL => {
            let (alert, echo) = rest.split_first()?;
            Some(DatagramKind::Refusal(*alert, echo.try_into().ok()?))
        }
        _ => None,
    }
}

/// Returns `true` for a datagram that a listener may have sent. QUIC sends none like it, as long as it does not clear
/// the bit that tells its packets apart: its long headers are longer than the messages that begin like them.
pub(super) fn is_from_listener(datagram: &[u8]) -> bool {
    !matches!(sort(datagram), None | Some(DatagramKind::Id(..) | DatagramKind::Ticket(..)))
}

pub(super) fn id_prefix(id: u64) -> Vec<u8> {
    [&[ID], &id.to_be_bytes()[..]].concat()
}

pub(super) fn ticket_prefix(token: &Token) -> Vec<u8> {
    [&[TICKET], &token[..]].concat()
}

pub(super) fn challenge(token: &Token, echo: &Echo) -> Vec<u8> {
    [&[CHALLENGE], &token[..], &echo[..]].concat()
}

pub(super) fn reset(token: &Token) -> Vec<u8> {
    [&[RESET], &token[..]].concat()
}

pub(super) fn busy(echo: &Echo) -> Vec<u8> {
    [&[BUSY], &echo[..]].concat()
}

pub(super) fn refusal(alert: u8, echo: &Echo) -> Vec<u8> {
    [&[REFUSAL, alert], &echo[..]].concat()
}

/// Returns the beginning of the random if a datagram begins with a ClientHello. A hello that comes in pieces counts by
/// the piece that holds the random.
pub(super) fn client_hello(datagram: &[u8]) -> Option<Echo> {
    let (kind, body) = first_piece(datagram)?;
    // Two bytes of version, then the random.
    let random = body.get(2..2 + ECHO_BYTES)?;
    if kind == CLIENT_HELLO { random.try_into().ok() } else { None }
}

/// Returns whether a datagram begins with an answer to a hello that only a listener without DTLS 1.3 gives. Anybody can
/// make one.
pub(super) fn is_without_dtls13(datagram: &[u8]) -> bool {
    match first_piece(datagram) {
        Some((HELLO_VERIFY_REQUEST, _)) => true,
        Some((SERVER_HELLO, body)) => !has_supported_versions(body).unwrap_or(true),
        _ => false,
    }
}

/// Returns whether a ServerHello has the extension in which the version is chosen since TLS 1.3 (RFC 8446, 4.2.1);
/// `None` if the hello is cut off.
fn has_supported_versions(body: &[u8]) -> Option<bool> {
    // Version, random, session id, cipher suite, compression, extensions.
    let (session_id_bytes, rest) = body.get(34..)?.split_first()?;
    let rest = rest.get(usize::from(*session_id_bytes) + 3..)?;
    if rest.is_empty() {
        return Some(false);
    }
    let (length, mut rest) = rest.split_first_chunk()?;
    rest = rest.get(..usize::from(u16::from_be_bytes(*length)))?;
    while !rest.is_empty() {
        let (kind, after) = rest.split_first_chunk()?;
        let (length, after) = after.split_first_chunk()?;
        if u16::from_be_bytes(*kind) == SUPPORTED_VERSIONS {
            return Some(true);
        }
        rest = after.get(usize::from(u16::from_be_bytes(*length))..)?;
    }
    Some(false)
}

/// Returns kind and content of the unencrypted handshake message that a datagram begins with, if it is the message's
/// first piece.
fn first_piece(datagram: &[u8]) -> Option<(u8, &[u8])> {
    let (head, rest) = datagram.split_at_checked(RECORD_HEAD_BYTES)?;
    let length = usize::from(u16::from_be_bytes([head[11], head[12]]));
    let (handshake, body) = rest.get(..length)?.split_at_checked(HANDSHAKE_HEAD_BYTES)?;
    let is_handshake = head[0] == CONTENT_HANDSHAKE && epoch(head) == 0;
    (is_handshake && handshake[6..9] == [0, 0, 0]).then_some((handshake[0], body))
}

/// Returns whether any record of a datagram is one that everybody can make; also if it is malformed. Ciphertext of DTLS
/// 1.3 has a header of its own, 001CSLEE (RFC 9147, 4).
pub(super) fn has_plaintext(mut records: &[u8]) -> bool {
    while let Some(first) = records.first() {
        let next = match first {
            0x20..=0x3f if first & 0x10 == 0 => {
                let sequence_bytes = if first & 0x08 == 0 { 1 } else { 2 };
                if first & 0x04 == 0 {
                    // A record without a length is the last.
                    return false;
                }
                let at = 1 + sequence_bytes;
                records.get(at..at + 2).map(|n| at + 2 + usize::from(u16::from_be_bytes([n[0], n[1]])))
            }
            20..=25 => match records.get(..RECORD_HEAD_BYTES) {
                Some(head) if epoch(head) > 0 => {
                    Some(RECORD_HEAD_BYTES + usize::from(u16::from_be_bytes([head[11], head[12]])))
                }
                _ => return true,
            },
            _ => return true,
        };
        let Some(rest) = next.and_then(|next| records.get(next..)) else { return true };
        records = rest;
    }
    false
}

fn epoch(head: &[u8]) -> u16 {
    u16::from_be_bytes([head[3], head[4]])
}

/// A message inside of records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RecordMessage {
    /// The dialer asks for an id.
    Ask,
    /// The listener's answer: the id to put in front from now on, and the token of a reset.
    Answer { id: u64, reset: Token },
    /// The certificate is refused, with this alert (RFC 8446, 6.2).
    Refused { alert: u8 },
    /// The listener sends a token to an address.
    Probe { token: Token },
    /// The dialer repeats the token.
    Proof { token: Token },
    /// Another version, or an unknown message.
    Unknown,
}

impl RecordMessage {
    pub(super) fn is_inside(plaintext: &[u8]) -> bool {
        plaintext.first() == Some(&INSIDE)
    }

    pub(super) fn parse(plaintext: &[u8]) -> Self {
        match plaintext {
            [INSIDE, HELLO, INSIDE_VERSION] => Self::Ask,
            [INSIDE, HELLO, INSIDE_VERSION, rest @ ..] => {
                let answer = rest.split_first_chunk::<ID_BYTES>();
                let answer = answer.and_then(|(id, reset)| Some((id, reset.try_into().ok()?)));
                answer
                    .map_or(Self::Unknown, |(id, reset)| Self::Answer { id: u64::from_be_bytes(*id), reset })
            }
            [INSIDE, REFUSED, alert] => Self::Refused { alert: *alert },
            [INSIDE, PROBE, token @ ..] => {
                token.try_into().map_or(Self::Unknown, |token| Self::Probe { token })
            }
            [INSIDE, PROOF, token @ ..] => {
                token.try_into().map_or(Self::Unknown, |token| Self::Proof { token })
            }
            _ => Self::Unknown,
        }
    }

    pub(super) fn to_bytes(self) -> Vec<u8> {
        match self {
            Self::Ask => vec![INSIDE, HELLO, INSIDE_VERSION],
            Self::Answer { id, reset } => {
                [&[INSIDE, HELLO, INSIDE_VERSION], &id.to_be_bytes()[..], &reset].concat()
            }
            Self::Refused { alert } => vec![INSIDE, REFUSED, alert],
            Self::Probe { token } => [&[INSIDE, PROBE], &token[..]].concat(),
            Self::Proof { token } => [&[INSIDE, PROOF], &token[..]].concat(),
            Self::Unknown => vec![INSIDE],
        }
    }
}

/// Checks this module with one datagram, for the fuzzer and the seeded test: a sorted datagram encodes to the same
/// bytes.
#[doc(hidden)]
pub fn exercise(datagram: &[u8]) {
    let again = match sort(datagram) {
        None => None,
        Some(DatagramKind::Plain(record)) => {
            let _ = has_plaintext(record);
            // A hello is plaintext.
            assert!(client_hello(record).is_none() || has_plaintext(record));
            assert!(!is_without_dtls13(record) || has_plaintext(record));
            Some(record.to_vec())
        }
        Some(DatagramKind::Id(id, record)) => Some([&id_prefix(id), record].concat()),
        Some(DatagramKind::Ticket(token, record)) => Some([&ticket_prefix(&token), record].concat()),
        Some(DatagramKind::Challenge(token, echo)) => Some(challenge(&token, &echo)),
        Some(DatagramKind::Reset(token)) => Some(reset(&token)),
        Some(DatagramKind::Busy(echo)) => Some(busy(&echo)),
        Some(DatagramKind::Refusal(alert, echo)) => Some(refusal(alert, &echo)),
    };
    assert!(again.is_none_or(|again| again == datagram));
    if RecordMessage::is_inside(datagram) {
        let inside = RecordMessage::parse(datagram);
        assert!(inside == RecordMessage::Unknown || inside.to_bytes() == datagram);
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_core::{RngCore as _, SeedableRng as _};

    use super::*;

    fn record(epoch: u16, body: &[u8]) -> Vec<u8> {
        let mut out = vec![CONTENT_HANDSHAKE, 0xfe, 0xfd];
        out.extend_from_slice(&epoch.to_be_bytes());
        out.extend_from_slice(&[0; 6]);
        out.extend_from_slice(&(body.len() as u16).to_be_bytes());
        out.extend_from_slice(body);
        out
    }

    fn hello() -> Vec<u8> {
        let mut body = vec![CLIENT_HELLO, 0, 0, 60, 0, 0, 0, 0, 0, 0, 0, 60, 0xfe, 0xfd];
        body.extend(1..=58);
        record(0, &body)
    }

    #[test]
    fn a_hello_is_known_by_its_random() {
        let hello = hello();
        assert_eq!(client_hello(&hello).unwrap()[..3], [1, 2, 3]);
        assert!(has_plaintext(&hello));
        for (at, value) in [(0, 23), (4, 1), (13, 2), (19, 1), (12, 0xff)] {
            let mut other = hello.clone();
            other[at] = value;
            assert_eq!(client_hello(&other), None, "byte {at}");
        }
    }

    #[test]
    fn answer_of_a_listener_without_dtls13_is_recognised() {
        let message = |kind: u8, body: &[u8]| {
            let len = body.len() as u8;
            record(0, &[&[kind, 0, 0, len, 0, 0, 0, 0, 0, 0, 0, len], body].concat())
        };
        let server_hello = |extensions: &[u8]| {
            let fixed = [&[0xfe, 0xfd][..], &[7; 32], &[2, 9, 9], &[0xc0, 0x2b, 0]].concat();
            message(SERVER_HELLO, &[&fixed, &[0, extensions.len() as u8][..], extensions].concat())
        };
        assert!(is_without_dtls13(&message(HELLO_VERIFY_REQUEST, &[0xfe, 0xff, 1, 5])));
        assert!(is_without_dtls13(&server_hello(&[0, 23, 0, 0])));
        assert!(!is_without_dtls13(&server_hello(&[0, 23, 0, 0, 0, 43, 0, 2, 0xfe, 0xfc])));
        // A hello that is cut off proves nothing.
        assert!(!is_without_dtls13(&server_hello(&[0, 23, 0, 9])));
        assert!(!is_without_dtls13(&hello()));
    }

    #[test]
    fn plaintext_is_found_behind_ciphertext() {
        let sealed12 = record(1, &[7; 40]);
        let sealed13 = [&[0x2f, 0, 1, 0, 20], &[7; 20][..]].concat();
        for sealed in [&sealed12, &sealed13] {
            assert!(!has_plaintext(sealed));
            assert!(has_plaintext(&[&sealed[..], &hello()].concat()));
            assert!(has_plaintext(&sealed[..sealed.len() - 1]));
        }
        assert!(!has_plaintext(&[&sealed13[..], &sealed12].concat()));
    }

    #[test]
    fn random_datagrams_are_sorted_without_harm() {
        let mut rng = ChaCha20Rng::seed_from_u64(7);
        let known = [
            hello(),
            challenge(&[1; 16], &[2; 16]),
            RecordMessage::Answer { id: 7, reset: [3; 16] }.to_bytes(),
        ];
        for round in 0..20_000 {
            let mut bytes = match known.get(round % 8) {
                Some(known) => known.clone(),
                None => vec![0; rng.next_u32() as usize % 80],
            };
            if round % 8 >= known.len() {
                rng.fill_bytes(&mut bytes);
            }
            if let Some(first) = bytes.first_mut()
                && round % 3 == 0
            {
                *first =
                    [0, 22, 0x2c, ID, CHALLENGE, TICKET, RESET, BUSY, REFUSAL][rng.next_u32() as usize % 9];
            }
            if !bytes.is_empty() {
                let at = rng.next_u32() as usize % bytes.len();
                bytes[at] ^= rng.next_u32() as u8;
                bytes.truncate(1 + rng.next_u32() as usize % bytes.len());
            }
            exercise(&bytes);
        }
    }
}
