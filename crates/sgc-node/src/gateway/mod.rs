//! [`Gateway`]: the part of a node that serves programs without ROS. It opens the hub when it is first needed, and its
//! sockets if the configuration has some.
//!
//! `sgc-gateway` serves the clients. The gateway is a participant of its own, which the node's own participant sees
//! like any program, so shares and uses apply to its topics as well.

pub(crate) mod access;
pub(crate) mod certificate;
mod files;
mod network;

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use sgc_cdr::{Layout, TypeName};
use sgc_config::{GatewayConfig, GatewayUrl};
use sgc_gateway::{
    Access, Client, FindDefinitions, GatewayError, GatewayStatus, Hub, HubOptions, ListenAt, LocalRos,
    NotListening, Server, ServerError, ServerOptions, Session, SessionLimits, ShownCertificate, TlsKeys,
    Types,
};
use sgc_ros::{Reach, RosError};
use sgc_sync::lock;
use sgc_trust::{Identity, ServerCertificate, TrustAnchors};
use sgc_types::{Definitions, TypeStore};
use sgc_wire::UnixMillis;
use tokio::sync::OnceCell;
use tracing::{info, warn};

use self::certificate::{GatewayCertificateError, ShownKey};
use self::files::clients_within_files;
use self::network::{GatewayNetwork, HubNetwork};
use crate::control::faults::alerts::Alert;
use crate::state::is_storage_fault;

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
    /// The certificate for programs; `None` if no address has TLS.
    pub(crate) key: Option<ShownKey>,
    /// The node, whose certificate members of its fleet may ask for.
    pub(crate) identity: Arc<Identity>,
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
    /// The gateway's own certificate, if the state directory cannot keep it.
    unkept: Mutex<Option<ServerCertificate>>,
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
        let (name, showing, unkept) = (node_name.to_owned(), Mutex::default(), Mutex::default());
        let open = Mutex::new(open);
        let network = Mutex::default();
        Arc::new(Self { open, definitions, name, node, hub, network, server, showing, unkept })
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
        let Sockets { listen, access, key, identity, clients_max, .. } = sockets;
        let clients_max = clients_within_files(clients_max);
        let name = format!("sgc {}", self.name);
        let keys = key.map(|key| tls_keys(&key, &identity));
        let options = ServerOptions { name, listen, access, keys, clients_max, limits };
        let server = Server::start(self.hub().await?.clone(), options).await?;
        log_shown(&server);
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

    /// Returns the certificate for programs of this configuration; `None` if no address has TLS. Blocks.
    pub(crate) fn shown_key(
        &self,
        config: &GatewayConfig,
        state: Option<&Path>,
        now: UnixMillis,
    ) -> Result<Option<ShownKey>, GatewayCertificateError> {
        if !certificate::uses_tls(config) {
            return Ok(None);
        }
        if let Some(tls) = &config.tls {
            return Ok(Some(ShownKey::Files(certificate::key_of_files(tls)?)));
        }
        let names = certificate::wanted_names(config);
        let mut unkept = lock(&self.unkept);
        let reason = match state.map(|state| certificate::kept(&names, state, now)) {
            Some(Ok(own)) => {
                *unkept = None;
                return Ok(Some(ShownKey::Own(own.certified_key()?)));
            }
            Some(Err(GatewayCertificateError::File { source, .. })) if is_storage_fault(&source) => {
                source.to_string()
            }
            Some(Err(error)) => return Err(error),
            None => "there is no state directory; set `state` in [node]".to_owned(),
        };
        let mut before = unkept.take();
        if before.is_none() {
            warn!(
                "the gateway's own certificate is not kept, so its pin may change at the next start: {reason}"
            );
            before = state.map(certificate::read).transpose()?.flatten();
        }
        let (own, _) = certificate::current(before, &names, now)?;
        let key = own.certified_key()?;
        *unkept = Some(own);
        Ok(Some(ShownKey::Own(key)))
    }

    /// Replaces the rules and the certificate for programs. Returns `true` if the certificate changed. `identity` is
    /// called at the moment of replacement. Without a key, the certificates stay, since addresses that close later may
    /// need them.
    pub(crate) fn reconfigure(
        &self,
        access: Access,
        key: Option<&ShownKey>,
        identity: impl FnOnce() -> Arc<Identity>,
    ) -> Result<bool, ServerError> {
        let Some(server) = self.server() else { return Ok(false) };
        let _showing = self.lock_showing();
        let before = server.shown();
        let keys = key.map(|key| tls_keys(key, &identity()));
        server.reconfigure(access, keys.or_else(|| server.keys()))?;
        let is_another = server.shown() != before;
        if is_another {
            log_shown(&server);
        }
        Ok(is_another)
    }

    /// Shows this certificate to programs that connect from now on, if it is another.
    pub(crate) fn show(&self, key: &ShownKey) -> Result<(), ServerError> {
        let Some(server) = self.server() else { return Ok(()) };
        let _showing = self.lock_showing();
        if server.shown() == key.certified().cert {
            return Ok(());
        }
        let node = server.keys().and_then(|keys| keys.node);
        server.show(TlsKeys { shown: key.certified().clone(), node })?;
        log_shown(&server);
        Ok(())
    }

    /// Changes the number of clients that may be connected at once. Returns the number, which open files bound.
    pub(crate) fn set_clients_max(&self, clients_max: usize) -> usize {
        let clients_max = clients_within_files(clients_max);
        if let Some(server) = self.server() {
            server.set_clients_max(clients_max);
        }
        clients_max
    }

    /// Shows the node's renewed certificate to members of its fleet that connect from now on.
    pub(crate) fn set_identity(&self, identity: &Identity) {
        let Some(server) = self.server() else { return };
        let _showing = self.lock_showing();
        server.set_gateway(identity.as_peer().clone());
        let Some(keys) = server.keys() else { return };
        if let Err(error) = server.show(TlsKeys { node: Some(identity.certified_key()), ..keys }) {
            warn!(%error, "the gateway cannot show the renewed certificate");
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
    /// There is no certificate for TLS.
    #[error(transparent)]
    Certificate(#[from] GatewayCertificateError),
}

/// Returns the certificates of a gateway: the one for programs, and that of the node.
fn tls_keys(key: &ShownKey, identity: &Identity) -> TlsKeys {
    TlsKeys { shown: key.certified().clone(), node: Some(identity.certified_key()) }
}

/// Logs the certificate for programs, if there is one.
fn log_shown(server: &Server) {
    let shown = server.shown();
    if let Some(ShownCertificate { pin, names, until }) =
        shown.first().and_then(|leaf| ShownCertificate::of(leaf))
    {
        let until = UnixMillis(until);
        info!("programs are shown a certificate with the pin {pin} for {}, until {until}", names.join(", "));
    }
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
    use rustls_pki_types::CertificateDer;
    use sgc_gateway::{LocalReader, Protocol, ShippedDefinitions};
    use sgc_ros::{
        DiscoveryHandler, EndpointSpec, GraphNode, RequestHandler, RosClient, RosServer, RosWriter,
        SampleHandler, ServiceSpec,
    };
    use sgc_testkit::FakeDomain;
    use sgc_trust::{EnrollRequest, Fleet, certificate_pin};

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

    /// A gateway of this network.
    fn gateway() -> Arc<Gateway> {
        let domain = FakeDomain::default();
        let open: OpenLocalRos = Arc::new(move || Ok(Arc::new(domain.join(false)) as Arc<dyn LocalRos>));
        Gateway::new(Some(open), "arm-1", ShippedDefinitions)
    }

    fn sockets(key: Option<ShownKey>, identity: &Arc<Identity>) -> Sockets {
        let at =
            ListenAt { protocol: Protocol::WebSocket, is_encrypted: true, addr: ([127, 0, 0, 1], 0).into() };
        Sockets {
            listen: vec![at],
            access: Access::default(),
            key,
            identity: Arc::clone(identity),
            clients_max: 8,
            client_bytes_max: 1 << 20,
        }
    }

    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

    fn enroll<const N: usize>(names: [&str; N]) -> [Arc<Identity>; N] {
        let rng = &mut ChaCha20Rng::seed_from_u64(8);
        let mut fleet = Fleet::create("lab".parse().unwrap(), NOW, rng).unwrap();
        names
            .map(|name| Arc::new(fleet.enroll(&EnrollRequest::new(name.parse().unwrap(), NOW), rng).unwrap()))
    }

    #[tokio::test]
    async fn a_renewed_certificate_is_shown_and_a_reload_does_not_undo_it() {
        let [first, renewed, file] = enroll(["one", "two", "file"]);
        let gateway = gateway();
        let config = |names: &str| {
            let text = format!(
                "identity = 'x'\n[node]\nrouters = ['quic://r']\n[gateway]\nlisten = ['wss://127.0.0.1']\nnames = [{names}]"
            );
            let config = sgc_config::parse(&text, "node.toml", Path::new("/"), &|_| None);
            config.unwrap().gateway.unwrap()
        };
        let dir = tempfile::tempdir().unwrap();
        let key = |names: &str| gateway.shown_key(&config(names), Some(dir.path()), NOW).unwrap().unwrap();
        let own = key("");
        gateway.listen(sockets(Some(own.clone()), &first)).await.unwrap();
        let server = gateway.server().unwrap();
        let of_node = || server.keys().unwrap().node.unwrap().cert.clone();
        assert_eq!((server.shown(), of_node()), (own.certified().cert.clone(), first.chain().to_vec()));
        gateway.set_identity(&renewed);
        assert_eq!((server.shown(), of_node()), (own.certified().cert.clone(), renewed.chain().to_vec()));
        let reload = |key: Option<&ShownKey>| {
            gateway.reconfigure(Access::default(), key, || Arc::clone(&renewed)).unwrap()
        };
        assert!(!reload(Some(&key(""))), "it is the same");
        assert_eq!(of_node(), renewed.chain());
        let named = key("'robot.example'");
        assert!(reload(Some(&named)));
        assert_eq!(server.shown(), named.certified().cert);
        let files = ShownKey::Files(file.certified_key());
        assert!(reload(Some(&files)));
        gateway.set_identity(&first);
        assert_eq!((server.shown(), of_node()), (file.chain().to_vec(), first.chain().to_vec()));
        assert!(!reload(None), "the addresses with TLS close after the rules change");
        gateway.show(&named).unwrap();
        assert_eq!((server.shown(), of_node()), (named.certified().cert.clone(), first.chain().to_vec()));
        gateway.stop().await;
    }

    #[test]
    fn certificate_without_a_state_directory_lasts_as_long_as_the_node() {
        let gateway = gateway();
        let config =
            GatewayConfig { listen: vec!["wss://127.0.0.1".parse().unwrap()], ..GatewayConfig::default() };
        let shown = |gateway: &Gateway, now| {
            let key = gateway.shown_key(&config, None, now).unwrap().unwrap();
            key.certified().cert.clone()
        };
        let first = shown(&gateway, NOW);
        assert_eq!(shown(&gateway, NOW), first);
        let later = shown(&gateway, UnixMillis(NOW.0 + 300 * 86_400_000));
        let pin = |chain: &[CertificateDer<'_>]| certificate_pin(&chain[0]).unwrap();
        assert!(later != first && pin(&later) == pin(&first));
        assert!(gateway.shown_key(&GatewayConfig::default(), None, NOW).unwrap().is_none());
    }
}
