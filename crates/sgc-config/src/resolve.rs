//! Draft to configuration: values, and their relations.
//!
//! All mistakes are collected. Consequential mistakes are not reported: an invalid value takes no part in comparisons.

mod gateway_table;
mod zenoh_table;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use sgc_ros::{Interface, Naming, QosOverride, Rename, Resume, Shaping, is_enclave, is_pattern, matches};
use sgc_router::MappingKind;
use sgc_store::{SERVERS_MAX, StoreServer};
use sgc_transport::Congestion;
use sgc_trust::{FleetName, NodeName, ShareToken, Suite, TOKEN_PREFIX};
use sgc_wire::{
    Class, Durability, History, METADATA_FIELD_BYTES_MAX, PayloadEncoding, PayloadForm, Reliability,
};

use crate::config::{
    AuditConfig, AuditRoom, AuthorityConfig, Config, DeadManConfig, KEEP_ALIVE_MAX, KEEP_ALIVE_MIN,
    PartnerConfig, RosConfig, RotationConfig, SecurityConfig, ShareConfig, ShareMetadata, StopSource,
    StoreSettings, TokenConfig, TokenSource, TransportConfig, UseConfig,
};
use crate::draft::{
    DeadManDraft, Draft, MetricsDraft, NamingDraft, PartnerDraft, QosDraft, RosDraft, ShapingDraft,
    ShareDraft, StoreDraft, UseDraft, WithOrigin, Words,
};
use crate::error::{ConfigError, Mistake, Origin};
use crate::metrics::{MetricsConfig, OtlpConfig};
use crate::names;
use crate::recipient::Recipient;
use crate::ros_env::{self, Environment};
use crate::schema::nearest;
use crate::zenoh::Middleware;

/// Most shares of one node.
pub const SHARES_MAX: usize = 1024;
/// Most uses of one node.
pub const USES_MAX: usize = 1024;
/// Most exceptions of one share or use.
pub const EXCEPT_MAX: usize = 256;
/// Most recipients of one share.
pub const RECIPIENTS_MAX: usize = 1024;
/// Most routers that one node dials.
pub const ROUTERS_MAX: usize = 16;
/// Most files with CAs whose nodes may attach to one router.
pub const ACCEPT_MAX: usize = 16;
/// Most listen addresses of one node.
pub const LISTEN_MAX: usize = 16;
/// Most partners of one node.
pub const PARTNERS_MAX: usize = 32;
/// Most files with further CAs that one node trusts.
pub const TRUST_MAX: usize = 16;
/// Most directories with definitions.
pub const DEFINITIONS_MAX: usize = 64;
/// Longest path of a Unix socket: `sun_path` without its terminator.
pub const SOCKET_PATH_BYTES_MAX: usize = 107;

const PRIORITIES: [&str; 3] = ["realtime", "default", "bulk"];
/// Names of suites, in the order of their ids from 1.
pub const SUITES: [&str; 10] = [
    "group",
    "group-chacha",
    "standard",
    "standard-chacha",
    "paper",
    "paper-3072",
    "paper-chacha",
    "paper-3072-chacha",
    "pairwise",
    "pairwise-chacha",
];

/// An identity file, with details for errors.
#[derive(Debug)]
pub struct IdentityFile<'i> {
    /// The file.
    pub path: &'i Path,
    /// The key that names it.
    pub key: &'static str,
    /// Whether the path follows from the name instead of being written down.
    pub implied: bool,
    /// The node's name in the configuration, if there is one.
    pub node_name: Option<&'i NodeName>,
}

