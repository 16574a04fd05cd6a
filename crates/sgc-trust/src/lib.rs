//! Who a node is, what it may do, and how payloads are sealed: identities, names, grants, suites, policy.
//!
//! Pure: time is an argument, files are text. One thing draws randomness by itself: the cryptographic
//! provider, for signatures and key encapsulation; nothing that decides behaviour depends on it.
//! The normative text is `docs/spec/names.md` and `docs/spec/trust.md`.
#![forbid(unsafe_code)]

mod batch;
mod crl;
mod fleet;
mod grant;
mod hpke;
mod identity;
mod key;
mod label;
mod message_key;
mod names;
mod pem;
mod policy;
mod replay;
mod seal;
mod signed;
mod suite;
mod verify;
mod x509;
mod xwing;

pub use batch::{BATCH_PACKETS_MAX, Batch, BatchVerifier, SignedBatch, trailer_bytes_max};
pub use crl::CrlError;
pub use fleet::{
    CA_VALIDITY, CLOCK_SKEW, CRL_VALIDITY, EnrollRequest, Fleet, FleetError, FleetSecret,
    LEAF_VALIDITY_DEFAULT,
};
pub use grant::{GrantError, Kem, ReplyKey, seal_grant};
pub use identity::{Identity, IdentityError};
pub use label::{FleetName, GroupName, LABEL_BYTES_MAX, LabelError, NodeName};
pub use message_key::{MessageKey, MessageKeyError};
pub use names::{TopicSecret, derive_name, name_of, renewal_blind};
pub use pem::PemError;
pub use policy::{Denied, Grantees, Listed, Policy};
pub use replay::{Freshness, REPLAY_WINDOW, ReplayWindow};
pub use seal::{OpenError, SourceKey, TAG_BYTES, opened_bytes};
pub use signed::{
    CLOCK_SKEW_MAX, SignedError, VerifiedAdvert, VerifiedJoin, verify_advert, verify_answer, verify_join,
};
pub use suite::{ParseSuiteError, Suite};
pub use verify::{
    ANCHORS_MAX, AnchorError, CaFingerprint, CertError, CertId, GROUPS_MAX, SignatureError, TrustAnchors,
    VerifiedPeer, node_id,
};
