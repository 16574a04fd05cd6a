//! [`Gateway`]: the part of a node that serves programs without ROS. It opens the hub when it is first needed, and its
//! sockets if the configuration has some.
//!
//! `sgc-gateway` serves the clients. The gateway is a participant of its own, which the node's own participant sees
//! like any program, so shares and uses apply to its topics as well.

pub(crate) mod access;
mod network;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use rustls::sign::CertifiedKey;
use sgc_cdr::{Layout, TypeName};
use sgc_config::{GatewayConfig, GatewayUrl};
use sgc_gateway::{
    Access, Client, FindDefinitions, GatewayError, GatewayStatus, Hub, HubOptions, ListenAt, LocalRos,
    NotListening, Server, ServerError, ServerOptions, Session, SessionLimits, TlsError, Types, certified_key,
};
use sgc_ros::{Reach, RosError};
use sgc_sync::lock;
use sgc_trust::{Identity, TrustAnchors};
use sgc_types::{Definitions, TypeStore};
use tokio::sync::OnceCell;
use zeroize::Zeroizing;

use self::network::{GatewayNetwork, HubNetwork};
use crate::control::faults::alerts::Alert;

/// Opens the gateway's part of the local network. May block.
pub type OpenLocalRos = Arc<dyn Fn() -> Result<Arc<dyn LocalRos>, RosError> + Send + Sync>;

/// Prefix of the gateway's ROS 2 node, before the name of the SGC node.
const NODE_PREFIX: &str = "sgc_gateway_";

/// Type definitions of this node: from files, and from other nodes' descriptions.
pub(crate) struct NodeDefinitions {
    pub(crate) files: Definitions,
    pub(crate) described: Arc<TypeStore>,
}

impl FindDefinitions for NodeDefinitions {
    fn text(&self, file: &TypeName) -> Option<String> {
        self.files.text(file)
    }

    fn described(&self, name: &TypeName, hash: Option<&str>) -> Option<Arc<Layout>> {
        self.described.layout(name, hash)
    }
}

/// Settings of the sockets.
pub(crate) struct Sockets {
    pub(crate) listen: Vec<ListenAt>,
    pub(crate) access: Access,
    pub(crate) key: ShownKey,
    pub(crate) clients_max: usize,
    pub(crate) client_bytes_max: usize,
}

/// The gateway of this node.
pub(crate) struct Gateway {
    /// Opens the local network; `None` if there is none.
    open: Mutex<Option<OpenLocalRos>>,
    definitions: Arc<dyn FindDefinitions>,
    /// Name of the SGC node.
    name: String,
    /// Name of the ROS 2 node.
    node: String,
    hub: OnceCell<Hub>,
    /// The network of the hub.
    network: Mutex<Option<Arc<GatewayNetwork>>>,
    server: Mutex<Option<Arc<Server>>>,
    /// Held while the shown certificates change, so that a reload does not undo a renewal.
    showing: Mutex<()>,
    /// Whether the shown certificate is the node's own, not one of the configuration.
    shows_own: AtomicBool,
}

impl Gateway {
    pub(crate) fn new(
        open: Option<OpenLocalRos>,
        node_name: &str,
        definitions: impl FindDefinitions,
    ) -> Arc<Self> {
        let fits = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
        let node = NODE_PREFIX.chars().chain(node_name.chars().map(fits)).collect();
        let definitions = Arc::new(definitions);
        let (hub, server) = (OnceCell::new(), Mutex::default());
        let (name, showing, shows_own) = (node_name.to_owned(), Mutex::default(), AtomicBool::default());
        let open = Mutex::new(open);
        let network = Mutex::default();
        Arc::new(Self { open, definitions, name, node, hub, network, server, showing, shows_own })
    }

    /// Sets how to open a local network that the node joined after its start.
    pub(crate) fn set_local_network(&self, open: Option<OpenLocalRos>) {
        *self.lock_open() = open;
    }

