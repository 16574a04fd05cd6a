//! [`Draft`]: the user's input, well-formed but not yet judged: texts and numbers, each with its origin.
//!
//! `file` makes a draft from TOML, and `args` makes one from the command line. `resolve` makes a `Config` of either, so
//! each rule about values is written once.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::error::{ConfigError, Mistake, Origin};

/// A value with its origin.
#[derive(Clone, Debug)]
pub(crate) struct WithOrigin<T> {
    pub(crate) value: T,
    /// Name of the value in the user's words: `to`, `--to`, `ROS_DOMAIN_ID`.
    pub(crate) key: &'static str,
    pub(crate) origin: Origin,
}

impl<T> WithOrigin<T> {
    /// Returns an error with this origin.
    pub(crate) fn error(&self, mistake: Mistake) -> ConfigError {
        ConfigError::new(self.origin.clone(), mistake)
    }

    /// Converts the value and keeps the origin.
    pub(crate) fn map<U>(self, convert: impl FnOnce(T) -> U) -> WithOrigin<U> {
        WithOrigin { value: convert(self.value), key: self.key, origin: self.origin }
    }

    /// Returns a reference to this value for another error.
    pub(crate) fn reference(&self) -> String {
        match &self.origin {
            Origin::File { line: Some(line), .. } => format!("line {line}"),
            _ => format!("a `{}`", self.key),
        }
    }
}

/// A whole configuration.
#[derive(Debug)]
pub(crate) struct Draft {
    /// Origin of mistakes about missing values.
    pub(crate) origin: Origin,
    /// Names of settings in this source.
    pub(crate) words: Words,
    /// Keys that were present but not understood. Each has an error, so that its absence needs none.
    pub(crate) attempted: BTreeSet<&'static str>,
    pub(crate) identity: Option<WithOrigin<PathBuf>>,
    pub(crate) name: Option<WithOrigin<String>>,
    pub(crate) routers: Vec<WithOrigin<String>>,
    pub(crate) resolver: Option<WithOrigin<String>>,
    pub(crate) keep_alive: Option<WithOrigin<String>>,
    /// The peers, or one of the words `auto` and `never` in place of a list.
    pub(crate) direct: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) port_mapping: Option<WithOrigin<bool>>,
    pub(crate) listen: Vec<WithOrigin<String>>,
    pub(crate) peer_rate: Option<WithOrigin<String>>,
    pub(crate) mapping: Option<WithOrigin<String>>,
    pub(crate) store: StoreDraft,
    pub(crate) announce: Option<WithOrigin<bool>>,
    /// The list has an origin of its own, since an empty one is a mistake.
    pub(crate) accept: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) ros: Option<RosDraft>,
    pub(crate) shares: Vec<ShareDraft>,
    pub(crate) uses: Vec<UseDraft>,
    pub(crate) admin_socket: Option<WithOrigin<PathBuf>>,
    pub(crate) observers: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) state: Option<WithOrigin<PathBuf>>,
    pub(crate) trust: Vec<WithOrigin<String>>,
    pub(crate) watch: Option<WithOrigin<bool>>,
    pub(crate) authority: Option<WithOrigin<PathBuf>>,
    pub(crate) operators: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) rotation: RotationDraft,
    pub(crate) audit: AuditDraft,
    pub(crate) transport: TransportDraft,
    pub(crate) partners: Vec<PartnerDraft>,
    pub(crate) gateway: Option<GatewayDraft>,
    pub(crate) metrics: Option<MetricsDraft>,
}

/// Names of settings in one source of configuration, for errors that ask for them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Words {
    pub(crate) no_identity: &'static str,
    pub(crate) identity: &'static str,
    pub(crate) dial: &'static str,
    pub(crate) listen: &'static str,
    pub(crate) share: &'static str,
    pub(crate) uses: &'static str,
}

/// `[ros]`.
#[derive(Debug, Default)]
pub(crate) struct RosDraft {
    pub(crate) middleware: Option<WithOrigin<String>>,
    pub(crate) domain_id: Option<WithOrigin<i64>>,
    pub(crate) localhost_only: Option<WithOrigin<bool>>,
    pub(crate) discovery_range: Option<WithOrigin<String>>,
    /// The list has an origin of its own, since an empty one is a choice.
    pub(crate) static_peers: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) graph: Option<WithOrigin<bool>>,
    pub(crate) definitions: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) enclave: Option<WithOrigin<String>>,
    pub(crate) security_root: Option<WithOrigin<String>>,
    pub(crate) zenoh: Option<ZenohDraft>,
}

