//! [`check`]: says whether a store fits, by asking its servers and by using it as a router does.

use std::fmt;
use std::hash::{BuildHasher as _, RandomState};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_router::{
    BATCH_TAG_LEN, BatchTag, StoreAction, StoreEvent, StoreFailure, StoreKey, StoreOp, StoreOpId, StoreReply,
    WriteIf,
};
use sgc_wire::{Name, NodeId};
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::command::message;
use crate::config::{ServerAddress, StoreConfig};
use crate::driver::run;
use crate::link::{Access, CONNECT_MAX, Connection, LinkError};
use crate::resp::Frame;

/// Reads of which the latency is measured.
const READS: usize = 100;
/// Latency of a read above which look-ups are slow.
const SLOW: Duration = Duration::from_millis(50);
/// Longest wait for a result or a reported change.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Time after which the keys of a check end by themselves, if the check cannot remove them.
const LIFETIME: Duration = Duration::from_secs(60);
/// The first version with all commands that are used: `SET` with `GET`.
const VERSION_MIN: (u32, u32) = (6, 2);
/// The setting of a server with the number of keys whose readers are remembered, and the least that is useful.
const TRACKED: &str = "tracking-table-max-keys";
const TRACKED_MIN: u64 = 100_000;

/// The findings about a store.
#[derive(Clone, Debug)]
pub struct StoreReport {
    /// The findings, in the order of the questions.
    pub findings: Vec<StoreFinding>,
}

impl StoreReport {
    /// Returns the gravest severity.
    pub fn severity(&self) -> Severity {
        self.findings.iter().map(StoreFinding::severity).max().unwrap_or(Severity::Fits)
    }
}

/// The severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// It fits, or is for information.
    Fits,
    /// The store works, with a risk or a part unknown.
    Warning,
    /// The store does not work, or loses names, until this is fixed.
    Error,
}

/// A finding. `Display` says it in words.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum StoreFinding {
    /// A server of the configuration cannot be used.
    ServerFails {
        /// The server.
        server: String,
        /// The reason.
        reason: String,
        /// Whether it refuses the user.
        is_refused: bool,
    },
    /// The version of a server.
    Version {
        /// The server.
        server: String,
        /// Valkey or Redis, and the version.
        version: String,
        /// Whether it is recent enough.
        is_enough: bool,
    },
    /// The servers are a cluster.
    Cluster {
        /// Whether all slots are served.
        is_complete: bool,
    },
    /// The store is one server without a cluster.
    SingleServer,
    /// The rule by which servers drop values when their memory is full.
    Eviction {
        /// The rule.
        policy: String,
        /// The memory, bytes; 0 for no bound.
        max_bytes: u64,
    },
    /// Whether a server keeps values on disk.
    Persistence {
        /// Whether it does.
        is_kept: bool,
    },
    /// The number of keys whose readers a server remembers.
    Tracking {
        /// The number; 0 for no bound.
        keys: u64,
    },
    /// A server does not tell a part of this, since the user has not the right.
    Untold {
        /// The command that is refused.
        command: &'static str,
        /// The message of the server.
        reason: String,
    },
    /// No server that has a key could be reached.
    Unreachable,
    /// The user may not do what a router does.
    Refused {
        /// The operation.
        operation: &'static str,
        /// The user and the prefix, for the fix.
        rights: String,
    },
    /// A value was read otherwise than it was written.
    Altered,
    /// A change was not reported.
    NotReported,
    /// Reading, writing, removing and reports of changes work.
    Works {
        /// The median of the time of a read, microseconds.
        p50_us: u64,
        /// The 99th percentile, microseconds.
        p99_us: u64,
    },
}

