//! Alerts for the operator: mistakes outside of this program that look like its faults, or like attacks.
//!
//! Every affected node knows of a mistake. `Alerts` remembers those that no machine's state shows. `sgc status` and
//! `sgc why` display them; no decision depends on them.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use sgc_trust::Identity;
use sgc_wire::{NodeId, UnixMillis};

/// Most peers that are remembered because two processes use their identity. Beyond it, the one seen longest ago is
/// dropped.
const PEERS_MAX: usize = 1024;
/// Most characters that are shown of a configuration's mistakes.
const MISTAKES_CHARS_MAX: usize = 1000;
/// Time for which a foreign use of an identity is shown. A waiting process tries again sooner than that.
const SHOWN_FOR: Duration = Duration::from_secs(660);

/// A mistake of an operator.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Alert {
    /// Another process uses this node's identity and has its links.
    Displaced {
        /// This node's name.
        node: String,
        /// The place of the other process, as far as known.
        place: String,
        /// Seconds since it was seen.
        ago_s: u64,
    },
    /// Another process uses this node's identity, and is kept out.
    IdentityInUse {
        /// This node's name.
        node: String,
        /// The place of the other process.
        place: String,
        /// Seconds since it was seen.
        ago_s: u64,
    },
    /// Two processes use the identity of a peer.
    PeerIdentityInUse {
        /// The peer.
        peer: String,
        /// The place of the process that has the links.
        place: String,
        /// The place of the process that is kept out.
        other: String,
        /// Seconds since it was seen.
        ago_s: u64,
    },
    /// The clocks of this node and a peer differ so much that certificates are refused.
    ClocksDiffer {
        /// The peer.
        peer: String,
        /// Its address.
        remote: String,
        /// Milliseconds by which the peer's clock is ahead of this node's.
        ahead_ms: i64,
    },
    /// This node's clock is before the beginning of its certificate.
    ClockBeforeCertificate {
        /// Beginning of the certificate, RFC 3339.
        not_before: String,
        /// This node's time, RFC 3339.
        now: String,
    },
    /// This node's clock is past the end of its certificate.
    CertificateOver {
        /// End of the certificate, RFC 3339.
        not_after: String,
        /// This node's time, RFC 3339.
        now: String,
    },
    /// Programs use a Discovery Server of Fast DDS, which this node cannot join.
    DiscoveryServer {
        /// The server, as `ROS_DISCOVERY_SERVER` names it.
        server: String,
        /// The program with the variable; `None` for this one.
        program: Option<String>,
    },
    /// Packets to programs of the local ROS 2 network cannot be sent.
    LocalNetworkFails {
        /// The destination of the last one.
        to: String,
        /// Their number since the node's start.
        packets: u64,
        /// Seconds since the last one.
        ago_s: u64,
    },
    /// The local ROS 2 network was closed after this host's addresses changed, and cannot be opened again.
    LocalNetworkClosed {
        /// The reason.
        reason: String,
    },
    /// The router of the local Zenoh network is not connected, so programs and this node do not find each other.
    ZenohRouterMissing {
        /// The endpoint of the router.
        router: String,
    },
    /// DDS Security protects programs of the local ROS 2 network, and this node has no enclave.
    ProtectedPrograms {
        /// The enclave that they name, `/` if they have none of their own.
        enclave: String,
    },
    /// The changed configuration has mistakes, so the node keeps running with the previous one.
    ConfigurationRefused {
        /// The mistakes, as `sgc check` reports them.
        mistakes: String,
        /// Seconds since the node read it.
        ago_s: u64,
    },
    /// The configuration changed in parts that hold only after a restart.
    RestartPending {
        /// These parts, a sentence each.
        changes: Vec<String>,
    },
    /// The gateway cannot listen at an address.
    GatewayNotListening {
        /// The address, as a URL.
        at: String,
        /// The reason.
        reason: String,
    },
    /// The address for metrics cannot be bound.
    MetricsNotServed {
        /// The address.
        at: String,
        /// The reason.
        reason: String,
    },
    /// The collector did not take the last push of metrics.
    MetricsNotPushed {
        /// The URL of the collector.
        to: String,
        /// The reason.
        reason: String,
    },
    /// The state directory is missing, full or read-only, so nothing outlives a restart.
    StateNotKept {
        /// The reason.
        reason: String,
    },
    /// The store of names does not answer.
    StoreDown {
        /// Seconds since the router noticed it.
        ago_s: u64,
    },
    /// The store of names refuses what this router wants to read or write: rights or memory are missing.
    StoreRefuses {
        /// Seconds since the last refusal.
        ago_s: u64,
    },
    /// The audit log cannot be written.
    AuditNotWritten {
        /// The file.
        path: String,
        /// The reason.
        reason: String,
    },
    /// DDS Security protects both this node and local programs, and one does not admit the other.
    RefusedPrograms {
        /// The enclave that they name, `/` if they have none of their own.
        enclave: String,
    },
    /// DDS Security protects this node, but not all local programs.
    UnprotectedPrograms {
        /// Their number.
        programs: usize,
    },
    /// This host has no IPv4 address besides loopback, so programs of other hosts are not found.
    LocalNetworkAlone,
    /// A node whose topics this node uses is on the same local ROS 2 network, or a node of another fleet with its name.
    SameLocalNetwork {
        /// The other node's name.
        node: String,
    },
    /// Local programs announce themselves, but nothing else arrives from them.
    SilentPrograms {
        /// The enclave that they name, `/` if they have none of their own.
        enclave: String,
    },
    /// An alert that this version does not know.
    #[serde(other)]
    Other,
}

