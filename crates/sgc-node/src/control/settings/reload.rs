//! Reload: applies another configuration to a running node. The whole configuration is read and judged before anything
//! changes.
//!
//! This module computes the differences; the route machine carries them out.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_config::{Config, ConfigErrors, GatewayConfig, MetricsConfig, RosConfig, RotationConfig};
use sgc_gateway::Access;
use sgc_ros::{Direction, ShareRule, UseRule};
use sgc_transport::CredentialStore;
use sgc_trust::{Identity, Suite, TrustAnchors};
use sgc_wire::{Kind, UnixMillis};
use tokio::sync::{Mutex, Notify, mpsc, oneshot};
use tracing::{info, warn};

use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::settings::rules::Rules;
use crate::data::sending::message_keys::{MessageKeys, make_for};
use crate::discovery::{Searches, WantedRouters};
use crate::gateway::access::access_with;
use crate::gateway::certificate::ShownKey;
use crate::gateway::{Gateway, GatewayStartError, listen_at};
use crate::link::roaming::Network;
use crate::local::network_slot::JoinNetwork;
use crate::metrics::Metrics;
use crate::node::build::{audit_place, listen_for_clients};
use crate::node::error::NodeError;
use crate::node::identity::{FileIdentity, wanted_nearby};
use crate::state::audit::{Audit, AuditEvent, AuditRecord, PeerNames};
use crate::state::credentials::with_kept_crls;

/// Reads the configuration from the same source as at start.
pub type ConfigSource = Arc<dyn Fn() -> Result<Config, ConfigErrors> + Send + Sync>;

/// Longest wait before expired tokens are searched again, so that setting the wall clock keeps no token in force.
const EXPIRY_CHECK_MAX: Duration = Duration::from_secs(60);

/// Interval between looks at the gateway's own certificate, whether it ends soon.
const CERTIFICATE_CHECK: Duration = Duration::from_secs(600);

/// Result of a reload.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ReloadReport {
    /// Changes, one line each.
    pub changed: Vec<String>,
    /// Changes that take effect only after a restart.
    pub needs_restart: Vec<String>,
    /// Warnings about the new configuration.
    pub warnings: Vec<String>,
}

/// The running configuration, with everything that a reload needs.
pub(crate) struct Reloader {
    pub(crate) source: Option<ConfigSource>,
    pub(crate) identity: Arc<Identity>,
    pub(crate) credentials: CredentialStore,
    pub(crate) state: Option<PathBuf>,
    pub(crate) audit: Audit,
    pub(crate) names: PeerNames,
    pub(crate) events: mpsc::Sender<CoreEvent>,
    /// Joins the local network if the node began without one; blocks. `None` if the node cannot join one.
    pub(crate) join: Option<JoinNetwork>,
    /// Whether there is a local network.
    pub(crate) has_ros: AtomicBool,
    pub(crate) searches: Searches,
    pub(crate) gateway: Arc<Gateway>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) running: Mutex<Running>,
    /// Notified when the time of the next expiry changes.
    pub(crate) changed: Notify,
}

/// The current configuration and its consequences.
pub(crate) struct Running {
    /// Restart-only settings as they were at start, the others as they are now.
    pub(crate) config: Config,
    pub(crate) rules: Rules,
    /// Suites with a signing key.
    pub(crate) suites: BTreeSet<Suite>,
}

/// Everything that has to exist before a configuration is applied.
struct PreparedReload {
    rules: Rules,
    identity: FileIdentity,
    /// New trust anchors; `None` if they are unchanged.
    anchors: Option<TrustAnchors>,
    message_keys: MessageKeys,
    /// The gateway's access rules, and its certificate for programs if an address has TLS; `None` without a gateway.
    gateway: Option<(Access, Option<ShownKey>)>,
}

/// Whether a reload looks at the identity file and at the gateway's certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ReadIdentity {
    /// A user, or a change of a file, asks for the reload.
    Yes,
    /// A token has ended. That must not depend on the file.
    No,
}

impl Reloader {
    /// Returns the running configuration.
    pub(crate) async fn config(&self) -> Config {
        self.running.lock().await.config.clone()
    }

