//! [`WebSocketFront`]: connections over WebSocket, from the upgrade to the end of the client's protocol. The
//! subprotocol selects the protocol.

use std::sync::Arc;

use tokio::time::Instant;

use super::stream::ByteStream;
use crate::access::Denial;
use crate::admission::{Admission, Arrival, Handshake, Place};
#[cfg(feature = "foxglove")]
use crate::foxglove::{self, FoxgloveError};
use crate::hub::Hub;
use crate::inflow::{Inflow, MeteredStream};
use crate::limits::SessionLimits;
use crate::refusal::ClientRefusal;
#[cfg(feature = "rosbridge")]
use crate::rosbridge::{self, Authenticate, RosbridgeError, RosbridgeOptions};
use crate::session::Session;
use crate::ws::{Subprotocols, Upgrade, UpgradeError, finish, upgrade};

/// The subprotocols of this build. Without one, a client speaks the rosbridge protocol.
const SUBPROTOCOLS: Subprotocols = Subprotocols {
    #[cfg(feature = "foxglove")]
    known: &foxglove::SUBPROTOCOLS,
    #[cfg(not(feature = "foxglove"))]
    known: &[],
    is_needed: cfg!(not(feature = "rosbridge")),
};

/// Close code for a client that finds no place (1013, "try again later", of IANA's registry for RFC 6455, 11.7). Pages
/// in browsers see close codes, and no HTTP status of a refused upgrade.
const TRY_AGAIN_LATER: u16 = 1013;

/// A protocol over WebSocket.
#[derive(Clone, Copy)]
enum Dialect {
    #[cfg(feature = "rosbridge")]
    Rosbridge,
    #[cfg(feature = "foxglove")]
    Foxglove,
}

impl Dialect {
    /// Returns the protocol of a negotiated subprotocol.
    fn from_subprotocol(subprotocol: Option<&str>) -> Option<Self> {
        match subprotocol {
            #[cfg(feature = "foxglove")]
            Some(_) => Some(Self::Foxglove),
            #[cfg(feature = "rosbridge")]
            None => Some(Self::Rosbridge),
            #[cfg(not(all(feature = "foxglove", feature = "rosbridge")))]
            _ => None,
        }
    }

    fn as_str(self) -> &'static str {
        match self {
            #[cfg(feature = "rosbridge")]
            Self::Rosbridge => "rosbridge",
            #[cfg(feature = "foxglove")]
            Self::Foxglove => "foxglove",
        }
    }
}

/// The front end for the protocols over WebSocket.
pub(super) struct WebSocketFront {
    hub: Hub,
    admission: Arc<Admission>,
    limits: SessionLimits,
    #[cfg(feature = "foxglove")]
    foxglove: foxglove::Options,
}

impl WebSocketFront {
    /// Serves a hub. `name` is the name that programs display.
    pub(super) fn new(hub: Hub, admission: Arc<Admission>, limits: SessionLimits, name: String) -> Self {
        #[cfg(not(feature = "foxglove"))]
        drop(name);
        Self {
            hub,
            admission,
            limits,
            #[cfg(feature = "foxglove")]
            foxglove: foxglove::Options { name, ..foxglove::Options::default() },
        }
    }

