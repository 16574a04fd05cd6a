//! [`Draft`]: the user's input, well-formed but not yet judged: texts and numbers, each with its origin.
//!
//! `file` makes a draft from TOML, and `args` makes one from the command line. `resolve` makes a `Config` of either, so
//! each rule about values is written once.

use std::collections::BTreeSet;
use std::path::PathBuf;

use super::error::{ConfigError, Mistake, Origin};

/// A value with its origin.
#[derive(Clone, Debug)]
pub(super) struct WithOrigin<T> {
    pub(super) value: T,
    /// Name of the value in the user's words: `to`, `--to`, `ROS_DOMAIN_ID`.
    pub(super) key: &'static str,
    pub(super) origin: Origin,
}

impl<T> WithOrigin<T> {
    /// Returns an error with this origin.
    pub(super) fn error(&self, mistake: Mistake) -> ConfigError {
        ConfigError::new(self.origin.clone(), mistake)
    }

    /// Converts the value and keeps the origin.
    pub(super) fn map<U>(self, convert: impl FnOnce(T) -> U) -> WithOrigin<U> {
        WithOrigin { value: convert(self.value), key: self.key, origin: self.origin }
    }

    /// Returns a reference to this value for another error.
    pub(super) fn reference(&self) -> String {
        match &self.origin {
            Origin::File { line: Some(line), .. } => format!("line {line}"),
            _ => format!("a `{}`", self.key),
        }
    }
}

/// A whole configuration.
#[derive(Debug)]
pub(super) struct Draft {
    /// Origin of mistakes about missing values.
    pub(super) origin: Origin,
    /// Names of settings in this source.
    pub(super) words: Words,
    /// Keys that were present but not understood. Each has an error, so that its absence needs none.
    pub(super) attempted: BTreeSet<&'static str>,
    pub(super) identity: Option<WithOrigin<PathBuf>>,
    pub(super) name: Option<WithOrigin<String>>,
    pub(super) routers: Vec<WithOrigin<String>>,
    pub(super) resolver: Option<WithOrigin<String>>,
    pub(super) keep_alive: Option<WithOrigin<String>>,
    pub(super) listen: Vec<WithOrigin<String>>,
    pub(super) peer_rate: Option<WithOrigin<String>>,
    pub(super) mapping: Option<WithOrigin<String>>,
    pub(super) announce: Option<WithOrigin<bool>>,
    /// The list has an origin of its own, since an empty one is a mistake.
    pub(super) accept: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) ros: Option<RosDraft>,
    pub(super) shares: Vec<ShareDraft>,
    pub(super) uses: Vec<UseDraft>,
    pub(super) admin_socket: Option<WithOrigin<PathBuf>>,
    pub(super) state: Option<WithOrigin<PathBuf>>,
    pub(super) trust: Vec<WithOrigin<String>>,
    pub(super) watch: Option<WithOrigin<bool>>,
    pub(super) authority: Option<WithOrigin<PathBuf>>,
    pub(super) operators: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) rotation: RotationDraft,
    pub(super) audit: AuditDraft,
    pub(super) transport: TransportDraft,
    pub(super) partners: Vec<PartnerDraft>,
    pub(super) gateway: Option<GatewayDraft>,
}

/// Names of settings in one source of configuration, for errors that ask for them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Words {
    pub(super) no_identity: &'static str,
    pub(super) identity: &'static str,
    pub(super) dial: &'static str,
    pub(super) listen: &'static str,
    pub(super) share: &'static str,
    pub(super) uses: &'static str,
}

/// `[ros]`.
#[derive(Debug, Default)]
pub(super) struct RosDraft {
    pub(super) domain_id: Option<WithOrigin<i64>>,
    pub(super) localhost_only: Option<WithOrigin<bool>>,
    pub(super) discovery_range: Option<WithOrigin<String>>,
    /// The list has an origin of its own, since an empty one is a choice.
    pub(super) static_peers: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) graph: Option<WithOrigin<bool>>,
    pub(super) definitions: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) enclave: Option<WithOrigin<String>>,
    pub(super) security_root: Option<WithOrigin<String>>,
}

/// `[[share]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug, Default)]
pub(super) struct ShareDraft {
    /// Topic, or the name of another interface, as its key says.
    pub(super) topic: Option<WithOrigin<String>>,
    pub(super) to: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) publish: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) type_name: Option<WithOrigin<String>>,
    pub(super) priority: Option<WithOrigin<String>>,
    pub(super) link: Option<WithOrigin<String>>,
    pub(super) suite: Option<WithOrigin<String>>,
    pub(super) description: Option<WithOrigin<String>>,
    pub(super) author: Option<WithOrigin<String>>,
    pub(super) maintainer: Option<WithOrigin<String>>,
    pub(super) interface: Option<WithOrigin<String>>,
    pub(super) unique: Option<WithOrigin<String>>,
    pub(super) node: Option<WithOrigin<String>>,
    pub(super) shaping: ShapingDraft,
    pub(super) qos: QosDraft,
    pub(super) naming: NamingDraft,
}