impl RosDraft {
    /// Iterates over the keys that only DDS Security has, with their origins.
    pub(crate) fn security(&self) -> impl Iterator<Item = (&'static str, &Origin)> {
        [&self.enclave, &self.security_root].into_iter().flatten().map(|one| (one.key, &one.origin))
    }

    /// Iterates over the keys of the discovery of DDS, with their origins.
    pub(crate) fn discovery(&self) -> impl Iterator<Item = (&'static str, &Origin)> {
        let range = self.discovery_range.iter().map(|one| (one.key, &one.origin));
        let only = self.localhost_only.iter().map(|one| (one.key, &one.origin));
        let peers = self.static_peers.iter().map(|one| (one.key, &one.origin));
        range.chain(only).chain(peers)
    }
}

/// `[ros.zenoh]`.
#[derive(Debug)]
pub(crate) struct ZenohDraft {
    /// The place of the table.
    pub(crate) origin: Origin,
    pub(crate) router: Option<WithOrigin<String>>,
    pub(crate) config: Option<WithOrigin<PathBuf>>,
}

/// `[[share]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug, Default)]
pub(crate) struct ShareDraft {
    /// Topic, or the name of another interface, as its key says.
    pub(crate) topic: Option<WithOrigin<String>>,
    pub(crate) to: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) publish: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) type_name: Option<WithOrigin<String>>,
    pub(crate) priority: Option<WithOrigin<String>>,
    pub(crate) link: Option<WithOrigin<String>>,
    pub(crate) suite: Option<WithOrigin<String>>,
    pub(crate) description: Option<WithOrigin<String>>,
    pub(crate) author: Option<WithOrigin<String>>,
    pub(crate) maintainer: Option<WithOrigin<String>>,
    pub(crate) interface: Option<WithOrigin<String>>,
    pub(crate) unique: Option<WithOrigin<String>>,
    pub(crate) node: Option<WithOrigin<String>>,
    pub(crate) dead_man: Option<DeadManDraft>,
    pub(crate) shaping: ShapingDraft,
    pub(crate) qos: QosDraft,
    pub(crate) naming: NamingDraft,
}

/// QoS policies that replace those of publishers.
#[derive(Debug, Default)]
pub(crate) struct QosDraft {
    pub(crate) reliability: Option<WithOrigin<String>>,
    pub(crate) durability: Option<WithOrigin<String>>,
    pub(crate) history: Option<WithOrigin<String>>,
    pub(crate) depth: Option<WithOrigin<i64>>,
    pub(crate) deadline: Option<WithOrigin<String>>,
    pub(crate) lifespan: Option<WithOrigin<String>>,
}

impl QosDraft {
    /// Iterates over the policies that are set, with their origins.
    pub(crate) fn written(&self) -> impl Iterator<Item = (&'static str, &Origin)> {
        let texts = [&self.reliability, &self.durability, &self.history, &self.deadline, &self.lifespan];
        let texts = texts.into_iter().flatten().map(|one| (one.key, &one.origin));
        texts.chain(self.depth.iter().map(|one| (one.key, &one.origin)))
    }
}

/// Exceptions and other names.
#[derive(Clone, Debug, Default)]
pub(crate) struct NamingDraft {
    pub(crate) except: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) renamed: Option<WithOrigin<String>>,
    pub(crate) namespace: Option<WithOrigin<String>>,
}

/// Limits of rate, bandwidth and age.
#[derive(Debug, Default)]
pub(crate) struct ShapingDraft {
    pub(crate) max_rate: Option<WithOrigin<String>>,
    pub(crate) max_bandwidth: Option<WithOrigin<String>>,
    pub(crate) max_age: Option<WithOrigin<String>>,
    pub(crate) compress: Option<WithOrigin<String>>,
    pub(crate) encoding: Option<WithOrigin<String>>,
}

/// `[[use]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug, Default)]
pub(crate) struct UseDraft {
    pub(crate) from: Option<WithOrigin<String>>,
    /// Topic, or the name of another interface, as its key says.
    pub(crate) topic: Option<WithOrigin<String>>,
    pub(crate) type_name: Option<WithOrigin<String>>,
    pub(crate) publish: Option<WithOrigin<bool>>,
    pub(crate) token: Option<WithOrigin<String>>,
    pub(crate) priority: Option<WithOrigin<String>>,
    pub(crate) shaping: ShapingDraft,
    pub(crate) qos: QosDraft,
    pub(crate) naming: NamingDraft,
    pub(crate) frame_prefix: Option<WithOrigin<String>>,
    pub(crate) dead_man: Option<DeadManDraft>,
    pub(crate) link: Option<WithOrigin<String>>,
}