    /// Upgrades a connection by the deadline, and serves its client.
    pub(super) async fn serve(
        &self,
        stream: Box<dyn ByteStream>,
        arrival: Arrival,
        deadline: Instant,
        mut handshake: Handshake,
    ) {
        let (admission, peer) = (&self.admission, arrival.peer);
        let inflow: Arc<Inflow> = Arc::default();
        let stream = MeteredStream::new(stream, Arc::clone(&inflow));
        let upgraded = tokio::select! {
            upgraded = tokio::time::timeout_at(deadline, upgrade(stream, &arrival, admission, SUBPROTOCOLS)) => upgraded,
            () = handshake.evicted() => return admission.count(ClientRefusal::HandshakeGaveWay),
        };
        match upgraded {
            Ok(Ok(upgraded)) => {
                // `upgrade` refuses clients without a protocol of this build.
                let Some(dialect) = Dialect::from_subprotocol(upgraded.subprotocol) else { return };
                match admission.enter(&upgraded.client, dialect.as_str(), peer) {
                    Ok(place) => {
                        drop(handshake);
                        self.speak(dialect, upgraded, place, arrival, inflow).await;
                    }
                    Err(why) => {
                        tracing::debug!(%peer, client = %upgraded.client.name, %why, "a client finds no place");
                        let why = why.to_string();
                        // The refusal keeps the place of its handshake, so that refusals are bounded.
                        tokio::select! {
                            () = finish(upgraded.socket, &inflow, Some((TRY_AGAIN_LATER, &why))) => {}
                            () = handshake.evicted() => {}
                        }
                    }
                }
            }
            Ok(Err(UpgradeError::NotAdmitted)) => {}
            Ok(Err(UpgradeError::Socket(error))) => {
                tracing::debug!(%peer, %error, "no WebSocket");
                admission.count(ClientRefusal::NoWebSocket);
            }
            Err(_) => admission.count(ClientRefusal::HandshakeTooSlow),
        }
    }

    /// Serves a client until it leaves or its rights end.
    async fn speak(
        &self,
        dialect: Dialect,
        upgraded: Upgrade<MeteredStream<Box<dyn ByteStream>>>,
        place: Place,
        arrival: Arrival,
        inflow: Arc<Inflow>,
    ) {
        let (admission, peer, client) = (&self.admission, arrival.peer, upgraded.client);
        let place = Arc::new(place);
        let name = Arc::clone(&client.name);
        let session = Session::new(&self.hub, client, self.limits).admitted_by(admission.rules().clone());
        let session = session.metered_by(inflow);
        let ended = match dialect {
            #[cfg(feature = "foxglove")]
            Dialect::Foxglove => {
                let served = foxglove::serve(upgraded.socket, Arc::new(session), self.foxglove.clone());
                served.await.map_err(EndReason::from)
            }
            #[cfg(feature = "rosbridge")]
            Dialect::Rosbridge => {
                let (asked, place) = (Arc::clone(admission), Arc::clone(&place));
                // A token after the upgrade changes the credential of the client.
                let authenticate: Authenticate = Arc::new(move |token| {
                    let admitted = asked.admit(&arrival, None, Some(token));
                    let client = admitted.map_err(|denied| denied.client_message().to_owned())?;
                    place.rename(&client).map_err(|why| why.to_string())?;
                    Ok(client)
                });
                let options =
                    RosbridgeOptions { authenticate: Some(authenticate), ..RosbridgeOptions::default() };
                let served = rosbridge::serve(upgraded.socket, Arc::new(session), options);
                served.await.map_err(EndReason::from)
            }
        };
        drop(place);
        match ended {
            Ok(()) => {}
            Err(EndReason::Denied(denied)) => {
                admission.count(ClientRefusal::NoLongerAdmitted);
                tracing::info!(client = %name, %denied, "a client is disconnected");
            }
            Err(EndReason::Failed(error)) => tracing::debug!(%peer, %error, "a client's connection failed"),
        }
    }
}

/// The reason why a connection ended without the client's wish.
enum EndReason {
    /// The client's rights ended.
    Denied(Denial),
    /// The connection failed.
    Failed(String),
}

#[cfg(feature = "rosbridge")]
impl From<RosbridgeError> for EndReason {
    fn from(error: RosbridgeError) -> Self {
        match error {
            RosbridgeError::Denied(denied) => Self::Denied(denied),
            error => Self::Failed(error.to_string()),
        }
    }
}

#[cfg(feature = "foxglove")]
impl From<FoxgloveError> for EndReason {
    fn from(error: FoxgloveError) -> Self {
        match error {
            FoxgloveError::Denied(denied) => Self::Denied(denied),
            error => Self::Failed(error.to_string()),
        }
    }
}
