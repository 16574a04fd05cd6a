//! The task that pushes: one request at a time, with new values for each attempt, so nothing queues up.

use std::convert::Infallible;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use rand_chacha::ChaCha20Rng;
use sgc_config::{OtlpConfig, OtlpUrl};
use sgc_http::http::HeaderMap;
use sgc_otlp::{Client, Endpoint, Fault, FaultKind, Origin, PushSchedule, StartTimes, TrustedRoots, encode};
use sgc_sync::lock;
use sgc_trust::Identity;
use tokio::time::sleep_until;
use tracing::{info, warn};

use super::mapping::{metrics_of, origin_of};
use super::{PushState, Pushes};
use crate::config::files::PEM_BYTES_MAX;
use crate::control::fleet::partners;
use crate::metrics::headers;
use crate::metrics::source::Source;

/// Everything that pushes share, wherever they go.
struct Pusher<'p> {
    pushes: &'p Pushes,
    source: &'p Source,
    origin: Origin,
    starts: StartTimes,
    rng: ChaCha20Rng,
}

impl Pushes {
    /// Pushes to the wanted collector until it is dropped.
    pub(in crate::metrics) async fn run(&self, source: &Source, identity: &Identity, rng: ChaCha20Rng) {
        let (origin, starts) = (origin_of(identity), StartTimes::new(source.started()));
        let mut pusher = Pusher { pushes: self, source, origin, starts, rng };
        let mut wanted = self.wanted.subscribe();
        loop {
            let config = wanted.borrow_and_update().clone();
            self.begin(config.as_ref().map(|config| &config.url));
            let push = async {
                match &config {
                    Some(config) => pusher.push_to(config).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                never = push => match never {},
                changed = wanted.changed() => if changed.is_err() { return },
            }
        }
    }

    /// Notes where pushes go from here on. Counts go on.
    fn begin(&self, to: Option<&OtlpUrl>) {
        let mut state = lock(&self.state);
        let PushState { accepted, mut failed, last, .. } = std::mem::take(&mut *state);
        // Prometheus sees no increase in a series that begins with 1.
        for kind in FaultKind::ALL {
            failed.entry(kind.label()).or_default();
        }
        *state =
            PushState { to: to.map(ToString::to_string), accepted, failed, last, ..PushState::default() };
    }

    /// Notes the end of a push. Writes to the log if it ended otherwise than the one before.
    fn note(&self, ended: &Result<String, Fault>, to: &OtlpUrl) {
        let mut state = lock(&self.state);
        match ended {
            Ok(warning) => {
                let is_first = state.last.is_none() || state.fault.is_some();
                (state.fault, state.last) = (None, Some(Instant::now()));
                state.accepted += 1;
                if is_first {
                    info!("metrics are pushed to {to}");
                }
                if !warning.is_empty() && !state.has_warned {
                    warn!("{to} takes the metrics, and warns: {warning}");
                }
                state.has_warned = !warning.is_empty();
            }
            Err(fault) => {
                let label = fault.kind().label();
                if state.fault.as_ref().is_none_or(|(before, _)| *before != label) {
                    warn!("metrics are not pushed to {to}: {fault}; trying again");
                }
                state.fault = Some((label, fault.to_string()));
                *state.failed.entry(label).or_default() += 1;
            }
        }
    }
}

impl Pusher<'_> {
    async fn push_to(&mut self, config: &OtlpConfig) -> Infallible {
        let mut schedule = PushSchedule::new(config.interval, Instant::now());
        let mut client = None;
        loop {
            sleep_until(schedule.due().into()).await;
            let ended = self.push_once(config, &mut client).await;
            let fault = ended.as_ref().and_then(|ended| ended.as_ref().err());
            if fault.is_some() {
                // The CAs may have been replaced.
                client = None;
            }
            schedule.ended(fault, Instant::now(), &mut self.rng);
            if let Some(ended) = ended {
                self.pushes.note(&ended, &config.url);
            }
        }
    }