impl Alert {
    /// Returns `true` if nothing flows over this node because of the alert.
    pub fn stops_all(&self) -> bool {
        matches!(
            self,
            Self::Displaced { .. }
                | Self::ClockBeforeCertificate { .. }
                | Self::CertificateOver { .. }
                | Self::LocalNetworkClosed { .. }
        )
    }

    /// Returns the fix.
    pub fn fix(&self) -> &'static str {
        match self {
            Self::Displaced { .. } | Self::IdentityInUse { .. } | Self::PeerIdentityInUse { .. } => {
                "stop one of the two, or enroll its machine under a name of its own; if nobody knows the other place, the \
                 identity was stolen: `sgc fleet revoke` it and enroll the node again"
            }
            Self::ClocksDiffer { .. } => {
                "compare `date -u` on both machines and set the clock that is wrong, for instance by NTP (`timedatectl`)"
            }
            Self::ClockBeforeCertificate { .. } => {
                "set the clock, for instance by NTP (`timedatectl`); the node goes on by itself as soon as it is right"
            }
            Self::CertificateOver { .. } => {
                "if `date -u` is wrong, set the clock, for instance by NTP (`timedatectl`); else renew the certificate with `sgc fleet renew` \
                 where the fleet file is, and bring the identity file here. The node goes on by itself after either"
            }
            Self::DiscoveryServer { .. } => {
                "start programs whose topics cross without ROS_DISCOVERY_SERVER, with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST \
                 and ROS_STATIC_PEERS where multicast is to be avoided (docs/reference/compatibility.md)"
            }
            Self::LocalNetworkFails { .. } => {
                "compare `ip addr` and `ip route` with that address; if this host's own address changed, the node opens its network again \
                 within some 15 s of the change. If this stays, restart the node"
            }
            Self::LocalNetworkClosed { .. } => {
                "see whether an interface or address that CYCLONEDDS_URI or ROS_STATIC_PEERS names is gone; the node tries again by itself, \
                 up to a minute apart"
            }
            Self::ZenohRouterMissing { .. } => {
                "start the router (`ros2 run rmw_zenoh_cpp rmw_zenohd`), or name the one that the programs use with `router` in [ros.zenoh]. \
                 The node connects by itself as soon as it is there"
            }
            Self::ProtectedPrograms { .. } => {
                "set `security_root` in [ros] to their keystore and `enclave` to one of its enclaves (docs/how-to/sros2.md)"
            }
            Self::ConfigurationRefused { .. } => {
                "mend the file; `sgc check -c FILE` says everything that is wrong with it. Then `sgc reload`, if the node does not \
                 watch it"
            }
            Self::RestartPending { .. } => {
                "restart the node when it suits you; until then it keeps the old values"
            }
            Self::GatewayNotListening { .. } => {
                "find the process that holds the port (`ss -ltnp`), or give this node another address: `listen` in [gateway]. The node \
                 tries again by itself"
            }
            Self::MetricsNotServed { .. } => {
                "find the process that holds the port (`ss -ltnp`), or give this node another address: `listen` in [metrics]. Each node of \
                 a host needs a port of its own. The node tries again by itself"
            }
            Self::MetricsNotPushed { .. } => {
                "look whether a collector takes OTLP over HTTP there, and what its log says; `otlp` in [metrics] names it, \
                 `otlp_headers_file` its token. The node pushes again by itself"
            }
            Self::StateNotKept { .. } => {
                "free space on its disk or mount it to be written, or set `state` in [node] to a directory that can be written; restart the \
                 node if there was no directory"
            }
            Self::StoreDown { .. } => {
                "`sgc router store check` tells what is wrong with it. Names that are in use go on, and other names are asked of all \
                 routers until it answers"
            }
            Self::StoreRefuses { .. } => {
                "`sgc router store check` tells which right is missing, or whether its memory is full. The router writes again by itself, \
                 and its names are found by asking routers until then"
            }
            Self::AuditNotWritten { .. } => {
                "free space on its disk or mount it to be written, or name another file with `file` in [audit]. The node tries again by \
                 itself"
            }
            Self::RefusedPrograms { .. } => {
                "the log says who refuses whom where Cyclone DDS does; compare CA, governance and permissions of the two enclaves, and when \
                 both certificates end"
            }
            Self::UnprotectedPrograms { .. } => {
                "start them with ROS_SECURITY_ENABLE=true and an enclave of this node's keystore, or share their topics with a second node \
                 of sgc without `enclave`"
            }
            Self::LocalNetworkAlone => {
                "give an interface an IPv4 address, since ROS 2 uses IPv4 unless told otherwise; the node opens its network again then. \
                 Links to routers may be IPv6"
            }
            Self::SameLocalNetwork { .. } => {
                "give the two nodes and their programs different domains: `domain_id` in [ros], ROS_DOMAIN_ID for programs. Programs on \
                 one network need no `[[use]]`"
            }
            Self::SilentPrograms { .. } => "look for a firewall that stops UDP between them and sgc",
            Self::Other => "use an `sgc` of the node's version",
        }
    }
}

