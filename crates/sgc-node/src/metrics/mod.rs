//! Metrics for Prometheus, and the health of the node, over HTTP (`[metrics]`); metrics for an OpenTelemetry collector.
//!
//! `readings` has the values, `series` the metrics that are made of them, `source` takes both at one moment. `server`
//! answers to Prometheus, `push` sends to a collector. An address that cannot be bound and a collector that takes
//! nothing do not stop the node: it tries again, and shows an alert.

pub(crate) mod headers;
mod process;
pub(crate) mod push;
pub(crate) mod readings;
pub(crate) mod series;
mod server;
mod source;

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use sgc_config::MetricsConfig;
use sgc_sync::lock;
use sgc_trust::Identity;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tracing::{info, warn};

use self::push::{PushStatus, Pushes};
use self::server::serve;
use self::source::Source;
use crate::control::event::CoreEvent;
use crate::control::faults::alerts::Alert;
use crate::gateway::Gateway;

/// Interval between attempts to bind.
const BIND_AGAIN: Duration = Duration::from_secs(5);

/// The server of metrics and the pushes: each with its wanted place, and its state.
pub(crate) struct Metrics {
    wanted: watch::Sender<Option<SocketAddr>>,
    state: Mutex<State>,
    pushes: Pushes,
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
    pub(crate) fn new(wanted: Option<&MetricsConfig>) -> Self {
        let listen = wanted.map(|wanted| wanted.listen);
        let otlp = wanted.and_then(|wanted| wanted.otlp.clone());
        Self { wanted: watch::Sender::new(listen), state: Mutex::default(), pushes: Pushes::new(otlp) }
    }

    /// Serves and pushes elsewhere from here on, or not at all.
    pub(crate) fn set(&self, wanted: Option<&MetricsConfig>) {
        let listen = wanted.map(|wanted| wanted.listen);
        self.wanted.send_if_modified(|now| std::mem::replace(now, listen) != listen);
        self.pushes.set(wanted.and_then(|wanted| wanted.otlp.clone()));
    }

    /// Returns the URL of the server, or `None` if nothing is served.
    pub(crate) fn url(&self) -> Option<String> {
        match *lock(&self.state) {
            State::Serving(at) => Some(format!("http://{at}/metrics")),
            _ => None,
        }
    }

    /// Returns the state of pushes, or `None` if nothing is pushed.
    pub(crate) fn push_status(&self) -> Option<PushStatus> {
        self.pushes.status()
    }

    /// Returns alerts if the wanted address cannot be bound, or if the collector does not take pushes.
    pub(crate) fn alerts(&self) -> Vec<Alert> {
        let not_served = match &*lock(&self.state) {
            State::Failing { at, reason } => {
                Some(Alert::MetricsNotServed { at: at.to_string(), reason: reason.clone() })
            }
            _ => None,
        };
        not_served.into_iter().chain(self.pushes.alert()).collect()
    }

    /// Serves at the wanted address and pushes to the wanted collector until it is dropped.
    #[cfg_attr(
        not(feature = "otlp"),
        expect(unused_variables, reason = "only pushes name the node and are jittered")
    )]
    pub(crate) async fn run(
        self: Arc<Self>,
        events: mpsc::Sender<CoreEvent>,
        gateway: Arc<Gateway>,
        identity: Arc<Identity>,
        rng: ChaCha20Rng,
    ) {
        let source = Arc::new(Source::new(events, gateway, self.clone()));
        #[cfg(feature = "otlp")]
        tokio::join!(self.serve_where_wanted(&source), self.pushes.run(&source, &identity, rng));
        #[cfg(not(feature = "otlp"))]
        self.serve_where_wanted(&source).await;
    }

    async fn serve_where_wanted(&self, source: &Arc<Source>) {
        let mut wanted = self.wanted.subscribe();
        loop {
            let listen = *wanted.borrow_and_update();
            let done = async {
                match listen {
                    Some(listen) => self.serve_at(listen, source).await,
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
