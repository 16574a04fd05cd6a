//! Errors of fleets and of requests to them: one variant per cause.

use std::fmt;

use sgc_wire::{DecodeError, SECRET_GENERATIONS_MAX, UnixMillis};

use crate::blocks::{CERTIFICATE_BLOCK, FLEET_BLOCK, KEY_BLOCK, ROSTER_BLOCK};
use crate::invitation_bounds::{INVITATION_ROUTERS_MAX, INVITATION_TIME_MAX, ROUTER_BYTES_MAX};
use crate::label::{FleetName, GROUPS_MAX, LabelError, NodeName};
use crate::pem::PemError;
use crate::revocations::REVOKED_NODES_MAX;
use crate::roster::{ROSTER_BYTES_MAX, ROSTER_NODES_MAX};
use crate::secret::{NAMING_BLOCK, SECRET_BLOCK, SECRET_BYTES};
use crate::verify::AnchorError;

/// The reason why a fleet cannot be made or read, or cannot enrol a node.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// The file is not a sequence of blocks.
    #[error("this is not a fleet file")]
    File(#[source] PemError),
    /// A block that this version does not know.
    #[error("block \"{0}\" does not belong into a fleet file")]
    UnknownBlock(String),
    /// A block occurs twice.
    #[error("block \"{0}\" occurs twice in the fleet file")]
    Repeated(&'static str),
    /// A block is missing.
    #[error("block \"{0}\" is missing from the fleet file")]
    Missing(&'static str),
    /// The block that names the fleet is broken.
    #[error("block \"{FLEET_BLOCK}\" is broken")]
    About(#[source] DecodeError),
    /// The fleet's name is invalid.
    #[error("block \"{FLEET_BLOCK}\" holds an illegal name")]
    Name(#[source] LabelError),
    /// The CA certificate is broken.
    #[error("block \"{CERTIFICATE_BLOCK}\" is broken")]
    Certificate(#[source] AnchorError),
    /// The CA key is broken.
    #[error(
        "block \"{KEY_BLOCK}\" is no key in PKCS #8 that is P-256, P-384, Ed25519 or RSA of 2048 bits and more"
    )]
    Key,
    /// The key does not belong to the certificate.
    #[error("the key and the certificate in the fleet file do not belong together")]
    KeyMismatch,
    /// The secret has a wrong length.
    #[error("block \"{SECRET_BLOCK}\" does not hold {SECRET_BYTES} bytes")]
    Secret,
    /// A naming secret is broken, not the one that the roster names, or one too many.
    #[error("the blocks \"{NAMING_BLOCK}\" are not those that the roster names")]
    NamingSecret,
    /// The roster cannot be read.
    #[error("block \"{ROSTER_BLOCK}\" is broken")]
    Roster(#[source] DecodeError),
    /// The roster is not as the CA signed it.
    #[error(
        "block \"{ROSTER_BLOCK}\" was altered: its signature is not the CA's; restore the file from a copy"
    )]
    RosterSignature,
    /// The roster would be too long.
    #[error("the roster would have {bytes} bytes, at most {ROSTER_BYTES_MAX} are kept: make a second fleet")]
    RosterFull {
        /// Its length.
        bytes: usize,
    },
    /// The fleet has too many nodes.
    #[error("a fleet has at most {ROSTER_NODES_MAX} nodes: make a second one")]
    TooManyNodes,
    /// The fleet has revoked too many nodes.
    #[error("a fleet revokes at most {REVOKED_NODES_MAX} nodes: make a second one")]
    TooManyRevoked,
    /// Two files of different fleets cannot be merged.
    #[error(
        "it is of another fleet, {name}, or of another one of that name: only copies of one fleet's file are merged"
    )]
    OtherFleet {
        /// The name of the other.
        name: FleetName,
    },
    /// No such node.
    #[error("the fleet's roster has no node {node}: see `sgc fleet list`")]
    UnknownNode {
        /// The requested name.
        node: String,
    },
    /// The node is revoked.
    #[error("node {node} was revoked at {at}: `sgc fleet enroll {node} --again` makes it a node anew")]
    NodeRevoked {
        /// The node.
        node: NodeName,
        /// Time of the revocation.
        at: UnixMillis,
    },
    /// The fleet has no authority, which has to answer whoever is invited.
    #[error(
        "the fleet has no authority, which an invited node asks: see `sgc fleet set --authority NODE`, and run that node \
         with this file in its [authority]"
    )]
    NoAuthority,
    /// The time of an invitation, or of the certificate to which it entitles, is out of bounds.
    #[error(
        "an invitation is for at least a second and at most {} days, for a certificate of at least a second",
        INVITATION_TIME_MAX.as_secs() / 86_400
    )]
    InvitationTime,
    /// No router for an invitation, too many, or one too long.
    #[error(
        "an invitation names 1 to {INVITATION_ROUTERS_MAX} routers, each of at most {ROUTER_BYTES_MAX} bytes"
    )]
    InvitationRouters,
    /// The node was revoked after it was invited.
    #[error("{node} was revoked at {at}, after this invitation was made: ask for another one")]
    InvitationRevoked {
        /// The invited node.
        node: NodeName,
        /// Time of the revocation.
        at: UnixMillis,
    },
    /// The certificate is none of an invitation that this copy of the file made.
    #[error("the invitation is not one of this fleet's file")]
    NotInvited,
    /// The invitation was used, or a later one replaced it.
    #[error(
        "the invitation of {node} was used, or replaced by another one, at {at}: ask for another one. If nobody of \
         yours used it, revoke the node: sgc fleet revoke {node}"
    )]
    InvitationUsed {
        /// The invited node.
        node: NodeName,
        /// Time of its use.
        at: UnixMillis,
    },
    /// A request for a certificate that cannot be used.
    #[error("the request for a certificate cannot be used: {0}")]
    Request(&'static str),
    /// A certificate that cannot be entered in the roster.
    #[error("the certificate cannot be entered in the roster: {0}")]
    Adopt(&'static str),
    /// No more generations.
    #[error("{SECRET_GENERATIONS_MAX} generations of the secret are in use: retire old ones first")]
    TooManyGenerations,
    /// The generation in use cannot go.
    #[error("generation {newest} is the newest of the secret and stays: rotate first")]
    NewestGeneration {
        /// Its number.
        newest: u32,
    },
    /// A CA's name that cannot be repeated in certificates.
    #[error(
        "the name of this CA cannot be written by SGC (a component occurs twice, or is of a rare kind): keep the key \
         where it is and have the CA sign what `sgc fleet request` makes"
    )]
    CaName,
    /// A certificate that is no CA's.
    #[error("this certificate is not that of a CA that may sign certificates and revocation lists: {0}")]
    NotACa(&'static str),
    /// The CA has expired.
    #[error(
        "the fleet's CA expired at {not_after} and the clock here says {now}: create a new fleet, or set the clock"
    )]
    CaExpired {
        /// Its end.
        not_after: UnixMillis,
        /// The time of the request.
        now: UnixMillis,
    },
    /// The request has too many groups.
    #[error("a node is in at most {GROUPS_MAX} groups, {groups} are asked for")]
    TooManyGroups {
        /// Their number.
        groups: usize,
    },
    /// The time, or the time plus the validity, is no date that certificates can hold.
    #[error("a certificate cannot be valid until {0}: is the clock right?")]
    Time(UnixMillis),
    /// The certificate could not be made.
    #[error("the certificate could not be made: {0}")]
    Making(String),
}

impl FleetError {
    pub(crate) fn making(error: impl fmt::Display) -> Self {
        Self::Making(error.to_string())
    }
}
