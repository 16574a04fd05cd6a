//! Reasons why a node does not start.

use std::io;
use std::path::PathBuf;

use sgc_ros::RosError;
use sgc_transport::ListenAddr;
use sgc_trust::{AnchorError, IdentityError};

use crate::control::settings::rules::RulesError;
use crate::gateway::GatewayStartError;
use crate::gateway::access::AccessError;
use crate::link::store::StoreSettingsError;
use crate::state::run_lock::IdentityInUse;
use crate::state::{StateError, owner_hint};

/// Reasons why a node does not start.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// The identity file could not be read.
    #[error("identity {}: {source}{}", path.display(), owner_hint(path, source))]
    IdentityFile {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The identity file may be read by others.
    #[error("identity {}: others can read it (mode {mode:o}); it holds a private key: chmod 600 it", path.display())]
    IdentityExposed {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The identity file holds no identity.
    #[error("identity {}: {source}", path.display())]
    Identity {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: IdentityError,
    },
    /// The name in the configuration is not that of the identity.
    #[error(
        "`name` is {configured:?}, but the identity is of {certified:?}: use that node's identity file or change `name`"
    )]
    OtherName {
        /// Name in the configuration.
        configured: String,
        /// Name in the identity.
        certified: String,
    },
    /// Another process of this machine uses the identity.
    #[error(
        "identity {}: {source}. One identity is for one process: stop that one, or enroll this node under a name of its own",
        path.display()
    )]
    IdentityInUse {
        /// The identity file.
        path: PathBuf,
        /// The other process and its lock.
        source: IdentityInUse,
    },
    /// The identity's certificate is invalid.
    #[error("identity {}: {source}", path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: sgc_trust::CertError,
    },
    /// A router's identity cannot share or use.
    #[error(
        "this identity is a router's and holds no fleet secret: it can neither share nor use. Enroll the node without --role router"
    )]
    RouterIdentity,
    /// `mdns://NODE` with a router's identity, which cannot recognise names.
    #[error(
        "`routers` names \"mdns://{node}\", but this identity is a router's and cannot tell nodes by their names: write \"mdns://\""
    )]
    NamelessIdentity {
        /// The router that is wanted.
        node: String,
    },
    /// A use of the node's own topic.
    #[error("[[use]] from {node:?}: that is this node itself")]
    UseOfOwn {
        /// The node.
        node: String,
    },
    /// The store of names cannot be used as it is configured.
    #[error(transparent)]
    Store(#[from] StoreSettingsError),
    /// The state directory cannot be used.
    #[error(transparent)]
    State(#[from] StateError),
    /// Partners or tokens cannot be used.
    #[error(transparent)]
    Rules(#[from] RulesError),
    /// The CAs of the identity, of partners and of tokens are invalid, or too many.
    #[error("trusted CAs: {0}")]
    Anchors(#[from] AnchorError),
    /// The audit log cannot be written.
    #[error("audit log {}: {source}; name another with `file` in [audit], or set `off`", path.display())]
    Audit {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// An address could not be bound.
    #[error("cannot listen on {addr}: {source}")]
    Listen {
        /// The address.
        addr: ListenAddr,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The local network could not be joined.
    #[error(transparent)]
    Ros(#[from] RosError),
    /// The access records of the gateway cannot be used.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// The gateway does not start.
    #[error(transparent)]
    Gateway(Box<GatewayStartError>),
    /// A thread of the local network did not start, or no key could be made.
    #[error("starting ended in a panic; this is a bug")]
    Panicked,
    /// The system has no room for a thread.
    #[error("a thread cannot start: {0}; check the limits of processes and memory (`ulimit -u`, `TasksMax`)")]
    Thread(io::Error),
    /// The system provides no random numbers.
    #[error("the system gives no randomness: {0}")]
    Randomness(String),
}

impl From<GatewayStartError> for NodeError {
    fn from(error: GatewayStartError) -> Self {
        Self::Gateway(Box::new(error))
    }
}
