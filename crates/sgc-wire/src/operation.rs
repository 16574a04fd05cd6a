//! Operations on a fleet, carried out by its authority for an operator: questions at the authority's operations name,
//! and their answers.
//!
//! An operation names a challenge that the authority gave to the same operator before, so that nobody can repeat it.

use std::fmt;

use bytes::Bytes;
use zeroize::Zeroize;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::control::{CSR_BYTES_MAX, REPLY_KEY_BYTES_MAX, SEALED_BYTES_MAX};
use crate::ids::{NodeId, SinkId, UnixMillis};

/// Longest name of a node or group, bytes.
const LABEL_BYTES_MAX: usize = 64;
/// Most groups of one node.
const GROUPS_MAX: usize = 32;
/// Most nodes that one operation revokes.
pub const REVOKED_AT_ONCE_MAX: usize = 32;
/// Most nodes of one page of a roster.
pub const ROSTER_ROWS_MAX: usize = 2048;
/// Most certificates of one node that a page shows.
pub const ROW_CERTIFICATES_MAX: usize = 256;
/// Most generations of the naming secret.
const GENERATIONS_MAX: usize = 8;
/// Most routers that an invitation names.
pub const INVITATION_ROUTERS_MAX: usize = 8;
/// Longest URL of a router in an invitation, bytes.
pub const ROUTER_BYTES_MAX: usize = 300;
/// Longest serial number, bytes.
const SERIAL_BYTES_MAX: usize = 20;
/// Longest explanation of a refusal, bytes.
pub const REFUSAL_DETAIL_BYTES_MAX: usize = 512;

/// Stands for the sink where the answer to [`Operation::Redeem`] is sealed to the key in the operation.
pub const REDEEM_SINK: SinkId = SinkId([0; 16]);

/// A challenge of an authority: random, for one operation of one operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Challenge(pub [u8; 16]);

/// A question at an authority's operations name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum OperationRequest {
    /// A request for a challenge.
    Challenge,
    /// A request for an operation, once.
    Execute {
        /// The challenge that the authority gave for it.
        challenge: Challenge,
        /// The operation.
        operation: Operation,
    },
}

/// An operation on a fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Operation {
    /// Shows the roster, a page at a time.
    List {
        /// The last node of the page before.
        after: Option<String>,
    },
    /// Revokes nodes: all of them or none.
    Revoke {
        /// Their names.
        nodes: Vec<String>,
    },
    /// Enrols a node that made its key itself.
    Enroll {
        /// Its name.
        node: String,
        /// Its groups.
        groups: Vec<String>,
        /// Whether it only routes.
        router: bool,
        /// Whether it may route for others as well.
        may_route: bool,
        /// Whether a revoked node may be enrolled again.
        again: bool,
        /// Requested validity of its certificate, milliseconds.
        valid_ms: u64,
        /// Its signing request (PKCS #10), DER.
        csr: Bytes,
    },
    /// Makes another certificate for a node, in its groups and with its role.
    Renew {
        /// Its name.
        node: String,
        /// Requested validity of the certificate, milliseconds.
        valid_ms: u64,
        /// Its signing request (PKCS #10), DER.
        csr: Bytes,
    },
    /// Makes the identity of the invited node, asked for by the holder of its invitation: nobody else may, and the
    /// holder may ask for nothing else.
    Redeem {
        /// Its signing request (PKCS #10), DER.
        csr: Bytes,
        /// Public key to which the identity is sealed, X25519 or X-Wing: others may have the holder's certificate.
        reply_key: Bytes,
    },
    /// Enters a node in the roster and makes an invitation for it.
    Invite {
        /// Its name.
        node: String,
        /// Its groups.
        groups: Vec<String>,
        /// Whether it only routes.
        router: bool,
        /// Whether it may route for others as well.
        may_route: bool,
        /// Whether a revoked node may be enrolled again.
        again: bool,
        /// Requested validity of its certificate, milliseconds.
        valid_ms: u64,
        /// Time for which the invitation is valid, milliseconds.
        within_ms: u64,
        /// Routers that the invitation names, as URLs.
        routers: Vec<String>,
    },
}

