//! One side of `sgc bench`: a separate node in a process of its own, on a ROS domain that no other program uses.
//!
//! The node is `sgc run` with a configuration as a user writes it and the identity that the user named. Its other files
//! are in a directory that is removed with the side. It takes only revocation lists from the user's own node.

use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange};
use sgc_diagnosis::status;
use sgc_node::config;
use sgc_process::children::{ROS_VARIABLES, ReadyLine, last_lines};
use sgc_process::domains::{DomainLock, lock_one};
use sgc_process::{EndSignals, ProcessError};
use sgc_trust::Suite;
use tempfile::TempDir;

use crate::error::{MeasureError, failed};
use crate::event::Event;
use crate::words::{Channel, TYPE};

/// Longest time a node may take to end cleanly.
const END_MAX: Duration = Duration::from_secs(6);
/// How often an ending node is polled.
const END_PERIOD: Duration = Duration::from_millis(20);
/// Longest time a node may take to start.
const READY_MAX: Duration = Duration::from_secs(30);
/// Most revocation lists that are taken over.
const CRLS_MAX: usize = 128;
const CRL_BYTES_MAX: u64 = 1 << 20;

/// The way in which the two nodes meet.
#[derive(Clone, Debug)]
pub(crate) enum Rendezvous {
    /// This node listens.
    Listen(Vec<String>),
    /// This node connects to the other, or to a router between them.
    Connect(Vec<String>),
}

/// The topics that a node carries.
#[derive(Clone, Debug)]
pub(crate) enum Topics {
    /// Its own channels, for all members of its fleet.
    Own,
    /// The channels of that node.
    Of(String, Vec<Suite>),
}

/// A side. Dropping it ends its node and removes its files.
pub(crate) struct Side {
    dir: TempDir,
    domain: DomainLock,
    node: Child,
}

impl Side {
    /// Starts the node. Events report that it is up and that it ended.
    pub(crate) fn start(
        identity: &Path,
        meeting: &Rendezvous,
        topics: &Topics,
        events: &SyncSender<Event>,
    ) -> Result<Self, MeasureError> {
        let dir = tempfile::Builder::new()
            .prefix("sgc-bench-")
            .tempdir()
            .map_err(|source| ProcessError::Write { path: std::env::temp_dir(), source })?;
        let domain = lock_one(std::process::id()).ok_or_else(|| {
            failed(
                "no free ROS domain among 20 to 69: other ROS 2 programs or demos run here; end one of them",
            )
        })?;
        let identity = fs::canonicalize(identity)
            .map_err(|source| ProcessError::Read { path: identity.to_owned(), source })?;
        let text = configuration(&identity, meeting, topics, domain.id())?;
        let path = dir.path().join("bench.toml");
        fs::write(&path, text).map_err(|source| ProcessError::Write { path: path.clone(), source })?;
        // Mistakes in the user's arguments are reported before any process runs.
        let config =
            config::load(&path, &|_: &str| None).map_err(|errors| MeasureError::Arguments { errors })?;
        let what = identity.display().to_string();
        sgc_node::check_identity(&config).map_err(|source| MeasureError::CheckIdentity { what, source })?;
        take_over_revocations(&config, dir.path());
        let node = start_node(dir.path(), &path, events)?;
        Ok(Self { dir, domain, node })
    }

    /// Joins the side's domain as a separate DDS program.
    pub(crate) fn join(&self) -> Result<CycloneNetwork, MeasureError> {
        let config = DdsConfig {
            domain: self.domain.id(),
            discovery: DiscoveryRange::LocalHost,
            ..DdsConfig::default()
        };
        CycloneNetwork::open(&config).map_err(|error| failed(error.to_string()))
    }

    /// Asks the node for its status.
    pub(crate) fn status(&self) -> Result<status::Status, MeasureError> {
        Ok(status::query(&self.socket())?)
    }

    /// Returns the node's status socket.
    pub(crate) fn socket(&self) -> PathBuf {
        self.dir.path().join("bench.sock")
    }

    /// Returns the node's process id.
    pub(crate) fn process(&self) -> u32 {
        self.node.id()
    }

    /// Returns the last lines of the node's log.
    pub(crate) fn last_words(&self) -> Vec<String> {
        last_lines(&self.dir.path().join("bench.log"))
    }
}

