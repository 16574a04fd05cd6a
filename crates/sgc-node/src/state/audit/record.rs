//! Records of the audit log: one line each.

use std::net::{IpAddr, SocketAddr};

use serde::{Deserialize, Serialize};
use sgc_wire::{Name, NodeId, UnixMillis};

use crate::clock::now;

/// Longest text of one field, bytes.
const FIELD_BYTES_MAX: usize = 512;
/// Digits of an id in a record for people.
pub const AUDIT_ID_CHARS: usize = 8;

/// Kind of event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AuditEvent {
    /// The node started.
    Started,
    /// The node stopped orderly.
    Stopped,
    /// A node was granted a share.
    Granted,
    /// A node was refused a share.
    Refused,
    /// A node left a share.
    Left,
    /// A certificate was revoked.
    Revoked,
    /// A node lost a share that was granted.
    Cut,
    /// A share has a new key.
    Epoch,
    /// A link was made.
    LinkUp,
    /// A connecting peer was refused.
    LinkRefused,
    /// A link ended.
    LinkClosed,
    /// A revocation list came into force.
    Crl,
    /// This node's certificate was renewed, or it renewed another's.
    Renewed,
    /// This authority carried out or refused an operation of an operator.
    Operation,
    /// The configuration was read again.
    Reload,
    /// An access token was made for the gateway.
    TokenMade,
    /// An access token was revoked.
    TokenRevoked,
    /// An invalid access token was presented at the gateway.
    TokenRefused,
    /// Stands for records beyond a peer's hourly quota: the last of them, and their number.
    Summary,
    /// Records were lost.
    Lost,
}

impl AuditEvent {
    /// All events.
    pub const ALL: [Self; 20] = [
        Self::Started,
        Self::Stopped,
        Self::Granted,
        Self::Refused,
        Self::Left,
        Self::Revoked,
        Self::Cut,
        Self::Epoch,
        Self::LinkUp,
        Self::LinkRefused,
        Self::LinkClosed,
        Self::Crl,
        Self::Renewed,
        Self::Operation,
        Self::Reload,
        Self::TokenMade,
        Self::TokenRevoked,
        Self::TokenRefused,
        Self::Summary,
        Self::Lost,
    ];

    /// Returns the event's name in the log.
    pub fn label(self) -> &'static str {
        match self {
            Self::Started => "started",
            Self::Stopped => "stopped",
            Self::Granted => "granted",
            Self::Refused => "refused",
            Self::Left => "left",
            Self::Revoked => "revoked",
            Self::Cut => "cut",
            Self::Epoch => "epoch",
            Self::LinkUp => "link_up",
            Self::LinkRefused => "link_refused",
            Self::LinkClosed => "link_closed",
            Self::Crl => "crl",
            Self::Renewed => "renewed",
            Self::Operation => "operation",
            Self::Reload => "reload",
            Self::TokenMade => "token_made",
            Self::TokenRevoked => "token_revoked",
            Self::TokenRefused => "token_refused",
            Self::Summary => "summary",
            Self::Lost => "audit_lost",
        }
    }

    /// Returns the cause of a record that names no peer.
    fn cause(self) -> Cause {
        match self {
            Self::Crl | Self::Epoch | Self::Renewed => Cause::Fleet,
            _ => Cause::Local,
        }
    }
}

/// One line of the log. Fields that do not apply are absent.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct AuditRecord {
    /// Time, RFC 3339, UTC.
    pub time: String,
    /// Time, milliseconds since 1970.
    pub unix_ms: u64,
    /// Event: [`AuditEvent::label`], or an event of a later version.
    pub event: String,
    /// The ROS topic.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// Its name, hexadecimal digits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The peer's node id, hexadecimal digits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peer: Option<String>,
    /// The peer's name in the configuration.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peer_name: Option<String>,
    /// The peer's address.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remote: Option<String>,
    /// The reason.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The cause: an entry of the policy, a user, a CA.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    /// The epoch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epoch: Option<u32>,
    /// Number of lost records.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lost: Option<u64>,
    /// Event of the summarised records.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// Number of the summarised records.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count: Option<u64>,
    /// Time of the first summarised record. `time` is that of the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    #[serde(skip)]
    pub(super) kind: Option<AuditEvent>,
    #[serde(skip)]
    pub(super) cause: Cause,
    #[serde(skip)]
    pub(super) about: Option<Name>,
}

