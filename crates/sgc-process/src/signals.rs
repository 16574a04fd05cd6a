//! The signals that end a process, and the standard input that a parent may hold open.

use std::io::Read;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;

use crate::error::ProcessError;

/// Exit code for a failure while running.
pub const EXIT_FAILURE: u8 = 1;
/// Time that a process has to end by itself once the parent that holds its standard input is gone.
pub const ORPHAN_GRACE: Duration = Duration::from_secs(5);

/// Returns a receiver that becomes ready when standard input ends, which also happens when the parent dies. If the
/// process still runs [`ORPHAN_GRACE`] later, it is ended.
pub fn stdin_closed() -> oneshot::Receiver<()> {
    let (closed, when_closed) = oneshot::channel();
    // A plain thread, because a runtime would wait for one of its own at shutdown.
    std::thread::spawn(move || {
        let mut buffer = [0; 256];
        while !matches!(std::io::stdin().lock().read(&mut buffer), Ok(0) | Err(_)) {}
        let _ = closed.send(());
        exit_after_grace();
    });
    when_closed
}

/// Blocks for [`ORPHAN_GRACE`], then ends the process.
pub fn exit_after_grace() {
    std::thread::sleep(ORPHAN_GRACE);
    std::process::exit(EXIT_FAILURE.into());
}

/// The signals that ask a process to end.
pub struct EndSignals {
    interrupt: Signal,
    terminate: Signal,
    hang_up: Option<Signal>,
}

impl EndSignals {
    /// Starts to listen for the signals. Needs a runtime.
    pub fn new() -> Result<Self, ProcessError> {
        Ok(Self { hang_up: Some(listen(SignalKind::hangup())?), ..Self::without_hang_up()? })
    }

    /// Starts to listen for the signals except SIGHUP, which means something else to a node.
    pub fn without_hang_up() -> Result<Self, ProcessError> {
        let (interrupt, terminate) = (listen(SignalKind::interrupt())?, listen(SignalKind::terminate())?);
        Ok(Self { interrupt, terminate, hang_up: None })
    }

    /// Waits for the next signal.
    pub async fn next(&mut self) {
        let Self { interrupt, terminate, hang_up } = self;
        let hung_up = async {
            match hang_up {
                Some(signal) => drop(signal.recv().await),
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            () = hung_up => {}
        }
    }

    /// Ends the process at the next signal.
    pub fn end_at_once(mut self) {
        tokio::spawn(async move {
            self.next().await;
            std::process::exit(EXIT_FAILURE.into());
        });
    }
}

/// Starts to listen for a signal. Needs a runtime.
pub fn listen(kind: SignalKind) -> Result<Signal, ProcessError> {
    signal(kind).map_err(|source| ProcessError::System { what: "cannot listen for signals", source })
}