impl StoreFinding {
    /// Returns the severity.
    pub fn severity(&self) -> Severity {
        match self {
            Self::ServerFails { .. }
            | Self::Version { is_enough: false, .. }
            | Self::Cluster { is_complete: false }
            | Self::Unreachable
            | Self::Refused { .. }
            | Self::Altered
            | Self::NotReported => Severity::Error,
            Self::Eviction { policy, max_bytes } if *max_bytes > 0 && policy != "noeviction" => {
                if policy.starts_with("allkeys") { Severity::Error } else { Severity::Warning }
            }
            Self::Tracking { keys } if *keys > 0 && *keys < TRACKED_MIN => Severity::Warning,
            Self::Works { p99_us, .. } if *p99_us > SLOW.as_micros() as u64 => Severity::Warning,
            Self::Untold { .. } => Severity::Warning,
            Self::Version { .. }
            | Self::Cluster { .. }
            | Self::SingleServer
            | Self::Eviction { .. }
            | Self::Persistence { .. }
            | Self::Tracking { .. }
            | Self::Works { .. } => Severity::Fits,
        }
    }

    /// Returns the step that mends it; `None` if there is nothing to mend.
    pub fn fix(&self) -> Option<String> {
        if self.severity() == Severity::Fits {
            return None;
        }
        Some(match self {
            Self::ServerFails { is_refused: true, .. } => {
                "correct `store_user` and `store_password_file`, or the user of the server's ACL".to_owned()
            }
            Self::ServerFails { .. } => {
                "start the server, or correct `store`: host, port, and valkey:// or valkeys://".to_owned()
            }
            Self::Version { .. } => {
                let (major, minor) = VERSION_MIN;
                format!("install Valkey, or Redis {major}.{minor} or later")
            }
            Self::Cluster { .. } => {
                "`redis-cli --cluster check HOST:PORT` on a server names the slots without a server, and \
                 `--cluster fix` gives them to others"
                    .to_owned()
            }
            Self::Eviction { .. } => {
                "CONFIG SET maxmemory-policy noeviction on each server: a name whose value was dropped is found \
                 only by asking all routers"
                    .to_owned()
            }
            Self::Tracking { .. } => format!("CONFIG SET {TRACKED} 1000000 on each server"),
            Self::Untold { .. } => "nothing, if somebody else looks after the servers; otherwise run this check \
                 with a user who has the right"
                .to_owned(),
            Self::Unreachable => "start the servers that have the slots; \
                 `redis-cli --cluster check HOST:PORT` names them"
                .to_owned(),
            Self::Refused { rights, .. } => format!("on each server: {rights}"),
            Self::Altered | Self::NotReported => {
                "use a store that is Valkey or Redis itself: a proxy in between, or a server that imitates them, does \
                 not do"
                    .to_owned()
            }
            Self::Works { .. } => {
                "put the store nearer to the routers: a first look-up takes two round trips".to_owned()
            }
            Self::SingleServer | Self::Persistence { .. } => return None,
        })
    }
}

impl fmt::Display for StoreFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ServerFails { server, reason, .. } => write!(f, "{server}: {reason}"),
            Self::Version { server, version, is_enough: true } => write!(f, "{server}: {version}"),
            Self::Version { server, version, .. } => write!(f, "{server}: {version} is too old"),
            Self::Cluster { is_complete: true } => f.write_str("a cluster that serves all slots"),
            Self::Cluster { .. } => f.write_str("the cluster does not serve all slots"),
            Self::SingleServer => f.write_str("one server, no cluster"),
            Self::Eviction { policy, max_bytes: 0 } => {
                write!(f, "memory without a bound, so that nothing is evicted ({policy})")
            }
            Self::Eviction { policy, max_bytes } => write!(f, "{max_bytes} bytes of memory, then {policy}"),
            Self::Persistence { is_kept: true } => f.write_str("values outlive a restart of the servers"),
            Self::Persistence { .. } => f.write_str(
                "values end with a restart of all servers, after which the routers write everything again",
            ),
            Self::Tracking { keys: 0 } => f.write_str("remembers the readers of all keys"),
            Self::Tracking { keys } => write!(f, "remembers the readers of {keys} keys"),
            Self::Untold { command, reason } => {
                write!(f, "{command} is refused, so a part is unknown: {reason}")
            }
            Self::Unreachable => f.write_str("no server that has the key of this check answers"),
            Self::Refused { operation, .. } => write!(f, "the user may not {operation}"),
            Self::Altered => f.write_str("a value was read otherwise than it was written"),
            Self::NotReported => f.write_str("the change of a key that was read was not reported"),
            Self::Works { p50_us, p99_us } => write!(
                f,
                "reading, writing and reports of changes work; a read takes {p50_us} µs, and {p99_us} µs at the 99th \
                 percentile"
            ),
        }
    }
}