/// A check of a named file, which takes the key that names it.
type FileCheck = fn(&'static str, &Path) -> Result<(), Mistake>;

/// Checks of named files. They are an argument, since they read the file system.
///
/// Each takes the key that names the file, and its path.
#[derive(Debug)]
pub struct FileChecks {
    /// Checks an identity.
    pub identity: fn(&IdentityFile<'_>) -> Result<(), Mistake>,
    /// Checks a file of CA certificates.
    pub ca: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Reads a share token.
    pub token: fn(&'static str, &Path) -> Result<ShareToken, Mistake>,
    /// Checks a fleet file.
    pub fleet: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks the certificate chain of the gateway.
    pub chain: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks the private key of the gateway, or of a router at its store.
    pub private_key: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks the CAs of a collector of metrics.
    pub roots: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks a file with headers for a collector of metrics.
    pub headers: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks a file with the password of a store's user.
    pub password: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks a session configuration of Zenoh.
    pub zenoh: fn(&'static str, &Path) -> Result<(), Mistake>,
    /// Checks a directory of message definitions.
    pub directory: fn(&'static str, &Path) -> Result<(), Mistake>,
}

/// Resolves a draft whose reader found `errors`. Relative paths are resolved against `base_dir`.
pub(crate) fn resolve(
    draft: &Draft,
    errors: Vec<ConfigError>,
    base_dir: &Path,
    env: Environment<'_>,
    checks: Option<&FileChecks>,
) -> Result<Config, Vec<ConfigError>> {
    let mut resolver = Resolver { words: draft.words, errors, base_dir, checks };
    let node_name = draft.name.as_ref().and_then(|name| resolver.keep(name, names::node));
    let identity = resolver.identity(draft, node_name.as_ref());
    let routers = resolver.addresses(&draft.routers, names::router, ROUTERS_MAX);
    let dns = draft.resolver.as_ref().and_then(|server| resolver.keep(server, names::resolver));
    let keep_alive = draft.keep_alive.as_ref().filter(|written| written.value != "auto");
    let bounds = (KEEP_ALIVE_MIN, KEEP_ALIVE_MAX);
    let keep_alive = keep_alive
        .and_then(|written| resolver.keep(written, |key, value| names::duration(key, value, bounds)));
    let listen = resolver.addresses(&draft.listen, names::listen, LISTEN_MAX);
    let announce = resolver.announce(draft);
    let accept = resolver.accept(draft);
    let attempted = |key| draft.attempted.contains(key);
    let known = draft.mapping.as_ref().map(|kind| resolver.keep(kind, mapping));
    let mapping = known.flatten().unwrap_or_default();
    // A mapping that is not understood has an error, so that the settings beside it need none.
    let store = (known != Some(None)).then(|| resolver.store(draft, mapping)).flatten();
    let peer_rate = draft.peer_rate.as_ref().and_then(|rate| resolver.keep(rate, names::rate));
    let connects = !draft.routers.is_empty() || !draft.listen.is_empty();
    if !connects && !["routers", "listen", "node", "router"].into_iter().any(attempted) {
        let (dial, listen) = (draft.words.dial, draft.words.listen);
        resolver.record(&draft.origin, Mistake::ConnectsToNobody { dial, listen });
    }
    let has_rules = !draft.shares.is_empty() || !draft.uses.is_empty();
    let touches_ros = draft.ros.is_some() || has_rules || draft.gateway.is_some();
    let ros = touches_ros.then(|| {
        let nothing = RosDraft::default();
        let written = draft.ros.as_ref().unwrap_or(&nothing);
        let middleware = resolver.middleware(written, attempted("middleware"));
        let ros = ros_env::resolve(written, middleware, env, &mut resolver.errors);
        let security = resolver.security(written, middleware, env);
        let zenoh = resolver.zenoh(written, middleware, env);
        RosConfig { definitions: resolver.definitions(written), security, zenoh, ..ros }
    });
    let partners = resolver.partners(draft);
    let shares = resolver.shares(draft, node_name.as_ref());
    let uses = resolver.uses(draft, node_name.as_ref());
    let tokens = resolver.tokens(draft);
    let trust = resolver.ca_files(&draft.trust, TRUST_MAX);
    let operators = draft.operators.as_ref().map(|operators| resolver.operators(operators));
    let observers = draft.observers.as_ref().map(|observers| resolver.observers(observers));
    let direct = draft.direct.as_ref();
    let direct = direct.map(|peers| resolver.recipients(peers, node_name.as_ref(), &draft.partners));
    let authority = draft.authority.as_ref().and_then(|fleet| resolver.fleet(fleet));
    let authority =
        authority.map(|fleet| AuthorityConfig { fleet, operators: operators.unwrap_or_default() });
    let state = draft.state.as_ref().and_then(|state| resolver.path(state, "\"/var/lib/sgc/arm-1\""));
    let rotation = resolver.rotation(draft);
    let audit = resolver.audit(draft);
    let transport = resolver.transport(draft);
    let gateway = draft.gateway.as_ref().map(|written| resolver.gateway(written, &draft.partners));
    let metrics = draft.metrics.as_ref().map(|written| resolver.metrics(written));
    let admin_socket = draft.admin_socket.as_ref().and_then(|socket| resolver.socket(socket));
    match identity {
        Some(identity) if resolver.errors.is_empty() => Ok(Config {
            node_name,
            identity,
            routers,
            resolver: dns,
            keep_alive,
            listen,
            peer_rate,
            mapping,
            store,
            announce,
            accept,
            ros,
            shares,
            uses,
            tokens,
            partners,
            trust,
            watch: draft.watch.as_ref().is_none_or(|watch| watch.value),
            authority,
            state,
            rotation,
            audit,
            transport,
            gateway,
            metrics,
            direct: direct.unwrap_or_else(|| vec![Recipient::Everyone]),
            port_mapping: draft.port_mapping.as_ref().is_none_or(|written| written.value),
            admin_socket,
            observers,
        }),
        _ => Err(resolver.errors),
    }
}

struct Resolver<'r> {
    words: Words,
    errors: Vec<ConfigError>,
    base_dir: &'r Path,
    checks: Option<&'r FileChecks>,
}

impl Resolver<'_> {
    fn record(&mut self, origin: &Origin, mistake: Mistake) {
        self.errors.push(ConfigError::new(origin.clone(), mistake));
    }

    /// Returns the value of a check, or records its error.
    fn keep<T>(
        &mut self,
        located: &WithOrigin<String>,
        check: impl FnOnce(&'static str, &str) -> Result<T, Mistake>,
    ) -> Option<T> {
        check(located.key, &located.value).map_err(|mistake| self.errors.push(located.error(mistake))).ok()
    }

    fn check_count(&mut self, origin: &Origin, what: &'static str, count: usize, max: usize) {
        if count > max {
            self.record(origin, Mistake::TooMany { what, count, max });
        }
    }

    fn identity(&mut self, draft: &Draft, node_name: Option<&NodeName>) -> Option<PathBuf> {
        let base_dir = self.base_dir;
        const EXAMPLE: &str = "\"arm-1.identity\"";
        let (path, origin, implied) = match (&draft.identity, &draft.name) {
            (Some(identity), _) if identity.value.as_os_str().is_empty() => {
                let mistake = Mistake::Empty { key: identity.key, example: EXAMPLE };
                self.record(&identity.origin, mistake);
                return None;
            }
            (Some(identity), _) => (base_dir.join(&identity.value), &identity.origin, false),
            (None, Some(name)) => (base_dir.join(format!("{}.identity", node_name?)), &name.origin, true),
            (None, None) => {
                if ["identity", "name", "node"].into_iter().any(|key| draft.attempted.contains(key)) {
                    return None;
                }
                self.record(&draft.origin, Mistake::NoIdentity { missing: self.words.no_identity });
                return None;
            }
        };
        let file = IdentityFile { path: &path, key: self.words.identity, implied, node_name };
        if let Some(Err(mistake)) = self.checks.map(|checks| (checks.identity)(&file)) {
            self.record(origin, mistake);
        }
        Some(path)
    }

    fn addresses<T: Ord + Clone>(
        &mut self,
        written: &[WithOrigin<String>],
        check: fn(&'static str, &str) -> Result<T, Mistake>,
        max: usize,
    ) -> Vec<T> {
        if let Some(first) = written.get(max) {
            let mistake = Mistake::TooManyEntries { key: first.key, count: written.len(), max };
            self.record(&first.origin, mistake);
        }
        let mut seen = BTreeSet::new();
        let mut valid = Vec::new();
        for one in written.iter().take(max) {
            let Some(address) = self.keep(one, check) else { continue };
            if seen.insert(address.clone()) {
                valid.push(address);
            } else {
                self.record(&one.origin, Mistake::Repeated { key: one.key, value: one.value.clone() });
            }
        }
        valid
    }

    fn shares(&mut self, draft: &Draft, node_name: Option<&NodeName>) -> Vec<ShareConfig> {
        self.check_count(&draft.origin, self.words.share, draft.shares.len(), SHARES_MAX);
        let mut first: BTreeMap<(&str, &str), &WithOrigin<String>> = BTreeMap::new();
        let mut called: BTreeMap<(&str, String), &WithOrigin<String>> = BTreeMap::new();
        let mut valid = Vec::new();
        for share in draft.shares.iter().take(SHARES_MAX) {
            let interface = interface_of(share.topic.as_ref());
            let topic =
                share.topic.as_ref().and_then(|topic| self.keep(topic, names::interface_name(interface)));
            if let (Some(topic), Some(written)) = (&topic, &share.topic) {
                if let Some(other) = first.get(&(interface.key(), topic.as_str())) {
                    let mistake = Mistake::SharedTwice {
                        key: written.key,
                        topic: topic.clone(),
                        other: other.reference(),
                    };
                    self.record(&written.origin, mistake);
                } else {
                    first.insert((interface.key(), &written.value), written);
                }
            }
            let resolved = self.share(share, topic, node_name, &draft.partners);
            if let (Some(resolved), Some(written)) = (&resolved, &share.topic) {
                let name = (interface.key(), resolved.naming.renamed(&resolved.topic, &resolved.topic));
                match called.get(&name).filter(|other| other.value != written.value) {
                    Some(other) => {
                        let (key, other) = (written.key, other.reference());
                        self.record(&written.origin, Mistake::SharedAsOne { key, topic: name.1, other });
                    }
                    None => drop(called.insert(name, written)),
                }
            }
            valid.extend(resolved);
        }
        valid
    }

    fn share(
        &mut self,
        share: &ShareDraft,
        topic: Option<String>,
        node_name: Option<&NodeName>,
        partners: &[PartnerDraft],
    ) -> Option<ShareConfig> {
        let to = share.to.as_ref().map(|to| {
            if to.value.is_empty() {
                self.record(&to.origin, Mistake::NobodyMay { key: to.key });
            }
            self.recipients(to, node_name, partners)
        });
        let publish = share.publish.as_ref().map(|publish| self.recipients(publish, node_name, partners));
        let interface = interface_of(share.topic.as_ref());
        let type_name = share
            .type_name
            .as_ref()
            .and_then(|name| self.keep(name, |key, value| names::interface_type(key, value, interface)));
        let publishes = share.publish.as_ref().map(|publish| (publish.key, &publish.origin));
        self.check_topics_only(interface, publishes, &share.shaping, &share.qos);
        let pattern = topic.as_ref().filter(|topic| is_pattern(topic));
        if let (Some(publish), Some(topic)) = (&share.publish, pattern) {
            let topic = topic.clone();
            self.record(&publish.origin, Mistake::PublishOnPattern { key: publish.key, topic });
        } else if let Some(publish) = &share.publish
            && share.type_name.is_none()
            && interface == Interface::Topic
        {
            self.record(&publish.origin, Mistake::PublishWithoutType { key: publish.key });
        }
        let dead_man = share.dead_man.as_ref().and_then(|written| {
            if share.publish.is_none() {
                self.record(&written.origin, Mistake::DeadManOfOwn { key: "deadman" });
            }
            self.dead_man(written)
        });
        let priority = share.priority.as_ref().and_then(|priority| self.keep(priority, priority_class));
        let dedicated = self.dedicated(share.link.as_ref());
        let suite = share.suite.as_ref().and_then(|name| self.keep(name, suite));
        let shaping = self.shaping(&share.shaping);
        let qos = self.qos(&share.qos);
        let naming = self.naming(&share.naming, topic.as_deref());
        let metadata = ShareMetadata {
            description: self.metadata(share.description.as_ref()),
            author: self.metadata(share.author.as_ref()),
            maintainer: self.metadata(share.maintainer.as_ref()),
            interface: self.metadata(share.interface.as_ref()),
            unique: self.metadata(share.unique.as_ref()),
            node: self.metadata(share.node.as_ref()),
        };
        Some(ShareConfig {
            interface,
            topic: topic?,
            naming: naming?,
            to: to?,
            publish: publish.unwrap_or_default(),
            type_name,
            priority: priority.unwrap_or_default(),
            dead_man,
            shaping,
            qos,
            dedicated,
            suite: suite.unwrap_or(Suite::DEFAULT),
            metadata,
        })
    }

    fn recipients(
        &mut self,
        to: &WithOrigin<Vec<WithOrigin<String>>>,
        node_name: Option<&NodeName>,
        partners: &[PartnerDraft],
    ) -> Vec<Recipient> {
        if to.value.len() > RECIPIENTS_MAX {
            let (key, count) = (to.key, to.value.len());
            self.record(&to.origin, Mistake::TooManyEntries { key, count, max: RECIPIENTS_MAX });
        }
        let mut seen = BTreeSet::new();
        let mut valid = Vec::new();
        for one in to.value.iter().take(RECIPIENTS_MAX) {
            let Some(recipient) = self.keep(one, names::recipient) else { continue };
            if let Recipient::Partner(partner) = &recipient {
                self.check_partner(one, partner, partners);
            }
            if seen.insert(recipient.clone()) {
                valid.push(recipient);
            } else {
                self.record(&one.origin, Mistake::Repeated { key: one.key, value: one.value.clone() });
            }
        }
        // `*` covers every member of this fleet but no partners, which may stand beside it.
        let other = valid.iter().find(|r| !matches!(r, Recipient::Everyone | Recipient::Partner(_)));
        if let Some(other) = other.filter(|_| seen.contains(&Recipient::Everyone)) {
            let other = other.to_string();
            self.record(&to.origin, Mistake::EveryoneAndMore { key: to.key, other });
        }
        if let ([Recipient::Node(only)], 1, Some(name)) = (&valid[..], to.value.len(), node_name)
            && only == name
        {
            self.record(&to.origin, Mistake::OnlyItself { key: to.key, name: name.to_string() });
        }
        valid
    }

    /// Operators are named one by one or by their groups, since they change the fleet.
    fn operators(&mut self, written: &WithOrigin<Vec<WithOrigin<String>>>) -> Vec<Recipient> {
        self.members(written, |recipient| match recipient {
            Recipient::Everyone | Recipient::Partner(_) => Err(|key, value| Mistake::Operator { key, value }),
            Recipient::Node(_) | Recipient::Group(_) => Ok(()),
        })
    }

    /// Observers are of the own fleet.
    fn observers(&mut self, written: &WithOrigin<Vec<WithOrigin<String>>>) -> Vec<Recipient> {
        self.members(written, |recipient| match recipient {
            Recipient::Partner(_) => Err(|key, value| Mistake::Observer { key, value }),
            Recipient::Everyone | Recipient::Node(_) | Recipient::Group(_) => Ok(()),
        })
    }

    fn members(
        &mut self,
        written: &WithOrigin<Vec<WithOrigin<String>>>,
        check: impl Fn(&Recipient) -> Result<(), fn(&'static str, String) -> Mistake>,
    ) -> Vec<Recipient> {
        if written.value.len() > RECIPIENTS_MAX {
            let (key, count) = (written.key, written.value.len());
            self.record(&written.origin, Mistake::TooManyEntries { key, count, max: RECIPIENTS_MAX });
        }
        let mut valid = Vec::new();
        for one in written.value.iter().take(RECIPIENTS_MAX) {
            let Some(recipient) = self.keep(one, names::recipient) else { continue };
            let (key, value) = (one.key, one.value.clone());
            match check(&recipient) {
                Err(mistake) => self.record(&one.origin, mistake(key, value)),
                Ok(()) if valid.contains(&recipient) => {
                    self.record(&one.origin, Mistake::Repeated { key, value });
                }
                Ok(()) => valid.push(recipient),
            }
        }
        valid
    }

    fn check_partner(&mut self, one: &WithOrigin<String>, partner: &FleetName, known: &[PartnerDraft]) {
        let names: Vec<&str> =
            known.iter().filter_map(|p| p.name.as_ref()).map(|name| name.value.as_str()).collect();
        // A partner with an invalid name has its own error, and may be the one meant.
        if !names.contains(&partner.as_str()) && names.len() == known.len() {
            let nearest = nearest(partner.as_str(), &names).map(str::to_owned);
            let partner = partner.to_string();
            self.record(&one.origin, Mistake::UnknownPartner { key: one.key, partner, nearest });
        }
    }

    fn partners(&mut self, draft: &Draft) -> Vec<PartnerConfig> {
        self.check_count(&draft.origin, "[[partner]]", draft.partners.len(), PARTNERS_MAX);
        let mut first: BTreeMap<FleetName, &WithOrigin<String>> = BTreeMap::new();
        let mut valid = Vec::new();
        for partner in draft.partners.iter().take(PARTNERS_MAX) {
            let name = partner.name.as_ref().and_then(|name| self.keep(name, names::partner));
            if let (Some(name), Some(written)) = (&name, &partner.name) {
                if let Some(other) = first.get(name) {
                    let (key, name, other) = (written.key, name.to_string(), other.reference());
                    self.record(&written.origin, Mistake::PartnerTwice { key, name, other });
                } else {
                    first.insert(name.clone(), written);
                }
            }
            let ca = partner.ca.as_ref().and_then(|ca| self.ca_file(ca));
            let nodes = match &partner.node {
                Some(written) if written.value.is_empty() => {
                    let example = "node = \"64 hexadecimal digits\", or leave it out to mean all of that CA";
                    self.record(&written.origin, Mistake::Empty { key: written.key, example });
                    Vec::new()
                }
                Some(written) => self.addresses(&written.value, names::node_id, RECIPIENTS_MAX),
                None => Vec::new(),
            };
            valid.extend(name.zip(ca).map(|(name, ca)| PartnerConfig { name, ca, nodes }));
        }
        valid
    }

    fn announce(&mut self, draft: &Draft) -> bool {
        let Some(announce) = draft.announce.as_ref().filter(|announce| announce.value) else { return false };
        if draft.listen.is_empty() && !draft.attempted.contains("listen") {
            let (key, listen) = (announce.key, self.words.listen);
            self.record(&announce.origin, Mistake::AnnouncesNothing { key, listen });
        }
        true
    }

    fn accept(&mut self, draft: &Draft) -> Vec<PathBuf> {
        let Some(accept) = &draft.accept else { return Vec::new() };
        let key = accept.key;
        if accept.value.is_empty() {
            // As a list it would admit nobody, as the default everybody.
            let example =
                "accept = [\"lab-ca.pem\"], or leave it out to accept every CA that is trusted here";
            self.record(&accept.origin, Mistake::Empty { key, example });
        } else if draft.listen.is_empty() && !draft.attempted.contains("listen") {
            self.record(&accept.origin, Mistake::AcceptsNobody { key, listen: self.words.listen });
        }
        self.ca_files(&accept.value, ACCEPT_MAX)
    }

    fn ca_files(&mut self, written: &[WithOrigin<String>], max: usize) -> Vec<PathBuf> {
        if let Some(first) = written.get(max) {
            let (key, count) = (first.key, written.len());
            self.record(&first.origin, Mistake::TooManyEntries { key, count, max });
        }
        let mut valid: Vec<PathBuf> = Vec::new();
        for one in written.iter().take(max) {
            let Some(path) = self.ca_file(&one.clone().map(PathBuf::from)) else { continue };
            if valid.contains(&path) {
                self.record(&one.origin, Mistake::Repeated { key: one.key, value: one.value.clone() });
            } else {
                valid.push(path);
            }
        }
        valid
    }

    fn ca_file(&mut self, written: &WithOrigin<PathBuf>) -> Option<PathBuf> {
        let path = self.path(written, "\"acme-ca.pem\"")?;
        if let Some(Err(mistake)) = self.checks.map(|checks| (checks.ca)(written.key, &path)) {
            self.record(&written.origin, mistake);
        }
        Some(path)
    }

    fn fleet(&mut self, written: &WithOrigin<PathBuf>) -> Option<PathBuf> {
        let path = self.path(written, "\"lab.fleet\"")?;
        if let Some(Err(mistake)) = self.checks.map(|checks| (checks.fleet)(written.key, &path)) {
            self.record(&written.origin, mistake);
        }
        Some(path)
    }

    fn path(&mut self, written: &WithOrigin<PathBuf>, example: &'static str) -> Option<PathBuf> {
        if written.value.as_os_str().is_empty() {
            self.record(&written.origin, Mistake::Empty { key: written.key, example });
            return None;
        }
        Some(self.base_dir.join(&written.value))
    }

    fn definitions(&mut self, written: &RosDraft) -> Vec<PathBuf> {
        let Some(written) = &written.definitions else { return Vec::new() };
        let count = written.value.len();
        if count > DEFINITIONS_MAX {
            let (key, max) = (written.key, DEFINITIONS_MAX);
            self.record(&written.origin, Mistake::TooManyEntries { key, count, max });
        }
        let mut valid = Vec::new();
        for one in written.value.iter().take(DEFINITIONS_MAX) {
            let path = self.path(&one.clone().map(PathBuf::from), "\"/opt/robot/share\"");
            if let Some(Err(mistake)) =
                path.as_ref().and_then(|path| Some((self.checks?.directory)(one.key, path)))
            {
                self.record(&one.origin, mistake);
            }
            valid.extend(path);
        }
        valid
    }

    /// Returns the enclave of the file, or else of the environment as rcl reads it. Without a DDS network there is none.
    fn security(
        &mut self,
        written: &RosDraft,
        middleware: Option<Middleware>,
        env: Environment<'_>,
    ) -> Option<SecurityConfig> {
        if !middleware.is_none_or(Middleware::has_dds) {
            return None;
        }
        let variable = |name| ros_env::variable(env, name);
        let is_written = written.security().next().is_some();
        if !is_written && variable(ros_env::SECURITY_ENABLE).as_deref() != Some("true") {
            return None;
        }
        let enforced = is_written || variable(ros_env::SECURITY_STRATEGY).as_deref() == Some("Enforce");
        let keystore = match &written.security_root {
            Some(root) => self.path(&root.clone().map(PathBuf::from), "\"/opt/robot/keystore\"")?,
            None => match variable(ros_env::SECURITY_KEYSTORE) {
                Some(keystore) => PathBuf::from(keystore),
                None if enforced => {
                    let origin = written.enclave.as_ref().map_or(Origin::Environment, |e| e.origin.clone());
                    self.record(&origin, Mistake::NoKeystore);
                    return None;
                }
                None => return None,
            },
        };
        let environment_error = variable(ros_env::SECURITY_ENCLAVE_OVERRIDE);
        let (key, enclave, origin) = match (&written.enclave, environment_error) {
            (Some(enclave), _) => (enclave.key, enclave.value.clone(), enclave.origin.clone()),
            (None, Some(enclave)) => (ros_env::SECURITY_ENCLAVE_OVERRIDE, enclave, Origin::Environment),
            (None, None) => ("enclave", "/".to_owned(), Origin::Environment),
        };
        if !is_enclave(&enclave) {
            self.record(&origin, Mistake::Enclave { key, value: enclave });
            return None;
        }
        Some(SecurityConfig { keystore, enclave, enforced })
    }

    fn rotation(&mut self, draft: &Draft) -> RotationConfig {
        let bounds = (RotationConfig::EVERY_MIN, RotationConfig::EVERY_MAX);
        let written = &draft.rotation;
        let every = written
            .every
            .as_ref()
            .and_then(|every| self.keep(every, |key, value| names::duration(key, value, bounds)));
        let bounds = (RotationConfig::MESSAGES_MIN, RotationConfig::MESSAGES_MAX);
        let messages = written.messages.as_ref().and_then(|n| self.number(n, "a number of messages", bounds));
        let default = RotationConfig::default();
        RotationConfig {
            every: every.unwrap_or(default.every),
            messages: messages.unwrap_or(default.messages),
        }
    }

    fn transport(&mut self, draft: &Draft) -> TransportConfig {
        let written = &draft.transport;
        let congestion = written.congestion.as_ref().and_then(|name| self.keep(name, congestion));
        TransportConfig {
            congestion: congestion.unwrap_or_default(),
            offload: written.offload.as_ref().is_none_or(|offload| offload.value),
            mtu_discovery: written.mtu_discovery.as_ref().is_none_or(|looks| looks.value),
            bulk_lanes: written.bulk_lanes.as_ref().is_none_or(|allowed| allowed.value),
            dtls12: written.dtls_1_2.as_ref().is_some_and(|takes| takes.value),
            dscp: written.dscp.as_ref().and_then(|mark| self.keep(mark, names::dscp)),
            lane_dscp: written.lane_dscp.as_ref().and_then(|mark| self.keep(mark, names::dscp)),
        }
    }

    fn metrics(&mut self, written: &MetricsDraft) -> MetricsConfig {
        let listen = written.listen.as_ref().and_then(|listen| self.keep(listen, names::metrics_listen));
        let default = MetricsConfig::default();
        MetricsConfig { listen: listen.unwrap_or(default.listen), otlp: self.otlp(written) }
    }

    fn otlp(&mut self, written: &MetricsDraft) -> Option<OtlpConfig> {
        let Some(otlp) = &written.otlp else {
            let files = [&written.otlp_headers_file, &written.otlp_ca];
            let interval = written.otlp_interval.iter().map(|written| (written.key, &written.origin));
            let files = files.into_iter().flatten().map(|written| (written.key, &written.origin));
            for (key, origin) in interval.chain(files) {
                self.record(origin, Mistake::OtlpMissing { key });
            }
            return None;
        };
        let url = self.keep(otlp, names::otlp);
        let bounds = (OtlpConfig::INTERVAL_MIN, OtlpConfig::INTERVAL_MAX);
        let interval = written
            .otlp_interval
            .as_ref()
            .and_then(|interval| self.keep(interval, |key, value| names::duration(key, value, bounds)));
        let (headers, roots) =
            (self.checks.map(|checks| checks.headers), self.checks.map(|checks| checks.roots));
        let headers_file =
            self.checked_file(written.otlp_headers_file.as_ref(), "\"collector.headers\"", headers);
        let ca = self.checked_file(written.otlp_ca.as_ref(), "\"collector-ca.pem\"", roots);
        if let (Some(url), Some(ca)) = (&url, &written.otlp_ca)
            && !url.is_encrypted()
        {
            self.record(&ca.origin, Mistake::OtlpCaUnused { key: ca.key });
        }
        Some(OtlpConfig { url: url?, interval: interval.unwrap_or(OtlpConfig::INTERVAL), headers_file, ca })
    }

    fn store(&mut self, draft: &Draft, mapping: MappingKind) -> Option<StoreSettings> {
        let StoreDraft { servers: urls, prefix, user, password_file, ca, certificate, key } = &draft.store;
        let files =
            [password_file, ca, certificate, key].map(|file| file.as_ref().map(|f| (f.key, &f.origin)));
        let words = [prefix, user].map(|word| word.as_ref().map(|w| (w.key, &w.origin)));
        if mapping != MappingKind::Store {
            let servers = urls.first().map(|url| (url.key, &url.origin));
            let unused = servers.into_iter().chain(words.into_iter().chain(files).flatten());
            for (key, origin) in unused.filter(|_| !draft.attempted.contains("mapping")) {
                self.record(origin, Mistake::StoreUnused { key });
            }
            return None;
        }
        if let Some(mapping) = draft.mapping.as_ref().filter(|_| urls.is_empty())
            && !draft.attempted.contains("store")
        {
            self.record(&mapping.origin, Mistake::StoreMissing);
        }
        if let Some(url) = urls.get(SERVERS_MAX) {
            let (key, count, max) = (url.key, urls.len(), SERVERS_MAX);
            self.record(&url.origin, Mistake::TooManyEntries { key, count, max });
        }
        let mut servers = Vec::new();
        for url in urls.iter().take(SERVERS_MAX) {
            let Some(server) = self.keep(url, names::store_server) else { continue };
            if servers
                .first()
                .is_some_and(|first: &StoreServer| first.is_encrypted() != server.is_encrypted())
            {
                self.record(&url.origin, Mistake::StoreMixed { key: url.key });
            }
            servers.push(server);
        }
        let is_open = servers.first().is_some_and(|server| !server.is_encrypted());
        for (key, origin) in files[1..].iter().flatten().filter(|_| is_open) {
            self.record(origin, Mistake::StoreTlsUnused { key });
        }
        let pairs = [(words[1], files[0], "store_password_file"), (files[0], words[1], "store_user")]
            .into_iter()
            .chain([(files[2], files[3], "store_key"), (files[3], files[2], "store_certificate")]);
        for (one, other, missing) in pairs {
            if let (Some((key, origin)), None) = (one, other) {
                self.record(origin, Mistake::StoreHalf { key, missing });
            }
        }
        let prefix = prefix.as_ref().and_then(|prefix| self.keep(prefix, names::store_prefix));
        let user = user.as_ref().and_then(|user| self.keep(user, names::store_user));
        let checks = self.checks;
        let password = checks.map(|checks| checks.password);
        let password_file = self.checked_file(password_file.as_ref(), "\"store.password\"", password);
        let ca = self.checked_file(ca.as_ref(), "\"store-ca.pem\"", checks.map(|checks| checks.roots));
        let chain = checks.map(|checks| checks.chain);
        let certificate = self.checked_file(certificate.as_ref(), "\"router.pem\"", chain);
        let key = self.checked_file(key.as_ref(), "\"router.key\"", checks.map(|checks| checks.private_key));
        Some(StoreSettings {
            servers,
            prefix: prefix.unwrap_or_default(),
            user: user.zip(password_file),
            ca,
            certificate: certificate.zip(key),
        })
    }

    fn checked_file(
        &mut self,
        written: Option<&WithOrigin<PathBuf>>,
        example: &'static str,
        check: Option<FileCheck>,
    ) -> Option<PathBuf> {
        let written = written?;
        let path = self.path(written, example)?;
        if let Some(Err(mistake)) = check.map(|check| check(written.key, &path)) {
            self.record(&written.origin, mistake);
        }
        Some(path)
    }

    fn audit(&mut self, draft: &Draft) -> AuditConfig {
        let written = &draft.audit;
        let file = written.file.as_ref().and_then(|f| self.path(f, "\"/var/log/sgc/arm-1.audit\""));
        let bounds = (AuditConfig::MAX_BYTES_MIN, AuditConfig::MAX_BYTES_MAX);
        let max_bytes = written.max_bytes.as_ref().and_then(|n| self.number(n, "a number of bytes", bounds));
        let bounds = (AuditConfig::FILES_MIN.into(), AuditConfig::FILES_MAX.into());
        let files = written.files.as_ref().and_then(|n| self.number(n, "a number of files", bounds));
        let files = files.and_then(|files| u32::try_from(files).ok());
        let off = written.off.as_ref().is_some_and(|off| off.value);
        let other = [written.file.as_ref().map(|f| (f.key, &f.origin))]
            .into_iter()
            .chain([&written.max_bytes, &written.files].map(|n| n.as_ref().map(|n| (n.key, &n.origin))))
            .flatten()
            .next();
        if let Some((other, origin)) = other.filter(|_| off) {
            let right = "take one of them out";
            let other_value = "given".to_owned();
            self.record(
                origin,
                Mistake::Contradiction { key: "off", value: "true", other, other_value, right },
            );
        }
        let usual = AuditConfig::default().room;
        let room = AuditRoom {
            max_bytes: max_bytes.unwrap_or(usual.max_bytes),
            files: files.unwrap_or(usual.files),
        };
        AuditConfig { file, room, off }
    }

    fn number(
        &mut self,
        written: &WithOrigin<i64>,
        what: &'static str,
        (min, max): (u64, u64),
    ) -> Option<u64> {
        let value = written.value;
        let valid = u64::try_from(value).ok().filter(|n| (min..=max).contains(n));
        if valid.is_none() {
            let key = written.key;
            self.record(&written.origin, Mistake::Number { key, value, what, min, max });
        }
        valid
    }

    fn tokens(&mut self, draft: &Draft) -> Vec<TokenConfig> {
        let mut first: Vec<(TokenConfig, &WithOrigin<String>)> = Vec::new();
        for one in &draft.uses {
            let Some(written) = &one.token else { continue };
            for beside in [
                &one.priority,
                &one.shaping.max_rate,
                &one.shaping.max_bandwidth,
                &one.shaping.max_age,
                &one.shaping.compress,
                &one.shaping.encoding,
            ]
            .into_iter()
            .flatten()
            {
                self.record(&beside.origin, Mistake::TokenUnshaped { key: beside.key });
            }
            for beside in [&one.from, &one.topic, &one.type_name].into_iter().flatten() {
                self.record(&beside.origin, Mistake::TokenAndMore { key: beside.key });
            }
            if let Some(except) = &one.naming.except {
                self.record(&except.origin, Mistake::TokenAndMore { key: except.key });
            }
            // The token determines the single topic.
            let unnamed = NamingDraft { except: None, ..one.naming.clone() };
            let naming = self.naming(&unnamed, Some("/topic")).unwrap_or_default();
            let frame_prefix = self.frame_prefix(one);
            let dead_man = one.dead_man.as_ref().and_then(|written| self.dead_man(written));
            let Some(source) = self.token(written) else { continue };
            if let Some((_, other)) = first.iter().find(|(known, _)| known.source == source) {
                let other = other.reference();
                self.record(&written.origin, Mistake::TokenTwice { key: written.key, other });
            } else {
                let dedicated = self.dedicated(one.link.as_ref());
                let qos = self.qos(&one.qos);
                first.push((TokenConfig { source, naming, frame_prefix, dead_man, qos, dedicated }, written));
            }
        }
        first.into_iter().map(|(token, _)| token).collect()
    }

    fn token(&mut self, written: &WithOrigin<String>) -> Option<TokenSource> {
        if written.value.trim_start().starts_with(TOKEN_PREFIX) {
            let token = self.keep(written, |key, text| {
                ShareToken::parse(text).map_err(|fault| Mistake::Token { key, fault })
            })?;
            return Some(TokenSource::Text(Box::new(token)));
        }
        let path = self.path(&written.clone().map(PathBuf::from), "\"arm-1-pose.token\"")?;
        if let Some(Err(mistake)) = self.checks.map(|checks| (checks.token)(written.key, &path)) {
            self.record(&written.origin, mistake);
        }
        Some(TokenSource::File(path))
    }

    /// Returns `true` if a topic has a lane.
    fn dedicated(&mut self, link: Option<&WithOrigin<String>>) -> bool {
        link.and_then(|link| self.keep(link, is_dedicated)).unwrap_or_default()
    }

    fn metadata(&mut self, text: Option<&WithOrigin<String>>) -> String {
        let Some(text) = text else { return String::new() };
        let (bytes, max) = (text.value.len(), METADATA_FIELD_BYTES_MAX);
        if bytes > max {
            self.record(&text.origin, Mistake::TooLong { key: text.key, bytes, max });
        }
        text.value.clone()
    }

    fn uses(&mut self, draft: &Draft, node_name: Option<&NodeName>) -> Vec<UseConfig> {
        self.check_count(&draft.origin, self.words.uses, draft.uses.len(), USES_MAX);
        let shared: BTreeMap<(&str, &str), &WithOrigin<String>> = draft
            .shares
            .iter()
            .filter_map(|share| share.topic.as_ref())
            .map(|topic| ((interface_of(Some(topic)).key(), topic.value.as_str()), topic))
            .rev()
            .collect();
        let mut first: BTreeMap<(NodeName, &str, String, bool), &WithOrigin<String>> = BTreeMap::new();
        let mut valid = Vec::new();
        for one in draft.uses.iter().take(USES_MAX).filter(|one| one.token.is_none()) {
            let resolved = self.resolve_use(one, node_name);
            if let (Some(resolved), Some(written)) = (&resolved, &one.topic) {
                let (key, topic) = (written.key, resolved.topic.clone());
                // Topics that match a pattern may go in different directions.
                let is_other_way = is_pattern(&topic) && resolved.publish;
                let what = resolved.interface.key();
                let pair = (resolved.from.clone(), what, topic.clone(), is_other_way);
                let here = resolved.naming.renamed(&topic, &topic);
                if let Some(other) = first.get(&pair) {
                    let (from, other) = (pair.0.to_string(), other.reference());
                    self.record(&written.origin, Mistake::UsedTwice { key, topic, from, other });
                } else if let Some(share) = shared.get(&(what, here.as_str())).filter(|_| !is_pattern(&here))
                {
                    let other = share.reference();
                    self.record(&written.origin, Mistake::SharedAndUsed { key, topic: here, other });
                } else {
                    first.insert(pair, written);
                }
            }
            valid.extend(resolved);
        }
        valid
    }

    fn resolve_use(&mut self, one: &UseDraft, node_name: Option<&NodeName>) -> Option<UseConfig> {
        let from = one.from.as_ref().and_then(|from| {
            let name = self.keep(from, names::node)?;
            if node_name == Some(&name) {
                self.record(&from.origin, Mistake::UseFromItself { key: from.key, name: name.to_string() });
            }
            Some(name)
        });
        let interface = interface_of(one.topic.as_ref());
        let topic = one.topic.as_ref().and_then(|topic| self.keep(topic, names::interface_name(interface)));
        let naming = self.naming(&one.naming, topic.as_deref());
        let type_name = one
            .type_name
            .as_ref()
            .and_then(|name| self.keep(name, |key, value| names::interface_type(key, value, interface)));
        let publishes = one.publish.as_ref().map(|publish| (publish.key, &publish.origin));
        self.check_topics_only(interface, publishes, &one.shaping, &one.qos);
        let publish = one.publish.as_ref().is_some_and(|publish| publish.value);
        let sends = publish || interface != Interface::Topic;
        if let Some(written) = one.priority.as_ref().filter(|_| !sends) {
            self.record(&written.origin, Mistake::PriorityOfOther { key: written.key });
        }
        if let Some(written) = one.shaping.compress.as_ref().filter(|_| !publish) {
            self.record(&written.origin, Mistake::CompressionOfOther { key: written.key });
        }
        if let Some(written) = one.shaping.encoding.as_ref().filter(|_| !publish) {
            self.record(&written.origin, Mistake::EncodingOfOther { key: written.key });
        }
        let priority = one.priority.as_ref().and_then(|priority| self.keep(priority, priority_class));
        let shaping = self.shaping(&one.shaping);
        for (key, origin) in one.qos.written().filter(|_| publish) {
            self.record(origin, Mistake::QosElsewhere { key });
        }
        let qos = self.qos(&one.qos);
        let dedicated = self.dedicated(one.link.as_ref());
        if let Some(written) = one.frame_prefix.as_ref().filter(|_| publish) {
            self.record(&written.origin, Mistake::OnlyForWhatComes { key: written.key });
        }
        let frame_prefix = self.frame_prefix(one);
        let dead_man = one.dead_man.as_ref().and_then(|written| {
            const KEY: &str = "deadman";
            if publish {
                self.record(&written.origin, Mistake::OnlyForWhatComes { key: KEY });
            }
            if interface != Interface::Topic {
                self.record(&written.origin, Mistake::TopicsOnly { key: KEY, interface: interface.key() });
            }
            if let Some(topic) = topic.as_ref().filter(|topic| is_pattern(topic)) {
                self.record(&written.origin, Mistake::DeadManOfMany { key: KEY, topic: topic.clone() });
            }
            self.dead_man(written)
        });
        Some(UseConfig {
            from: from?,
            interface,
            topic: topic?,
            naming: naming?,
            frame_prefix,
            dead_man,
            type_name,
            publish,
            priority,
            shaping,
            qos,
            dedicated,
        })
    }

    fn dead_man(&mut self, written: &DeadManDraft) -> Option<DeadManConfig> {
        let after = written.after.as_ref().and_then(|after| self.keep(after, names::dead_man_time));
        let base_dir = self.base_dir;
        let stop = written.publish.as_ref().and_then(|publish| {
            self.keep(publish, |key, value| match value {
                "zero" => Ok(StopSource::Zero),
                "last" => Ok(StopSource::Last),
                file if file.ends_with(".json") => Ok(StopSource::File(base_dir.join(file))),
                _ => Err(unknown_word(key, value, &["zero", "last", "FILE.json"])),
            })
        });
        let repeat = written.repeat.as_ref().and_then(|repeat| self.keep(repeat, names::dead_man_time));
        let resume =
            written.resume.as_ref().and_then(|resume| self.keep(resume, resume_of)).unwrap_or_default();
        Some(DeadManConfig { after: after?, stop: stop?, repeat, resume })
    }

    fn frame_prefix(&mut self, one: &UseDraft) -> Option<String> {
        one.frame_prefix.as_ref().and_then(|prefix| self.keep(prefix, names::frame_prefix))
    }

    /// Resolves exceptions and other names. Returns `None` if the topic is unknown.
    fn naming(&mut self, written: &NamingDraft, topic: Option<&str>) -> Option<Naming> {
        let except = written.except.as_ref().map(|except| {
            if let Some(topic) = topic.filter(|topic| !is_pattern(topic)) {
                let topic = topic.to_owned();
                self.record(&except.origin, Mistake::ExceptOfOne { key: except.key, topic });
            }
            let valid = self.addresses(&except.value, names::pattern, EXCEPT_MAX);
            for one in &except.value {
                let nothing = topic.filter(|topic| is_pattern(topic) && !is_pattern(&one.value));
                if let Some(topic) =
                    nothing.filter(|topic| valid.contains(&one.value) && !matches(topic, &one.value))
                {
                    let (key, value, topic) = (one.key, one.value.clone(), topic.to_owned());
                    self.record(&one.origin, Mistake::ExceptsNothing { key, value, topic });
                }
            }
            valid
        });
        if let (Some(_), Some(namespace)) = (&written.renamed, &written.namespace) {
            self.record(&namespace.origin, Mistake::AsAndNamespace { key: namespace.key });
        }
        let renamed = written.renamed.as_ref().and_then(|name| {
            let other = self.keep(name, names::pattern)?;
            topic.is_none_or(|topic| self.check_as(name, topic)).then_some(other)
        });
        let namespace = written.namespace.as_ref().and_then(|name| self.keep(name, names::topic));
        let rename = match (renamed, namespace) {
            (Some(other), _) => Rename::As(other),
            (None, Some(namespace)) => Rename::Namespace(namespace),
            (None, None) => Rename::Keep,
        };
        let naming = Naming { except: except.unwrap_or_default(), rename };
        let topic = topic?;
        if let (Some(namespace), Rename::Namespace(_)) = (&written.namespace, &naming.rename)
            && let Err(mistake) = names::pattern(namespace.key, &naming.renamed(topic, topic))
        {
            self.record(&namespace.origin, mistake);
        }
        Some(naming)
    }

    /// Checks that `as` and the topic both have a wildcard, or neither has.
    fn check_as(&mut self, written: &WithOrigin<String>, topic: &str) -> bool {
        let split = |name: &str| {
            let (stem, last) = name.rsplit_once('/').unwrap_or_default();
            (stem.to_owned(), last.to_owned())
        };
        let ((topic_stem, topic_last), (stem, last)) = (split(topic), split(&written.value));
        let right = match (is_pattern(topic), is_pattern(&topic_stem), is_pattern(&stem)) {
            (true, false, false) if topic_last == last => return true,
            (false, ..) if !is_pattern(&written.value) => return true,
            (true, false, false) if is_pattern(&last) => Some(format!("{stem}/{topic_last}")),
            (true, false, false) => Some(format!("{}/{topic_last}", written.value)),
            (false, _, false) if !stem.is_empty() => Some(stem),
            _ => None,
        };
        let (key, value, topic) = (written.key, written.value.clone(), topic.to_owned());
        self.record(&written.origin, Mistake::AsWildcard { key, value, topic, right });
        false
    }

    /// Reports settings that services do not have.
    fn check_topics_only(
        &mut self,
        interface: Interface,
        publish: Option<(&'static str, &Origin)>,
        shaping: &ShapingDraft,
        qos: &QosDraft,
    ) {
        if interface == Interface::Topic {
            return;
        }
        let shaping = [&shaping.max_rate, &shaping.max_bandwidth, &shaping.max_age, &shaping.encoding];
        let written = shaping.into_iter().flatten().map(|one| (one.key, &one.origin));
        for (key, origin) in publish.into_iter().chain(written).chain(qos.written()) {
            self.record(origin, Mistake::TopicsOnly { key, interface: interface.key() });
        }
    }

    fn qos(&mut self, written: &QosDraft) -> QosOverride {
        let reliability = written.reliability.as_ref().and_then(|r| self.keep(r, reliability));
        let durability = written.durability.as_ref().and_then(|d| self.keep(d, durability));
        let keeps_all = written.history.as_ref().and_then(|h| self.keep(h, keeps_all));
        let bounds = (1, HISTORY_DEPTH_MAX);
        let depth = written.depth.as_ref().and_then(|d| self.number(d, "a number of messages", bounds));
        let depth = depth.and_then(|depth| u32::try_from(depth).ok());
        if let (Some(true), Some(depth)) = (keeps_all, &written.depth) {
            let (other, other_value) = (depth.key, depth.value.to_string());
            let right = "take one of them out";
            let mistake =
                Mistake::Contradiction { key: "history", value: "keep_all", other, other_value, right };
            self.record(&depth.origin, mistake);
        }
        if let (Some(false), Some(history), None) = (keeps_all, &written.history, &written.depth) {
            self.record(&history.origin, Mistake::HistoryWithoutDepth { key: history.key });
        }
        if let (Some(Reliability::BestEffort), Some(Durability::TransientLocal), Some(origin)) =
            (reliability, durability, written.durability.as_ref().map(|d| &d.origin))
        {
            let (other, other_value) = ("reliability", "best_effort".to_owned());
            let right =
                "late joiners get what was said before from reliable publishers alone; take one of them out";
            let mistake = Mistake::Contradiction {
                key: "durability",
                value: "transient_local",
                other,
                other_value,
                right,
            };
            self.record(origin, mistake);
        }
        let mut ns = |time: &Option<WithOrigin<String>>| {
            let time = self.keep(time.as_ref()?, names::age)?;
            u64::try_from(time.as_nanos()).ok()
        };
        QosOverride {
            reliability,
            durability,
            history: if keeps_all == Some(true) {
                Some(History::KeepAll)
            } else {
                depth.map(History::KeepLast)
            },
            deadline_ns: ns(&written.deadline),
            lifespan_ns: ns(&written.lifespan),
        }
    }

    fn shaping(&mut self, written: &ShapingDraft) -> Shaping {
        Shaping {
            interval: written.max_rate.as_ref().and_then(|rate| self.keep(rate, names::interval)),
            bits_per_s: written.max_bandwidth.as_ref().and_then(|rate| self.keep(rate, names::bandwidth)),
            max_age: written.max_age.as_ref().and_then(|age| self.keep(age, names::age)),
            compression: written
                .compress
                .as_ref()
                .and_then(|c| self.keep(c, compression))
                .unwrap_or_default(),
            form: written.encoding.as_ref().and_then(|e| self.keep(e, encoding)).unwrap_or_default(),
        }
    }

    fn socket(&mut self, socket: &WithOrigin<PathBuf>) -> Option<PathBuf> {
        const EXAMPLE: &str = "\"/run/sgc/arm-1.sock\"";
        let path = self.base_dir.join(&socket.value);
        let (bytes, max) = (path.as_os_str().len(), SOCKET_PATH_BYTES_MAX);
        if socket.value.as_os_str().is_empty() {
            self.record(&socket.origin, Mistake::Empty { key: socket.key, example: EXAMPLE });
        } else if bytes > max {
            self.record(&socket.origin, Mistake::TooLong { key: socket.key, bytes, max });
        }
        Some(path)
    }
}

/// The deepest history that can be configured.
const HISTORY_DEPTH_MAX: u64 = 4096;

/// Returns the kind of a table's interface from the key of its name, or from the last word of an argument's key.
fn interface_of(named: Option<&WithOrigin<String>>) -> Interface {
    let key = named.and_then(|named| named.key.split(' ').next_back()).unwrap_or_default();
    let others = [Interface::Service, Interface::Action, Interface::Parameters];
    others.into_iter().find(|interface| interface.key() == key).unwrap_or_default()
}

fn priority_class(key: &'static str, value: &str) -> Result<Class, Mistake> {
    match value {
        "realtime" => Ok(Class::Realtime),
        "default" => Ok(Class::Default),
        "bulk" => Ok(Class::Bulk),
        _ => Err(unknown_word(key, value, &PRIORITIES)),
    }
}

fn compression(key: &'static str, value: &str) -> Result<PayloadEncoding, Mistake> {
    match value {
        "zstd" => Ok(PayloadEncoding::Zstd),
        "lz4" => Ok(PayloadEncoding::Lz4),
        "none" => Ok(PayloadEncoding::Plain),
        _ => Err(unknown_word(key, value, &["zstd", "lz4", "none"])),
    }
}

fn encoding(key: &'static str, value: &str) -> Result<PayloadForm, Mistake> {
    match value {
        "cdr" => Ok(PayloadForm::Cdr),
        "json" => Ok(PayloadForm::Json),
        _ => Err(unknown_word(key, value, &["cdr", "json"])),
    }
}

fn reliability(key: &'static str, value: &str) -> Result<Reliability, Mistake> {
    match value {
        "reliable" => Ok(Reliability::Reliable),
        "best_effort" => Ok(Reliability::BestEffort),
        _ => Err(unknown_word(key, value, &["reliable", "best_effort"])),
    }
}

fn resume_of(key: &'static str, value: &str) -> Result<Resume, Mistake> {
    match value {
        "auto" => Ok(Resume::Auto),
        "manual" => Ok(Resume::Manual),
        _ => Err(unknown_word(key, value, &["auto", "manual"])),
    }
}

fn durability(key: &'static str, value: &str) -> Result<Durability, Mistake> {
    match value {
        "volatile" => Ok(Durability::Volatile),
        "transient_local" => Ok(Durability::TransientLocal),
        _ => Err(unknown_word(key, value, &["volatile", "transient_local"])),
    }
}

fn keeps_all(key: &'static str, value: &str) -> Result<bool, Mistake> {
    match value {
        "keep_last" => Ok(false),
        "keep_all" => Ok(true),
        _ => Err(unknown_word(key, value, &["keep_last", "keep_all"])),
    }
}

fn is_dedicated(key: &'static str, value: &str) -> Result<bool, Mistake> {
    match value {
        "shared" => Ok(false),
        "dedicated" => Ok(true),
        _ => Err(unknown_word(key, value, &["shared", "dedicated"])),
    }
}

fn mapping(key: &'static str, value: &str) -> Result<MappingKind, Mistake> {
    match value {
        "flood" => Ok(MappingKind::Flood),
        "query" => Ok(MappingKind::Query),
        "store" => Ok(MappingKind::Store),
        _ => Err(unknown_word(key, value, &["flood", "query", "store"])),
    }
}

fn congestion(key: &'static str, value: &str) -> Result<Congestion, Mistake> {
    value.parse().map_err(|_| unknown_word(key, value, &["delay", "cubic", "bbr", "newreno"]))
}

fn suite(key: &'static str, value: &str) -> Result<Suite, Mistake> {
    value.parse().map_err(|_| unknown_word(key, value, &SUITES))
}

fn unknown_word(key: &'static str, value: &str, known: &'static [&'static str]) -> Mistake {
    Mistake::UnknownWord { key, value: value.to_owned(), nearest: nearest(value, known), known }
}
