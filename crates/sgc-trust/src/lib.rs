//! Identities, names, grants, suites and policy: the proof of a node's identity, its rights, and the sealing of
//! payloads.
//!
//! Pure: time is an argument, files are text. Only the cryptographic provider draws randomness by itself, for
//! signatures and key encapsulation; no decision depends on it. The normative text is `docs/spec/names.md` and
//! `docs/spec/trust.md`.
#![forbid(unsafe_code)]

mod batch;
mod blocks;
mod cert_error;
mod cert_id;
mod chains;
mod code_text;
mod crl;
mod crowd;
mod enrol;
mod fleet;
mod fleet_error;
mod grant;
mod hpke;
mod identity;
mod identity_error;
mod invitation;
mod invitation_bounds;
mod issue;
mod key;
mod label;
mod member;
mod message_key;
mod names;
mod peer;
mod pem;
mod policy;
mod receiver;
mod replay;
mod revocations;
mod roster;
mod seal;
mod secret;
mod server_certificate;
mod signed;
mod suite;
mod tls13;
mod token;
mod verify;
mod x509;
mod xwing;

pub use batch::{BATCH_PACKETS_MAX, Batch, BatchVerifier, SignedBatch, trailer_bytes_max};
pub use cert_error::CertError;
pub use cert_id::{CaFingerprint, CertId, NodeIncarnation};
pub use crl::{CrlNews, CrlNumber};
pub use crowd::{
    AddressPrefix, PLACE_HELD_MIN, PlaceDecision, PlaceLimits, PlaceRefusal, Places, REPEAT_SOURCES_MAX,
    REPEAT_WINDOW, RepeatCount, Repeats,
};
pub use enrol::EnrollRequest;
pub use fleet::{CrlReport, Fleet, LEAF_VALIDITY_DEFAULT, MergeReport, SEEN_RECENTLY, SEEN_STEP};
pub use fleet_error::FleetError;
pub use grant::{GrantError, Kem, ReplyKey, seal_grant};
pub use identity::{Identity, Import};
pub use identity_error::IdentityError;
pub use invitation::{INVITATION_PREFIX, INVITATION_TEXT_BYTES_MAX, Invitation, InvitationError};
pub use invitation_bounds::{INVITATION_ROUTERS_MAX, INVITATION_TIME_MAX};
pub use issue::{CA_VALIDITY, CLOCK_SKEW, CRL_VALIDITY, KeyRequest, certificate_uris, requested_key_hash};
pub use label::{FleetName, GROUPS_MAX, GroupName, LABEL_BYTES_MAX, LabelError, NodeName, OBSERVERS_GROUP};
pub use member::Membership;
pub use message_key::{MessageKey, MessageKeyError};
pub use names::{
    TopicSecret, clock_blind, consumers_blind, derive_name, name_of, operations_blind, paths_blind,
    renewal_blind, reports_blind, types_blind, wishes_blind,
};
pub use peer::{SignatureError, VerifiedPeer, node_id};
pub use pem::{FLEET_FILE_BYTES_MAX, PemError, pem_contents, pem_text};
pub use policy::{DenialReason, GrantReason, Grantees, Policy};
pub use receiver::{MacKey, RECEIVERS_MAX, ReceiverSecret, has_macs, mac_trailer_bytes, put_macs};
pub use replay::{Freshness, REPLAY_WINDOW, ReplayWindow};
pub use revocations::{CrlError, FLEET_LISTS_MAX, LIST_NODES_MAX, REVOKED_NODES_MAX, Revocation};
pub use roster::{
    Generation, IssuedCertificate, NODE_CERTIFICATES_MAX, ROSTER_BYTES_MAX, ROSTER_NODES_MAX, RosterNode,
    is_invitation,
};
pub use seal::{OpenError, SourceKey, TAG_BYTES, opened_bytes, sealed_bytes};
pub use secret::{FleetSecret, NamingSecret};
pub use server_certificate::{
    CertificateName, CertificateNameError, SERVER_FILE_BYTES_MAX, SERVER_NAMES_MAX, SERVER_SKEW,
    SERVER_VALIDITY, ServerCertificate, ServerCertificateError, certificate_end, certificate_names,
    certificate_pin,
};
pub use signed::{
    CLOCK_SKEW_MAX, SEQ_AHEAD_MAX, SignedError, VerifiedAdvert, VerifiedJoin, VerifiedLinkState,
    names_digest, next_seq, signed_digest, verify_advert, verify_answer, verify_join, verify_link_state,
};
pub use suite::{ParseSuiteError, Suite};
pub use token::{ShareToken, TOKEN_PREFIX, TOKEN_ROUTERS_MAX, TOKEN_TEXT_BYTES_MAX, TokenError};
pub use verify::{ANCHORS_MAX, AnchorError, TrustAnchors};
pub use x509::serial_of;
