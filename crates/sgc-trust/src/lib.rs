//! Who a node is, what it may do, and how payloads are sealed: identities, names, grants, suites, policy.
//!
//! Pure: time is an argument, files are text. One thing draws randomness by itself: the cryptographic
//! provider, for signatures and key encapsulation; nothing that decides behaviour depends on it.
//! The normative text is `docs/spec/names.md` and `docs/spec/trust.md`.
#![forbid(unsafe_code)]

mod fleet;
mod grant;
mod identity;
mod key;
mod label;
mod names;
mod pem;
mod policy;
mod replay;
mod seal;
mod signed;
mod token;
mod verify;
mod x509;

pub use fleet::{
    CA_VALIDITY, CLOCK_SKEW, EnrollRequest, Fleet, FleetError, FleetSecret, LEAF_VALIDITY_DEFAULT,
};
pub use grant::{GrantError, ReplyKey, seal_grant};
pub use identity::{Identity, IdentityError};
pub use label::{FleetName, GroupName, LABEL_BYTES_MAX, LabelError, NodeName};
pub use names::{TopicSecret, derive_name, name_of};
pub use pem::PemError;
pub use policy::{Denied, Grantees, Listed, Policy};
pub use replay::{Freshness, REPLAY_WINDOW, ReplayWindow};
pub use seal::{OpenError, SourceKey, Suite, TAG_BYTES, opened_bytes};
pub use signed::{
    CLOCK_SKEW_MAX, SignedError, VerifiedAdvert, VerifiedJoin, verify_advert, verify_answer, verify_join,
};
pub use token::{ShareToken, TOKEN_PREFIX, TOKEN_ROUTERS_MAX, TOKEN_TEXT_BYTES_MAX, TokenError};
pub use verify::{
    ANCHORS_MAX, AnchorError, CaFingerprint, CertError, CertId, GROUPS_MAX, SignatureError, TrustAnchors,
    VerifiedPeer, node_id,
};