/// An authority's answer to an [`OperationRequest`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum OperationAnswer {
    /// A challenge for the next operation.
    Challenge(Challenge),
    /// The authority did nothing.
    Refused {
        /// The reason.
        why: OperationRefusal,
        /// The reason in words, at most [`REFUSAL_DETAIL_BYTES_MAX`] bytes; may be empty.
        detail: String,
    },
    /// A page of the roster.
    Roster(RosterPage),
    /// The nodes are revoked.
    Revoked {
        /// Number of the revocation list with them.
        list: u64,
    },
    /// The node is in the roster; this is the text that makes its identity, together with its key.
    Membership(SecretText),
    /// The node is in the roster; this is the text of its invitation.
    Invitation(SecretText),
    /// The invitation is redeemed; this is the [`OperationAnswer::Membership`], sealed to the key in the request.
    Sealed {
        /// Encapsulated key.
        enc: Bytes,
        /// The sealed answer.
        sealed: Bytes,
    },
}

/// The reason why an authority refuses an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum OperationRefusal {
    /// The challenge is not one that this run of the authority gave to the operator, or was used before.
    Stale,
    /// Too many operations wait.
    Busy,
    /// The fleet's file cannot be read or written.
    File,
    /// The fleet refuses; the detail has the reason.
    Fleet,
    /// An invalid name or other field.
    Malformed,
}

/// A text with secrets, such as an answer for a node: debug output hides it, and its memory is cleared.
#[derive(Clone, PartialEq, Eq)]
pub struct SecretText(String);

/// A page of a roster, for display.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RosterPage {
    /// The fleet's name.
    pub fleet: String,
    /// Last moment at which its CA is valid.
    pub expires: UnixMillis,
    /// The node that renews certificates.
    pub authority: Option<String>,
    /// Whether links and grants resist quantum computers.
    pub post_quantum: bool,
    /// `false` if the file is from before rosters.
    pub has_roster: bool,
    /// Number of the last revocation list.
    pub revocation_list: u64,
    /// Generations of the naming secret in use with their times, oldest first.
    pub generations: Vec<(u32, UnixMillis)>,
    /// Nodes by name.
    pub nodes: Vec<RosterRow>,
    /// Whether further nodes follow.
    pub more: bool,
}

/// A node of a roster.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosterRow {
    /// Its name.
    pub name: String,
    /// Its node id.
    pub id: NodeId,
    /// Number of times that it was enrolled again after a revocation.
    pub incarnation: u32,
    /// Its groups.
    pub groups: Vec<String>,
    /// Whether it only routes.
    pub router: bool,
    /// Whether it may route for others.
    pub may_route: bool,
    /// Last moment at which a certificate of it is valid.
    pub expires: Option<UnixMillis>,
    /// Time of its revocation, if it is revoked.
    pub revoked: Option<UnixMillis>,
    /// The newest generation of the naming secret that it was handed; 0 if that is unknown or it has none.
    pub generation: u32,
    /// Time at which the fleet last heard of it, as far as is known.
    pub seen: Option<UnixMillis>,
    /// Its certificates.
    pub certificates: Vec<RowCertificate>,
}

/// A certificate of a [`RosterRow`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowCertificate {
    /// Its serial number.
    pub serial: Bytes,
    /// Last moment at which it is valid.
    pub expires: UnixMillis,
    /// The incarnation of its node.
    pub incarnation: u32,
    /// Time of its revocation, if it is revoked.
    pub revoked: Option<UnixMillis>,
}

impl SecretText {
    /// Hides a text.
    pub fn new(text: String) -> Self {
        Self(text)
    }

    /// Returns the text.
    pub fn expose(&self) -> &str {
        &self.0
    }
}

impl Drop for SecretText {
    fn drop(&mut self) {
        self.0.zeroize();
    }
}

impl fmt::Debug for SecretText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretText(…)")
    }
}

impl OperationRefusal {
    const ALL: [Self; 5] = [Self::Stale, Self::Busy, Self::File, Self::Fleet, Self::Malformed];

    /// Returns a short, stable name for counters and JSON.
    pub const fn key(self) -> &'static str {
        match self {
            Self::Stale => "operation_stale",
            Self::Busy => "operation_busy",
            Self::File => "operation_fleet_file",
            Self::Fleet => "operation_refused",
            Self::Malformed => "operation_malformed",
        }
    }
}

