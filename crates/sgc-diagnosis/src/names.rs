//! The 256-bit names of shares, as their owner derives them.

use std::path::Path;

use sgc_node::config::{Interface, ShareConfig};
use sgc_node::policy::metadata;
use sgc_trust::{Identity, NodeName, derive_name};
use sgc_wire::{Kind, Metadata, Name};

use crate::error::DiagnosisError;

/// Derives the name of a share of `owner` with a member's secret. The share has to have a type.
pub fn name_of(
    identity: &Identity,
    identity_path: &Path,
    owner: &NodeName,
    share: &ShareConfig,
) -> Result<Name, DiagnosisError> {
    let newest = identity.naming_secrets().first().map(|n| &n.secret);
    let (Some(secret), Some(owner_id)) = (newest, identity.node_id_of(owner.as_str())) else {
        return Err(DiagnosisError::RouterCannotName { path: identity_path.to_owned() });
    };
    let metadata = Metadata {
        kind: if share.interface == Interface::Service { Kind::Service } else { Kind::Topic },
        ..metadata(share, owner.as_str())
    };
    Ok(derive_name(secret, &owner_id, &metadata))
}
