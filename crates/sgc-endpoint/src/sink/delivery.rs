//! The results of packets: messages, signs of missing ones, and drops.

use bytes::Bytes;
use sgc_trust::OpenError;
use sgc_wire::{MessageHead, SourceId};

/// A complete message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// The publishing source.
    pub source: SourceId,
    /// Its number at the source.
    pub seq: u64,
    /// Kind and time of publication.
    pub head: MessageHead,
    /// Whether its publisher waits for slow receivers; otherwise newer messages replace it.
    pub reliable: bool,
    /// The payload, as it was published.
    pub payload: Bytes,
}

/// Result of a packet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The packet completed a message.
    Message(Message),
    /// More fragments are needed.
    Incomplete,
    /// No message, but a sign that none is missing.
    Mark,
    /// No message: the source asks whether this number of it and all before have arrived, which they have.
    Confirm(SourceId, u64),
    /// No message: the publisher of this source asserted its liveliness.
    Asserted(SourceId),
    /// The sink has to ask the source for missing messages before it delivers later ones; see [`crate::Sink::ask`].
    NeedsHistory(SourceId),
    /// The source has sent the requested messages.
    Synced(SourceId),
    /// This many numbers of the source will never be delivered: nobody has their messages any more.
    Lost(SourceId, u64),
    /// The packet waits for the grant that explains its epoch or source; see [`crate::Sink::regrant`].
    Parked,
}

/// The reason why a packet was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum SinkDrop {
    /// The packet could not be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The packet is for another sink, or for an earlier id of this one.
    #[error("addressed to another sink")]
    NotForUs,
    /// Several grants came, and none announced its source.
    #[error("of a source that the owner does not announce")]
    UnknownSource,
    /// Several grants came, and none had its epoch.
    #[error("of an epoch that was never granted")]
    UnknownEpoch,
    /// The packet waits for a grant, and an older waiting packet was dropped for it.
    #[error("too many packets wait for a grant")]
    ParkingFull,
    /// The message was published before the source was announced to this sink, and not asked for.
    #[error("message older than the announcement of its source")]
    BelowFloor,
    /// The message was delivered before, or is too old to tell.
    #[error("message delivered before")]
    Replayed,
    /// A newer message of its best-effort source was delivered before.
    #[error("a newer message was delivered before")]
    Late,
    /// The fragment was received before.
    #[error("fragment received before")]
    DuplicateFragment,
    /// The fragment contradicts an earlier one of the same message.
    #[error("fragment contradicts its message")]
    Inconsistent,
    /// The message's head is malformed.
    #[error("message head malformed")]
    Head,
    /// The requested messages have not arrived yet, and will contain this one.
    #[error("awaiting the answer that contains it")]
    AwaitingHistory,
    /// The bound on incomplete messages is reached, and its source would have more than its share of them.
    #[error("too many incomplete messages")]
    PartialsFull,
}

impl SinkDrop {
    /// Returns a short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Open(OpenError::Suite { .. }) => "sink_suite",
            Self::Open(OpenError::Epoch { .. }) => "sink_epoch",
            Self::Open(OpenError::Length) => "sink_length",
            Self::Open(OpenError::Forged) => "sink_forged",
            Self::Open(OpenError::Trailer) => "sink_trailer",
            Self::Open(OpenError::Signature) => "sink_signature",
            Self::Open(OpenError::NoMac) => "sink_no_mac",
            Self::Open(OpenError::Mac) => "sink_mac",
            Self::NotForUs => "sink_not_for_us",
            Self::UnknownSource => "sink_unknown_source",
            Self::UnknownEpoch => "sink_unknown_epoch",
            Self::ParkingFull => "sink_parking_full",
            Self::BelowFloor => "sink_below_floor",
            Self::Replayed => "sink_replayed",
            Self::Late => "sink_late",
            Self::DuplicateFragment => "sink_duplicate_fragment",
            Self::Inconsistent => "sink_inconsistent",
            Self::Head => "sink_head",
            Self::AwaitingHistory => "sink_awaiting_history",
            Self::PartialsFull => "sink_partials_full",
        }
    }
}

/// Action for a source that was asked and then silent for a while.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AskAgain {
    /// Nothing is missing any more.
    No,
    /// The answer is on its way.
    Wait,
    /// Ask for all messages from this number on.
    From(u64),
}
