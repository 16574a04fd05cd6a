//! What the user wrote, well-formed but not yet judged: texts and numbers, each with its place.
//!
//! `file` makes a draft from TOML, `args` from the command line; `resolve` makes a `Config` of either. So each
//! rule about values is written once.

use std::collections::BTreeSet;
use std::path::PathBuf;

use super::error::{ConfigError, Mistake, Origin};

/// A value and where it came from.
#[derive(Clone, Debug)]
pub(super) struct Located<T> {
    pub(super) value: T,
    /// What the user knows it by: `to`, `--to`, `ROS_DOMAIN_ID`.
    pub(super) key: &'static str,
    pub(super) origin: Origin,
}

impl<T> Located<T> {
    /// An error in this place.
    pub(super) fn error(&self, mistake: Mistake) -> ConfigError {
        ConfigError::new(self.origin.clone(), mistake)
    }

    /// The same place, another value.
    pub(super) fn map<U>(self, convert: impl FnOnce(T) -> U) -> Located<U> {
        Located { value: convert(self.value), key: self.key, origin: self.origin }
    }

    /// How another error refers to this place.
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
    /// The place of what is missing altogether.
    pub(super) origin: Origin,
    /// How the missing things are called here.
    pub(super) words: Words,
    /// Keys that were meant but not understood; each has an error, so that their absence needs none.
    pub(super) attempted: BTreeSet<&'static str>,
    pub(super) identity: Option<Located<PathBuf>>,
    pub(super) name: Option<Located<String>>,
    pub(super) routers: Vec<Located<String>>,
    pub(super) resolver: Option<Located<String>>,
    pub(super) keep_alive: Option<Located<String>>,
    pub(super) listen: Vec<Located<String>>,
    pub(super) peer_rate: Option<Located<String>>,
    pub(super) mapping: Option<Located<String>>,
    pub(super) announce: Option<Located<bool>>,
    /// The whole list is located too, since an empty one would be a mistake.
    pub(super) accept: Option<Located<Vec<Located<String>>>>,
    pub(super) ros: Option<RosDraft>,
    pub(super) shares: Vec<ShareDraft>,
    pub(super) uses: Vec<UseDraft>,
    pub(super) admin_socket: Option<Located<PathBuf>>,
    pub(super) state: Option<Located<PathBuf>>,
    pub(super) trust: Vec<Located<String>>,
    pub(super) watch: Option<Located<bool>>,
    pub(super) authority: Option<Located<PathBuf>>,
    pub(super) operators: Option<Located<Vec<Located<String>>>>,
    pub(super) rotation: RotationDraft,
    pub(super) audit: AuditDraft,
    pub(super) transport: TransportDraft,
    pub(super) partners: Vec<PartnerDraft>,
    pub(super) gateway: Option<GatewayDraft>,
}

/// How a source of configuration names the settings that an error may ask for.
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
    pub(super) domain_id: Option<Located<i64>>,
    pub(super) localhost_only: Option<Located<bool>>,
    pub(super) discovery_range: Option<Located<String>>,
    /// The whole list is located too, since an empty one is a choice.
    pub(super) static_peers: Option<Located<Vec<Located<String>>>>,
    pub(super) graph: Option<Located<bool>>,
    pub(super) definitions: Option<Located<Vec<Located<String>>>>,
    pub(super) enclave: Option<Located<String>>,
    pub(super) security_root: Option<Located<String>>,
}

/// `[[share]]`. What is required is `None` only where an error has been recorded already.
#[derive(Debug, Default)]
pub(super) struct ShareDraft {
    /// Or the name of something else, as its key says.
    pub(super) topic: Option<Located<String>>,
    pub(super) to: Option<Located<Vec<Located<String>>>>,
    pub(super) publish: Option<Located<Vec<Located<String>>>>,
    pub(super) type_name: Option<Located<String>>,
    pub(super) priority: Option<Located<String>>,
    pub(super) link: Option<Located<String>>,
    pub(super) suite: Option<Located<String>>,
    pub(super) description: Option<Located<String>>,
    pub(super) author: Option<Located<String>>,
    pub(super) maintainer: Option<Located<String>>,
    pub(super) interface: Option<Located<String>>,
    pub(super) unique: Option<Located<String>>,
    pub(super) node: Option<Located<String>>,
    pub(super) shaping: ShapingDraft,
    pub(super) qos: QosDraft,
    pub(super) naming: NamingDraft,
}

/// Policies in place of the publishers'.
#[derive(Debug, Default)]
pub(super) struct QosDraft {
    pub(super) reliability: Option<Located<String>>,
    pub(super) durability: Option<Located<String>>,
    pub(super) history: Option<Located<String>>,
    pub(super) depth: Option<Located<i64>>,
    pub(super) deadline: Option<Located<String>>,
    pub(super) lifespan: Option<Located<String>>,
}

