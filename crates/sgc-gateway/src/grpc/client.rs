//! [`Clients`]: the admission of gRPC clients.

use std::sync::{Arc, Weak};

use aws_lc_rs::digest::{SHA256, digest};
use sgc_sync::lock;
use tokio::sync::watch;
use tonic::{Request, Status};

use super::connection::Connection;
use super::fault::Fault;
use super::guest::{Guest, GuestEntry, Proof};
use super::options::GrpcOptions;
use crate::access::{AdmissionRequest, Client, ORIGIN_BYTES_MAX};
use crate::access_watch::AccessWatch;
use crate::error::GatewayError;
use crate::hub::Hub;
use crate::session::Session;

/// Most credentials in use on one connection at a time.
const CREDENTIALS_MAX: usize = 16;

/// The admission of clients.
pub(super) struct Clients {
    hub: Hub,
    access: AccessWatch,
    options: GrpcOptions,
    stopping: watch::Receiver<bool>,
}

impl Clients {
    pub(super) fn new(
        hub: Hub,
        access: AccessWatch,
        options: GrpcOptions,
        stopping: watch::Receiver<bool>,
    ) -> Self {
        Self { hub, access, options, stopping }
    }

    pub(super) fn hub(&self) -> &Hub {
        &self.hub
    }

    /// Returns the guest that makes a request.
    pub(super) fn admit(&self, request: &Request<()>) -> Result<Arc<Guest>, Status> {
        Ok(self.find(request)?)
    }

    fn find(&self, request: &Request<()>) -> Result<Arc<Guest>, Fault> {
        // A dropped sender means that the front end is gone.
        if *self.stopping.borrow() || self.stopping.has_changed().is_err() {
            return Err(GatewayError::Stopping.into());
        }
        let connection = request.extensions().get::<Connection>().ok_or(Fault::NoConnection)?;
        let text = |name: &str| request.metadata().get(name).map(|value| value.to_str());
        let token = match text("authorization").transpose().map_err(|_| Fault::Authorization)? {
            Some(header) => Some(bearer(header).ok_or(Fault::Authorization)?),
            None => None,
        };
        // An origin that is not text counts as an unknown origin.
        let origin = text("origin").map(|origin| origin.unwrap_or("?"));
        if token.is_none() && origin.is_some_and(|origin| origin.len() > ORIGIN_BYTES_MAX) {
            return Err(Fault::Origin { max: ORIGIN_BYTES_MAX });
        }
        let shown = Proof {
            origin: origin.filter(|_| token.is_none()).map(Box::from),
            token: token.map(|token| {
                let mut hash = [0; 32];
                hash.copy_from_slice(digest(&SHA256, token.as_bytes()).as_ref());
                hash
            }),
        };
        let access = self.access.current();
        let mut known = lock(connection.known());
        if let Some(at) = known.iter().position(|known| known.shown == shown) {
            let guest = &known[at].guest;
            match access.still_admits(guest.session.client(), self.access.now()) {
                Ok(()) if !guest.has_ended() => return Ok(Arc::clone(guest)),
                Ok(()) => drop(known.remove(at)),
                // The current rules may admit the client anew.
                Err(why) => known.remove(at).guest.end(why),
            }
        }
        let client = access.admit(&AdmissionRequest {
            peer: connection.peer(),
            encrypted: connection.is_encrypted(),
            origin,
            token,
            certificate: connection.certificate(),
            now: self.access.now(),
        });
        let client = client.map_err(|why| {
            tracing::debug!(%why, peer = %connection.peer(), "a gRPC client is not admitted");
            Fault::Denied(why)
        })?;
        tracing::debug!(client = %client.name, peer = %connection.peer(), "a gRPC client is admitted");
        if known.len() >= CREDENTIALS_MAX {
            let idle = known.iter().position(|known| Arc::strong_count(&known.guest) == 1);
            known.remove(idle.ok_or(Fault::Credentials { max: CREDENTIALS_MAX })?);
        }
        let session = Session::new(&self.hub, client.clone(), self.options.session);
        let guest = Arc::new_cyclic(|guest| {
            let watched = watch_over(guest.clone(), self.access.clone(), client, self.stopping.clone());
            Guest::new(
                session.admitted_by(self.access.clone()),
                connection.serving_task(),
                tokio::spawn(watched).abort_handle(),
                [self.options.unread_bytes_max, self.options.incoming_bytes_max],
            )
        });
        known.push(GuestEntry { shown, guest: Arc::clone(&guest) });
        Ok(guest)
    }
}

/// Returns the token in an `authorization` header.
fn bearer(header: &str) -> Option<&str> {
    let (scheme, token) = header.split_once(' ')?;
    let token = token.trim();
    (scheme.eq_ignore_ascii_case("bearer") && !token.is_empty()).then_some(token)
}

/// Ends a guest when its rights end or the front end stops. Dropping the guest aborts this task.
async fn watch_over(
    guest: Weak<Guest>,
    access: AccessWatch,
    client: Client,
    mut stopping: watch::Receiver<bool>,
) {
    let denied = tokio::select! {
        denied = access.until_denied(&client) => Some(denied),
        _ = stopping.wait_for(|is_stopping| *is_stopping) => None,
    };
    // A guest under construction appears shortly, and a dropped guest aborts this task.
    let guest = loop {
        match guest.upgrade() {
            Some(guest) => break guest,
            None => tokio::task::yield_now().await,
        }
    };
    match denied {
        Some(why) => guest.end(why),
        None => guest.end_with(GatewayError::Stopping.into()),
    }
}
