//! [`Gateway`]: programs without ROS at this node. Opens the hub when it is first needed, and its sockets where the
//! configuration has some.
//!
//! What clients do is the business of `sgc-gateway`. Its part of the local network is one of its own, which the node's
//! own sees as any program's: so shares and uses hold for its topics as for others.

use std::sync::Arc;

use sgc_gateway::{
    Access, Client, FindDefinitions, GatewayError, GatewayStatus, Hub, HubOptions, ListenAt, LocalRos,
    Server, ServerError, ServerOptions, Session, SessionLimits, Types,
};
use sgc_ros::RosError;
use tokio::sync::{Mutex, OnceCell};

/// Opens the gateway's part of the local network; may block.
pub type OpenLocalRos = Arc<dyn Fn() -> Result<Arc<dyn LocalRos>, RosError> + Send + Sync>;

/// What the gateway's ROS 2 node is called, before the name of the SGC node.
const NODE_PREFIX: &str = "sgc_gateway_";

/// What the sockets are to be.
pub(crate) struct Sockets {
    pub(crate) listen: Vec<ListenAt>,
    pub(crate) access: Access,
    pub(crate) key: Option<Arc<rustls::sign::CertifiedKey>>,
    pub(crate) clients_max: usize,
    pub(crate) client_bytes_max: usize,
}

/// Programs without ROS at this node.
pub(crate) struct Gateway {
    /// None where there is no local network.
    open: Option<OpenLocalRos>,
    types: Mutex<Option<Types>>,
    /// The SGC node's name.
    name: String,
    /// The ROS 2 node's.
    node: String,
    hub: OnceCell<Hub>,
    server: Mutex<Option<Server>>,
}

impl Gateway {
    pub(crate) fn new(
        open: Option<OpenLocalRos>,
        node_name: &str,
        definitions: impl FindDefinitions,
    ) -> Arc<Self> {
        let fits = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
        let node = NODE_PREFIX.chars().chain(node_name.chars().map(fits)).collect();
        let (types, hub, server) =
            (Mutex::new(Some(Types::new(definitions))), OnceCell::new(), Mutex::new(None));
        Arc::new(Self { open, types, name: node_name.to_owned(), node, hub, server })
    }

    /// The hub, which joins the local network if it has not yet.
    pub(crate) async fn hub(&self) -> Result<&Hub, GatewayError> {
        self.hub
            .get_or_try_init(|| async {
                let open = self.open.clone().ok_or_else(|| {
                    let reason = "this node has no local ROS 2 network: it is only a router".to_owned();
                    GatewayError::Ros(RosError::Domain { domain: 0, reason })
                })?;
                let opened = tokio::task::spawn_blocking(move || open()).await;
                let ros = opened.map_err(|_| GatewayError::Stopping)??;
                let types = self.types.lock().await.take().ok_or(GatewayError::Stopping)?;
                Hub::start(ros, types, HubOptions { node: self.node.clone() }).await
            })
            .await
    }

    /// A session of the user that runs the node, who may everything.
    pub(crate) async fn own_session(&self) -> Result<Session, GatewayError> {
        Ok(Session::new(self.hub().await?, Client::own("the command line"), SessionLimits::default()))
    }

    /// Opens the sockets.
    pub(crate) async fn listen(&self, sockets: Sockets) -> Result<(), GatewayStartError> {
        let limits =
            SessionLimits { waiting_bytes_max: sockets.client_bytes_max, ..SessionLimits::default() };
        let Sockets { listen, access, key, clients_max, .. } = sockets;
        let name = format!("sgc {}", self.name);
        let options = ServerOptions { name, listen, access, key, clients_max, limits };
        let server = Server::start(self.hub().await?.clone(), options).await?;
        *self.server.lock().await = Some(server);
        Ok(())
    }

    /// Other rules and another certificate from now on.
    pub(crate) async fn reconfigure(
        &self,
        access: Access,
        key: Option<&Arc<rustls::sign::CertifiedKey>>,
    ) -> Result<(), ServerError> {
        match &*self.server.lock().await {
            Some(server) => server.reconfigure(access, key),
            None => Ok(()),
        }
    }

    /// What goes on, if there are sockets.
    pub(crate) async fn status(&self) -> Option<GatewayStatus> {
        self.server.lock().await.as_ref().map(Server::status)
    }

    /// Ends the sockets, and leaves the local network.
    pub(crate) async fn stop(&self) {
        drop(self.server.lock().await.take());
        if let Some(hub) = self.hub.get() {
            hub.stop().await;
        }
    }
}

/// Why the gateway does not start.
#[derive(Debug, thiserror::Error)]
pub enum GatewayStartError {
    /// The local network, or what is on it.
    #[error(transparent)]
    Hub(#[from] GatewayError),
    /// Its sockets.
    #[error(transparent)]
    Server(#[from] ServerError),
}
