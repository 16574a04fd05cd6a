//! Operations as commands, and what the replies to them mean.

use std::time::Duration;

use bytes::Bytes;
use sgc_router::{StoreAction, StoreReply, WriteIf};

use crate::config::ServerAddress;
use crate::resp::{Frame, encode};
use crate::topology::redirection;

/// Sets a value and says whether there was one, without sending it back.
pub(crate) const SCRIPT_SET: &[u8] =
    b"return redis.call('SET',KEYS[1],ARGV[1],'GET',unpack(ARGV,2)) and 1 or 0";
/// Removes a key if it has this value.
pub(crate) const SCRIPT_REMOVE: &[u8] =
    b"if redis.call('GET',KEYS[1])==ARGV[1] then return redis.call('DEL',KEYS[1]) end return 0";
/// Most bytes of a value for which the old value in the reply costs less than a script.
const SHORT_VALUE_MAX: usize = 256;
/// Longest time after which a key ends: ten years.
const LIFETIME_MAX: Duration = Duration::from_secs(10 * 365 * 86_400);
/// Most characters of a server's message in a log.
const MESSAGE_CHARS_MAX: usize = 200;

/// Appends the command of an operation.
pub(crate) fn encode_action(action: &StoreAction, key: &[u8], to: &mut Vec<u8>) {
    match action {
        StoreAction::Read => encode(&[b"GET", key], to),
        StoreAction::Write { value, lifetime, condition } => {
            let lifetime =
                lifetime.map(|time| time.clamp(Duration::from_millis(1), LIFETIME_MAX).as_millis());
            let lifetime = lifetime.map(|time| time.to_string());
            let mut parts: Vec<&[u8]> = match condition {
                WriteIf::Absent => vec![b"SET", key, value, b"NX"],
                WriteIf::Always if value.len() <= SHORT_VALUE_MAX => vec![b"SET", key, value, b"GET"],
                WriteIf::Always => vec![b"EVAL", SCRIPT_SET, b"1", key, value],
            };
            if let Some(lifetime) = &lifetime {
                parts.extend([b"PX".as_slice(), lifetime.as_bytes()]);
            }
            encode(&parts, to);
        }
        StoreAction::Remove { value } => encode(&[b"EVAL", SCRIPT_REMOVE, b"1", key, value], to),
    }
}

/// The meaning of a reply to an operation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Answer {
    Done(StoreReply),
    /// The slot has moved.
    Moved {
        slot: u16,
        to: ServerAddress,
    },
    /// The key may be at another server already.
    Ask {
        to: ServerAddress,
    },
    /// The server cannot answer at present: its role or the cluster is changing.
    Later,
    /// The server can only read: it is a replica now.
    ReadOnly,
    /// The server says no, with this message.
    Refused(String),
}

/// Returns the meaning of a reply.
pub(crate) fn answer(action: &StoreAction, reply: &Frame, from: &ServerAddress) -> Answer {
    if let Frame::Error(text) = reply {
        return error(text, from);
    }
    let done = match (action, reply) {
        (StoreAction::Read, Frame::Text(value)) => Some(StoreReply::Value(Some(value.clone()))),
        // A value that is too long is none of ours.
        (StoreAction::Read, Frame::Null | Frame::TooLong) => Some(StoreReply::Value(None)),
        (StoreAction::Write { condition: WriteIf::Absent, .. }, Frame::Text(_)) => {
            Some(StoreReply::Written { existed: false })
        }
        (StoreAction::Write { condition: WriteIf::Absent, .. }, Frame::Null) => {
            Some(StoreReply::Written { existed: true })
        }
        (StoreAction::Write { condition: WriteIf::Always, .. }, Frame::Text(_) | Frame::TooLong) => {
            Some(StoreReply::Written { existed: true })
        }
        (StoreAction::Write { condition: WriteIf::Always, .. }, Frame::Null) => {
            Some(StoreReply::Written { existed: false })
        }
        (StoreAction::Write { condition: WriteIf::Always, .. }, Frame::Integer(number)) => {
            Some(StoreReply::Written { existed: *number != 0 })
        }
        (StoreAction::Remove { .. }, Frame::Integer(_)) => Some(StoreReply::Removed),
        _ => None,
    };
    match done {
        Some(reply) => Answer::Done(reply),
        None => Answer::Refused("a reply that does not belong to the command".into()),
    }
}