impl QosDraft {
    /// Where each policy that is set stands.
    pub(super) fn written(&self) -> impl Iterator<Item = (&'static str, &Origin)> {
        let texts = [&self.reliability, &self.durability, &self.history, &self.deadline, &self.lifespan];
        let texts = texts.into_iter().flatten().map(|one| (one.key, &one.origin));
        texts.chain(self.depth.iter().map(|one| (one.key, &one.origin)))
    }
}

/// What is left out, and other names.
#[derive(Clone, Debug, Default)]
pub(super) struct NamingDraft {
    pub(super) except: Option<Located<Vec<Located<String>>>>,
    pub(super) renamed: Option<Located<String>>,
    pub(super) namespace: Option<Located<String>>,
}

/// How much of a topic goes on.
#[derive(Debug, Default)]
pub(super) struct ShapingDraft {
    pub(super) max_rate: Option<Located<String>>,
    pub(super) max_bandwidth: Option<Located<String>>,
    pub(super) max_age: Option<Located<String>>,
    pub(super) compress: Option<Located<String>>,
    pub(super) encoding: Option<Located<String>>,
}

/// `[[use]]`. What is required is `None` only where an error has been recorded already.
#[derive(Debug, Default)]
pub(super) struct UseDraft {
    pub(super) from: Option<Located<String>>,
    /// Or the name of something else, as its key says.
    pub(super) topic: Option<Located<String>>,
    pub(super) type_name: Option<Located<String>>,
    pub(super) publish: Option<Located<bool>>,
    pub(super) token: Option<Located<String>>,
    pub(super) priority: Option<Located<String>>,
    pub(super) shaping: ShapingDraft,
    pub(super) qos: QosDraft,
    pub(super) naming: NamingDraft,
    pub(super) frame_prefix: Option<Located<String>>,
    pub(super) link: Option<Located<String>>,
}

/// `[rotation]`.
#[derive(Debug, Default)]
pub(super) struct RotationDraft {
    pub(super) every: Option<Located<String>>,
    pub(super) messages: Option<Located<i64>>,
}

/// `[audit]`.
#[derive(Debug, Default)]
pub(super) struct AuditDraft {
    pub(super) file: Option<Located<PathBuf>>,
    pub(super) max_bytes: Option<Located<i64>>,
    pub(super) files: Option<Located<i64>>,
    pub(super) off: Option<Located<bool>>,
}

/// `[transport]`.
#[derive(Debug, Default)]
pub(super) struct TransportDraft {
    pub(super) congestion: Option<Located<String>>,
    pub(super) offload: Option<Located<bool>>,
    pub(super) mtu_discovery: Option<Located<bool>>,
    pub(super) dtls_1_2: Option<Located<bool>>,
    pub(super) dscp: Option<Located<String>>,
    pub(super) lane_dscp: Option<Located<String>>,
}

/// `[gateway]`.
#[derive(Debug, Default)]
pub(super) struct GatewayDraft {
    /// The whole list is located too, since an empty one would be a mistake.
    pub(super) listen: Option<Located<Vec<Located<String>>>>,
    pub(super) certificate: Option<Located<PathBuf>>,
    pub(super) key: Option<Located<PathBuf>>,
    pub(super) anonymous: Option<Located<String>>,
    pub(super) origins: Vec<Located<String>>,
    pub(super) plain: Option<Located<bool>>,
    pub(super) clients_max: Option<Located<i64>>,
    pub(super) client_bytes_max: Option<Located<String>>,
    pub(super) clients: Vec<GatewayClientDraft>,
}

/// `[[gateway.client]]`. What is required is `None` only where an error has been recorded already.
#[derive(Debug)]
pub(super) struct GatewayClientDraft {
    /// The place of what is missing.
    pub(super) origin: Origin,
    pub(super) who: Option<Located<Vec<Located<String>>>>,
    pub(super) subscribe: Vec<Located<String>>,
    pub(super) publish: Vec<Located<String>>,
    pub(super) call: Vec<Located<String>>,
    pub(super) serve: Vec<Located<String>>,
    /// A list of patterns is there, but could not be read.
    pub(super) is_broken: bool,
}

/// `[[partner]]`. What is required is `None` only where an error has been recorded already.
#[derive(Debug, Default)]
pub(super) struct PartnerDraft {
    pub(super) name: Option<Located<String>>,
    pub(super) ca: Option<Located<PathBuf>>,
    pub(super) node: Option<Located<Vec<Located<String>>>>,
}