    /// Reads and applies the configuration. After an error nothing has changed.
    pub(crate) async fn reload(&self, by: &str) -> Result<ReloadReport, String> {
        let result = self.try_reload().await;
        let record = AuditRecord::new(AuditEvent::Reload).by(by);
        // A stopping node shows no alerts, so a failure to send is ignored.
        let outcome = result.as_ref().map(|report| report.needs_restart.clone()).map_err(Clone::clone);
        let read = CoreEvent::ConfigurationRead { outcome };
        let _ = self.events.send(read).await;
        match &result {
            Ok(report) => {
                let changes = [&report.changed[..], &report.needs_restart[..]].concat();
                self.audit.write(record.reason(match changes.is_empty() {
                    true => "nothing changed".to_owned(),
                    false => changes.join("; "),
                }));
                report.changed.iter().for_each(|line| info!("reload: {line}"));
                report.needs_restart.iter().for_each(|line| warn!("reload: {line}"));
                report.warnings.iter().for_each(|line| warn!("reload: {line}"));
            }
            Err(error) => {
                warn!("reload refused, everything is as it was: {error}");
                self.audit.write(record.reason(format!("refused: {error}")));
            }
        }
        result
    }

    async fn try_reload(&self) -> Result<ReloadReport, String> {
        let source = self.source.clone().ok_or("this node cannot read its configuration again")?;
        // Reloads run one at a time, so that the configuration that was read last is applied last.
        let mut running = self.running.lock().await;
        let read = tokio::task::spawn_blocking(move || source());
        let config =
            read.await.map_err(|_| "reading ended in a panic")?.map_err(|errors| errors.to_string())?;
        let certified = self.identity.node_name();
        if let Some(own) = config.uses.iter().find(|one| one.from == *certified) {
            return Err(format!("[[use]] from {:?}: that is this node itself", own.from.as_str()));
        }
        let has_rules = !(config.shares.is_empty() && config.uses.is_empty() && config.tokens.is_empty());
        let wants_ros = has_rules || config.gateway.is_some();
        if wants_ros && !self.has_ros.load(Ordering::Relaxed) && self.join.is_none() {
            let why = "this node joined no ROS network when it started, so it can neither share nor use";
            return Err(format!("{why}: restart it"));
        }
        self.apply(&mut running, config, ReadIdentity::Yes).await
    }

    /// Joins the local network if the node began without one.
    async fn join(&self, running: &mut Running, wanted: Option<&RosConfig>) -> Result<(), String> {
        let join = self.join.clone().filter(|_| !self.has_ros.load(Ordering::Relaxed));
        let Some((join, ros)) = join.zip(wanted.cloned()) else { return Ok(()) };
        let (wanted, identity) = (ros.clone(), self.credentials.identity());
        let joined = tokio::task::spawn_blocking(move || join(&wanted, &identity));
        joined.await.map_err(|_| "joining the local network ended in a panic")??;
        self.has_ros.store(true, Ordering::Relaxed);
        info!("joined the local ROS 2 network of domain {}", ros.domain_id);
        // Definitions are read only at start.
        running.config.ros = Some(RosConfig { definitions: Vec::new(), ..ros });
        Ok(())
    }