impl Drop for Side {
    fn drop(&mut self) {
        drop(self.node.stdin.take());
        let deadline = Instant::now() + END_MAX;
        while matches!(self.node.try_wait(), Ok(None)) {
            if Instant::now() > deadline {
                let _ = self.node.kill();
                let _ = self.node.wait();
                return;
            }
            thread::sleep(END_PERIOD);
        }
    }
}

/// Joins a domain in which both machines discover each other by unicast.
pub(crate) fn join_directly(domain: u32, peer: std::net::IpAddr) -> Result<CycloneNetwork, MeasureError> {
    let config = DdsConfig {
        domain,
        discovery: DiscoveryRange::LocalHost,
        static_peers: vec![peer.to_string()],
        ..DdsConfig::default()
    };
    CycloneNetwork::open(&config).map_err(|error| failed(error.to_string()))
}

/// Turns the user's first signal into an event. The next signal ends the process at once.
pub(crate) fn tell_of_signals(events: SyncSender<Event>) -> Result<(), MeasureError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| ProcessError::System { what: "cannot start a runtime", source })?;
    let mut signals = {
        let _guard = runtime.enter();
        EndSignals::new()?
    };
    thread::spawn(move || {
        runtime.block_on(async {
            signals.next().await;
            let _ = events.send(Event::Interrupted);
            signals.next().await;
            std::process::exit(sgc_process::EXIT_FAILURE.into());
        });
    });
    Ok(())
}

fn start_node(dir: &Path, config: &Path, events: &SyncSender<Event>) -> Result<Child, MeasureError> {
    let failed = |source| ProcessError::System { what: "cannot start a node", source };
    let log = dir.join("bench.log");
    let log = File::create(&log).map_err(|source| ProcessError::Write { path: log, source })?;
    let mut command = Command::new(std::env::current_exe().map_err(failed)?);
    command
        .args(["run", "--until-stdin-closes", "--print-ready", "-c"])
        .arg(config)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(log)
        // In a process group of its own the node gets no Ctrl-C; this process ends it in order.
        .process_group(0);
    for variable in ROS_VARIABLES {
        command.env_remove(variable);
    }
    let mut node = command.spawn().map_err(failed)?;
    let (stdout, events) = (node.stdout.take(), events.clone());
    thread::spawn(move || {
        for line in stdout.into_iter().flat_map(|out| BufReader::new(out).lines()).map_while(Result::ok) {
            if let Ok(ready) = serde_json::from_str::<ReadyLine>(&line) {
                let _ = events.send(Event::NodeReady(ready.ready));
            }
        }
        // The node's standard output ends with the node.
        let _ = events.send(Event::NodeEnded);
    });
    Ok(node)
}

/// Copies the revocation lists that the user's own node has.
fn take_over_revocations(config: &config::Config, dir: &Path) {
    let mut usual = config.clone();
    usual.state = None;
    let Ok(name) = sgc_diagnosis::ask::node_name(config) else { return };
    let Some(kept) = sgc_node::state_dir(&usual, &name) else { return };
    let state = dir.join("state");
    let lists = sgc_process::files::with_extension(&kept.join("crl"), "crl").unwrap_or_default();
    if lists.is_empty() || sgc_node::create_state_dir(&state.join("crl")).is_err() {
        return;
    }
    for list in lists.iter().take(CRLS_MAX) {
        let (Some(file), Ok(metadata)) = (list.file_name(), fs::metadata(list)) else { continue };
        // The node itself refuses a broken list.
        if metadata.is_file() && metadata.len() <= CRL_BYTES_MAX {
            let _ = fs::copy(list, state.join("crl").join(file));
        }
    }
}

/// Returns the next event, or `None` if there is none by then. Fails if the user interrupts the program or the node
/// ends.
pub(crate) fn next_event(
    events: &Receiver<Event>,
    side: &Side,
    until: Instant,
) -> Result<Option<Event>, MeasureError> {
    match events.recv_timeout(until.saturating_duration_since(Instant::now())) {
        Ok(Event::Interrupted) => Err(failed("interrupted")),
        Ok(Event::NodeEnded) => {
            let reason = "the node here ended; its last words:".to_owned();
            Err(MeasureError::Failed { reason, facts: side.last_words() })
        }
        Ok(event) => Ok(Some(event)),
        Err(RecvTimeoutError::Timeout) => Ok(None),
        Err(RecvTimeoutError::Disconnected) => Err(failed("nobody is left to say anything")),
    }
}