fn error(text: &Bytes, from: &ServerAddress) -> Answer {
    let (code, rest) = match text.iter().position(|byte| *byte == b' ') {
        Some(at) => (&text[..at], &text[at + 1..]),
        None => (text.as_ref(), [].as_slice()),
    };
    match code {
        b"MOVED" => match redirection(rest, from) {
            Some((slot, to)) => Answer::Moved { slot, to },
            None => Answer::Refused(message(text)),
        },
        b"ASK" => match redirection(rest, from) {
            Some((_, to)) => Answer::Ask { to },
            None => Answer::Refused(message(text)),
        },
        b"TRYAGAIN" | b"CLUSTERDOWN" | b"LOADING" | b"MASTERDOWN" | b"BUSY" => Answer::Later,
        b"READONLY" => Answer::ReadOnly,
        _ => Answer::Refused(message(text)),
    }
}

/// Returns a server's message for a log: of bounded length, without control characters.
pub(crate) fn message(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    let clean = text.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c });
    clean.take(MESSAGE_CHARS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from() -> ServerAddress {
        ServerAddress::new("10.0.0.1", 6379).unwrap()
    }

    fn answer_to(action: &StoreAction, reply: Frame) -> Answer {
        answer(action, &reply, &from())
    }

    fn text(text: &'static str) -> Frame {
        Frame::Text(Bytes::from_static(text.as_bytes()))
    }

    fn write(length: usize, condition: WriteIf) -> StoreAction {
        StoreAction::Write { value: vec![b'v'; length].into(), lifetime: Some(Duration::ZERO), condition }
    }

    fn encoded(action: &StoreAction) -> String {
        let mut bytes = Vec::new();
        encode_action(action, b"key", &mut bytes);
        let text = String::from_utf8(bytes).unwrap();
        let parts = text.split("\r\n").filter(|part| !part.is_empty() && !part.starts_with(['*', '$']));
        parts.collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn short_values_need_no_script() {
        assert_eq!(encoded(&write(1, WriteIf::Always)), "SET key v GET PX 1");
        assert_eq!(encoded(&write(1, WriteIf::Absent)), "SET key v NX PX 1");
        assert!(encoded(&write(300, WriteIf::Always)).starts_with("EVAL return redis.call('SET'"));
        assert!(encoded(&write(300, WriteIf::Absent)).starts_with("SET key vvv"));
        assert_eq!(encoded(&StoreAction::Read), "GET key");
    }

    #[test]
    fn replies_say_whether_a_value_was_there() {
        let existed = |existed| Answer::Done(StoreReply::Written { existed });
        assert_eq!(answer_to(&write(1, WriteIf::Always), Frame::Null), existed(false));
        assert_eq!(answer_to(&write(1, WriteIf::Always), Frame::TooLong), existed(true));
        assert_eq!(answer_to(&write(300, WriteIf::Always), Frame::Integer(0)), existed(false));
        assert_eq!(answer_to(&write(1, WriteIf::Absent), text("OK")), existed(false));
        assert_eq!(answer_to(&write(1, WriteIf::Absent), Frame::Null), existed(true));
        assert_eq!(answer_to(&StoreAction::Read, Frame::TooLong), Answer::Done(StoreReply::Value(None)));
    }

    #[test]
    fn replies_that_do_not_belong_to_the_command_are_refused() {
        for (action, reply) in [
            (StoreAction::Read, Frame::Integer(1)),
            (StoreAction::Read, Frame::Array(vec![])),
            (write(1, WriteIf::Absent), Frame::Integer(1)),
            (write(1, WriteIf::Always), Frame::Array(vec![])),
            (StoreAction::Remove { value: Bytes::new() }, text("OK")),
        ] {
            assert!(matches!(answer_to(&action, reply), Answer::Refused(_)));
        }
    }

    #[test]
    fn errors_redirect_delay_or_refuse() {
        let error = |text: &'static str| {
            answer_to(&StoreAction::Read, Frame::Error(Bytes::from_static(text.as_bytes())))
        };
        let to = ServerAddress::new("10.0.0.2", 7).unwrap();
        assert_eq!(error("MOVED 5 10.0.0.2:7"), Answer::Moved { slot: 5, to: to.clone() });
        assert_eq!(error("ASK 5 10.0.0.2:7"), Answer::Ask { to });
        assert_eq!(error("CLUSTERDOWN The cluster is down"), Answer::Later);
        assert_eq!(error("READONLY You can't write against a read only replica."), Answer::ReadOnly);
        assert_eq!(error("NOPERM\x1b[1m no"), Answer::Refused("NOPERM\u{fffd}[1m no".into()));
        for broken in ["MOVED", "MOVED x", "ASK 70000 a:1", "", " "] {
            assert!(matches!(error(broken), Answer::Refused(_)), "{broken}");
        }
    }
}