    /// Applies `config`.
    async fn apply(
        &self,
        running: &mut Running,
        config: Config,
        reads: ReadIdentity,
    ) -> Result<ReloadReport, String> {
        let prepared = self.prepare(running, &config, reads).await?;
        let PreparedReload { mut rules, identity, anchors, message_keys, gateway } = prepared;
        if fleet_of(&running.config) != fleet_of(&config) {
            // They are for the fleet that this node keeps after a restart.
            rules.operators.clone_from(&running.rules.operators);
        }
        let nearby = wanted_nearby(&config.routers, &self.identity).map_err(|error| error.to_string())?;
        self.join(running, config.ros.as_ref()).await?;
        running.suites.extend(message_keys.keys().copied());
        let mut report = ReloadReport {
            changed: changes(&running.rules, &rules),
            needs_restart: needs_restart(running, &config),
            warnings: rules.warnings.clone(),
        };
        let identity = match identity {
            FileIdentity::Same => None,
            FileIdentity::Replaced(identity) => {
                let until = identity.not_after();
                report
                    .changed
                    .push(format!("this node has the identity of its replaced file, until {until}"));
                Some(identity)
            }
            FileIdentity::OfAnother(why) => {
                report
                    .needs_restart
                    .push(format!("the identity is as it was: the file {why}, which needs a restart"));
                None
            }
            FileIdentity::Unusable(why) => {
                report.warnings.push(format!("the identity is as it was: {why}"));
                None
            }
        };
        // Links have the setting of the start.
        let present = identity.clone().unwrap_or_else(|| self.credentials.identity());
        if present.post_quantum() != self.identity.post_quantum() {
            let changed = "the fleet's setting of post-quantum links changed, which needs a restart";
            report.needs_restart.push(changed.to_owned());
        }
        // This precedes the control task's check of existing links.
        self.credentials.set_admitted(rules.partners.admitted.clone());
        self.reconfigure(&rules, identity, anchors, message_keys, (config.peer_rate, config.rotation))
            .await?;
        // The control task has the newest revocation lists.
        if let Some((access, key)) = gateway.filter(|_| running.config.gateway.is_some()) {
            match self.reconfigure_gateway(running, &config, access, key.as_ref()) {
                Ok(changed) => report.changed.extend(changed),
                Err(error) => {
                    report.needs_restart.push(format!("who may connect to the gateway is as it was: {error}"))
                }
            }
        }
        let mut config = config;
        match self.move_gateway(running, &config, &rules).await {
            Ok(changed) => {
                report.changed.extend(changed);
                report
                    .warnings
                    .extend(self.gateway.alerts().iter().map(|alert| format!("{alert}: {}", alert.fix())));
                if let Some(after) =
                    config.gateway.as_ref().filter(|_| running.config.gateway != config.gateway)
                {
                    report.warnings.extend(after.warnings());
                }
            }
            Err(error) => {
                report.needs_restart.push(format!("the gateway is as it was: {error}"));
                // The next reload tries again.
                config.gateway.clone_from(&running.config.gateway);
            }
        }
        // A router may be trusted only by the rules that hold from here on.
        let (configured, of_tokens) = (config.routers.clone(), rules.routers.clone());
        let searched = self.searches.search(WantedRouters { configured, of_tokens, nearby });
        report.changed.extend(searched.begun.iter().map(|url| format!("{url} is searched for")));
        report.changed.extend(searched.ended.iter().map(|url| format!("{url} is no longer searched for")));
        if running.config.metrics != config.metrics {
            self.metrics.set(config.metrics.as_ref());
            report.warnings.extend(config.metrics.iter().flat_map(MetricsConfig::warnings));
            report.changed.extend(metrics_changes(running.config.metrics.as_ref(), config.metrics.as_ref()));
        }
        match self.move_audit(running, &config).await {
            Ok(changed) => report.changed.extend(changed),
            Err(error) => {
                report.needs_restart.push(format!("the audit log is as it was: {error}"));
                // The next reload tries again.
                config.audit.clone_from(&running.config.audit);
            }
        }
        if running.config.peer_rate != config.peer_rate {
            report.changed.push(match config.peer_rate {
                Some(rate) => format!("each peer may send {} Mbit/s", rate as f64 / 1e6),
                None => "peers may send as much as they like".to_owned(),
            });
        }
        if running.config.rotation != config.rotation {
            let RotationConfig { every, messages } = config.rotation;
            report
                .changed
                .push(format!("topics get a new key after {} s or {messages} messages", every.as_secs()));
        }
        self.names.set(rules.names.clone());
        running.config = merged(running.config.clone(), config);
        running.rules = rules;
        report.changed.dedup();
        self.changed.notify_one();
        Ok(report)
    }