    fn lock_open(&self) -> MutexGuard<'_, Option<OpenLocalRos>> {
        lock(&self.open)
    }

    /// Returns the hub, and opens it first if needed. A later call tries again after an error.
    pub(crate) async fn hub(&self) -> Result<&Hub, GatewayError> {
        self.hub
            .get_or_try_init(|| async {
                let open = self.lock_open().clone().ok_or_else(|| {
                    let reason = "this node has no local ROS 2 network: it is only a router".to_owned();
                    GatewayError::Ros(RosError::Domain { domain: 0, reason })
                })?;
                let opened = tokio::task::spawn_blocking(move || GatewayNetwork::open(open)).await;
                let network = opened.map_err(|_| GatewayError::Stopping)??;
                let types = Types::new(Arc::clone(&self.definitions));
                let ros = Arc::new(HubNetwork(Arc::clone(&network)));
                let hub = Hub::start(ros, types, HubOptions { node: self.node.clone() }).await?;
                *lock(&self.network) = Some(network);
                Ok(hub)
            })
            .await
    }

    /// Returns the reach of the hub's network, if it is open.
    pub(crate) fn reach(&self) -> Reach {
        self.network().map_or(Reach::Whole, |network| HubNetwork(network).reach())
    }

    /// Returns `true` if the hub's network would reach more if it were opened again. May block.
    pub(crate) fn gains_by_reopening(&self) -> Result<bool, RosError> {
        self.network().map_or(Ok(false), |network| HubNetwork(network).gains_by_reopening())
    }

    /// Closes the hub's network, if it is open. Clients stay connected.
    pub(crate) async fn close_network(&self, max: Duration) {
        if let Some(network) = self.network() {
            let _ = tokio::task::spawn_blocking(move || network.close_for_now(max)).await;
        }
    }

    /// Opens the hub's network again after [`Self::close_network`].
    pub(crate) async fn open_network(&self) -> Result<(), RosError> {
        let Some(network) = self.network() else { return Ok(()) };
        let opening = Arc::clone(&network);
        if let Ok(Err(error)) = tokio::task::spawn_blocking(move || opening.open_again()).await {
            return Err(error);
        }
        if let Some(deadline) = network.rediscovery_deadline() {
            tokio::spawn(async move {
                tokio::time::sleep_until(deadline.into()).await;
                network.rediscovery_due(deadline);
            });
        }
        Ok(())
    }

    fn network(&self) -> Option<Arc<GatewayNetwork>> {
        lock(&self.network).clone()
    }

    /// Opens a session with all rights for the user who runs the node.
    pub(crate) async fn own_session(&self) -> Result<Session, GatewayError> {
        Ok(Session::new(self.hub().await?, Client::own("the command line"), SessionLimits::default()))
    }

    /// Opens the sockets.
    pub(crate) async fn listen(&self, sockets: Sockets) -> Result<(), GatewayStartError> {
        let limits =
            SessionLimits { waiting_bytes_max: sockets.client_bytes_max, ..SessionLimits::default() };
        let Sockets { listen, access, key, clients_max, .. } = sockets;
        let name = format!("sgc {}", self.name);
        let key = {
            let _showing = self.lock_showing();
            self.shows_own.store(matches!(key, ShownKey::Own(_)), Ordering::Relaxed);
            key.certified()
        };
        let options = ServerOptions { name, listen, access, key: Some(key), clients_max, limits };
        let server = Server::start(self.hub().await?.clone(), options).await?;
        *self.lock() = Some(Arc::new(server));
        Ok(())
    }

    /// Listens at these addresses from here on, and at no others, if there are sockets.
    pub(crate) async fn listen_elsewhere(&self, listen: Vec<ListenAt>) -> Result<(), ServerError> {
        match self.server() {
            Some(server) => server.listen(listen).await,
            None => Ok(()),
        }
    }

    /// Closes the sockets, waits until their ports are free, and disconnects their clients.
    pub(crate) async fn close_sockets(&self) {
        let server = self.lock().take();
        if let Some(server) = server {
            // Without addresses nothing can fail.
            let _ = server.listen(Vec::new()).await;
        }
    }

    /// Returns an alert for each address at which it should listen and does not.
    pub(crate) fn alerts(&self) -> Vec<Alert> {
        let not_listening = self.server().map(|server| server.not_listening()).unwrap_or_default();
        let alert = |NotListening { at, reason }: NotListening| Alert::GatewayNotListening {
            at: at.to_string(),
            reason,
        };
        not_listening.into_iter().map(alert).collect()
    }

    /// Replaces the rules and the certificate. Returns `true` if the certificate changed. `key` is called at the moment
    /// of replacement.
    pub(crate) fn reconfigure(
        &self,
        access: Access,
        key: impl FnOnce() -> ShownKey,
    ) -> Result<bool, ServerError> {
        let Some(server) = self.server() else { return Ok(false) };
        let _showing = self.lock_showing();
        let before = server.shown();
        let key = key();
        let shows_own = matches!(key, ShownKey::Own(_));
        let key = key.certified();
        server.reconfigure(access, Some(&key))?;
        self.shows_own.store(shows_own, Ordering::Relaxed);
        Ok(server.shown() != before)
    }

    /// Changes the number of clients that may be connected at once.
    pub(crate) fn set_clients_max(&self, clients_max: usize) {
        if let Some(server) = self.server() {
            server.set_clients_max(clients_max);
        }
    }

    /// Shows the node's renewed certificate to new connections, unless the configuration names another.
    pub(crate) fn set_identity(&self, identity: &Identity) {
        let Some(server) = self.server() else { return };
        let _showing = self.lock_showing();
        server.set_gateway(identity.as_peer().clone());
        if !self.shows_own.load(Ordering::Relaxed) {
            return;
        }
        if let Err(error) = server.show(&identity.certified_key()) {
            tracing::warn!(%error, "the gateway cannot show the renewed certificate");
        }
    }

    fn lock_showing(&self) -> MutexGuard<'_, ()> {
        lock(&self.showing)
    }

    /// Returns the status, if there are sockets.
    pub(crate) fn status(&self) -> Option<GatewayStatus> {
        self.server().map(|server| server.status())
    }

    /// Replaces the trust anchors. Clients with a revoked certificate are disconnected.
    pub(crate) fn set_anchors(&self, anchors: &TrustAnchors) {
        if let Some(server) = self.server() {
            server.set_anchors(anchors.clone());
        }
    }

    fn server(&self) -> Option<Arc<Server>> {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, Option<Arc<Server>>> {
        lock(&self.server)
    }

    /// Closes the sockets and leaves the local network.
    pub(crate) async fn stop(&self) {
        self.close_sockets().await;
        if let Some(hub) = self.hub.get() {
            hub.stop().await;
        }
    }
}