impl fmt::Display for Alert {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Displaced { node, place, ago_s } => write!(
                f,
                "the identity {node} is in use at another place: {place}, which has the links of this node ({ago_s} s ago)"
            ),
            Self::IdentityInUse { node, place, ago_s } => write!(
                f,
                "the identity {node} is in use at another place: {place}, which is kept out while this node has its links \
                 ({ago_s} s ago)"
            ),
            Self::PeerIdentityInUse { peer, place, other, ago_s } => write!(
                f,
                "the identity {peer} is in use at two places: {place} has its links, {other} is kept out ({ago_s} s ago)"
            ),
            Self::ClocksDiffer { peer, remote, ahead_ms } => {
                let (by, way) = (duration(*ahead_ms), if *ahead_ms > 0 { "ahead of" } else { "behind" });
                write!(
                    f,
                    "the clock of {peer} at {remote} is {by} {way} the one here: neither believes what the other signs"
                )
            }
            Self::ClockBeforeCertificate { not_before, now } => write!(
                f,
                "the clock here says {now}, and this node's certificate begins at {not_before}: the clock is wrong"
            ),
            Self::CertificateOver { not_after, now } => write!(
                f,
                "the clock here says {now}, and this node's certificate ended at {not_after}: nobody links to this node"
            ),
            Self::DiscoveryServer { server, program: None } => write!(
                f,
                "ROS_DISCOVERY_SERVER={server} is set: sgc cannot join a Discovery Server, and finds no program that uses one"
            ),
            Self::DiscoveryServer { server, program: Some(program) } => write!(
                f,
                "{program} runs with ROS_DISCOVERY_SERVER={server}: sgc finds no program that uses a Discovery Server"
            ),
            Self::LocalNetworkFails { to, packets, ago_s } => write!(
                f,
                "packets to the local ROS 2 network cannot be sent, the last to {to} {ago_s} s ago ({packets} so far)"
            ),
            Self::LocalNetworkClosed { reason } => {
                write!(f, "the local ROS 2 network is closed and cannot be opened again: {reason}")
            }
            Self::ZenohRouterMissing { router } => write!(
                f,
                "the Zenoh router {router} of the local ROS 2 network is not connected: programs of rmw_zenoh and this node find each \
                 other through it"
            ),
            Self::ProtectedPrograms { enclave } => write!(
                f,
                "a program of enclave {enclave} announces itself to sgc, but none of its topics: DDS Security (SROS2) protects it, and \
                 this node has no enclave"
            ),
            Self::GatewayNotListening { at, reason } => {
                write!(f, "programs without ROS cannot connect at {at}: {reason}")
            }
            Self::MetricsNotServed { at, reason } => {
                write!(f, "metrics are not served at {at}: {reason}")
            }
            Self::MetricsNotPushed { to, reason } => {
                write!(f, "metrics are not pushed to {to}: {reason}")
            }
            Self::StateNotKept { reason } => {
                write!(f, "nothing is kept over a restart, revocation lists included: {reason}")
            }
            Self::StoreDown { ago_s } => {
                write!(f, "the store of names has not answered for {ago_s} s, so new names are found more slowly")
            }
            Self::StoreRefuses { ago_s } => {
                write!(f, "the store of names refused this router {ago_s} s ago, so names from here may be found more slowly")
            }
            Self::AuditNotWritten { path, reason } => {
                write!(f, "the audit log {path} cannot be written, and events are lost from it: {reason}")
            }
            Self::RefusedPrograms { enclave } => write!(
                f,
                "a program of enclave {enclave} and this node do not admit each other: DDS Security (SROS2) protects both, and none of \
                 its topics are announced"
            ),
            Self::UnprotectedPrograms { programs: 1 } => f.write_str(
                "1 program has no DDS Security (SROS2) on the local network: this node's governance does not let it in",
            ),
            Self::UnprotectedPrograms { programs } => write!(
                f,
                "{programs} programs have no DDS Security (SROS2) on the local network: this node's governance does not let them in"
            ),
            Self::LocalNetworkAlone => f.write_str(
                "this host has no IPv4 address besides loopback: the local ROS 2 network reaches programs of this host only",
            ),
            Self::SameLocalNetwork { node } => write!(
                f,
                "{node} and this node are on the same local ROS 2 network: what this node uses of {node} arrives there twice"
            ),
            Self::SilentPrograms { enclave } => write!(
                f,
                "a program of enclave {enclave} announces itself to sgc, and nothing else of it arrives; it has no DDS Security"
            ),
            Self::ConfigurationRefused { mistakes, ago_s } => write!(
                f,
                "the changed configuration was refused {ago_s} s ago, and the one before holds: {mistakes}"
            ),
            Self::RestartPending { changes } => write!(f, "restart pending: {}", changes.join("; ")),
            Self::Other => f.write_str("the node says something that this version of sgc does not know"),
        }
    }
}

