//! Log of peers that are refused a link. It is rate-limited, so that strangers cannot fill it by reconnecting.
//!
//! Counters and the audit log are elsewhere (`sgc-transport` `metrics.rs`, `audit.rs`).

use std::collections::BTreeSet;

use sgc_transport::{Refusal, RefusalKind, RefusedPeer};
use sgc_trust::{AddressPrefix, CaFingerprint, CertError, RepeatCount, Repeats};
use tokio::time::Instant;
use tracing::{debug, warn};

/// Refused peers of one listener.
#[derive(Default)]
pub(crate) struct RefusalLog {
    repeats: Repeats<RefusalKind>,
    /// CAs whose refusal was logged, at most one for each trusted CA.
    strangers: BTreeSet<CaFingerprint>,
}

impl RefusalLog {
    /// Logs a refusal, or only counts it if the same address was refused for the same reason recently.
    pub(crate) fn note(&mut self, refused: &RefusedPeer) {
        let prefix = AddressPrefix::from(refused.remote.ip());
        let is_first = self.repeats.note(prefix, refused.reason.kind(), Instant::now().into_std());
        let is_known_stranger = match &refused.reason {
            // The log explains the fix once per CA.
            Refusal::Certificate(CertError::NotAdmitted { ca }) => !self.strangers.insert(*ca),
            _ => false,
        };
        if is_first && !is_known_stranger {
            warn!("{refused}");
        } else {
            debug!("{refused}");
        }
    }

    /// Waits until [`Self::summarise`] is to be called.
    pub(crate) async fn is_due(&self) {
        match self.repeats.due() {
            Some(due) => tokio::time::sleep_until(due.into()).await,
            None => std::future::pending().await,
        }
    }

    /// Logs the number of counted refusals.
    pub(crate) fn summarise(&mut self) {
        for RepeatCount { source, count, within } in self.repeats.take_due(Instant::now().into_std()) {
            let seconds = within.as_secs();
            match source {
                // They were named once, and a count adds nothing.
                Some((_, RefusalKind::NotAdmitted)) => {}
                Some((prefix, kind)) => {
                    let kind = kind.label();
                    warn!("{prefix} is refused: … and {count} more like it in {seconds} s ({kind})");
                }
                None => warn!("… and {count} more from other addresses are refused in {seconds} s"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::io;
    use std::sync::{Arc, Mutex};
    use std::time::Duration;

    use sgc_trust::REPEAT_SOURCES_MAX;
    use tracing_subscriber::fmt::MakeWriter;

    use super::*;

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Lines {
        fn take(&self) -> Vec<String> {
            let text = String::from_utf8(std::mem::take(&mut *self.0.lock().unwrap())).unwrap();
            text.lines().map(str::to_owned).collect()
        }
    }

    impl io::Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl<'a> MakeWriter<'a> for Lines {
        type Writer = Self;

        fn make_writer(&'a self) -> Self {
            self.clone()
        }
    }

    fn refused(address: &str, reason: Refusal) -> RefusedPeer {
        RefusedPeer { remote: format!("{address}:4000").parse().unwrap(), reason }
    }

    fn late() -> Refusal {
        Refusal::TimedOut { after: Duration::from_secs(5) }
    }

    #[tokio::test(start_paused = true)]
    async fn a_flood_of_refused_connections_does_not_fill_the_log() {
        let lines = Lines::default();
        let subscriber = tracing_subscriber::fmt()
            .with_max_level(tracing::Level::WARN)
            .with_ansi(false)
            .with_writer(lines.clone())
            .finish();
        let _guard = tracing::subscriber::set_default(subscriber);
        let mut log = RefusalLog::default();
        for _ in 0..313 {
            log.note(&refused("10.0.0.66", late()));
        }
        log.note(&refused("10.0.0.7", Refusal::Certificate(CertError::NoCertificate)));
        let said = lines.take();
        assert_eq!(said.len(), 2, "{said:#?}");
        log.is_due().await;
        log.summarise();
        let said = lines.take();
        assert_eq!(said.len(), 1, "{said:#?}");
        let expected = "10.0.0.66 is refused: … and 312 more like it in 10 s (timed_out)";
        assert!(said[0].ends_with(expected), "{said:?}");
        // Other addresses do not help it either.
        for n in 0..10_000_u32 {
            log.note(&refused(&std::net::Ipv4Addr::from(0x0b00_0000 + n).to_string(), late()));
        }
        let said = lines.take();
        assert!(said.len() <= REPEAT_SOURCES_MAX, "{} lines", said.len());
        log.is_due().await;
        log.summarise();
        let said = lines.take();
        assert_eq!(said.len(), 1, "{said:#?}");
        assert!(said[0].contains("more from other addresses"), "{said:?}");
    }
}