/// Reasons why the gateway does not start.
#[derive(Debug, thiserror::Error)]
pub enum GatewayStartError {
    /// The hub cannot be opened.
    #[error(transparent)]
    Hub(#[from] GatewayError),
    /// The sockets cannot be opened.
    #[error(transparent)]
    Server(#[from] ServerError),
    /// The certificate or key file cannot be read.
    #[error("the gateway's {}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// TLS cannot use the certificate or key.
    #[error("the gateway's {}: {source}", path.display())]
    Certificate {
        /// The certificate.
        path: PathBuf,
        /// The fault.
        source: TlsError,
    },
}

/// The certificate that the gateway shows within TLS.
pub(crate) enum ShownKey {
    /// The certificate that the configuration names.
    Files(Arc<CertifiedKey>),
    /// The certificate of the node itself.
    Own(Arc<Identity>),
}

impl ShownKey {
    fn certified(self) -> Arc<CertifiedKey> {
        match self {
            Self::Files(key) => key,
            Self::Own(identity) => identity.certified_key(),
        }
    }
}

/// Reads the certificate and key that the configuration names; `None` if the node's own are shown.
pub(crate) fn key_of_files(config: &GatewayConfig) -> Result<Option<Arc<CertifiedKey>>, GatewayStartError> {
    let Some(tls) = &config.tls else { return Ok(None) };
    let read = |path: &Path| {
        fs::read(path).map_err(|source| GatewayStartError::File { path: path.to_owned(), source })
    };
    let (certificate, key) = (read(&tls.certificate)?, Zeroizing::new(read(&tls.key)?));
    let key = certified_key(&certificate, &key)
        .map_err(|source| GatewayStartError::Certificate { path: tls.certificate.clone(), source })?;
    Ok(Some(key))
}

/// Returns the listen addresses in the form of `sgc-gateway`.
pub(crate) fn listen_at(config: &GatewayConfig) -> Vec<ListenAt> {
    let at = |url: &GatewayUrl| ListenAt {
        protocol: url.scheme.protocol(),
        is_encrypted: url.scheme.is_encrypted(),
        addr: url.address,
    };
    config.listen.iter().map(at).collect()
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use sgc_gateway::{LocalReader, Protocol, ShippedDefinitions};
    use sgc_ros::{
        DiscoveryHandler, EndpointSpec, GraphNode, RequestHandler, RosClient, RosServer, RosWriter,
        SampleHandler, ServiceSpec,
    };
    use sgc_testkit::FakeDomain;
    use sgc_trust::{EnrollRequest, Fleet};
    use sgc_wire::UnixMillis;

    use super::*;

    /// A network whose discovery fails.
    struct Undiscovered(HubNetwork);

    impl LocalRos for Undiscovered {
        fn discover(&self, _: DiscoveryHandler) -> Result<(), RosError> {
            Err(RosError::Closed)
        }

        fn reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<LocalReader, RosError> {
            self.0.reader(spec, handler)
        }

        fn writer(&self, spec: &EndpointSpec) -> Result<Box<dyn RosWriter>, RosError> {
            self.0.writer(spec)
        }

        fn client(
            &self,
            spec: &ServiceSpec,
            handler: RequestHandler,
        ) -> Result<Box<dyn RosClient>, RosError> {
            self.0.client(spec, handler)
        }

        fn server(
            &self,
            spec: &ServiceSpec,
            handler: RequestHandler,
        ) -> Result<Box<dyn RosServer>, RosError> {
            self.0.server(spec, handler)
        }

        fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
            self.0.announce(nodes)
        }

        fn reach(&self) -> Reach {
            self.0.reach()
        }

        fn gains_by_reopening(&self) -> Result<bool, RosError> {
            self.0.gains_by_reopening()
        }

        fn close(self: Arc<Self>, _: Duration) -> bool {
            true
        }
    }

    #[tokio::test]
    async fn hub_starts_at_a_later_attempt_after_discovery_failed() {
        let domain = FakeDomain::default();
        let open: OpenLocalRos = Arc::new(move || Ok(Arc::new(domain.join(false)) as Arc<dyn LocalRos>));
        let network = GatewayNetwork::open(Arc::clone(&open)).unwrap();
        let undiscovered: OpenLocalRos = Arc::new(move || {
            Ok(Arc::new(Undiscovered(HubNetwork(Arc::clone(&network)))) as Arc<dyn LocalRos>)
        });
        let gateway = Gateway::new(Some(undiscovered), "arm-1", ShippedDefinitions);
        assert_eq!(gateway.hub().await.unwrap_err(), GatewayError::Ros(RosError::Closed));
        gateway.set_local_network(Some(open));
        gateway.hub().await.unwrap();
        gateway.stop().await;
    }

    #[tokio::test]
    async fn a_renewed_certificate_is_shown_and_a_reload_does_not_undo_it() {
        let (rng, now) = (&mut ChaCha20Rng::seed_from_u64(8), UnixMillis(1_795_000_000_000));
        let mut fleet = Fleet::create("lab".parse().unwrap(), now, rng).unwrap();
        let mut enroll = |name: &str| {
            Arc::new(fleet.enroll(&EnrollRequest::new(name.parse().unwrap(), now), rng).unwrap())
        };
        let (first, renewed, file) = (enroll("one"), enroll("two"), enroll("file"));
        let domain = FakeDomain::default();
        let open: OpenLocalRos = Arc::new(move || Ok(Arc::new(domain.join(false)) as Arc<dyn LocalRos>));
        let gateway = Gateway::new(Some(open), "arm-1", ShippedDefinitions);
        let at =
            ListenAt { protocol: Protocol::WebSocket, is_encrypted: true, addr: ([127, 0, 0, 1], 0).into() };
        let sockets = Sockets {
            listen: vec![at],
            access: Access::default(),
            key: ShownKey::Own(Arc::clone(&first)),
            clients_max: 8,
            client_bytes_max: 1 << 20,
        };
        gateway.listen(sockets).await.unwrap();
        let shown = || gateway.server().unwrap().shown();
        assert_eq!(shown(), first.chain());
        gateway.set_identity(&renewed);
        assert_eq!(shown(), renewed.chain());
        let reload = |key: ShownKey| gateway.reconfigure(Access::default(), || key).unwrap();
        assert!(!reload(ShownKey::Own(Arc::clone(&renewed))), "it is the same");
        // The node's certificate is not shown if the configuration names another one.
        assert!(reload(ShownKey::Files(file.certified_key())));
        gateway.set_identity(&first);
        assert_eq!(shown(), file.chain());
        assert!(reload(ShownKey::Own(first)));
        gateway.stop().await;
    }
}