/// Returns an alert if this node's certificate is not valid by its clock.
pub fn clock_alert(identity: &Identity, now: UnixMillis) -> Option<Alert> {
    let (not_before, not_after) = (identity.as_peer().not_before, identity.not_after());
    if now < not_before {
        Some(Alert::ClockBeforeCertificate { not_before: not_before.to_string(), now: now.to_string() })
    } else if now > not_after {
        Some(Alert::CertificateOver { not_after: not_after.to_string(), now: now.to_string() })
    } else {
        None
    }
}

/// Formats a duration for people: the two largest units.
fn duration(ms: i64) -> String {
    let s = ms.unsigned_abs() / 1000;
    match (s / 86_400, s / 3600 % 24, s / 60 % 60) {
        (0, 0, minutes) => format!("{minutes} min"),
        (0, hours, minutes) => format!("{hours} h {minutes} min"),
        (days, hours, _) => format!("{days} d {hours} h"),
    }
}

/// The place of another process that uses an identity.
#[derive(Clone, Debug)]
struct Sighting {
    place: String,
    other: String,
    at: Instant,
}

impl Sighting {
    fn is_shown(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.at) < SHOWN_FOR
    }

    fn ago_s(&self, now: Instant) -> u64 {
        now.saturating_duration_since(self.at).as_secs()
    }
}

/// Recent foreign uses of identities, and a refused configuration.
#[derive(Debug, Default)]
pub(crate) struct Alerts {
    /// The mistakes of the last read configuration, and the time of reading.
    refused: Option<(String, Instant)>,
    /// The changes that need a restart.
    pending: Vec<String>,
    /// The process that has the links of this node.
    displaced: Option<Sighting>,
    /// The process that is kept out in favour of this node.
    kept_out: Option<Sighting>,
    peers: BTreeMap<NodeId, Sighting>,
    /// The owners on the local network that the log names.
    owners_here: BTreeSet<String>,
}

