//! Names of the text blocks in the files of fleets and identities. `secret.rs` has those of secrets.

pub(crate) const FLEET_BLOCK: &str = "SGC FLEET";
pub(crate) const CERTIFICATE_BLOCK: &str = "CERTIFICATE";
pub(crate) const KEY_BLOCK: &str = "PRIVATE KEY";
pub(crate) const ROSTER_BLOCK: &str = "SGC ROSTER";
pub(crate) const ABOUT_BLOCK: &str = "SGC IDENTITY";
pub(crate) const CA_BLOCK: &str = "SGC CA CERTIFICATE";
pub(crate) const RESET_BLOCK: &str = "SGC RESET KEY";
pub(crate) const AUTHORITY_BLOCK: &str = "SGC AUTHORITY";
pub(crate) const OBSERVERS_BLOCK: &str = "SGC OBSERVERS";