    /// Pushes the values of this moment. Returns the collector's warning, or `None` if the control task does not answer.
    async fn push_once(
        &mut self,
        config: &OtlpConfig,
        client: &mut Option<Arc<Client>>,
    ) -> Option<Result<String, Fault>> {
        let snapshot = self.source.snapshot().await?;
        let (sample, at) = (&snapshot.sample, snapshot.sample.at);
        let mut metrics = metrics_of(sample);
        self.starts.set(&mut metrics, at);
        let body = encode(&self.origin, metrics, at);
        let (wanted, known) = (config.clone(), client.take());
        let prepared = tokio::task::spawn_blocking(move || prepare(&wanted, known)).await;
        let (ready, headers) = match prepared {
            Ok(Ok(prepared)) => prepared,
            Ok(Err(fault)) => return Some(Err(fault)),
            // The node is stopping.
            Err(_) => return None,
        };
        let answer = client.insert(ready).push(body, headers).await;
        Some(answer.and_then(|answer| answer.judge(SystemTime::now())))
    }
}

/// Returns a client and the headers for a request. Reads files: tokens are replaced without a reload.
fn prepare(config: &OtlpConfig, known: Option<Arc<Client>>) -> Result<(Arc<Client>, HeaderMap), Fault> {
    let headers = match &config.headers_file {
        Some(path) => headers::read(path)
            .map_err(|error| Fault::Headers { reason: format!("{}: {error}", path.display()) })?,
        None => HeaderMap::new(),
    };
    if let Some(client) = known {
        return Ok((client, headers));
    }
    let roots = match &config.ca {
        Some(path) => read_roots(path)?,
        None => TrustedRoots::System,
    };
    let client = Client::new(endpoint_of(&config.url), roots, env!("CARGO_PKG_VERSION"))?;
    Ok((Arc::new(client), headers))
}

fn read_roots(path: &Path) -> Result<TrustedRoots, Fault> {
    let failed =
        |error: &dyn std::fmt::Display| Fault::Tls { reason: format!("{}: {error}", path.display()) };
    let mut pem = Vec::new();
    let file = File::open(path).map_err(|error| failed(&error))?;
    file.take(PEM_BYTES_MAX).read_to_end(&mut pem).map_err(|error| failed(&error))?;
    partners::chain(&pem).map(TrustedRoots::Certificates).map_err(|error| failed(&error))
}

fn endpoint_of(url: &OtlpUrl) -> Endpoint {
    Endpoint {
        is_encrypted: url.is_encrypted(),
        host: url.host().to_owned(),
        port: url.port(),
        authority: url.authority().to_owned(),
        path: url.path().to_owned(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::control::faults::alerts::Alert;

    #[test]
    fn state_shows_the_last_end_and_counts_go_on_elsewhere() {
        let pushes = Pushes::new(None);
        assert_eq!((pushes.status(), pushes.alert()), (None, None));
        let url: OtlpUrl = "http://127.0.0.1:4318".parse().unwrap();
        pushes.begin(Some(&url));
        let status = pushes.status().unwrap();
        assert_eq!((status.accepted, status.accepted_ago_s, status.fault), (0, None, None));
        assert_eq!(status.failed.len(), FaultKind::ALL.len());
        let refused = |message: &str| Err(Fault::Refused { status: 400, message: message.to_owned() });
        pushes.note(&refused("first"), &url);
        pushes.note(&refused("second"), &url);
        let reason = "it refuses (status 400): second".to_owned();
        assert_eq!(pushes.alert(), Some(Alert::MetricsNotPushed { to: url.to_string(), reason }));
        assert_eq!(pushes.status().unwrap().failed["refused"], 2);
        pushes.note(&Ok(String::new()), &url);
        assert_eq!((pushes.alert(), pushes.status().unwrap().accepted), (None, 1));
        pushes.note(&refused("third"), &url);
        pushes.begin(None);
        assert_eq!((pushes.status(), pushes.alert()), (None, None));
        pushes.begin(Some(&url));
        let status = pushes.status().unwrap();
        assert_eq!((status.accepted, status.failed["refused"], status.fault), (1, 3, None));
    }
}
