//! What the demo and its talkers and listeners say to each other: lines of JSON over standard input and output.

use serde::{Deserialize, Serialize};

use super::topics::Topic;
use super::tracker::Counts;

/// From the demo to a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub(crate) enum PeerCommand {
    /// Number the messages from 1.
    Go,
    /// Number them no longer, and say how many there were.
    Stop,
}

/// From a peer to the demo.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "is", rename_all = "snake_case")]
pub(crate) enum PeerEvent {
    /// A talker's number of subscribers on its network has changed.
    Matched {
        /// Whose.
        topic: Topic,
        /// How many there are.
        readers: u32,
    },
    /// A listener has received its first message.
    Arrived {
        /// Of which topic.
        topic: Topic,
    },
    /// How far a talker is.
    Sending {
        /// Which.
        topic: Topic,
        /// Messages sent.
        sent: u64,
    },
    /// A talker has stopped numbering.
    Sent {
        /// Which.
        topic: Topic,
        /// Messages sent in all.
        total: u64,
    },
    /// How far a listener is.
    Receiving {
        /// Of which topic.
        topic: Topic,
        /// What it has.
        counts: Counts,
    },
    /// A peer cannot go on.
    Failed {
        /// Why.
        reason: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_survive_the_line() {
        let events = [
            PeerEvent::Matched { topic: Topic::Image, readers: 2 },
            PeerEvent::Receiving { topic: Topic::CmdVel, counts: Counts::default() },
        ];
        for event in events {
            let line = serde_json::to_string(&event).unwrap();
            assert!(!line.contains('\n'));
            assert_eq!(serde_json::from_str::<PeerEvent>(&line).unwrap(), event);
        }
        assert_eq!(serde_json::to_string(&PeerCommand::Go).unwrap(), r#"{"do":"go"}"#);
    }
}
