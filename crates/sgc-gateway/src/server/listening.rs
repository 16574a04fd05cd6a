//! A listening address of the gateway. One that cannot be bound is tried again, so a taken port stops nothing else.

use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sgc_sync::lock;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::{ListenAt, ServerState, keep_accepting};

/// Interval between attempts to bind.
const BIND_AGAIN: Duration = Duration::from_secs(5);

/// An address at which the gateway should listen and does not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NotListening {
    /// The address.
    pub at: ListenAt,
    /// The error of the system.
    pub reason: String,
}

/// A wanted address with its listener. Dropping it closes the address and the connections that came over it.
pub(super) struct Listening {
    wanted: ListenAt,
    state: Arc<Mutex<State>>,
    task: JoinHandle<()>,
    /// Disconnected with the address, for connections that have tasks of their own.
    _open: watch::Sender<()>,
}

enum State {
    /// It listens there; the port is known.
    Bound(ListenAt),
    Failing(String),
}

impl Listening {
    /// Listens at an address as soon as that is possible.
    pub(super) async fn begin(wanted: ListenAt, shared: Arc<ServerState>) -> Self {
        let first = bind(wanted).await;
        let state = Arc::new(Mutex::new(State::Failing(String::new())));
        note(&state, wanted, &first);
        let (open, is_open) = watch::channel(());
        let task = tokio::spawn(keep_listening(wanted, first, Arc::clone(&state), shared, is_open));
        Self { wanted, state, task, _open: open }
    }

    /// Returns the wanted address.
    pub(super) fn wanted(&self) -> ListenAt {
        self.wanted
    }

    /// Returns the address at which it listens, if it does.
    pub(super) fn local(&self) -> Option<ListenAt> {
        match &*lock(&self.state) {
            State::Bound(at) => Some(*at),
            State::Failing(_) => None,
        }
    }

    /// Returns why it does not listen, unless it does.
    pub(super) fn fault(&self) -> Option<NotListening> {
        match &*lock(&self.state) {
            State::Bound(_) => None,
            State::Failing(reason) => Some(NotListening { at: self.wanted, reason: reason.clone() }),
        }
    }

    /// Closes the address, and waits until it is free.
    pub(super) async fn end(mut self) {
        self.task.abort();
        let _ = (&mut self.task).await;
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        self.task.abort();
    }
}

type Bound = io::Result<(TcpListener, ListenAt)>;

async fn bind(at: ListenAt) -> Bound {
    let listener = TcpListener::bind(at.addr).await?;
    let addr = listener.local_addr()?;
    Ok((listener, ListenAt { addr, ..at }))
}

/// Records the result of an attempt, and logs it unless it is that of the attempt before.
fn note(state: &Mutex<State>, wanted: ListenAt, attempt: &Bound) {
    let mut state = lock(state);
    match attempt {
        Ok((_, at)) => {
            tracing::info!("programs without ROS may connect at {at}");
            *state = State::Bound(*at);
        }
        Err(error) => {
            let reason = error.to_string();
            if !matches!(&*state, State::Failing(before) if *before == reason) {
                tracing::warn!("the gateway cannot listen on {wanted}: {reason}; trying again");
            }
            *state = State::Failing(reason);
        }
    }
}

async fn keep_listening(
    wanted: ListenAt,
    first: Bound,
    state: Arc<Mutex<State>>,
    shared: Arc<ServerState>,
    open: watch::Receiver<()>,
) {
    let mut attempt = first;
    loop {
        if let Ok((listener, at)) = attempt {
            return keep_accepting(listener, at, shared, open).await;
        }
        tokio::time::sleep(BIND_AGAIN).await;
        attempt = bind(wanted).await;
        note(&state, wanted, &attempt);
    }
}
