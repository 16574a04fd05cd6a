//! A node of this process in a namespace, with a local ROS network in memory.

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use serde_json::Value;
use sgc_node::admin::AdminRequest;
use sgc_node::{ConfigSource, RunOptions, config, run_on};
use sgc_testkit::FakeDomain;
use sgc_testkit::FakeRos;
use sgc_testkit::netsim::Namespace;
use sgc_trust::Identity;
use tokio::sync::oneshot;

use crate::support::PATIENCE;

pub(crate) struct Node {
    _runtime: tokio::runtime::Runtime,
    stop: Option<oneshot::Sender<()>>,
    ended: Receiver<()>,
    socket: std::path::PathBuf,
}

impl Node {
    /// Starts it from its file; up when this returns, though not connected.
    pub(crate) fn start(
        namespace: &Arc<Namespace>,
        file: &Path,
        identity: Arc<Identity>,
        domain: Option<&FakeDomain>,
    ) -> Self {
        let config = config::load(file, &|_| None).unwrap_or_else(|error| panic!("{error}"));
        let home = Arc::clone(namespace);
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .on_thread_start(move || home.enter().unwrap())
            .build()
            .unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let (ready, is_ready) = oneshot::channel();
        let (done, ended) = channel();
        let file = file.to_owned();
        let network = domain.map(|domain| Arc::new(domain.join(true)));
        let socket = config.admin_socket.clone().unwrap();
        runtime.spawn(async move {
            let source: ConfigSource = Arc::new(move || config::load(&file, &|_| None));
            let options = RunOptions { ready: Some(ready), source: Some(source), ..RunOptions::default() };
            let stopped = async {
                let _ = stopped.await;
            };
            run_on::<FakeRos>(config, identity, network, options, stopped).await.unwrap();
            let _ = done.send(());
        });
        runtime.block_on(is_ready).unwrap();
        Self { _runtime: runtime, stop: Some(stop), ended, socket }
    }

    pub(crate) fn status(&self) -> Value {
        self.ask(&AdminRequest::Status.to_line())
    }

    /// Lets the node read its file again.
    pub(crate) fn reload(&self) {
        let report = self.ask(&AdminRequest::Reload.to_line());
        assert!(report["ok"]["changed"].as_array().is_some_and(|changed| !changed.is_empty()), "{report}");
    }

    fn ask(&self, request: &str) -> Value {
        let mut stream = UnixStream::connect(&self.socket).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        serde_json::from_str(&text).unwrap()
    }

    /// Ends the node.
    pub(crate) fn stop(&mut self) {
        if let Some(stop) = self.stop.take() {
            let _ = stop.send(());
            let _ = self.ended.recv_timeout(PATIENCE);
        }
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.stop();
    }
}
