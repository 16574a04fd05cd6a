//! Refusals for want of capacity come in floods; one report in a while tells as much.

use std::time::{Duration, Instant};

use crate::error::Refusal;

/// How often refusals for want of capacity are reported one by one.
const OVERLOAD_REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// Refusals of one listener for want of capacity.
#[derive(Default)]
pub(crate) struct Overload {
    last_report: Option<Instant>,
    unreported: u64,
}

impl Overload {
    /// Notes one, with so many handshakes under way: what is to be reported now, if anything.
    pub(crate) fn note(&mut self, pending: usize) -> Option<Refusal> {
        self.unreported += 1;
        let is_due = self.last_report.is_none_or(|t| t.elapsed() >= OVERLOAD_REPORT_INTERVAL);
        is_due.then(|| {
            self.last_report = Some(Instant::now());
            Refusal::TooMany { pending, unreported: std::mem::take(&mut self.unreported) - 1 }
        })
    }
}
