//! Real servers of a store for tests and benchmarks: `redis-server` processes in a network namespace, alone or as a
//! cluster, that can be killed, frozen, cut off and resharded.
//!
//! Redis 7.0 is the last version under a free licence and the one of Debian 12, which has no Valkey yet. Valkey 7.2 and
//! later speak the same protocol: [`RedisOptions::program`] can name `valkey-server`.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::netsim::{Namespace, NetsimError};

/// Slots of a cluster.
const SLOTS: usize = 16_384;
/// The port of every server. The port of the cluster's bus is higher by 10000.
pub const REDIS_PORT: u16 = 6379;
/// Longest time until servers answer, or a cluster is complete.
const START_MAX: Duration = Duration::from_secs(20);
/// The time after which servers of a cluster take another for failed.
pub const NODE_TIMEOUT: Duration = Duration::from_millis(1000);
/// Lines of each log that are shown after a failure.
const LOG_LINES_SHOWN: usize = 10;
/// Most keys of a slot that are moved.
const KEYS_AT_ONCE: &str = "1000";
/// The table of nftables with the addresses that are cut off.
const TABLE: &str = "sgc_redis";

/// TLS of servers: files in PEM format.
#[derive(Clone, Debug)]
pub struct RedisTls {
    /// The CA of the servers, of each other's certificates, and of the clients'.
    pub ca: PathBuf,
    /// The certificate of all servers.
    pub certificate: PathBuf,
    /// Its key.
    pub key: PathBuf,
}

/// How to start servers.
#[derive(Clone, Debug)]
pub struct RedisOptions {
    /// The program.
    pub program: String,
    /// With TLS alone.
    pub tls: Option<RedisTls>,
    /// Further settings, such as `--maxmemory 10mb`, as separate words.
    pub settings: Vec<String>,
}

impl Default for RedisOptions {
    fn default() -> Self {
        Self { program: "redis-server".into(), tls: None, settings: Vec::new() }
    }
}

struct Server {
    host: String,
    process: Option<Child>,
}

/// Servers with an address each, in one namespace. Dropping the value kills them.
pub struct Redis {
    namespace: Arc<Namespace>,
    folder: PathBuf,
    options: RedisOptions,
    servers: Vec<Server>,
    is_cluster: bool,
}

/// Returns whether the programs are installed.
pub fn is_redis_installed() -> bool {
    let exists = |program: &&str| Path::new("/usr/bin").join(program).exists();
    ["redis-server", "redis-cli"].iter().all(exists)
}

impl Redis {
    /// Starts a single server at an address of the namespace. Its files go to the folder.
    pub fn single(namespace: Arc<Namespace>, folder: &Path, host: &str, options: RedisOptions) -> Self {
        Self::start(namespace, folder, &[host], options, false)
    }

    /// Starts a cluster at addresses of the namespace: the first half of the servers are primaries with equal shares of
    /// the slots, the second half their replicas in the same order. Returns when all of them know that.
    pub fn cluster(namespace: Arc<Namespace>, folder: &Path, hosts: &[&str], options: RedisOptions) -> Self {
        let cluster = Self::start(namespace, folder, hosts, options, true);
        let primaries = hosts.len() / 2;
        for (index, host) in hosts.iter().enumerate() {
            cluster.ok(index, &["CLUSTER", "SET-CONFIG-EPOCH", &(index + 1).to_string()]);
            if index > 0 {
                cluster.ok(0, &["CLUSTER", "MEET", host, &REDIS_PORT.to_string()]);
            }
            if index < primaries {
                let (first, last) = (SLOTS * index / primaries, SLOTS * (index + 1) / primaries - 1);
                cluster.ok(index, &["CLUSTER", "ADDSLOTSRANGE", &first.to_string(), &last.to_string()]);
            }
        }
        for replica in primaries..hosts.len() {
            let id = cluster.id(replica - primaries);
            cluster.until("a replica knows its primary", |cluster| {
                cluster
                    .try_cli(replica, &["CLUSTER", "REPLICATE", &id])
                    .is_some_and(|reply| reply.trim() == "OK")
            });
        }
        cluster.until_complete();
        cluster
    }

    fn start(
        namespace: Arc<Namespace>,
        folder: &Path,
        hosts: &[&str],
        options: RedisOptions,
        is_cluster: bool,
    ) -> Self {
        let servers = hosts.iter().map(|host| Server { host: (*host).to_owned(), process: None }).collect();
        let mut redis = Self { namespace, folder: folder.to_owned(), options, servers, is_cluster };
        for index in 0..hosts.len() {
            redis.restart(index);
        }
        redis
    }