impl fmt::Display for OperationRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Stale => "the request was made for an earlier run of the authority, or was repeated",
            Self::Busy => "the authority is busy with other operations: repeat the command later",
            Self::File => "the authority cannot use its fleet file",
            Self::Fleet => "the fleet refuses",
            Self::Malformed => "the authority does not understand the request",
        })
    }
}

impl Decode for OperationRefusal {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let tag = r.u8()?;
        let found = Self::ALL.get(usize::from(tag)).copied();
        found.ok_or(DecodeError::value("refusal of an operation", tag.into()))
    }
}

impl Encode for OperationRequest {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Challenge => w.u8(0),
            Self::Execute { challenge, operation } => {
                w.u8(1);
                w.raw(&challenge.0);
                operation.encode(w);
            }
        }
    }
}

impl Decode for OperationRequest {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::Challenge),
            1 => Ok(Self::Execute {
                challenge: Challenge(r.array("challenge")?),
                operation: Operation::decode(r)?,
            }),
            v => Err(DecodeError::value("operation request", v.into())),
        }
    }
}

impl Encode for Operation {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::List { after } => {
                w.u8(0);
                w.option(after.as_ref(), |w, name| w.str(name));
            }
            Self::Revoke { nodes } => {
                w.u8(1);
                w.list(nodes, |w, name| w.str(name));
            }
            Self::Enroll { node, groups, router, may_route, again, valid_ms, csr } => {
                w.u8(2);
                w.str(node);
                w.list(groups, |w, group| w.str(group));
                [router, may_route, again].into_iter().for_each(|flag| w.bool(*flag));
                w.u64(*valid_ms);
                w.bytes(csr);
            }
            Self::Renew { node, valid_ms, csr } => {
                w.u8(3);
                w.str(node);
                w.u64(*valid_ms);
                w.bytes(csr);
            }
            Self::Redeem { csr, reply_key } => {
                w.u8(4);
                w.bytes(csr);
                w.bytes(reply_key);
            }
            Self::Invite { node, groups, router, may_route, again, valid_ms, within_ms, routers } => {
                w.u8(5);
                w.str(node);
                w.list(groups, |w, group| w.str(group));
                [router, may_route, again].into_iter().for_each(|flag| w.bool(*flag));
                w.u64(*valid_ms);
                w.u64(*within_ms);
                w.list(routers, |w, url| w.str(url));
            }
        }
    }
}

impl Decode for Operation {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::List { after: r.option("after", |r| label(r, "node"))? }),
            1 => Ok(Self::Revoke { nodes: r.list("nodes", REVOKED_AT_ONCE_MAX, |r| label(r, "node"))? }),
            2 => Ok(Self::Enroll {
                node: label(r, "node")?,
                groups: r.list("groups", GROUPS_MAX, |r| label(r, "group"))?,
                router: r.bool("router")?,
                may_route: r.bool("may route")?,
                again: r.bool("again")?,
                valid_ms: r.u64()?,
                csr: csr(r)?,
            }),
            3 => Ok(Self::Renew { node: label(r, "node")?, valid_ms: r.u64()?, csr: csr(r)? }),
            4 => {
                let csr = csr(r)?;
                let reply_key = Bytes::copy_from_slice(r.bytes("reply key", REPLY_KEY_BYTES_MAX)?);
                Ok(Self::Redeem { csr, reply_key })
            }
            5 => Ok(Self::Invite {
                node: label(r, "node")?,
                groups: r.list("groups", GROUPS_MAX, |r| label(r, "group"))?,
                router: r.bool("router")?,
                may_route: r.bool("may route")?,
                again: r.bool("again")?,
                valid_ms: r.u64()?,
                within_ms: r.u64()?,
                routers: r.list("routers", INVITATION_ROUTERS_MAX, |r| r.str("router", ROUTER_BYTES_MAX))?,
            }),
            v => Err(DecodeError::value("operation", v.into())),
        }
    }
}

impl Encode for OperationAnswer {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Challenge(challenge) => {
                w.u8(0);
                w.raw(&challenge.0);
            }
            Self::Refused { why, detail } => {
                w.u8(1);
                w.u8(*why as u8);
                w.str(detail);
            }
            Self::Roster(page) => {
                w.u8(2);
                page.encode(w);
            }
            Self::Revoked { list } => {
                w.u8(3);
                w.u64(*list);
            }
            Self::Membership(text) => {
                w.u8(4);
                w.bytes(text.expose().as_bytes());
            }
            Self::Invitation(text) => {
                w.u8(5);
                w.bytes(text.expose().as_bytes());
            }
            Self::Sealed { enc, sealed } => {
                w.u8(6);
                w.bytes(enc);
                w.bytes(sealed);
            }
        }
    }
}

