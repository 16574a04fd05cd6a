//! Reasons why data of a peer goes over routers, as the status, reports and the graph tell them.

use std::fmt;

use serde::{Deserialize, Serialize};
use sgc_session::{DIRECT_PEERS_MAX, NoDirectPath};

/// Most peers without a direct link in one document.
pub const NOT_DIRECT_MAX: usize = DIRECT_PEERS_MAX;

/// A peer with which data is exchanged over routers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct NotDirectPeer {
    /// The node id of the peer.
    pub peer: String,
    /// The name of the peer, or the beginning of its node id if the node does not know the name.
    pub name: String,
    /// Why there is no direct link.
    pub reason: NotDirectReason,
}

/// Reasons why there is no direct link to a peer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NotDirectReason {
    /// The first search for a direct path is under way.
    First,
    /// The peer does not tell its addresses: its version is older, or `direct` there is `"never"`.
    Unanswered,
    /// `direct` of the peer does not permit this node.
    Refused,
    /// The peer knows none of its addresses yet, or has too many other searches under way.
    Unready,
    /// No packet passes between the two networks.
    Blocked,
    /// Packets pass, and no link was made.
    NoLink,
    /// There is a direct link, and nothing arrives over it.
    Silent,
    /// There was a direct link, and it ended.
    Lost,
    /// This node has no address that the peer could reach.
    NoAddress,
    /// One node has IPv4 alone, and the other IPv6 alone.
    NoCommonFamily,
    /// Too many searches are under way.
    Busy,
    /// `direct` of this node is `"never"`.
    Never,
    /// `direct` of this node does not permit the peer.
    NotPermitted,
    /// This node uses nothing of the peer, so the peer looks for a direct path.
    NotWanted,
    /// This node only routes.
    OnlyRoutes,
    /// A reason of another version.
    #[default]
    #[serde(other)]
    Other,
}

impl NotDirectReason {
    /// All reasons of this version.
    pub const ALL: [Self; 15] = [
        Self::First,
        Self::Unanswered,
        Self::Refused,
        Self::Unready,
        Self::Blocked,
        Self::NoLink,
        Self::Silent,
        Self::Lost,
        Self::NoAddress,
        Self::NoCommonFamily,
        Self::Busy,
        Self::Never,
        Self::NotPermitted,
        Self::NotWanted,
        Self::OnlyRoutes,
    ];

    /// Returns the remedy; empty if there is none to name.
    pub fn fix(self) -> &'static str {
        match self {
            Self::Unanswered => "update sgc at the peer, or let `direct` in [node] there permit this node",
            Self::Refused => {
                "name this node in `direct` of [node] at the peer, if it may learn the addresses there"
            }
            Self::Blocked => {
                "run `sgc netcheck` at both nodes: UDP has to pass at both. If one NAT is symmetric, IPv6 at both nodes or a \
                 port mapping at one of them helps"
            }
            Self::NoLink => "look into the logs of both nodes",
            Self::NoAddress => "give this host an address that others reach, and name a router by quic://",
            Self::NoCommonFamily => "give one of the two hosts an address of the other family",
            Self::Never | Self::NotPermitted => {
                "name the peer, or the partner that it is of, in `direct` of [node] here, if it may learn the addresses of \
                 this node"
            }
            Self::NotWanted => "`sgc why` at the peer says why there is none",
            Self::First
            | Self::Unready
            | Self::Silent
            | Self::Lost
            | Self::Busy
            | Self::OnlyRoutes
            | Self::Other => "",
        }
    }
}

impl From<NoDirectPath> for NotDirectReason {
    fn from(why: NoDirectPath) -> Self {
        match why {
            NoDirectPath::First => Self::First,
            NoDirectPath::Unanswered => Self::Unanswered,
            NoDirectPath::Refused => Self::Refused,
            NoDirectPath::Unready => Self::Unready,
            NoDirectPath::Blocked => Self::Blocked,
            NoDirectPath::NoLink => Self::NoLink,
            NoDirectPath::Silent => Self::Silent,
            NoDirectPath::Lost => Self::Lost,
            NoDirectPath::NoAddress => Self::NoAddress,
            NoDirectPath::NoCommonFamily => Self::NoCommonFamily,
            NoDirectPath::Busy => Self::Busy,
        }
    }
}

impl fmt::Display for NotDirectReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::First => NoDirectPath::First.fmt(f),
            Self::Unanswered => NoDirectPath::Unanswered.fmt(f),
            Self::Refused => NoDirectPath::Refused.fmt(f),
            Self::Unready => NoDirectPath::Unready.fmt(f),
            Self::Blocked => NoDirectPath::Blocked.fmt(f),
            Self::NoLink => NoDirectPath::NoLink.fmt(f),
            Self::Silent => NoDirectPath::Silent.fmt(f),
            Self::Lost => NoDirectPath::Lost.fmt(f),
            Self::NoAddress => NoDirectPath::NoAddress.fmt(f),
            Self::NoCommonFamily => NoDirectPath::NoCommonFamily.fmt(f),
            Self::Busy => NoDirectPath::Busy.fmt(f),
            Self::Never => f.write_str("`direct` of this node is \"never\""),
            Self::NotPermitted => f.write_str("`direct` of this node does not permit the peer"),
            Self::NotWanted => {
                f.write_str("this node uses nothing of the peer, so the peer looks for a direct path")
            }
            Self::OnlyRoutes => f.write_str("this node only routes"),
            Self::Other => f.write_str("a reason of another version of sgc"),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn reason_of_a_later_version_is_read() {
        for (text, reason) in
            [("\"blocked\"", NotDirectReason::Blocked), ("\"of_tomorrow\"", NotDirectReason::Other)]
        {
            assert_eq!(serde_json::from_str::<NotDirectReason>(text).unwrap(), reason);
        }
        for reason in NotDirectReason::ALL {
            let text = serde_json::to_string(&reason).unwrap();
            assert_eq!(serde_json::from_str::<NotDirectReason>(&text).unwrap(), reason);
            assert_ne!(reason.to_string(), NotDirectReason::Other.to_string());
        }
    }
}
