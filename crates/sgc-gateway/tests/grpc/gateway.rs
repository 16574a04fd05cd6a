//! A gRPC gateway on a network in memory, and clients over TCP.

#![allow(dead_code, reason = "each test program uses a part")]

use std::net::SocketAddr;
use std::time::{SystemTime, UNIX_EPOCH};

use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use sgc_gateway::grpc::proto::gateway_client::GatewayClient;
use sgc_gateway::grpc::{AcceptedStream, Connection, Grpc, GrpcOptions, MESSAGE_BYTES_MAX};
use sgc_gateway::{
    Access, AccessGrant, AccessRules, AccessWatch, Anonymous, ClientRule, Scope, TokenId, WallClock,
};
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::metadata::AsciiMetadataValue;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};

use crate::support::Site;

/// A gateway and its network.
pub(crate) struct Gateway {
    pub(crate) site: Site,
    pub(crate) grpc: Grpc,
    pub(crate) address: SocketAddr,
    pub(crate) serving: JoinHandle<()>,
    pub(crate) access: AccessWatch,
    identity: Identity,
    desk: Identity,
}

pub(crate) type Client = GatewayClient<InterceptedService<Channel, Bearer>>;

/// An interceptor that adds a token to each call.
#[derive(Clone)]
pub(crate) struct Bearer(Option<AsciiMetadataValue>);

impl tonic::service::Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(header) = &self.0 {
            request.metadata_mut().insert("authorization", header.clone());
        }
        Ok(request)
    }
}

pub(crate) fn now() -> UnixMillis {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    UnixMillis(since.as_millis() as u64)
}

impl Gateway {
    /// Creates a gateway that admits programs on this host.
    pub(crate) async fn new() -> Self {
        Self::with(GrpcOptions::default()).await
    }

    pub(crate) async fn with(options: GrpcOptions) -> Self {
        let site = Site::new().await;
        let mut rng = ChaCha20Rng::seed_from_u64(8);
        let began = UnixMillis(now().0 - 1000);
        let mut fleet = Fleet::create("lab".parse().unwrap(), began, &mut rng).unwrap();
        let identity = fleet.enroll(&EnrollRequest::new("robot".parse().unwrap(), began), &mut rng).unwrap();
        let desk = fleet.enroll(&EnrollRequest::new("desk".parse().unwrap(), began), &mut rng).unwrap();
        let access = AccessWatch::new(Access::default(), WallClock::system());
        let grpc = Grpc::new(site.hub.clone(), access.clone(), options);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (send, accepted) = mpsc::channel(1);
        tokio::spawn(async move {
            while let Ok((stream, peer)) = listener.accept().await {
                stream.set_nodelay(true).unwrap();
                if send.send(AcceptedStream::new(stream, Connection::plain(peer))).await.is_err() {
                    return;
                }
            }
        });
        let served = grpc.clone();
        let serving = tokio::spawn(async move { served.serve(ReceiverStream::new(accepted)).await.unwrap() });
        let gateway = Self { site, grpc, address, serving, access, identity, desk };
        gateway.admit(Anonymous::Local);
        gateway
    }

    /// Makes the gateway admit these clients and those with a token.
    pub(crate) fn admit(&self, anonymous: Anonymous) {
        self.access.change(|_| self.access_of(anonymous, Vec::new()));
    }

    /// Returns access for these clients, for these nodes, and for clients with a token.
    pub(crate) fn access_of(&self, anonymous: Anonymous, clients: Vec<ClientRule>) -> Access {
        let (gateway, anchors) =
            (Some(self.identity.as_peer().clone()), Some(self.identity.anchors().clone()));
        Access::new(AccessRules { anonymous, clients, gateway, anchors, ..AccessRules::default() })
    }

    /// Returns another node of the gateway's fleet.
    pub(crate) fn desk(&self) -> &Identity {
        &self.desk
    }

    /// Returns a token for a client with this name.
    pub(crate) fn token(&self, label: &str, scope: Scope, expires: UnixMillis) -> String {
        let (id, gateway, issued) = (TokenId([7; 16]), self.identity.node_id(), UnixMillis(now().0 - 1));
        let grant = AccessGrant { id, gateway, label: label.into(), scope, issued, expires };
        grant.sign(&self.identity).unwrap().to_text().to_string()
    }

    pub(crate) fn endpoint(&self) -> Endpoint {
        Endpoint::from_shared(format!("http://{}", self.address)).unwrap()
    }

    /// Returns a client without a token, on its own connection.
    pub(crate) async fn client(&self) -> Client {
        client(self.endpoint().connect().await.unwrap(), None)
    }

    pub(crate) async fn client_with(&self, token: &str) -> Client {
        client(self.endpoint().connect().await.unwrap(), Some(token))
    }
}

pub(crate) fn client(channel: Channel, token: Option<&str>) -> Client {
    let bearer = Bearer(token.map(|token| format!("Bearer {token}").parse().unwrap()));
    GatewayClient::with_interceptor(channel, bearer)
        .max_decoding_message_size(MESSAGE_BYTES_MAX)
        .max_encoding_message_size(MESSAGE_BYTES_MAX)
}