impl Alerts {
    /// Notes that an owner is on the local network. Returns `true` if that is news.
    pub(crate) fn owner_here(&mut self, node: &str) -> bool {
        self.owners_here.len() < PEERS_MAX && self.owners_here.insert(node.to_owned())
    }

    /// Notes the outcome of the last read configuration: the changes that need a restart, or its mistakes. A
    /// configuration with mistakes says nothing about the changes of the one before.
    pub(crate) fn configuration_read(&mut self, outcome: Result<Vec<String>, String>, now: Instant) {
        match outcome {
            Ok(pending) => (self.refused, self.pending) = (None, pending),
            Err(text) => self.refused = Some((text.chars().take(MISTAKES_CHARS_MAX).collect(), now)),
        }
    }

    /// Notes that another process has the links of this node. Returns `true` if that is news.
    pub(crate) fn displaced(&mut self, place: &str, now: Instant) -> bool {
        self.kept_out = None;
        note(&mut self.displaced, place, "", now)
    }

    /// Notes that another process is kept out in favour of this node. Returns `true` if that is news.
    pub(crate) fn kept_out(&mut self, place: SocketAddr, now: Instant) -> bool {
        self.displaced = None;
        note(&mut self.kept_out, &place.to_string(), "", now)
    }

    /// Notes that `other` is kept out in favour of `place`, where both use the identity of a peer. Returns `true` if
    /// that is news.
    pub(crate) fn peer_in_use(&mut self, peer: NodeId, place: &str, other: SocketAddr, now: Instant) -> bool {
        if self.peers.len() >= PEERS_MAX
            && !self.peers.contains_key(&peer)
            && let Some(oldest) = self.peers.iter().min_by_key(|(_, seen)| seen.at).map(|(peer, _)| *peer)
        {
            self.peers.remove(&oldest);
        }
        let mut seen = self.peers.remove(&peer);
        let is_news = note(&mut seen, place, &other.to_string(), now);
        self.peers.extend(seen.map(|seen| (peer, seen)));
        is_news
    }

    /// Returns the current alerts.
    pub(crate) fn shown(&self, node: &str, called: impl Fn(&NodeId) -> String, now: Instant) -> Vec<Alert> {
        let own = |seen: &Option<Sighting>| seen.clone().filter(|seen| seen.is_shown(now));
        let mut alerts = Vec::new();
        let node = node.to_owned();
        alerts.extend(self.refused.as_ref().map(|(mistakes, at)| Alert::ConfigurationRefused {
            mistakes: mistakes.clone(),
            ago_s: now.saturating_duration_since(*at).as_secs(),
        }));
        if !self.pending.is_empty() {
            alerts.push(Alert::RestartPending { changes: self.pending.clone() });
        }
        if let Some(seen) = own(&self.displaced) {
            let ago_s = seen.ago_s(now);
            alerts.push(Alert::Displaced { node, place: seen.place, ago_s });
        } else if let Some(seen) = own(&self.kept_out) {
            let ago_s = seen.ago_s(now);
            alerts.push(Alert::IdentityInUse { node, place: seen.place, ago_s });
        }
        let peers = self.peers.iter().filter(|(_, seen)| seen.is_shown(now));
        alerts.extend(peers.map(|(peer, seen)| Alert::PeerIdentityInUse {
            peer: called(peer),
            place: seen.place.clone(),
            other: seen.other.clone(),
            ago_s: seen.ago_s(now),
        }));
        alerts
    }
}