/// QoS policies that replace those of publishers.
#[derive(Debug, Default)]
pub(super) struct QosDraft {
    pub(super) reliability: Option<WithOrigin<String>>,
    pub(super) durability: Option<WithOrigin<String>>,
    pub(super) history: Option<WithOrigin<String>>,
    pub(super) depth: Option<WithOrigin<i64>>,
    pub(super) deadline: Option<WithOrigin<String>>,
    pub(super) lifespan: Option<WithOrigin<String>>,
}

impl QosDraft {
    /// Iterates over the policies that are set, with their origins.
    pub(super) fn written(&self) -> impl Iterator<Item = (&'static str, &Origin)> {
        let texts = [&self.reliability, &self.durability, &self.history, &self.deadline, &self.lifespan];
        let texts = texts.into_iter().flatten().map(|one| (one.key, &one.origin));
        texts.chain(self.depth.iter().map(|one| (one.key, &one.origin)))
    }
}

/// Exceptions and other names.
#[derive(Clone, Debug, Default)]
pub(super) struct NamingDraft {
    pub(super) except: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) renamed: Option<WithOrigin<String>>,
    pub(super) namespace: Option<WithOrigin<String>>,
}

/// Limits of rate, bandwidth and age.
#[derive(Debug, Default)]
pub(super) struct ShapingDraft {
    pub(super) max_rate: Option<WithOrigin<String>>,
    pub(super) max_bandwidth: Option<WithOrigin<String>>,
    pub(super) max_age: Option<WithOrigin<String>>,
    pub(super) compress: Option<WithOrigin<String>>,
    pub(super) encoding: Option<WithOrigin<String>>,
}

/// `[[use]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug, Default)]
pub(super) struct UseDraft {
    pub(super) from: Option<WithOrigin<String>>,
    /// Topic, or the name of another interface, as its key says.
    pub(super) topic: Option<WithOrigin<String>>,
    pub(super) type_name: Option<WithOrigin<String>>,
    pub(super) publish: Option<WithOrigin<bool>>,
    pub(super) token: Option<WithOrigin<String>>,
    pub(super) priority: Option<WithOrigin<String>>,
    pub(super) shaping: ShapingDraft,
    pub(super) qos: QosDraft,
    pub(super) naming: NamingDraft,
    pub(super) frame_prefix: Option<WithOrigin<String>>,
    pub(super) link: Option<WithOrigin<String>>,
}

/// `[rotation]`.
#[derive(Debug, Default)]
pub(super) struct RotationDraft {
    pub(super) every: Option<WithOrigin<String>>,
    pub(super) messages: Option<WithOrigin<i64>>,
}

/// `[audit]`.
#[derive(Debug, Default)]
pub(super) struct AuditDraft {
    pub(super) file: Option<WithOrigin<PathBuf>>,
    pub(super) max_bytes: Option<WithOrigin<i64>>,
    pub(super) files: Option<WithOrigin<i64>>,
    pub(super) off: Option<WithOrigin<bool>>,
}

/// `[transport]`.
#[derive(Debug, Default)]
pub(super) struct TransportDraft {
    pub(super) congestion: Option<WithOrigin<String>>,
    pub(super) offload: Option<WithOrigin<bool>>,
    pub(super) mtu_discovery: Option<WithOrigin<bool>>,
    pub(super) dtls_1_2: Option<WithOrigin<bool>>,
    pub(super) dscp: Option<WithOrigin<String>>,
    pub(super) lane_dscp: Option<WithOrigin<String>>,
}

/// `[gateway]`.
#[derive(Debug, Default)]
pub(super) struct GatewayDraft {
    /// The list has an origin of its own, since an empty one is a mistake.
    pub(super) listen: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) certificate: Option<WithOrigin<PathBuf>>,
    pub(super) key: Option<WithOrigin<PathBuf>>,
    pub(super) anonymous: Option<WithOrigin<String>>,
    pub(super) origins: Vec<WithOrigin<String>>,
    pub(super) plain: Option<WithOrigin<bool>>,
    pub(super) clients_max: Option<WithOrigin<i64>>,
    pub(super) client_bytes_max: Option<WithOrigin<String>>,
    pub(super) clients: Vec<GatewayClientDraft>,
}

/// `[[gateway.client]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug)]
pub(super) struct GatewayClientDraft {
    /// Origin of mistakes about missing values.
    pub(super) origin: Origin,
    pub(super) who: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(super) subscribe: Vec<WithOrigin<String>>,
    pub(super) publish: Vec<WithOrigin<String>>,
    pub(super) call: Vec<WithOrigin<String>>,
    pub(super) serve: Vec<WithOrigin<String>>,
    /// A list of patterns is present but could not be read.
    pub(super) is_broken: bool,
}

/// `[[partner]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug, Default)]
pub(super) struct PartnerDraft {
    pub(super) name: Option<WithOrigin<String>>,
    pub(super) ca: Option<WithOrigin<PathBuf>>,
    pub(super) node: Option<WithOrigin<Vec<WithOrigin<String>>>>,
}
