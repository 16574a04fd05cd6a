//! Dropped frames and bodies, and the reasons.

use sgc_trust::{CaFingerprint, CrlError, SignedError};
use sgc_wire::{NodeId, UnixMillis};

use crate::link_id::LinkId;

/// A dropped frame or body, and its sender.
#[derive(Clone, Debug)]
pub struct RouterDrop {
    /// The link that brought it.
    pub link: LinkId,
    /// The node at its other end, if the link is known.
    pub peer: Option<NodeId>,
    /// The reason.
    pub reason: DropReason,
}

/// The reason why a frame or body was dropped.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DropReason {
    /// A signed body that does not verify.
    #[error("{what} not believed: {why}")]
    NotVerified {
        /// Advertisement, join or answer.
        what: &'static str,
        /// The error of the verification.
        why: SignedError,
    },
    /// A node that carries nobody else's names advertised for another owner.
    #[error("advertises names of another node, {}", owner.short())]
    NotOwner {
        /// The owner in the advertisement.
        owner: NodeId,
    },
    /// An answer that no known key of the owner signed. Its sink asks again, and the neighbour is asked for the owner's
    /// advertisement: the owner may have another certificate by now.
    #[error("answer is not signed with a known key of node {}", owner.short())]
    OwnerKey {
        /// The owner of the name.
        owner: NodeId,
    },
    /// An advertisement that is older than the known one, or withdrawn.
    #[error("advertisement {seq} is not newer than {known}")]
    Stale {
        /// Its sequence number.
        seq: u64,
        /// The known number.
        known: u64,
    },
    /// Too many hops.
    #[error("hop limit reached")]
    HopLimit,
    /// A bound of [`Limits`](crate::Limits) is reached.
    #[error("limit reached: {what}")]
    Limit {
        /// The bound.
        what: &'static str,
    },
    /// The neighbour has brought the most questions for names, and the table is full. It may be honest: it brings the
    /// questions of the nodes behind it.
    #[error("too many questions for names are under way")]
    QuestionsFull,
    /// The neighbour has brought too many announcements without news; this one was not looked at.
    #[error("brings too many old announcements")]
    StaleFlood,
    /// A frame for an unknown name or sink.
    #[error("{what} for an unknown name or sink")]
    Unknown {
        /// Kind of frame.
        what: &'static str,
    },
    /// A frame from a neighbour that is not on the route to the owner.
    #[error("{what} from a neighbour that is not on the way to the owner")]
    WrongWay {
        /// Kind of frame.
        what: &'static str,
    },
    /// A frame over a link that is not up.
    #[error("a frame over a link that is not up")]
    NoLink,
    /// A revocation list that is not believed.
    #[error("revocation list not believed: {0}")]
    Crl(CrlError),
    /// A new revocation list beyond the allowance of its CA. The newest such list waits.
    #[error("new revocation lists of the CA {ca} come faster than one a second; the newest of them waits")]
    ListFlood {
        /// The CA that signed it.
        ca: CaFingerprint,
    },
    /// A signed body whose time is not near the time here.
    #[error(
        "{what} signed at {signed}, which is not near {now}: one of the two clocks is wrong, or it is a replay"
    )]
    Clock {
        /// Advertisement, join or link state.
        what: &'static str,
        /// The time in the body.
        signed: UnixMillis,
        /// The time here.
        now: UnixMillis,
    },
    /// A neighbour claims to be a router without the certificate of one.
    #[error(
        "says that it carries others' names, but its certificate does not let it: enroll it with --role router or --may-route"
    )]
    NotRouter,
    /// The holder of an invitation asks for another name than that of its fleet's authority.
    #[error("node {} holds an invitation, and asks for more than its identity", node.short())]
    Invited {
        /// The holder.
        node: NodeId,
    },
}

impl DropReason {
    /// Returns `true` for reasons that an honest neighbour never causes; the others happen when frames cross.
    pub fn is_suspicious(&self) -> bool {
        match self {
            Self::NotVerified { .. }
            | Self::NotOwner { .. }
            | Self::HopLimit
            | Self::Limit { .. }
            | Self::StaleFlood
            | Self::Crl(_)
            | Self::Clock { .. }
            | Self::NotRouter
            | Self::Invited { .. } => true,
            // An honest neighbour passes on what the CA signs.
            Self::ListFlood { .. }
            | Self::OwnerKey { .. }
            | Self::QuestionsFull
            | Self::Stale { .. }
            | Self::Unknown { .. }
            | Self::WrongWay { .. }
            | Self::NoLink => false,
        }
    }

    /// Returns a short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::NotVerified { .. } => "not_verified",
            Self::NotOwner { .. } => "not_owner",
            Self::OwnerKey { .. } => "owner_key",
            Self::Stale { .. } => "stale",
            Self::HopLimit => "hop_limit",
            Self::Limit { .. } => "limit",
            Self::QuestionsFull => "questions_full",
            Self::StaleFlood => "stale_flood",
            Self::Unknown { .. } => "unknown",
            Self::WrongWay { .. } => "wrong_way",
            Self::NoLink => "no_link",
            Self::Crl(_) => "crl",
            Self::ListFlood { .. } => "crl_flood",
            Self::Clock { .. } => "clock",
            Self::NotRouter => "not_router",
            Self::Invited { .. } => "invited",
        }
    }
}