/// Says whether a store fits. Writes two keys under the prefix, and removes them or lets them end within a minute.
pub async fn check(config: StoreConfig) -> StoreReport {
    let access = Access { user: config.user.clone(), tls: config.tls.clone() };
    let mut findings = Vec::new();
    let mut is_asked = false;
    for server in &config.servers {
        let opened = timeout(CONNECT_MAX, async {
            let mut connection = Connection::open(&server.address, &access).await?;
            connection.track().await?;
            Ok(connection)
        });
        match opened.await.unwrap_or(Err(LinkError::Timeout)) {
            Err(error) => findings.push(StoreFinding::ServerFails {
                server: server.to_string(),
                is_refused: matches!(error, LinkError::User(_)),
                reason: error.to_string(),
            }),
            // The servers of a cluster are set up alike.
            Ok(mut connection) if !is_asked => {
                is_asked = true;
                let asked = ask(&mut connection, &server.address, &mut findings);
                if let Ok(Err(error)) = timeout(ANSWER_MAX, asked).await {
                    let (server, reason) = (server.to_string(), error.to_string());
                    findings.push(StoreFinding::ServerFails { server, reason, is_refused: false });
                }
            }
            Ok(_) => {}
        }
    }
    if is_asked {
        findings.push(use_it(config).await);
    }
    StoreReport { findings }
}

/// Asks a server for its version and settings.
async fn ask(
    connection: &mut Connection,
    server: &ServerAddress,
    findings: &mut Vec<StoreFinding>,
) -> Result<(), LinkError> {
    match connection.call(&[b"INFO"]).await? {
        Frame::Error(text) => {
            findings.push(StoreFinding::Untold { command: "INFO", reason: message(&text) });
        }
        reply => {
            let text = text_of(&reply);
            findings.extend(version(server, &text));
            findings.extend(eviction(&text));
            findings.extend(persistence(&text));
        }
    }
    match connection.call(&[b"CONFIG", b"GET", TRACKED.as_bytes()]).await? {
        Frame::Error(text) => {
            findings.push(StoreFinding::Untold { command: "CONFIG GET", reason: message(&text) });
        }
        reply => {
            let keys = reply.array().and_then(|pair| pair.get(1)).and_then(Frame::text);
            let keys = keys.and_then(|keys| std::str::from_utf8(keys).ok()?.parse().ok());
            findings.extend(keys.map(|keys| StoreFinding::Tracking { keys }));
        }
    }
    findings.push(match connection.call(&[b"CLUSTER", b"INFO"]).await? {
        Frame::Error(text) if text.starts_with(b"ERR This instance has cluster support disabled") => {
            StoreFinding::SingleServer
        }
        Frame::Error(text) => StoreFinding::Untold { command: "CLUSTER INFO", reason: message(&text) },
        reply => {
            let text = text_of(&reply);
            let is_complete = field(&text, "cluster_state") == Some("ok")
                && field(&text, "cluster_slots_ok") == Some("16384");
            StoreFinding::Cluster { is_complete }
        }
    });
    Ok(())
}

/// Returns the text of a reply. That of `INFO` is a verbatim string, whose content follows its format.
fn text_of(reply: &Frame) -> String {
    let bytes = reply.text().unwrap_or_default();
    String::from_utf8_lossy(bytes.strip_prefix(b"txt:").unwrap_or(bytes)).into_owned()
}

/// Returns the value of a field of `INFO`.
fn field<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':')).map(str::trim_end)
}

fn version(server: &ServerAddress, text: &str) -> Option<StoreFinding> {
    let of = |program: &str, name| field(text, name).map(|version| (program.to_owned(), version));
    let (program, version) = of("Valkey", "valkey_version").or_else(|| of("Redis", "redis_version"))?;
    let mut parts = version.split('.').map(|part| part.parse().unwrap_or(0));
    let is_enough = (parts.next()?, parts.next().unwrap_or(0)) >= VERSION_MIN;
    let version = format!("{program} {version}");
    Some(StoreFinding::Version { server: server.to_string(), version, is_enough })
}