/// Notes a sighting. Returns `true` if none was shown.
fn note(noted: &mut Option<Sighting>, place: &str, other: &str, now: Instant) -> bool {
    let seen = Sighting { place: place.to_owned(), other: other.to_owned(), at: now };
    !noted.replace(seen).is_some_and(|old| old.is_shown(now))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    fn at(n: u16) -> SocketAddr {
        SocketAddr::from(([203, 0, 113, 5], n))
    }

    #[test]
    fn a_sighting_is_news_once_and_is_shown_for_a_while() {
        let (mut alerts, now) = (Alerts::default(), Instant::now());
        assert!(alerts.displaced("203.0.113.5:1", now));
        assert!(!alerts.displaced("203.0.113.5:2", now + SHOWN_FOR / 2));
        let shown = |alerts: &Alerts, at| alerts.shown("robot", NodeId::short, at);
        let text = shown(&alerts, now + SHOWN_FOR)[0].to_string();
        assert!(text.starts_with("the identity robot is in use at another place: 203.0.113.5:2"), "{text}");
        assert_eq!(shown(&alerts, now + 2 * SHOWN_FOR), []);
        assert!(alerts.displaced("203.0.113.5:1", now + 2 * SHOWN_FOR));
        // A node that has its links again replaces the other alert.
        assert!(alerts.kept_out(at(3), now + 2 * SHOWN_FOR));
        assert!(matches!(shown(&alerts, now + 2 * SHOWN_FOR)[..], [Alert::IdentityInUse { .. }]));
    }

    #[test]
    fn peers_are_bounded() {
        let (mut alerts, now) = (Alerts::default(), Instant::now());
        for n in 0..2 * PEERS_MAX {
            let mut id = [0; 32];
            id[..8].copy_from_slice(&n.to_be_bytes());
            let later = now + Duration::from_millis(n as u64);
            assert!(alerts.peer_in_use(NodeId(id), "203.0.113.5:1", at(2), later));
        }
        assert_eq!(alerts.peers.len(), PEERS_MAX);
        let mut oldest = [0; 32];
        oldest[..8].copy_from_slice(&PEERS_MAX.to_be_bytes());
        assert_eq!(alerts.peers.keys().next(), Some(&NodeId(oldest)), "those seen last stay");
    }

    #[test]
    fn refused_configuration_is_shown_until_one_is_read_that_holds() {
        let (mut alerts, now) = (Alerts::default(), Instant::now());
        alerts.configuration_read(Err("x".repeat(2 * MISTAKES_CHARS_MAX)), now);
        let shown = alerts.shown("robot", NodeId::short, now + 2 * SHOWN_FOR);
        let [Alert::ConfigurationRefused { mistakes, ago_s }] = &shown[..] else { panic!("{shown:?}") };
        assert_eq!((mistakes.len(), *ago_s), (MISTAKES_CHARS_MAX, 2 * SHOWN_FOR.as_secs()));
        alerts.configuration_read(Ok(Vec::new()), now);
        assert_eq!(alerts.shown("robot", NodeId::short, now), []);
    }

    #[test]
    fn pending_restart_is_shown_until_a_configuration_is_read_that_needs_none() {
        let (mut alerts, now) = (Alerts::default(), Instant::now());
        let pending = Alert::RestartPending { changes: vec!["`listen` changed".to_owned()] };
        alerts.configuration_read(Ok(vec!["`listen` changed".to_owned()]), now);
        assert_eq!(alerts.shown("robot", NodeId::short, now + 2 * SHOWN_FOR), std::slice::from_ref(&pending));
        assert_eq!(pending.to_string(), "restart pending: `listen` changed");
        // Mistakes come in addition.
        alerts.configuration_read(Err("x".to_owned()), now);
        let refused = Alert::ConfigurationRefused { mistakes: "x".to_owned(), ago_s: 0 };
        assert_eq!(alerts.shown("robot", NodeId::short, now), [refused, pending]);
        alerts.configuration_read(Ok(Vec::new()), now);
        assert_eq!(alerts.shown("robot", NodeId::short, now), []);
    }

    #[test]
    fn clocks_are_said_as_people_say_them() {
        let said = |ahead_ms| {
            Alert::ClocksDiffer { peer: "robot".into(), remote: at(1).to_string(), ahead_ms }.to_string()
        };
        assert!(said(7_260_000).contains("is 2 h 1 min ahead of the one here"));
        assert!(said(-90_000_000).contains("is 1 d 1 h behind the one here"));
        assert!(said(i64::MIN).contains("behind"));
    }

    #[test]
    fn alerts_survive_json() {
        let alert = Alert::Displaced { node: "robot".into(), place: at(1).to_string(), ago_s: 3 };
        let json = serde_json::to_string(&alert).unwrap();
        assert_eq!(json, r#"{"kind":"displaced","node":"robot","place":"203.0.113.5:1","ago_s":3}"#);
        assert_eq!(serde_json::from_str::<Alert>(&json).unwrap(), alert);
    }
}