impl Decode for OperationAnswer {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::Challenge(Challenge(r.array("challenge")?))),
            1 => Ok(Self::Refused {
                why: OperationRefusal::decode(r)?,
                detail: r.str("detail", REFUSAL_DETAIL_BYTES_MAX)?,
            }),
            2 => Ok(Self::Roster(RosterPage::decode(r)?)),
            3 => Ok(Self::Revoked { list: r.u64()? }),
            4 => Ok(Self::Membership(SecretText(r.str("membership", SEALED_BYTES_MAX)?))),
            5 => Ok(Self::Invitation(SecretText(r.str("invitation", SEALED_BYTES_MAX)?))),
            6 => {
                let enc = Bytes::copy_from_slice(r.bytes("encapsulated key", REPLY_KEY_BYTES_MAX)?);
                let sealed = Bytes::copy_from_slice(r.bytes("sealed answer", SEALED_BYTES_MAX)?);
                Ok(Self::Sealed { enc, sealed })
            }
            v => Err(DecodeError::value("answer to an operation", v.into())),
        }
    }
}

impl Encode for RosterPage {
    fn encode(&self, w: &mut Writer) {
        w.str(&self.fleet);
        self.expires.encode(w);
        w.option(self.authority.as_ref(), |w, name| w.str(name));
        w.bool(self.post_quantum);
        w.bool(self.has_roster);
        w.u64(self.revocation_list);
        w.list(&self.generations, |w, (number, made)| {
            w.u32(*number);
            made.encode(w);
        });
        w.list(&self.nodes, |w, node| node.encode(w));
        w.bool(self.more);
    }
}

impl Decode for RosterPage {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            fleet: label(r, "fleet")?,
            expires: UnixMillis(r.u64()?),
            authority: r.option("authority", |r| label(r, "authority"))?,
            post_quantum: r.bool("post-quantum")?,
            has_roster: r.bool("has roster")?,
            revocation_list: r.u64()?,
            generations: r.list("generations", GENERATIONS_MAX, |r| Ok((r.u32()?, UnixMillis(r.u64()?))))?,
            nodes: r.list("nodes", ROSTER_ROWS_MAX, RosterRow::decode)?,
            more: r.bool("more")?,
        })
    }
}

impl Encode for RosterRow {
    fn encode(&self, w: &mut Writer) {
        w.str(&self.name);
        self.id.encode(w);
        w.u32(self.incarnation);
        w.list(&self.groups, |w, group| w.str(group));
        w.bool(self.router);
        w.bool(self.may_route);
        for time in [&self.expires, &self.revoked] {
            w.option(time.as_ref(), |w, time| time.encode(w));
        }
        w.u32(self.generation);
        w.option(self.seen.as_ref(), |w, time| time.encode(w));
        w.list(&self.certificates, |w, certificate| {
            w.bytes(&certificate.serial);
            certificate.expires.encode(w);
            w.u32(certificate.incarnation);
            w.option(certificate.revoked.as_ref(), |w, time| time.encode(w));
        });
    }
}

impl Decode for RosterRow {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            name: label(r, "node")?,
            id: NodeId::decode(r)?,
            incarnation: r.u32()?,
            groups: r.list("groups", GROUPS_MAX, |r| label(r, "group"))?,
            router: r.bool("router")?,
            may_route: r.bool("may route")?,
            expires: r.option("expires", time)?,
            revoked: r.option("revoked", time)?,
            generation: r.u32()?,
            seen: r.option("seen", time)?,
            certificates: r.list("certificates", ROW_CERTIFICATES_MAX, |r| {
                Ok(RowCertificate {
                    serial: Bytes::copy_from_slice(r.bytes("serial", SERIAL_BYTES_MAX)?),
                    expires: time(r)?,
                    incarnation: r.u32()?,
                    revoked: r.option("revoked", time)?,
                })
            })?,
        })
    }
}