    /// Loads everything that `config` names. Nothing changes.
    async fn prepare(
        &self,
        running: &Running,
        config: &Config,
        reads: ReadIdentity,
    ) -> Result<PreparedReload, String> {
        // The identity may have been renewed since the start.
        let (identity, state) = (self.credentials.identity(), self.state.clone());
        let (wanted, suites) = (config.clone(), running.suites.clone());
        let file = running.config.identity.clone();
        let trusted = running.rules.partners.certificates.clone();
        let of_gateway = self.gateway.clone();
        let prepare = tokio::task::spawn_blocking(move || -> Result<PreparedReload, NodeError> {
            let found = match reads {
                ReadIdentity::Yes => FileIdentity::read(&file, &identity),
                ReadIdentity::No => FileIdentity::Same,
            };
            let before = identity;
            let identity = match &found {
                FileIdentity::Replaced(identity) => identity.clone(),
                FileIdentity::Same | FileIdentity::OfAnother(_) | FileIdentity::Unusable(_) => before.clone(),
            };
            let rules = Rules::load(&wanted, &identity, state.as_deref(), now().unix)?;
            let own = identity.anchors();
            let has_other_cas = !own.certificates().eq(before.anchors().certificates());
            let certificates = &rules.partners.certificates;
            let anchors = match same(&trusted, certificates) && !has_other_cas {
                true => None,
                // The state directory may hold lists of a CA that was trusted before.
                false => Some(with_kept_crls(
                    state.as_deref(),
                    own.with_anchors(certificates.iter().cloned())?,
                    now(),
                )),
            };
            let message_keys = make_for(&rules.shares, |suite| suites.contains(&suite));
            let access = access_with(&wanted, &identity, &rules.partners, state.as_deref(), now())?;
            let gateway = match access.zip(wanted.gateway.as_ref()) {
                Some((access, gateway)) => {
                    let key = match reads {
                        ReadIdentity::Yes => of_gateway
                            .shown_key(gateway, state.as_deref(), now().unix)
                            .map_err(GatewayStartError::from)?,
                        // The present certificates stay.
                        ReadIdentity::No => None,
                    };
                    Some((access, key))
                }
                None => None,
            };
            Ok(PreparedReload { rules, identity: found, anchors, message_keys, gateway })
        });
        let prepared = prepare.await.map_err(|_| "reading ended in a panic")?;
        prepared.map_err(|error| error.to_string())
    }

    /// Passes new rules to the control task, and waits until the change is under way.
    async fn reconfigure(
        &self,
        rules: &Rules,
        identity: Option<Arc<Identity>>,
        anchors: Option<TrustAnchors>,
        message_keys: MessageKeys,
        (peer_rate, rotation): (Option<u64>, RotationConfig),
    ) -> Result<(), String> {
        let (reply, done) = oneshot::channel();
        let (shares, uses) = (rules.shares.clone(), rules.uses.clone());
        let member_names = rules.members.clone();
        let (observers, operators) = (rules.observers.clone(), rules.operators.clone());
        let rights = rules.rights.clone();
        let event = CoreEvent::Reload {
            identity,
            shares,
            uses,
            anchors,
            message_keys,
            member_names,
            observers,
            direct: rules.direct.clone(),
            port_mapping: rules.port_mapping,
            operators,
            rights,
            peer_rate,
            rotation,
            reply,
        };
        let stopping = || "the node is stopping".to_owned();
        self.events.send(event).await.map_err(|_| stopping())?;
        done.await.map_err(|_| stopping())
    }

    /// Opens and closes sockets of the gateway. Returns the changes.
    async fn move_gateway(
        &self,
        running: &Running,
        config: &Config,
        rules: &Rules,
    ) -> Result<Vec<String>, String> {
        match (&running.config.gateway, &config.gateway) {
            (None, Some(after)) => {
                let (identity, state) = (self.credentials.identity(), self.state.as_deref());
                listen_for_clients(&self.gateway, config, &identity, rules, state, &self.audit)
                    .await
                    .map_err(|error| error.to_string())?;
                // They may have been renewed meanwhile.
                self.gateway.set_anchors(&self.credentials.anchors());
                self.gateway.set_identity(&self.credentials.identity());
                Ok(vec![format!("programs without ROS are to connect at {}", addresses(after))])
            }
            (Some(before), Some(after)) if before.listen != after.listen => {
                self.gateway.listen_elsewhere(listen_at(after)).await.map_err(|error| error.to_string())?;
                Ok(vec![format!("programs without ROS are to connect at {}", addresses(after))])
            }
            (Some(_), None) => {
                self.gateway.close_sockets().await;
                Ok(vec!["programs without ROS may not connect any more".to_owned()])
            }
            (Some(_), Some(_)) | (None, None) => Ok(Vec::new()),
        }
    }