fn eviction(text: &str) -> Option<StoreFinding> {
    let policy = field(text, "maxmemory_policy")?.to_owned();
    Some(StoreFinding::Eviction { policy, max_bytes: field(text, "maxmemory")?.parse().ok()? })
}

fn persistence(text: &str) -> Option<StoreFinding> {
    let appends = field(text, "aof_enabled")? == "1";
    // Without save points, the time of the last dump is that of the start.
    let dumps = field(text, "rdb_saves").is_some_and(|saves| saves != "0");
    Some(StoreFinding::Persistence { is_kept: appends || dumps })
}

/// Uses the store as a router does.
async fn use_it(config: StoreConfig) -> StoreFinding {
    let rights = rights(&config);
    let (operations, waiting) = mpsc::channel(1);
    let (news, events) = mpsc::channel(64);
    let trial = Trial { operations, events, next: 0, rights };
    tokio::select! {
        () = run(config, waiting, news) => StoreFinding::Unreachable,
        finding = trial.run() => finding.unwrap_or_else(|failed| failed),
    }
}

/// Returns the command that gives the user its rights.
fn rights(config: &StoreConfig) -> String {
    let user = config.user.as_ref().map_or("default", |user| user.name());
    format!("ACL SETUSER {user} ~{}:* -@all {ACL_COMMANDS}", config.prefix)
}

/// The commands that a router's user needs.
const ACL_COMMANDS: &str =
    "+hello +auth +ping +get +set +del +eval +asking +client|tracking +cluster|info +cluster|slots";

struct Trial {
    operations: mpsc::Sender<StoreOp>,
    events: mpsc::Receiver<StoreEvent>,
    next: u64,
    rights: String,
}

impl Trial {
    async fn run(mut self) -> Result<StoreFinding, StoreFinding> {
        let random = RandomState::new();
        let mut bytes = [0; 32];
        for (index, part) in bytes.chunks_mut(8).enumerate() {
            part.copy_from_slice(&random.hash_one(index).to_be_bytes());
        }
        let short = StoreKey::Name(Name(bytes));
        let long = StoreKey::Batch { owner: NodeId(bytes), tag: BatchTag([0; BATCH_TAG_LEN]) };
        let [first, second] = [Bytes::from_static(b"first"), Bytes::from(vec![7; 9000])];
        self.write(short, &first).await?;
        let mut times = Vec::with_capacity(READS);
        for _ in 0..READS {
            let begun = Instant::now();
            self.expect(short, Some(&first)).await?;
            times.push(begun.elapsed());
        }
        self.write(short, &second).await?;
        self.await_change(short).await?;
        self.write(long, &second).await?;
        self.expect(long, Some(&second)).await?;
        for (key, value) in [(short, &second), (long, &second)] {
            let action = StoreAction::Remove { value: value.clone() };
            self.call(key, action, "remove a key that has a value (EVAL, GET, DEL)").await?;
            self.expect(key, None).await?;
        }
        times.sort_unstable();
        let at = |part: usize| times[(READS - 1) * part / 100].as_micros() as u64;
        Ok(StoreFinding::Works { p50_us: at(50), p99_us: at(99) })
    }

    async fn write(&mut self, key: StoreKey, value: &Bytes) -> Result<(), StoreFinding> {
        let condition = WriteIf::Always;
        let action = StoreAction::Write { value: value.clone(), lifetime: Some(LIFETIME), condition };
        self.call(key, action, "write a key (SET, GET, EVAL)").await.map(|_| ())
    }

    async fn expect(&mut self, key: StoreKey, value: Option<&Bytes>) -> Result<(), StoreFinding> {
        match self.call(key, StoreAction::Read, "read a key (GET)").await? {
            StoreReply::Value(read) if read.as_ref() == value => Ok(()),
            _ => Err(StoreFinding::Altered),
        }
    }