/// `[share.deadman]` and `[use.deadman]`. Required fields are `None` only if an error was recorded.
#[derive(Debug)]
pub(crate) struct DeadManDraft {
    pub(crate) origin: Origin,
    pub(crate) after: Option<WithOrigin<String>>,
    pub(crate) publish: Option<WithOrigin<String>>,
    pub(crate) repeat: Option<WithOrigin<String>>,
    pub(crate) resume: Option<WithOrigin<String>>,
}

/// `[rotation]`.
#[derive(Debug, Default)]
pub(crate) struct RotationDraft {
    pub(crate) every: Option<WithOrigin<String>>,
    pub(crate) messages: Option<WithOrigin<i64>>,
}

/// `[audit]`.
#[derive(Debug, Default)]
pub(crate) struct AuditDraft {
    pub(crate) file: Option<WithOrigin<PathBuf>>,
    pub(crate) max_bytes: Option<WithOrigin<i64>>,
    pub(crate) files: Option<WithOrigin<i64>>,
    pub(crate) off: Option<WithOrigin<bool>>,
}

/// `[transport]`.
#[derive(Debug, Default)]
pub(crate) struct TransportDraft {
    pub(crate) congestion: Option<WithOrigin<String>>,
    pub(crate) offload: Option<WithOrigin<bool>>,
    pub(crate) mtu_discovery: Option<WithOrigin<bool>>,
    pub(crate) bulk_lanes: Option<WithOrigin<bool>>,
    pub(crate) dtls_1_2: Option<WithOrigin<bool>>,
    pub(crate) dscp: Option<WithOrigin<String>>,
    pub(crate) lane_dscp: Option<WithOrigin<String>>,
}

/// The store of `[router]`.
#[derive(Debug, Default)]
pub(crate) struct StoreDraft {
    pub(crate) servers: Vec<WithOrigin<String>>,
    pub(crate) prefix: Option<WithOrigin<String>>,
    pub(crate) user: Option<WithOrigin<String>>,
    pub(crate) password_file: Option<WithOrigin<PathBuf>>,
    pub(crate) ca: Option<WithOrigin<PathBuf>>,
    pub(crate) certificate: Option<WithOrigin<PathBuf>>,
    pub(crate) key: Option<WithOrigin<PathBuf>>,
}

/// `[metrics]`.
#[derive(Debug, Default)]
pub(crate) struct MetricsDraft {
    pub(crate) listen: Option<WithOrigin<String>>,
    pub(crate) otlp: Option<WithOrigin<String>>,
    pub(crate) otlp_interval: Option<WithOrigin<String>>,
    pub(crate) otlp_headers_file: Option<WithOrigin<PathBuf>>,
    pub(crate) otlp_ca: Option<WithOrigin<PathBuf>>,
}

/// `[gateway]`.
#[derive(Debug, Default)]
pub(crate) struct GatewayDraft {
    /// The place of the table; `None` for `--gateway`.
    pub(crate) origin: Option<Origin>,
    /// The list has an origin of its own, since an empty one is a mistake.
    pub(crate) listen: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) certificate: Option<WithOrigin<PathBuf>>,
    pub(crate) key: Option<WithOrigin<PathBuf>>,
    /// The list has an origin of its own, since it excludes `certificate`.
    pub(crate) names: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) anonymous: Option<WithOrigin<String>>,
    pub(crate) origins: Vec<WithOrigin<String>>,
    pub(crate) plain: Option<WithOrigin<bool>>,
    pub(crate) clients_max: Option<WithOrigin<i64>>,
    pub(crate) client_bytes_max: Option<WithOrigin<String>>,
    pub(crate) clients: Vec<GatewayClientDraft>,
}

/// `[[gateway.client]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug)]
pub(crate) struct GatewayClientDraft {
    /// Origin of mistakes about missing values.
    pub(crate) origin: Origin,
    pub(crate) who: Option<WithOrigin<Vec<WithOrigin<String>>>>,
    pub(crate) subscribe: Vec<WithOrigin<String>>,
    pub(crate) publish: Vec<WithOrigin<String>>,
    pub(crate) call: Vec<WithOrigin<String>>,
    pub(crate) serve: Vec<WithOrigin<String>>,
    /// A list of patterns is present but could not be read.
    pub(crate) is_broken: bool,
}

/// `[[partner]]`. Required fields are `None` only if an error was recorded.
#[derive(Debug, Default)]
pub(crate) struct PartnerDraft {
    pub(crate) name: Option<WithOrigin<String>>,
    pub(crate) ca: Option<WithOrigin<PathBuf>>,
    pub(crate) node: Option<WithOrigin<Vec<WithOrigin<String>>>>,
}