    /// Moves the audit log, or switches it on or off. Returns the changes.
    async fn move_audit(&self, running: &Running, config: &Config) -> io::Result<Vec<String>> {
        if running.config.audit == config.audit {
            return Ok(Vec::new());
        }
        let place = audit_place(config, self.state.as_deref());
        let changed = match &place {
            Some((path, room)) => format!(
                "the audit log is {}, at most {} files of {} bytes",
                path.display(),
                room.files + 1,
                room.max_bytes
            ),
            None => "there is no audit log any more".to_owned(),
        };
        let audit = self.audit.clone();
        tokio::task::spawn_blocking(move || audit.move_to(place)).await.map_err(io::Error::other)??;
        Ok(vec![changed])
    }

    /// Applies new access rules and another certificate to the gateway. Returns the changes.
    fn reconfigure_gateway(
        &self,
        running: &Running,
        config: &Config,
        access: Access,
        key: Option<&ShownKey>,
    ) -> Result<Vec<String>, String> {
        let mut changed = Vec::new();
        let access = access.with_anchors(TrustAnchors::clone(&self.credentials.anchors()));
        let identity = || self.credentials.identity();
        if self.gateway.reconfigure(access, key, identity).map_err(|error| error.to_string())? {
            changed.push("who connects to the gateway is shown another certificate".to_owned());
        }
        if let Some((before, after)) = running.config.gateway.as_ref().zip(config.gateway.as_ref())
            && before.clients_max != after.clients_max
        {
            let clients = self.gateway.set_clients_max(after.clients_max);
            changed.push(format!("the gateway takes {clients} clients at once"));
        }
        if running.config.gateway.as_ref().map(access_part) != config.gateway.as_ref().map(access_part) {
            changed.push("who may connect to the gateway changed".to_owned());
        }
        Ok(changed)
    }

    /// Renews the gateway's own certificate before it ends, and when the addresses of this host change. Never returns.
    pub(crate) async fn watch_gateway_certificate(&self, mut network: Network) {
        let mut failure = None;
        loop {
            tokio::select! {
                () = tokio::time::sleep(CERTIFICATE_CHECK) => {}
                () = network.changed() => {}
            }
            let failed = self.renew_gateway_certificate().await.err();
            if let Some(error) = failed.as_ref().filter(|_| failed != failure) {
                warn!("{error}; the gateway goes on with the certificate that it has");
            }
            failure = failed;
        }
    }

    async fn renew_gateway_certificate(&self) -> Result<(), String> {
        // A reload must not run meanwhile, since it shows a certificate, too.
        let running = self.running.lock().await;
        let own = running.config.gateway.clone().filter(|gateway| gateway.tls.is_none());
        let Some(config) = own else { return Ok(()) };
        let (gateway, state) = (self.gateway.clone(), self.state.clone());
        let make = move || match gateway.shown_key(&config, state.as_deref(), now().unix) {
            Ok(Some(key)) => gateway.show(&key).map_err(|error| error.to_string()),
            Ok(None) => Ok(()),
            Err(error) => Err(error.to_string()),
        };
        tokio::task::spawn_blocking(make)
            .await
            .map_err(|_| "making a certificate ended in a panic".to_owned())?
    }