fn label(r: &mut Reader<'_>, field: &'static str) -> Result<String, DecodeError> {
    r.str(field, LABEL_BYTES_MAX)
}

fn csr(r: &mut Reader<'_>) -> Result<Bytes, DecodeError> {
    r.bytes("signing request", CSR_BYTES_MAX).map(Bytes::copy_from_slice)
}

fn time(r: &mut Reader<'_>) -> Result<UnixMillis, DecodeError> {
    r.u64().map(UnixMillis)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::ASK_BYTES_MAX;

    fn row(name: &str) -> RosterRow {
        let (expires, revoked) = (UnixMillis(7), Some(UnixMillis(5)));
        let serial = Bytes::from_static(&[1; 16]);
        let certificate = RowCertificate { serial, expires, incarnation: 2, revoked };
        RosterRow {
            name: name.into(),
            id: NodeId([3; 32]),
            incarnation: 2,
            groups: vec!["arms".into(), "legs".into()],
            router: false,
            may_route: true,
            expires: Some(expires),
            revoked,
            generation: 3,
            seen: Some(UnixMillis(9)),
            certificates: vec![certificate],
        }
    }

    fn round_trip<T: Encode + Decode + PartialEq + fmt::Debug>(value: &T) {
        let bytes = value.to_vec();
        assert_eq!(T::from_slice(&bytes).as_ref(), Ok(value));
        for length in 0..bytes.len() {
            assert!(T::from_slice(&bytes[..length]).is_err(), "{length} of {value:?}");
        }
        assert!(T::from_slice(&[&bytes[..], &[0]].concat()).is_err());
    }

    #[test]
    fn requests_and_answers_round_trip_and_no_shorter_one_is_read() {
        let challenge = Challenge([7; 16]);
        let csr = Bytes::from_static(b"csr");
        let enroll = Operation::Enroll {
            node: "arm-1".into(),
            groups: vec!["arms".into()],
            router: false,
            may_route: true,
            again: true,
            valid_ms: 5,
            csr: csr.clone(),
        };
        round_trip(&OperationRequest::Challenge);
        for operation in [
            Operation::List { after: None },
            Operation::List { after: Some("arm-1".into()) },
            Operation::Revoke { nodes: vec!["arm-1".into(), "desk".into()] },
            enroll,
            Operation::Renew { node: "arm-1".into(), valid_ms: 9, csr },
        ] {
            round_trip(&OperationRequest::Execute { challenge, operation });
        }
        let page = RosterPage {
            fleet: "lab".into(),
            expires: UnixMillis(1),
            authority: Some("keeper".into()),
            post_quantum: true,
            has_roster: true,
            revocation_list: 4,
            generations: vec![(1, UnixMillis(1)), (3, UnixMillis(2))],
            nodes: vec![row("arm-1"), row("desk")],
            more: true,
        };
        for answer in [
            OperationAnswer::Challenge(challenge),
            OperationAnswer::Roster(page),
            OperationAnswer::Revoked { list: 77 },
            OperationAnswer::Membership(SecretText::new("secret".into())),
        ] {
            round_trip(&answer);
        }
        for (tag, why) in (0..).zip(OperationRefusal::ALL) {
            assert_eq!(why as u8, tag);
            round_trip(&OperationAnswer::Refused { why, detail: "because".into() });
        }
    }

    #[test]
    fn the_longest_operations_fit_into_a_question() {
        let challenge = Challenge([7; 16]);
        let label = "x".repeat(LABEL_BYTES_MAX);
        let enroll = Operation::Enroll {
            node: label.clone(),
            groups: vec![label.clone(); GROUPS_MAX],
            router: false,
            may_route: false,
            again: false,
            valid_ms: u64::MAX,
            csr: vec![0; CSR_BYTES_MAX].into(),
        };
        let revoke = Operation::Revoke { nodes: vec![label; REVOKED_AT_ONCE_MAX] };
        for operation in [enroll, revoke] {
            assert!(OperationRequest::Execute { challenge, operation }.to_vec().len() <= ASK_BYTES_MAX);
        }
    }

    #[test]
    fn debug_output_hides_secrets() {
        let answer = OperationAnswer::Membership(SecretText::new("hush".into()));
        assert!(!format!("{answer:?}").contains("hush"));
    }
}
