//! The protocol between the demo and its peers: lines of JSON over standard input and output.

use serde::{Deserialize, Serialize};

use crate::topics::Topic;
use crate::tracker::Counts;

/// A command of the demo to a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub(crate) enum PeerCommand {
    /// Number the messages from 1.
    Go,
    /// Stop numbering and report the total.
    Stop,
}

/// An event that a peer reports to the demo.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "is", rename_all = "snake_case")]
pub(crate) enum PeerEvent {
    /// A talker's number of subscribers on its network has changed.
    Matched {
        /// The talker's topic.
        topic: Topic,
        /// The number of matched readers.
        readers: u32,
    },
    /// A listener has received its first message.
    Arrived {
        /// The listener's topic.
        topic: Topic,
    },
    /// The progress of a talker.
    Sending {
        /// The talker's topic.
        topic: Topic,
        /// Messages sent.
        sent: u64,
    },
    /// A talker has stopped numbering.
    Sent {
        /// The talker's topic.
        topic: Topic,
        /// Messages sent in all.
        total: u64,
    },
    /// The progress of a listener.
    Receiving {
        /// The listener's topic.
        topic: Topic,
        /// The listener's counts.
        counts: Counts,
    },
    /// A peer cannot go on.
    Failed {
        /// The cause.
        reason: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_survive_encoding() {
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
