//! The identity of a node: reads its file and checks it against the configuration.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use sgc_config::{Config, RouterUrl};
use sgc_trust::{CertError, Identity};

use crate::clock::now;
use crate::discovery::RouterFilter;
use crate::node::error::NodeError;
use crate::state;

/// Reads an identity file, which only its owner may read.
pub fn load_identity(path: &Path) -> Result<Identity, NodeError> {
    let file = |source| NodeError::IdentityFile { path: path.to_owned(), source };
    if let Some(mode) = state::exposed(&fs::metadata(path).map_err(file)?) {
        return Err(NodeError::IdentityExposed { path: path.to_owned(), mode });
    }
    let text = zeroize::Zeroizing::new(fs::read_to_string(path).map_err(file)?);
    Identity::parse(&text).map_err(|source| NodeError::Identity { path: path.to_owned(), source })
}

/// Checks the identity as [`run`](crate::run) does, and binds nothing. A certificate that is not valid yet passes, see
/// [`clock_alert`](crate::control::faults::alerts::clock_alert). One that has ended does not, although a node would start
/// with it: whoever checks it can renew it now.
pub fn check_identity(config: &Config) -> Result<Identity, NodeError> {
    check(config, |error| matches!(error, CertError::NotYetValid { .. }))
}

/// Checks the identity of a node that starts. A certificate that is not valid by the clock passes: the clock may be
/// wrong and be set later, as NTP does after the start of a machine without a battery.
pub(crate) fn check_startable(config: &Config) -> Result<Identity, NodeError> {
    check(config, CertError::is_expiry)
}

fn check(config: &Config, is_tolerable: impl Fn(&CertError) -> bool) -> Result<Identity, NodeError> {
    let identity = load_identity(&config.identity)?;
    let certified = identity.node_name().as_str();
    if let Some(configured) = config.node_name.as_ref().filter(|n| n.as_str() != certified) {
        return Err(NodeError::OtherName {
            configured: configured.to_string(),
            certified: certified.to_owned(),
        });
    }
    match identity.anchors().verify(identity.chain(), now().unix) {
        Err(source) if !is_tolerable(&source) => {
            return Err(NodeError::Certificate { path: config.identity.clone(), source });
        }
        Ok(_) | Err(_) => {}
    }
    let touches_topics = !(config.shares.is_empty() && config.uses.is_empty() && config.tokens.is_empty());
    if identity.fleet_secret().is_none() && touches_topics {
        return Err(NodeError::RouterIdentity);
    }
    if let Some(own) = config.uses.iter().find(|u| u.from.as_str() == certified) {
        return Err(NodeError::UseOfOwn { node: own.from.to_string() });
    }
    wanted_nearby(&config.routers, &identity)?;
    Ok(identity)
}

/// The identity file of a running node.
pub(crate) enum FileIdentity {
    /// It holds the identity in use.
    Same,
    /// It holds another identity of this node, which it can use.
    Replaced(Arc<Identity>),
    /// It holds the identity of another node, or of another role, for the reason in words.
    OfAnother(&'static str),
    /// It holds no identity that is better than the one in use, for the reason in words.
    Unusable(String),
}

impl FileIdentity {
    /// Reads the file of a node that runs with `own`.
    pub(crate) fn read(path: &Path, own: &Identity) -> Self {
        let found = match load_identity(path) {
            Ok(found) => found,
            Err(why) => return Self::Unusable(why.to_string()),
        };
        if found.to_text() == own.to_text() {
            return Self::Same;
        }
        if found.node_id() != own.node_id() {
            return Self::OfAnother("is of another node");
        }
        if found.fleet_secret().is_some() != own.fleet_secret().is_some() {
            return Self::OfAnother("makes a router of a member, or a member of a router");
        }
        match found.anchors().verify(found.chain(), now().unix) {
            Ok(_) | Err(CertError::NotYetValid { .. }) => {}
            Err(source) => {
                return Self::Unusable(NodeError::Certificate { path: path.to_owned(), source }.to_string());
            }
        }
        // The fleet's authority renewed this node, and the file could not be written.
        if is_older(&found, own) {
            return Self::Unusable(format!("{} is older than what this node has", path.display()));
        }
        Self::Replaced(Arc::new(found))
    }
}

/// Returns `true` if an identity of the same node was made before another one.
pub(crate) fn is_older(identity: &Identity, other: &Identity) -> bool {
    let newest = |identity: &Identity| identity.naming_secrets().first().map(|n| n.generation);
    let age = |identity: &Identity| (identity.as_peer().incarnation, identity.as_peer().not_before);
    age(identity) < age(other) || newest(identity) < newest(other)
}

/// Returns the routers wanted on the local network, if any are.
pub(crate) fn wanted_nearby(
    routers: &[RouterUrl],
    identity: &Identity,
) -> Result<Option<RouterFilter>, NodeError> {
    let mut any = false;
    let (mut written, mut nodes) = (Vec::new(), BTreeSet::new());
    for url in routers {
        let RouterUrl::Mdns(node) = url else { continue };
        written.push(url.to_string());
        match node {
            None => any = true,
            Some(node) => {
                let id = identity.node_id_of(node.as_str());
                nodes.insert(id.ok_or_else(|| NodeError::NamelessIdentity { node: node.to_string() })?);
            }
        }
    }
    let nodes = (!any).then(|| Arc::new(nodes));
    Ok((!written.is_empty()).then(|| RouterFilter { written: written.join(", "), nodes }))
}
