//! [`Pushes`]: metrics that go to an OpenTelemetry collector (`otlp` in `[metrics]`), and their state.
//!
//! `task` sends them. It is the feature `otlp`; without it, `sgc-config` refuses the key.

#[cfg(feature = "otlp")]
mod mapping;
#[cfg(feature = "otlp")]
mod task;

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::Instant;

use serde::Serialize;
use sgc_config::OtlpConfig;
use sgc_sync::lock;
use tokio::sync::watch;

use crate::control::faults::alerts::Alert;

/// Pushes of metrics to an OpenTelemetry collector.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct PushStatus {
    /// The URL of the collector.
    pub to: String,
    /// The number of pushes that the collector took, since the node started.
    pub accepted: u64,
    /// The numbers of other pushes by reason, since the node started.
    pub failed: BTreeMap<&'static str, u64>,
    /// Seconds since the collector last took a push; null before the first.
    pub accepted_ago_s: Option<u64>,
    /// The present fault; null if the last push was taken.
    pub fault: Option<String>,
}

/// The wanted collector, and the state of pushing there.
pub(super) struct Pushes {
    wanted: watch::Sender<Option<OtlpConfig>>,
    state: Mutex<PushState>,
}

#[derive(Debug, Default)]
struct PushState {
    /// The URL of the collector; `None` while nothing is pushed.
    to: Option<String>,
    accepted: u64,
    failed: BTreeMap<&'static str, u64>,
    /// The time of the last accepted push.
    last: Option<Instant>,
    /// The label and the text of the fault of the last push.
    fault: Option<(&'static str, String)>,
    /// Whether the collector warned at the last accepted push.
    #[cfg(feature = "otlp")]
    has_warned: bool,
}

impl Pushes {
    pub(super) fn new(wanted: Option<OtlpConfig>) -> Self {
        Self { wanted: watch::Sender::new(wanted), state: Mutex::default() }
    }

    /// Pushes elsewhere from here on, or not at all.
    pub(super) fn set(&self, wanted: Option<OtlpConfig>) {
        self.wanted.send_if_modified(|now| {
            *now != wanted && {
                *now = wanted;
                true
            }
        });
    }

    /// Returns the state; `None` if nothing is pushed.
    pub(super) fn status(&self) -> Option<PushStatus> {
        let state = lock(&self.state);
        Some(PushStatus {
            to: state.to.clone()?,
            accepted: state.accepted,
            failed: state.failed.clone(),
            accepted_ago_s: state.last.map(|last| last.elapsed().as_secs()),
            fault: state.fault.as_ref().map(|(_, text)| text.clone()),
        })
    }

    /// Returns an alert if the collector did not take the last push.
    pub(super) fn alert(&self) -> Option<Alert> {
        let state = lock(&self.state);
        let (_, reason) = state.fault.clone()?;
        Some(Alert::MetricsNotPushed { to: state.to.clone()?, reason })
    }
}