    /// Starts a server that was killed, with the files that it left, and waits until it answers.
    pub fn restart(&mut self, index: usize) {
        let host = self.servers[index].host.clone();
        let folder = self.folder.join(&host);
        fs::create_dir_all(&folder).expect("a folder for the server");
        let mut command = self.namespace.command(&self.options.program);
        let port = REDIS_PORT.to_string();
        let words = |text: &str| text.split(' ').map(str::to_owned).collect::<Vec<_>>();
        command.args(["--bind", &host, "--bind-source-addr", &host, "--protected-mode", "no"]);
        command.arg("--dir").arg(&folder).args(["--save", "", "--repl-diskless-sync-delay", "0"]);
        command.args(words("--maxmemory-policy noeviction"));
        match &self.options.tls {
            None => {
                command.args(["--port", &port]);
            }
            Some(tls) => {
                command.args(["--port", "0", "--tls-port", &port]);
                command.args(words("--tls-cluster yes --tls-replication yes --tls-auth-clients yes"));
                command.arg("--tls-ca-cert-file").arg(&tls.ca).arg("--tls-cert-file").arg(&tls.certificate);
                command.arg("--tls-key-file").arg(&tls.key);
            }
        }
        if self.is_cluster {
            command.args(["--cluster-enabled", "yes", "--cluster-node-timeout"]);
            command.arg(NODE_TIMEOUT.as_millis().to_string());
        }
        command.args(&self.options.settings).stdin(Stdio::null());
        let log = File::options().create(true).append(true).open(folder.join("log")).expect("a log");
        command.stdout(log.try_clone().expect("a log")).stderr(log);
        self.servers[index].process = Some(command.spawn().expect("the server starts"));
        self.until("a server answers", |redis| {
            redis
                .try_cli(index, &["PING"])
                .is_some_and(|reply| reply.starts_with("PONG") || reply.contains("NOAUTH"))
        });
    }

    /// Kills a server at once, as `kill -9` does.
    pub fn kill(&mut self, index: usize) {
        if let Some(mut process) = self.servers[index].process.take() {
            process.kill().expect("the server can be killed");
            process.wait().expect("the server has ended");
        }
    }

    /// Stops a server where it is, as a host that hangs: it keeps its connections and answers nothing.
    pub fn freeze(&self, index: usize) {
        self.signal(index, Signal::STOP);
    }

    /// Ends what [`Self::freeze`] did.
    pub fn thaw(&self, index: usize) {
        self.signal(index, Signal::CONT);
    }

    fn signal(&self, index: usize, signal: Signal) {
        if let Some(process) = &self.servers[index].process {
            kill_process(Pid::from_child(process), signal).expect("the server takes signals");
        }
    }

    /// Returns the addresses of the servers, as URLs.
    pub fn urls(&self) -> Vec<String> {
        let scheme = if self.options.tls.is_some() { "valkeys" } else { "valkey" };
        self.servers.iter().map(|server| format!("{scheme}://{}:{REDIS_PORT}", server.host)).collect()
    }

    /// Sends a command to a server and returns the reply as `redis-cli` shows it.
    pub fn cli(&self, index: usize, command: &[&str]) -> String {
        self.run_cli(index, command).expect("redis-cli reaches the server")
    }

    /// Sends a command to a server that may not answer.
    pub fn try_cli(&self, index: usize, command: &[&str]) -> Option<String> {
        self.run_cli(index, command).ok()
    }

    fn run_cli(&self, index: usize, command: &[&str]) -> Result<String, NetsimError> {
        let port = REDIS_PORT.to_string();
        let mut args = vec!["-h", &self.servers[index].host, "-p", &port];
        let tls = self.options.tls.as_ref();
        let paths =
            tls.map(|tls| [&tls.ca, &tls.certificate, &tls.key].map(|path| path.display().to_string()));
        if let Some([ca, certificate, key]) = &paths {
            args.extend(["--tls", "--cacert", ca, "--cert", certificate, "--key", key]);
        }
        args.extend(command);
        self.namespace.run("redis-cli", &args)
    }

    /// Returns the keys that match a pattern, of all primaries that can be reached, as `redis-cli` shows them. Waits for
    /// servers that are frozen.
    pub fn keys(&self, pattern: &str) -> BTreeSet<String> {
        let is_primary = |index: &usize| {
            let replication = self.try_cli(*index, &["INFO", "replication"]);
            replication.is_some_and(|replication| replication.contains("role:master"))
        };
        let keys_of = |index| self.try_cli(index, &["--no-raw", "KEYS", pattern]).unwrap_or_default();
        let shown: Vec<String> = (0..self.servers.len()).filter(is_primary).map(keys_of).collect();
        shown.iter().flat_map(|shown| shown_keys(shown)).map(str::to_owned).collect()
    }

    /// Returns the id of a server in its cluster.
    pub fn id(&self, index: usize) -> String {
        self.cli(index, &["CLUSTER", "MYID"]).trim().to_owned()
    }

    /// Returns the server that has a slot, as another one sees it.
    pub fn owner(&self, seen_by: usize, slot: usize) -> Option<usize> {
        let nodes = self.try_cli(seen_by, &["CLUSTER", "NODES"])?;
        let has_slot = |line: &&str| {
            let ranges = line.split(' ').skip(8).filter(|range| !range.starts_with('['));
            ranges
                .filter_map(|range| {
                    let (first, last) = range.split_once('-').unwrap_or((range, range));
                    Some(first.parse::<usize>().ok()?..=last.parse::<usize>().ok()?)
                })
                .any(|range| range.contains(&slot))
        };
        let line = nodes.lines().find(has_slot)?;
        let host = line.split([' ', ':']).nth(1)?;
        self.servers.iter().position(|server| server.host == host)
    }

