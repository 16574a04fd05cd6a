//! Metrics for Prometheus, and the health of the node, over HTTP (`[metrics]`).
//!
//! `readings` has the values, `series` the metrics that are made of them, `server` the protocol. An address that cannot
//! be bound does not stop the node: it tries again, and shows an alert.

mod process;
pub(crate) mod readings;
pub(crate) mod series;
mod server;

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sgc_config::MetricsConfig;
use sgc_sync::lock;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tracing::{info, warn};

use self::server::{Source, serve};
use crate::control::event::CoreEvent;
use crate::control::faults::alerts::Alert;
use crate::gateway::Gateway;

/// Interval between attempts to bind.
const BIND_AGAIN: Duration = Duration::from_secs(5);

/// The server of metrics: the wanted address, and the state of serving there.
pub(crate) struct Metrics {
    wanted: watch::Sender<Option<MetricsConfig>>,
    state: Mutex<State>,
}

/// The state of serving.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
enum State {
    /// Nothing is served.
    #[default]
    Off,
    Serving(SocketAddr),
    Failing {
        at: SocketAddr,
        reason: String,
    },
}

impl Metrics {
    pub(crate) fn new(wanted: Option<MetricsConfig>) -> Self {
        Self { wanted: watch::Sender::new(wanted), state: Mutex::default() }
    }

    /// Serves elsewhere from here on, or not at all.
    pub(crate) fn set(&self, wanted: Option<MetricsConfig>) {
        self.wanted.send_if_modified(|now| std::mem::replace(now, wanted) != wanted);
    }

    /// Returns the URL of the server, or `None` if nothing is served.
    pub(crate) fn url(&self) -> Option<String> {
        match *lock(&self.state) {
            State::Serving(at) => Some(format!("http://{at}/metrics")),
            _ => None,
        }
    }

    /// Returns an alert if the wanted address cannot be bound.
    pub(crate) fn alert(&self) -> Option<Alert> {
        match &*lock(&self.state) {
            State::Failing { at, reason } => {
                Some(Alert::MetricsNotServed { at: at.to_string(), reason: reason.clone() })
            }
            _ => None,
        }
    }

    /// Serves at the wanted address until it is dropped.
    pub(crate) async fn run(self: Arc<Self>, events: mpsc::Sender<CoreEvent>, gateway: Arc<Gateway>) {
        let mut wanted = self.wanted.subscribe();
        let source = Arc::new(Source::new(events, gateway));
        loop {
            let config = *wanted.borrow_and_update();
            let done = async {
                match config {
                    Some(config) => self.serve_at(config.listen, &source).await,
                    None => {
                        self.become_state(State::Off);
                        std::future::pending().await
                    }
                }
            };
            tokio::select! {
                () = done => {}
                changed = wanted.changed() => if changed.is_err() { return },
            }
        }
    }

    /// Serves at an address, or waits until it may be tried again.
    async fn serve_at(&self, at: SocketAddr, source: &Arc<Source>) {
        match TcpListener::bind(at).await.and_then(|listener| Ok((listener.local_addr()?, listener))) {
            Ok((local, listener)) => {
                if self.become_state(State::Serving(local)) {
                    info!("metrics are served at http://{local}/metrics");
                }
                serve(listener, source.clone()).await;
            }
            Err(error) => {
                let reason = error.to_string();
                if self.become_state(State::Failing { at, reason: reason.clone() }) {
                    warn!("metrics are not served at {at}: {reason}; trying again");
                }
                tokio::time::sleep(BIND_AGAIN).await;
            }
        }
    }

    /// Records the state. Returns `true` if it is another one.
    fn become_state(&self, state: State) -> bool {
        let mut known = lock(&self.state);
        std::mem::replace(&mut *known, state.clone()) != state
    }
}
