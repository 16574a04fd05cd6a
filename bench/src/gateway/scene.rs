//! [`Scene`]: a node with a gateway and Cyclone's programs beside it, all of this host's loopback interface. Needs no root.

use std::fs;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use tempfile::TempDir;

use crate::compare::{Dds, Program};
use crate::fleet::BenchFleet;
use crate::process::status;

/// A ROS domain that other programs rarely use.
const DOMAIN: u32 = 91;
/// Topics of the client's messages and of their echoes.
pub(super) const PING: &str = "/bench/ping";
pub(super) const PONG: &str = "/bench/pong";
/// From a DDS program to the client, and the other way.
pub(super) const DOWN: &str = "/bench/down";
pub(super) const UP: &str = "/bench/up";
/// The type of the programs' messages.
pub(super) const TYPE: &str = "sgc_bench/msg/Load";
const DEFINITION: &str = "uint64 seq\nuint64 stamp_ns\nuint8[] data\n";
/// Longest time until a program is up.
const UP_MAX: Duration = Duration::from_secs(20);

/// The measured node and the programs beside it. Fields are dropped in this order.
pub(super) struct Scene {
    _pong: Program,
    source: Arc<Mutex<Program>>,
    sink: Arc<Mutex<Program>>,
    node: Program,
    /// Address of the rosbridge protocol.
    pub(super) rosbridge: SocketAddr,
    /// Address of gRPC.
    pub(super) grpc: SocketAddr,
    runs: AtomicU32,
    _dir: TempDir,
}

impl Scene {
    pub(super) fn start(sgc: &Path, load: &Path) -> Result<Self> {
        let sgc = sgc.canonicalize().with_context(|| format!("{}: is it built?", sgc.display()))?;
        let dir = tempfile::tempdir()?;
        let types = dir.path().join("sgc_bench/msg");
        fs::create_dir_all(&types)?;
        fs::write(types.join("Load.msg"), DEFINITION)?;
        BenchFleet::new()?.write(dir.path(), "desk", false)?;
        let config = dir.path().join("desk.toml");
        let text = format!(
            "identity = \"desk.identity\"\n[node]\nstate = \"desk.state\"\n[admin]\nsocket = \"desk.sock\"\n\
             [audit]\noff = true\n[router]\nlisten = [\"quic://127.0.0.1:0\"]\n\
             [ros]\ndomain_id = {DOMAIN}\ndiscovery_range = \"localhost\"\nstatic_peers = []\ndefinitions = [\".\"]\n\
             [gateway]\nlisten = [\"ws://127.0.0.1:0\", \"grpc://127.0.0.1:0\"]\n"
        );
        fs::write(&config, text)?;
        let mut command = Command::new(sgc);
        command.args(["run", "--print-ready", "--until-stdin-closes", "--log", "warn", "--config"]);
        command.arg(&config);
        // Variables of a user's shell must not affect the measurement.
        for variable in ["CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "SGC_LOG"] {
            command.env_remove(variable);
        }
        let mut node = Program::start("desk", command, dir.path())?;
        node.soon("ready")?;
        let said = status(&dir.path().join("desk.sock"))?;
        let listens = said["gateway"]["listen"].as_array().context("no gateway")?;
        let at = |number: usize| -> Result<SocketAddr> {
            let url = listens.get(number).and_then(|url| url.as_str()).context("it listens nowhere")?;
            Ok(url.split_once("//").context("no URL")?.1.parse()?)
        };
        let (rosbridge, grpc) = (at(0)?, at(1)?);
        let load = |role: &str, args: &[&str]| {
            let mut command = Command::new(load);
            command.arg(role).args(args).args(["--domain", &DOMAIN.to_string(), "--reliable"]);
            Dds::loopback().configure(&mut command);
            let mut program = Program::start(role, command, dir.path())?;
            program.until("up", UP_MAX)?;
            Ok::<_, anyhow::Error>(program)
        };
        let _pong = load("pong", &["--topic", PING, "--back", PONG, "--depth", "10"])?;
        // DDS keeps all unacknowledged messages and waits for slow readers.
        let source = load("source", &["--topic", DOWN, "--depth", "0"])?;
        let sink = load("sink", &["--topic", UP, "--depth", "0"])?;
        let [source, sink] = [source, sink].map(|program| Arc::new(Mutex::new(program)));
        Ok(Self { _pong, source, sink, node, rosbridge, grpc, runs: AtomicU32::new(0), _dir: dir })
    }

    /// A number for a run, more than all before.
    pub(super) fn run(&self) -> u32 {
        self.runs.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// CPU time that the gateway's process has taken, seconds.
    pub(super) fn cpu_seconds(&self) -> f64 {
        self.node.cpu_seconds()
    }

    /// Talks to the source, on a thread that may block.
    pub(super) async fn with_source<T: Send + 'static>(
        &self,
        talk: impl FnOnce(&mut Program) -> Result<T> + Send + 'static,
    ) -> Result<T> {
        with(&self.source, talk).await
    }

    /// Talks to the sink, on a thread that may block.
    pub(super) async fn with_sink<T: Send + 'static>(
        &self,
        talk: impl FnOnce(&mut Program) -> Result<T> + Send + 'static,
    ) -> Result<T> {
        with(&self.sink, talk).await
    }
}

async fn with<T: Send + 'static>(
    program: &Arc<Mutex<Program>>,
    talk: impl FnOnce(&mut Program) -> Result<T> + Send + 'static,
) -> Result<T> {
    let program = Arc::clone(program);
    let talked = tokio::task::spawn_blocking(move || {
        let mut program: MutexGuard<'_, Program> = program.lock().unwrap_or_else(PoisonError::into_inner);
        talk(&mut program)
    });
    talked.await?
}

/// A message's number: of its run, and its own.
pub(super) fn numbered(run: u32, number: u32) -> u64 {
    u64::from(run) << 32 | u64::from(number)
}

/// The monotonic clock that all processes of a host share, ns.
pub(super) fn now_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Checks a size.
pub(super) fn data_bytes(size: usize) -> Result<usize> {
    ensure!(size >= 16, "a message has at least 16 bytes");
    Ok(size - 16)
}