impl AuditRecord {
    /// Creates a record of the current time.
    pub fn new(event: AuditEvent) -> Self {
        Self::at(event, now().unix)
    }

    /// Creates a record of the time `unix`.
    pub fn at(event: AuditEvent, unix: UnixMillis) -> Self {
        let (label, cause) = (event.label().to_owned(), event.cause());
        let (time, kind) = (unix.to_string(), Some(event));
        Self { time, unix_ms: unix.0, event: label, kind, cause, ..Self::default() }
    }

    /// Returns the topic or, if it is not known, the beginning of its name.
    pub fn subject(&self) -> Option<String> {
        self.topic.clone().or_else(|| self.name.as_ref().map(|name| beginning(name)))
    }

    /// Returns the peer's name or, if it has none, the beginning of its node id.
    pub fn peer_word(&self) -> Option<String> {
        self.peer_name.clone().or_else(|| self.peer.as_ref().map(|peer| beginning(peer)))
    }

    /// Returns everything else that the record says, in words.
    pub fn detail(&self) -> String {
        let mut words = Vec::new();
        if let (Some(of), Some(count)) = (&self.of, self.count) {
            words.push(format!(
                "{count} more of {of} since {}, the last",
                self.from.as_deref().unwrap_or("?")
            ));
        }
        words.extend(self.reason.clone());
        words.extend(self.by.as_ref().map(|by| format!("by {by}")));
        words.extend(self.epoch.map(|epoch| format!("epoch {epoch}")));
        words.extend(self.remote.as_ref().map(|remote| format!("at {remote}")));
        words.extend(self.lost.map(|lost| format!("{lost} records were lost")));
        words.join(", ")
    }

    /// Returns `true` if the record is about the keeping of the fleet: an operation, a revocation list, a renewal, or a
    /// refusal that concerns no share.
    pub(super) fn is_of_fleet(&self) -> bool {
        match self.kind {
            Some(AuditEvent::Operation | AuditEvent::Crl | AuditEvent::Renewed) => true,
            Some(AuditEvent::Refused) => self.about.is_none() && self.topic.is_none(),
            _ => false,
        }
    }

    /// Sets the topic.
    #[must_use]
    pub fn topic(mut self, topic: Option<&str>) -> Self {
        self.topic = topic.map(bounded);
        self
    }

    /// Sets the name.
    #[must_use]
    pub fn name(mut self, name: &Name) -> Self {
        self.name = Some(name.to_string());
        self.about = Some(*name);
        self
    }

    /// Sets the peer.
    #[must_use]
    pub fn peer(mut self, peer: &NodeId) -> Self {
        self.peer = Some(peer.to_string());
        self.cause = Cause::Peer(*peer);
        self
    }

    /// Sets the address.
    #[must_use]
    pub fn remote(mut self, remote: SocketAddr) -> Self {
        self.remote = Some(remote.to_string());
        if !matches!(self.cause, Cause::Peer(_)) {
            self.cause = Cause::Address(remote.ip());
        }
        self
    }

    /// Marks a user of this machine as the cause, so that no quota counts the record.
    #[must_use]
    pub fn by_user(mut self) -> Self {
        self.cause = Cause::Local;
        self.by("a user")
    }

    /// Sets the reason.
    #[must_use]
    pub fn reason(mut self, reason: impl ToString) -> Self {
        self.reason = Some(bounded(&reason.to_string()));
        self
    }

    /// Sets the cause.
    #[must_use]
    pub fn by(mut self, by: impl ToString) -> Self {
        self.by = Some(bounded(&by.to_string()));
        self
    }

    /// Sets the epoch.
    #[must_use]
    pub fn epoch(mut self, epoch: u32) -> Self {
        self.epoch = Some(epoch);
        self
    }
}

/// The cause of a record.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Cause {
    /// This node or its user. Such records are unlimited.
    #[default]
    Local,
    /// The fleet: its CA, its authority, or the passage of time.
    Fleet,
    /// A peer with a certificate.
    Peer(NodeId),
    /// A peer at this address without a valid certificate.
    Address(IpAddr),
}

/// Returns the first digits of an id.
fn beginning(digits: &str) -> String {
    digits.chars().take(AUDIT_ID_CHARS).collect()
}

fn bounded(text: &str) -> String {
    let end = (0..=FIELD_BYTES_MAX).rev().find(|at| text.is_char_boundary(*at)).unwrap_or(0);
    text.get(..end).unwrap_or(text).to_owned()
}
