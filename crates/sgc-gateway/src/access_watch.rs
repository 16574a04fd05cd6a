//! [`AccessWatch`]: the rules in force, and the time at which a client's rights end: by revocation of a token or
//! certificate, by expiry or by a reload.
//!
//! No other mechanism ends sessions for their rights. Every protocol waits for it by
//! [`Session::until_denied`](crate::Session::until_denied). Nothing is polled: the rules announce changes, and a
//! timer ends with a right.

use std::fmt;
use std::sync::Arc;

use sgc_wire::UnixMillis;
use tokio::sync::watch;

use crate::access::{Access, Client, Denial};
use crate::clock::WallClock;

/// The rules in force. Clones share.
#[derive(Clone)]
pub struct AccessWatch {
    rules: Arc<watch::Sender<Access>>,
    clock: WallClock,
}

impl fmt::Debug for AccessWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AccessWatch").field("clock", &self.clock).finish_non_exhaustive()
    }
}

impl AccessWatch {
    /// Creates a watch of these rules with this clock.
    pub fn new(access: Access, clock: WallClock) -> Self {
        Self { rules: Arc::new(watch::Sender::new(access)), clock }
    }

    /// Returns the current rules.
    pub fn current(&self) -> Access {
        self.rules.borrow().clone()
    }

    /// Replaces the rules. Sessions of clients that the new rules do not admit end.
    pub fn change(&self, change: impl FnOnce(&Access) -> Access) {
        self.rules.send_modify(|access| *access = change(access));
    }

    /// Returns the time by which rights end.
    pub fn now(&self) -> UnixMillis {
        self.clock.now()
    }

    /// Waits until a client's rights end and returns the reason.
    pub async fn until_denied(&self, client: &Client) -> Denial {
        let mut rules = self.rules.subscribe();
        loop {
            let current = rules.borrow_and_update().clone();
            if let Err(denied) = current.still_admits(client, self.now()) {
                return denied;
            }
            let expires = async {
                match client.expires {
                    Some(end) => self.clock.passes(end).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                // The sender lives as long as `self`, so it cannot be gone.
                _ = rules.changed() => {}
                () = expires => {}
            }
        }
    }
}
