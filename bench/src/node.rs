//! Whole nodes in this process, with local networks in memory instead of DDS, so that only SGC and its links are
//! measured.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use sgc_node::config::{Config, ShareConfig, UseConfig};
use sgc_node::{RunOptions, run_on};
use sgc_ros::{EndpointSpec, RosNetwork, RosWriter, SampleKind, dds_topic, dds_type};
use sgc_testkit::netsim::Namespace;
use sgc_testkit::{FakeDomain, FakeReader, FakeRos, FakeWriter};
use sgc_trust::{Identity, Suite};
use sgc_wire::Qos;
use tokio::sync::oneshot;

use crate::process::{PATIENCE, status};

/// A node in a runtime of its own.
pub(crate) struct Node {
    _runtime: tokio::runtime::Runtime,
    stop: Option<oneshot::Sender<()>>,
    ended: Receiver<()>,
    socket: PathBuf,
}

impl Node {
    /// Starts a node, which is up on return, though not connected.
    pub(crate) fn start(config: Config, identity: Arc<Identity>, domain: &FakeDomain) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        Self::start_on(runtime, config, identity, Some(domain))
    }

    /// Starts a node with its sockets in a network namespace, and optionally without a local network.
    pub(crate) fn start_in(
        home: &Arc<Namespace>,
        config: Config,
        identity: Arc<Identity>,
        domain: Option<&FakeDomain>,
    ) -> Result<Self> {
        Self::start_on(runtime_in(home)?, config, identity, domain)
    }

    fn start_on(
        runtime: tokio::runtime::Runtime,
        config: Config,
        identity: Arc<Identity>,
        domain: Option<&FakeDomain>,
    ) -> Result<Self> {
        let (stop, stopped) = oneshot::channel::<()>();
        let (ready, is_ready) = oneshot::channel();
        let (done, ended) = channel();
        let socket = config.admin_socket.clone().context("a node of a benchmark has a socket")?;
        let network = domain.map(|domain| Arc::new(domain.join(true)));
        runtime.spawn(async move {
            let options = RunOptions { ready: Some(ready), ..RunOptions::default() };
            let stopped = async {
                let _ = stopped.await;
            };
            if let Err(error) = run_on::<FakeRos>(config, identity, network, options, stopped).await {
                eprintln!("a node ends: {error}");
            }
            let _ = done.send(());
        });
        runtime.block_on(is_ready)?;
        Ok(Self { _runtime: runtime, stop: Some(stop), ended, socket })
    }

    pub(crate) fn status(&self) -> Result<serde_json::Value> {
        status(&self.socket)
    }

    /// Returns the state of its only share or use.
    pub(crate) fn route_state(&self) -> Result<String> {
        Ok(self.status()?["routes"][0]["state"].as_str().unwrap_or_default().to_owned())
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.stop.take().map(|stop| stop.send(()));
        let _ = self.ended.recv_timeout(PATIENCE);
    }
}

/// A runtime whose threads are in a network namespace.
pub(crate) fn runtime_in(home: &Arc<Namespace>) -> Result<tokio::runtime::Runtime> {
    let home = Arc::clone(home);
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(2).enable_all().on_thread_start(move || {
        home.enter().expect("a namespace that is there can be entered");
    });
    Ok(builder.build()?)
}

/// A configuration with everything that the node writes in `dir`.
pub(crate) fn config(dir: &Path, node: &str, routers: &[&str]) -> Result<Config> {
    Ok(Config {
        routers: routers.iter().map(|url| url.parse()).collect::<Result<_, _>>()?,
        admin_socket: Some(dir.join(format!("{node}.sock"))),
        state: Some(dir.join(format!("{node}.state"))),
        ..Config::default()
    })
}

/// A topic for one other node.
pub(crate) fn share(topic: &str, to: &str, suite: Suite) -> Result<ShareConfig> {
    let mut config = parse(&format!("[[share]]\ntopic = \"{topic}\"\nto = [\"{to}\"]\n"))?;
    let share = config.shares.pop().context("a share")?;
    Ok(ShareConfig { suite, ..share })
}

/// Returns the use of the same topic at that node.
pub(crate) fn usage(topic: &str, from: &str) -> Result<UseConfig> {
    let mut config = parse(&format!("[[use]]\nfrom = \"{from}\"\ntopic = \"{topic}\"\n"))?;
    config.uses.pop().context("a use")
}

/// Parses part of a configuration as users write it, so that omitted keys have their defaults.
fn parse(tables: &str) -> Result<Config> {
    let text = format!("identity = \"x\"\n[node]\nrouters = [\"quic://router\"]\n{tables}");
    Ok(sgc_node::config::parse(&text, "benchmark", Path::new(""), &|_| None)?)
}

/// An application that publishes.
pub(crate) struct Talker {
    writer: FakeWriter,
    _net: FakeRos,
}

impl Talker {
    pub(crate) fn new(domain: &FakeDomain, topic: &str, qos: Qos) -> Result<Self> {
        let net = domain.join(false);
        Ok(Self { writer: net.create_writer(&spec(topic, qos))?, _net: net })
    }

    pub(crate) fn say(&self, payload: Bytes) -> Result<()> {
        Ok(self.writer.write(SampleKind::Write, 1, payload)?)
    }

    /// Publishes several messages that a reader finds together, as under load.
    pub(crate) fn say_all(&self, payloads: &[Bytes]) {
        self.writer.write_burst(payloads.iter().cloned());
    }
}

/// An application that subscribes.
pub(crate) struct Listener {
    _reader: FakeReader,
    _net: FakeRos,
}

impl Listener {
    pub(crate) fn new(
        domain: &FakeDomain,
        topic: &str,
        qos: Qos,
        mut heard: impl FnMut(&[u8]) + Send + 'static,
    ) -> Result<Self> {
        let net = domain.join(false);
        let handler = Box::new(move |sample: sgc_ros::Sample| heard(&sample.payload));
        let reader = net.create_reader(&spec(topic, qos), handler)?;
        Ok(Self { _reader: reader, _net: net })
    }
}

fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec {
        topic: dds_topic(topic),
        type_name: dds_type("std_msgs/msg/ByteMultiArray"),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos,
    }
}

/// Waits until a condition holds. The period of polling is too long for timed waits.
pub(crate) fn wait(what: &str, mut until: impl FnMut() -> Result<bool>) -> Result<()> {
    let begun = Instant::now();
    while !until()? {
        ensure!(begun.elapsed() < PATIENCE, "never: {what}");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    Ok(())
}