    /// Removes expired tokens from the policies. Never returns.
    pub(crate) async fn watch_expiry(&self) {
        loop {
            let next = self.running.lock().await.rules.partners.next_expiry;
            let wait = next.map(|UnixMillis(at)| Duration::from_millis(at.saturating_sub(now().unix.0)));
            let timer = async {
                match wait {
                    Some(wait) => tokio::time::sleep(wait.min(EXPIRY_CHECK_MAX)).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = timer => {}
                () = self.changed.notified() => continue,
            }
            if next.is_none_or(|at| at > now().unix) {
                continue;
            }
            let mut running = self.running.lock().await;
            let config = running.config.clone();
            match self.apply(&mut running, config, ReadIdentity::No).await {
                Ok(report) => {
                    let record = AuditRecord::new(AuditEvent::Reload).by("a token ended");
                    self.audit.write(record.reason(report.changed.join("; ")));
                }
                Err(error) => {
                    warn!("a token expired, but its holder keeps access: {error}");
                    drop(running);
                    tokio::time::sleep(EXPIRY_CHECK_MAX).await;
                }
            }
        }
    }
}

/// Returns the configuration that runs after a reload. Restart-only settings keep their running values, so that the
/// next reload reports them again.
fn merged(before: Config, read: Config) -> Config {
    let authority = match fleet_of(&before) == fleet_of(&read) {
        true => read.authority,
        false => before.authority,
    };
    let gateway = match (&before.gateway, read.gateway) {
        (Some(before), Some(after)) => Some(with_buffers_of(before, &after)),
        (_, after) => after,
    };
    Config {
        routers: read.routers,
        shares: read.shares,
        uses: read.uses,
        tokens: read.tokens,
        partners: read.partners,
        trust: read.trust,
        accept: read.accept,
        metrics: read.metrics,
        observers: read.observers,
        direct: read.direct,
        port_mapping: read.port_mapping,
        peer_rate: read.peer_rate,
        audit: read.audit,
        rotation: read.rotation,
        authority,
        gateway,
        ..before
    }
}

/// Returns the part of a gateway's configuration that decides who may connect.
fn access_part(gateway: &GatewayConfig) -> GatewayConfig {
    let GatewayConfig { clients_max, client_bytes_max, listen, names, .. } = GatewayConfig::default();
    GatewayConfig { clients_max, client_bytes_max, listen, names, ..gateway.clone() }
}

/// Returns the gateway's configuration after a reload, with the bound of buffers that sessions have.
fn with_buffers_of(before: &GatewayConfig, after: &GatewayConfig) -> GatewayConfig {
    GatewayConfig { client_bytes_max: before.client_bytes_max, ..after.clone() }
}

fn needs_other_buffers(before: Option<&GatewayConfig>, after: Option<&GatewayConfig>) -> bool {
    before.zip(after).is_some_and(|(before, after)| with_buffers_of(before, after) != *after)
}

/// Returns the listening addresses of a gateway.
fn addresses(gateway: &GatewayConfig) -> String {
    gateway.listen.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// Lists the differences of metrics.
fn metrics_changes(before: Option<&MetricsConfig>, after: Option<&MetricsConfig>) -> Vec<String> {
    let listen = |metrics: Option<&MetricsConfig>| metrics.map(|metrics| metrics.listen);
    let otlp = |metrics: Option<&MetricsConfig>| metrics.and_then(|metrics| metrics.otlp.clone());
    let mut lines = Vec::new();
    if listen(before) != listen(after) {
        lines.push(match listen(after) {
            Some(listen) => format!("metrics are to be served at http://{listen}/metrics"),
            None => "metrics are not served any more".to_owned(),
        });
    }
    if otlp(before) != otlp(after) {
        lines.push(match otlp(after) {
            Some(otlp) => {
                format!("metrics are to be pushed to {} every {} s", otlp.url, otlp.interval.as_secs())
            }
            None => "metrics are not pushed any more".to_owned(),
        });
    }
    lines
}

/// Lists the differences, one line for each topic.
fn changes(old: &Rules, new: &Rules) -> Vec<String> {
    let mut lines = Vec::new();
    let shares = |rules: &Rules| -> BTreeMap<String, ShareRule> {
        rules.shares.iter().map(|s| (called(s.metadata.kind, &s.metadata.ros_name), s.clone())).collect()
    };
    let (before, after) = (shares(old), shares(new));
    for topic in before.keys().filter(|topic| !after.contains_key(*topic)) {
        lines.push(format!("{topic} is no longer shared"));
    }
    for (topic, rule) in &after {
        match before.get(topic) {
            None => lines.push(format!("{topic} is shared")),
            Some(known) if known == rule => {}
            Some(known) => lines.push(share_change(topic, known, rule)),
        }
    }
    let place = |rule: &UseRule| {
        let publishes = rule.direction == Direction::Publish;
        let token = rule.token.clone().map(|t| t.0);
        (rule.owner_name.clone(), called(rule.kind, &rule.topic), token, publishes)
    };
    let uses = |rules: &Rules| -> BTreeMap<_, _> {
        rules.uses.iter().map(|rule| (place(rule), rule.clone())).collect()
    };
    let (before, after) = (uses(old), uses(new));
    let by = |rule: &UseRule| if rule.token.is_some() { " (by token)" } else { "" };
    for (key, rule) in before.iter().filter(|(key, _)| !after.contains_key(*key)) {
        lines.push(format!("{} of {} is no longer used{}", key.1, key.0, by(rule)));
    }
    for (key, rule) in &after {
        match before.get(key) {
            None => lines.push(format!("{} of {} is used{}", key.1, key.0, by(rule))),
            Some(known) if known == rule => {}
            Some(_) => lines.push(format!("{} of {} is used otherwise", key.1, key.0)),
        }
    }
    let trusted = |rules: &Rules| rules.partners.certificates.clone();
    let (before, after) = (trusted(old), trusted(new));
    if after.iter().any(|ca| !before.contains(ca)) {
        lines.push("nodes of another CA may link to this one".to_owned());
    }
    if before.iter().any(|ca| !after.contains(ca)) {
        lines.push("nodes of a CA may no longer link to this one".to_owned());
    }
    if old.partners.admitted != new.partners.admitted {
        lines.push("whose nodes may attach changed".to_owned());
    }
    if old.observers != new.observers {
        lines.push("who may ask this node how it is doing changed".to_owned());
    }
    if old.direct != new.direct {
        lines.push("with whom direct links are made changed".to_owned());
    }
    if old.port_mapping != new.port_mapping {
        let is_asked = if new.port_mapping { "is asked" } else { "is no longer asked" };
        lines.push(format!("the gateway {is_asked} to map a port"));
    }
    if old.operators != new.operators {
        lines.push("who may change the fleet here changed".to_owned());
    }
    lines
}

/// Formats a name with its kind, unless it is a topic.
fn called(kind: Kind, name: &str) -> String {
    if kind == Kind::Service { format!("service {name}") } else { name.to_owned() }
}

/// Returns `true` if both lists hold the same CAs in any order.
fn same(a: &[CertificateDer<'_>], b: &[CertificateDer<'_>]) -> bool {
    a.len() == b.len() && a.iter().all(|ca| b.contains(ca))
}

fn share_change(topic: &str, known: &ShareRule, rule: &ShareRule) -> String {
    let mut what = Vec::new();
    if known.policy.subscribe != rule.policy.subscribe {
        what.push("who may subscribe");
    }
    if known.policy.publish != rule.policy.publish {
        what.push("who may publish");
    }
    let changes_share = (known.suite, known.class, &known.metadata, &known.naming.rename)
        != (rule.suite, rule.class, &rule.metadata, &rule.naming.rename);
    let end = if changes_share { "; it begins anew" } else { "" };
    for (is_changed, word) in [
        (known.suite != rule.suite, "its suite"),
        (known.shaping != rule.shaping, "how much of it goes out"),
        (known.class != rule.class, "its priority"),
        (known.metadata != rule.metadata, "its type or metadata"),
        (known.naming.rename != rule.naming.rename, "its name for others"),
        (known.naming.except != rule.naming.except, "what it leaves out"),
    ] {
        if is_changed {
            what.push(word);
        }
    }
    format!("{topic}: {} changed{end}", what.join(", "))
}

/// Returns the fleet file of which the node is the authority.
fn fleet_of(config: &Config) -> Option<&Path> {
    config.authority.as_ref().map(|authority| &*authority.fleet)
}

fn needs_restart(running: &Running, config: &Config) -> Vec<String> {
    let now = &running.config;
    [
        (now.node_name != config.node_name, "`name`"),
        (now.identity != config.identity, "`identity`"),
        (now.resolver != config.resolver, "`resolver`"),
        (now.keep_alive != config.keep_alive, "`keep_alive`"),
        (now.listen != config.listen, "`listen` in [router]"),
        (now.mapping != config.mapping || now.store != config.store, "`mapping` in [router], or its store"),
        (now.announce != config.announce, "`announce` in [router]"),
        // Shares and uses join the default network if the file has no `[ros]`.
        (config.ros.is_some() && now.ros != config.ros, "[ros]"),
        (
            needs_other_buffers(now.gateway.as_ref(), config.gateway.as_ref()),
            "`client_bytes_max` in [gateway]",
        ),
        (now.state != config.state, "`state`"),
        (now.watch != config.watch, "`watch`"),
        (fleet_of(now) != fleet_of(config), "`fleet` in [authority]"),
        (now.transport != config.transport, "[transport]"),
        (now.admin_socket != config.admin_socket, "`socket` in [admin]"),
    ]
    .into_iter()
    .filter(|(is_changed, _)| *is_changed)
    .map(|(_, what)| format!("{what} changed, which needs a restart"))
    .collect()
}