    /// Waits until all servers that run see the cluster as complete, with replicas that follow their primaries.
    pub fn until_complete(&self) {
        self.until("the cluster is complete", |redis| {
            let mut running =
                (0..redis.servers.len()).filter(|index| redis.servers[*index].process.is_some());
            running.all(|index| {
                let reply = |command: &[&str]| redis.try_cli(index, command).unwrap_or_default();
                let nodes = reply(&["CLUSTER", "NODES"]);
                let replication = reply(&["INFO", "replication"]);
                reply(&["CLUSTER", "INFO"]).contains("cluster_state:ok")
                    && nodes.lines().count() == redis.servers.len()
                    && !nodes.contains("handshake")
                    && (replication.contains("role:master") || replication.contains("master_link_status:up"))
            })
        });
    }

    /// Begins to move a slot: from now on, the old primary sends clients on for keys that it does not have.
    pub fn begin_move(&self, slot: u16, from: usize, to: usize) {
        self.ok(to, &["CLUSTER", "SETSLOT", &slot.to_string(), "IMPORTING", &self.id(from)]);
        self.ok(from, &["CLUSTER", "SETSLOT", &slot.to_string(), "MIGRATING", &self.id(to)]);
    }

    /// Moves the keys of a slot.
    pub fn move_keys(&self, slot: u16, from: usize, to: usize) {
        let (host, port) = (&self.servers[to].host, REDIS_PORT.to_string());
        // Keys are bytes: `redis-cli` shows them in quotes and takes them so.
        let shown =
            self.cli(from, &["--no-raw", "CLUSTER", "GETKEYSINSLOT", &slot.to_string(), KEYS_AT_ONCE]);
        for key in shown_keys(&shown) {
            self.ok(from, &["--quoted-input", "MIGRATE", host, &port, key, "0", "5000"]);
        }
    }

    /// Ends the move of a slot.
    pub fn end_move(&self, slot: u16, from: usize, to: usize) {
        for server in [to, from] {
            self.ok(server, &["CLUSTER", "SETSLOT", &slot.to_string(), "NODE", &self.id(to)]);
        }
    }

    fn ok(&self, index: usize, command: &[&str]) {
        let reply = self.cli(index, command);
        assert_eq!(reply.trim(), "OK", "{command:?}");
    }

    /// Cuts a server off from all others and from clients; packets are lost without an answer.
    pub fn cut(&self, index: usize) {
        let host = &self.servers[index].host;
        let rules = format!(
            "add table inet {TABLE}\nadd set inet {TABLE} cut {{ type ipv4_addr; }}\n\
             add chain inet {TABLE} input {{ type filter hook input priority 0; }}\n\
             flush chain inet {TABLE} input\n\
             add rule inet {TABLE} input ip saddr @cut drop\nadd rule inet {TABLE} input ip daddr @cut drop\n\
             add element inet {TABLE} cut {{ {host} }}\n"
        );
        self.nft(&rules);
    }

    /// Ends what [`Self::cut`] did to all servers.
    pub fn mend(&self) {
        self.nft(&format!("delete table inet {TABLE}\n"));
    }

    fn nft(&self, rules: &str) {
        let file = self.folder.join("rules.nft");
        fs::write(&file, rules).expect("a file for the rules");
        self.namespace.run("nft", &["-f", &file.display().to_string()]).expect("nft takes the rules");
    }

    /// Returns the ends of the servers' logs.
    fn logs(&self) -> String {
        let log = |server: &Server| {
            let text = fs::read_to_string(self.folder.join(&server.host).join("log")).unwrap_or_default();
            let lines: Vec<&str> = text.lines().rev().take(LOG_LINES_SHOWN).collect();
            lines.into_iter().rev().map(|line| format!("{}: {line}\n", server.host)).collect::<String>()
        };
        self.servers.iter().map(log).collect()
    }

    /// Waits for a condition.
    pub fn until(&self, what: &str, mut condition: impl FnMut(&Self) -> bool) {
        let deadline = Instant::now() + START_MAX;
        while !condition(self) {
            assert!(Instant::now() < deadline, "not within {START_MAX:?}: {what}\n{}", self.logs());
            sleep(Duration::from_millis(20));
        }
    }
}

/// Returns the keys of a list as `redis-cli --no-raw` shows it.
fn shown_keys(list: &str) -> impl Iterator<Item = &str> {
    list.lines().filter_map(|line| line.split_once(") ")).map(|(_, key)| key)
}

impl Drop for Redis {
    fn drop(&mut self) {
        for server in &mut self.servers {
            if let Some(mut process) = server.process.take() {
                let _ = process.kill();
                let _ = process.wait();
            }
        }
    }
}