    /// Waits for the report of a change.
    async fn await_change(&mut self, key: StoreKey) -> Result<(), StoreFinding> {
        let change = async {
            while let Some(event) = self.events.recv().await {
                if event == StoreEvent::Changed(key) {
                    return true;
                }
            }
            false
        };
        match timeout(ANSWER_MAX, change).await {
            Ok(true) => Ok(()),
            _ => Err(StoreFinding::NotReported),
        }
    }

    /// Carries one operation out.
    async fn call(
        &mut self,
        key: StoreKey,
        action: StoreAction,
        operation: &'static str,
    ) -> Result<StoreReply, StoreFinding> {
        let id = StoreOpId(self.next);
        self.next += 1;
        let sent = self.operations.send(StoreOp { id, key, action }).await;
        sent.map_err(|_| StoreFinding::Unreachable)?;
        let answered = async {
            while let Some(event) = self.events.recv().await {
                if let StoreEvent::Reply { id: of, result } = event
                    && of == id
                {
                    return Some(result);
                }
            }
            None
        };
        match timeout(ANSWER_MAX, answered).await {
            Ok(Some(Ok(reply))) => Ok(reply),
            Ok(Some(Err(StoreFailure::Refused))) => {
                Err(StoreFinding::Refused { operation, rights: self.rights.clone() })
            }
            _ => Err(StoreFinding::Unreachable),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server() -> ServerAddress {
        ServerAddress::new("store.example", 6379).unwrap()
    }

    #[test]
    fn page_about_stores_names_the_rights_that_a_router_needs() {
        let page = include_str!("../../../docs/how-to/store-of-names.md").replace("\\\n", " ");
        let words = page.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.contains(&format!("-@all {ACL_COMMANDS}")), "{ACL_COMMANDS}");
    }

    #[test]
    fn versions_are_compared_by_number() {
        let is_enough = |text: &str| match version(&server(), text) {
            Some(StoreFinding::Version { is_enough, .. }) => is_enough,
            other => panic!("{other:?}"),
        };
        assert!(is_enough("redis_version:7.0.15\r\n"));
        assert!(is_enough("redis_version:6.2.0\r\n"));
        assert!(is_enough("redis_version:10.0.0\r\n"));
        assert!(is_enough("redis_version:7.2.4\r\nvalkey_version:8.1.1\r\n"));
        assert!(!is_enough("redis_version:6.0.16\r\n"));
        assert_eq!(version(&server(), "nothing"), None);
    }

    #[test]
    fn rules_that_drop_names_are_errors_if_memory_is_bounded() {
        let severity = |text: &str| eviction(text).map(|finding| finding.severity());
        let bounded = |policy: &str| severity(&format!("maxmemory:1000\r\nmaxmemory_policy:{policy}\r\n"));
        assert_eq!(bounded("noeviction"), Some(Severity::Fits));
        assert_eq!(bounded("allkeys-lru"), Some(Severity::Error));
        assert_eq!(bounded("volatile-ttl"), Some(Severity::Warning));
        assert_eq!(severity("maxmemory:0\r\nmaxmemory_policy:allkeys-lru\r\n"), Some(Severity::Fits));
    }

    #[test]
    fn every_finding_that_does_not_fit_has_a_fix() {
        let text = || "x".to_owned();
        let findings = [
            StoreFinding::ServerFails { server: text(), reason: text(), is_refused: true },
            StoreFinding::ServerFails { server: text(), reason: text(), is_refused: false },
            StoreFinding::Version { server: text(), version: text(), is_enough: false },
            StoreFinding::Cluster { is_complete: false },
            StoreFinding::Eviction { policy: "allkeys-lru".to_owned(), max_bytes: 1 },
            StoreFinding::Tracking { keys: 1 },
            StoreFinding::Untold { command: "INFO", reason: text() },
            StoreFinding::Unreachable,
            StoreFinding::Refused { operation: "read", rights: text() },
            StoreFinding::Altered,
            StoreFinding::NotReported,
            StoreFinding::Works { p50_us: 1, p99_us: 1_000_000 },
        ];
        for finding in findings {
            assert!(finding.severity() > Severity::Fits && finding.fix().is_some(), "{finding:?}");
        }
    }
}