/// Waits until the node is up. Returns the URLs at which it listens.
pub(crate) fn wait_ready(events: &Receiver<Event>, side: &Side) -> Result<Vec<String>, MeasureError> {
    let deadline = Instant::now() + READY_MAX;
    loop {
        match next_event(events, side, deadline)? {
            Some(Event::NodeReady(urls)) => return Ok(urls),
            Some(_) => {}
            None => {
                let reason =
                    format!("the node here is not up after {} s; its last words:", READY_MAX.as_secs());
                return Err(MeasureError::Failed { reason, facts: side.last_words() });
            }
        }
    }
}

fn configuration(
    identity: &Path,
    meeting: &Rendezvous,
    topics: &Topics,
    domain: u32,
) -> Result<String, MeasureError> {
    let identity = identity.to_str().ok_or_else(|| MeasureError::Cannot {
        reason: format!("{}: the path of an identity must be UTF-8; copy it elsewhere", identity.display()),
    })?;
    // A JSON string is a valid TOML string.
    let quoted = |text: &str| serde_json::Value::from(text).to_string();
    let list = |texts: &[String]| {
        let texts: Vec<_> = texts.iter().map(|text| quoted(text)).collect();
        format!("[{}]", texts.join(", "))
    };
    let (routers, listen) = match meeting {
        Rendezvous::Listen(urls) => (String::new(), format!("[router]\nlisten = {}\n\n", list(urls))),
        Rendezvous::Connect(urls) => (format!("routers = {}\n", list(urls)), String::new()),
    };
    let mut text = format!(
        "identity = {}\n\n[node]\nstate = \"state\"\n{routers}\n{listen}\
         [ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\ngraph = false\n\n\
         [audit]\noff = true\n\n[admin]\nsocket = \"bench.sock\"\n",
        quoted(identity)
    );
    match topics {
        Topics::Own => {
            let channels = Suite::ALL.map(|suite| (Channel::Sealed(suite), suite));
            for (channel, suite) in channels.into_iter().chain([(Channel::Control, Suite::Standard)]) {
                // Questions and answers overtake measured messages.
                let priority = if channel == Channel::Control { "realtime" } else { "default" };
                for (topic, publish) in [(channel.ask(), "publish = [\"*\"]\n"), (channel.answer(), "")] {
                    text += &format!(
                        "\n[[share]]\ntopic = {}\ntype = {}\nto = [\"*\"]\nsuite = {}\npriority = {}\n{publish}",
                        quoted(&topic),
                        quoted(TYPE),
                        quoted(suite.name()),
                        quoted(priority)
                    );
                }
            }
        }
        Topics::Of(owner, suites) => {
            let channels = suites.iter().map(|suite| Channel::Sealed(*suite));
            for channel in channels.chain([Channel::Control]) {
                for (topic, publish) in [(channel.ask(), "publish = true\n"), (channel.answer(), "")] {
                    text += &format!(
                        "\n[[use]]\nfrom = {}\ntopic = {}\n{publish}",
                        quoted(owner),
                        quoted(&topic)
                    );
                }
            }
        }
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(identity: &Path, meeting: &Rendezvous, topics: &Topics) -> config::Config {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bench.toml");
        let text = configuration(identity, meeting, topics, 42).unwrap();
        fs::write(&path, text).unwrap();
        config::load(&path, &|_: &str| None).unwrap()
    }

    #[test]
    fn both_sides_have_same_topics() {
        let listen = Rendezvous::Listen(vec!["quic://0.0.0.0:7448".into(), "tls://[::]:7448".into()]);
        let place = tempfile::tempdir().unwrap();
        let identity = place.path().join("a \"b\".identity");
        sgc_process::files::write_secret(&identity, "", sgc_process::files::Existing::Keep("")).unwrap();
        let own = load(&identity, &listen, &Topics::Own);
        assert_eq!(own.identity, identity);
        assert_eq!((own.shares.len(), own.uses.len()), (2 * (Suite::ALL.len() + 1), 0));
        let connect = Rendezvous::Connect(vec!["quic://desk.example:7448".into()]);
        let used =
            load(&identity, &connect, &Topics::Of("desk".into(), vec![Suite::Group, Suite::PaperChacha]));
        assert_eq!(used.uses.len(), 6);
        for used in &used.uses {
            assert!(own.shares.iter().any(|share| share.topic == used.topic), "{}", used.topic);
        }
    }
}
