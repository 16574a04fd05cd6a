//! Sessions end at the moment their rights end, for every protocol and every cause: through a server's own sockets,
//! with the libraries that programs use.
#![allow(clippy::unwrap_used)]

mod support;

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use futures_util::{SinkExt as _, StreamExt as _};
use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use serde_json::{Value as Json, json};
use sgc_cdr::{Layout, TypeName};
use sgc_gateway::grpc::proto::gateway_client::GatewayClient;
use sgc_gateway::grpc::proto::{GetTypeRequest, SubscribeRequest, SubscribeResponse, WatchGraphRequest};
use sgc_gateway::{
    Access, AccessGrant, AccessRules, Anonymous, ClientRule, FindDefinitions, ListenAt, NODE_SERVER_NAME,
    Protocol, Scope, Server, ServerOptions, SessionLimits, TlsKeys, TokenId, Types,
};
use sgc_ros::{RosNetwork as _, RosWriter as _, SampleKind};
use sgc_testkit::FakeWriter;
use sgc_trust::{EnrollRequest, Fleet, Grantees, Identity, ServerCertificate, certificate_pin};
use sgc_wire::{Qos, UnixMillis};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::{WebSocketStream, client_async};
use tonic::{Code, Request, Status, Streaming};

use support::{STRING, Site, eventually, spec, string};

const PATIENCE: Duration = Duration::from_secs(20);
/// Longest delay of an end, far below any polling interval and enough for a loaded machine.
const AT_ONCE: Duration = Duration::from_secs(3);
const HOUR_MS: u64 = 3_600_000;

fn now() -> UnixMillis {
    UnixMillis(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64)
}

async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, work).await.expect("it should have come by now")
}

/// Interfaces of a company, which do not ship with SGC.
struct Acme;

impl FindDefinitions for Acme {
    fn text(&self, file: &TypeName) -> Option<String> {
        match file.to_string().as_str() {
            "acme/msg/Shown" => Some("acme/Part part".to_owned()),
            "acme/msg/Part" => Some("int32 number".to_owned()),
            "acme/msg/Secret" => Some("int32 code".to_owned()),
            "acme/srv/Work" => Some("int32 a\n---\nint32 b".to_owned()),
            _ => None,
        }
    }

    fn described(&self, _: &TypeName, _: Option<&str>) -> Option<Arc<Layout>> {
        None
    }
}

/// A gateway that admits only clients with a token or a certificate.
struct Place {
    site: Site,
    server: Server,
    fleet: Fleet,
    robot: Identity,
    desk: Identity,
    rng: ChaCha20Rng,
    _talker: FakeWriter,
}

impl Place {
    async fn new() -> Self {
        let site = Site::with_types(Types::new(Acme)).await;
        let (mut rng, began) = (ChaCha20Rng::seed_from_u64(8), UnixMillis(now().0 - 1000));
        let mut fleet = Fleet::create("lab".parse().unwrap(), began, &mut rng).unwrap();
        let mut enroll =
            |name: &str| fleet.enroll(&EnrollRequest::new(name.parse().unwrap(), began), &mut rng).unwrap();
        let (robot, desk) = (enroll("robot"), enroll("desk"));
        let at =
            |protocol, is_encrypted| ListenAt { protocol, is_encrypted, addr: ([127, 0, 0, 1], 0).into() };
        let options = ServerOptions {
            name: "robot".into(),
            listen: vec![
                at(Protocol::WebSocket, false),
                at(Protocol::Grpc, false),
                at(Protocol::WebSocket, true),
            ],
            access: rules(&robot, &desk, &[]),
            keys: Some(robot.certified_key().into()),
            clients_max: 64,
            limits: SessionLimits::default(),
        };
        let server = Server::start(site.hub.clone(), options).await.unwrap();
        let _talker = site.writer("/odom", Qos::default());
        site.knows("/odom").await;
        Self { site, server, fleet, robot, desk, rng, _talker }
    }

    fn addr(&self, at: usize) -> SocketAddr {
        self.server.local()[at].addr
    }

    /// Returns a token for `/odom` with this time of expiry.
    fn token(&self, number: u8, expires: UnixMillis) -> String {
        let grant = AccessGrant {
            id: TokenId([number; 16]),
            gateway: self.robot.node_id(),
            label: format!("token {number}"),
            scope: Scope {
                subscribe: vec!["/odom".into(), "/shown".into()],
                publish: vec!["/mine".into()],
                ..Scope::default()
            },
            issued: UnixMillis(now().0 - 1),
            expires,
        };
        grant.sign(&self.robot).unwrap().to_text().to_string()
    }

    /// Revokes these tokens, like a reload after `sgc token access revoke`.
    fn revoke(&self, numbers: &[u8]) {
        let keys = self.robot.certified_key().into();
        self.server.reconfigure(rules(&self.robot, &self.desk, numbers), Some(keys)).unwrap();
    }

    async fn web_socket(&self, target: &str, subprotocol: Option<&str>) -> WebSocketStream<TcpStream> {
        let stream = TcpStream::connect(self.addr(0)).await.unwrap();
        let mut request = format!("ws://{}{target}", self.addr(0)).into_client_request().unwrap();
        if let Some(name) = subprotocol {
            request.headers_mut().insert("sec-websocket-protocol", name.parse().unwrap());
        }
        within(client_async(request, stream)).await.unwrap().0
    }

    /// Returns a rosbridge client that has shown its token within the session.
    async fn rosbridge(&self, token: &str, first: &str) -> WebSocketStream<TcpStream> {
        let mut socket = self.web_socket(&format!("/?token={first}"), None).await;
        say(&mut socket, &json!({"op": "set_level", "level": "info"})).await;
        say(&mut socket, &json!({"op": "auth", "token": token})).await;
        while !hear(&mut socket).await["msg"].as_str().is_some_and(|said| said.starts_with("you are ")) {}
        say(&mut socket, &json!({"op": "subscribe", "topic": "/odom", "type": STRING})).await;
        socket
    }

    async fn foxglove(&self, token: &str) -> WebSocketStream<TcpStream> {
        let mut socket = self.web_socket(&format!("/?token={token}"), Some("foxglove.sdk.v1")).await;
        while hear(&mut socket).await["op"] != "advertise" {}
        say(&mut socket, &json!({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]})).await;
        socket
    }

    /// Returns two long streams of one gRPC client.
    async fn grpc(
        &self,
        token: &str,
    ) -> (Streaming<SubscribeResponse>, impl Future<Output = Status> + use<>) {
        let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{}", self.addr(1))).unwrap();
        let header: tonic::metadata::AsciiMetadataValue = format!("Bearer {token}").parse().unwrap();
        let bearer = move |mut request: Request<()>| {
            request.metadata_mut().insert("authorization", header.clone());
            Ok(request)
        };
        let channel = within(endpoint.connect()).await.unwrap();
        let mut client = GatewayClient::with_interceptor(channel, bearer);
        let wanted = SubscribeRequest { topic: "/odom".into(), ..SubscribeRequest::default() };
        let heard = within(client.subscribe(wanted)).await.unwrap().into_inner();
        let mut graph = within(client.watch_graph(WatchGraphRequest::default())).await.unwrap().into_inner();
        within(graph.message()).await.unwrap();
        let watched = async move {
            loop {
                if let Err(ended) = graph.message().await {
                    return ended;
                }
            }
        };
        (heard, watched)
    }
}

fn rules(robot: &Identity, desk: &Identity, revoked: &[u8]) -> Access {
    let scope = Scope { subscribe: vec!["/odom".into()], ..Scope::default() };
    let who = Grantees { nodes: [desk.node_id()].into(), ..Grantees::default() };
    Access::new(AccessRules {
        anonymous: Anonymous::None,
        clients: vec![ClientRule { who, scope }],
        gateway: Some(robot.as_peer().clone()),
        anchors: Some(robot.anchors().clone()),
        revoked: revoked.iter().map(|number| TokenId([*number; 16])).collect::<BTreeSet<_>>(),
        ..AccessRules::default()
    })
}

async fn say<S>(socket: &mut WebSocketStream<S>, op: &Json)
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    within(socket.send(Message::text(op.to_string()))).await.unwrap();
}

async fn hear<S>(socket: &mut WebSocketStream<S>) -> Json
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    loop {
        match within(socket.next()).await.unwrap().unwrap() {
            Message::Text(text) => return serde_json::from_str(&text).unwrap(),
            Message::Close(why) => panic!("closed: {why:?}"),
            _ => {}
        }
    }
}

/// Waits for the close frame and returns its code and reason.
async fn close<S>(mut socket: WebSocketStream<S>) -> (u16, String)
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    loop {
        match within(socket.next()).await.expect("a close frame comes first").unwrap() {
            Message::Close(Some(why)) => return (why.code.into(), why.reason.to_string()),
            Message::Close(None) => panic!("no reason was said"),
            _ => {}
        }
    }
}

async fn end(mut heard: Streaming<SubscribeResponse>) -> Status {
    loop {
        match within(heard.message()).await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("no reason was said"),
            Err(status) => return status,
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_is_revoked_ends_sessions_of_all_protocols_at_once() {
    let place = Place::new().await;
    let ends = UnixMillis(now().0 + HOUR_MS);
    let [first, second, other] = [1, 2, 3].map(|number| place.token(number, ends));
    // The rosbridge client connected with another token than it shows now.
    let rosbridge = place.rosbridge(&second, &first).await;
    let foxglove = place.foxglove(&second).await;
    let (heard, watched) = place.grpc(&second).await;
    let mut stays = place.rosbridge(&other, &second).await;
    eventually(|| place.server.status().clients.len() == 4).await;
    // Another client never reads, and its connection is full.
    let (unread, _watched) = place.grpc(&second).await;
    let mut number = 0;
    let mut talk = |text: &str| {
        number += 1;
        place._talker.write(SampleKind::Write, number, string(text)).unwrap();
    };
    (0..200).for_each(|_| talk(&"x".repeat(50_000)));
    let began = Instant::now();
    place.revoke(&[2]);
    let told = "not admitted: the token was revoked";
    let rosbridge = tokio::spawn(close(rosbridge));
    let foxglove = tokio::spawn(close(foxglove));
    assert_eq!(rosbridge.await.unwrap(), (1008, told.to_owned()));
    assert_eq!(foxglove.await.unwrap(), (1008, told.to_owned()));
    for ended in [end(heard).await, within(watched).await] {
        assert_eq!((ended.code(), ended.message()), (Code::Unauthenticated, told));
    }
    assert!(began.elapsed() < AT_ONCE, "{:?}", began.elapsed());
    // Subscriptions and clients are gone, whether the clients read the reason or not.
    let names = || place.server.status().clients.into_iter().map(|client| client.name).collect::<Vec<_>>();
    eventually(|| names() == ["token 3"]).await;
    eventually(|| place.site.hub.readers() == 1).await;
    drop(unread);
    // A client that changed to another token stays, although its first one was revoked.
    talk("still here");
    while hear(&mut stays).await["msg"]["data"] != "still here" {}
    assert_eq!(place.server.status().refused["no longer admitted"], 4);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_expires_ends_sessions_of_all_protocols_in_that_moment() {
    let place = Place::new().await;
    let first = place.token(1, UnixMillis(now().0 + HOUR_MS));
    let began = Instant::now();
    let expires = UnixMillis(now().0 + 4000);
    let second = place.token(2, expires);
    let rosbridge = place.rosbridge(&second, &first).await;
    let foxglove = place.foxglove(&second).await;
    let (heard, watched) = place.grpc(&second).await;
    assert!(began.elapsed() < Duration::from_secs(4), "the machine is too slow for this test");
    let told = "not admitted: the token has ended";
    let rosbridge = tokio::spawn(close(rosbridge));
    let foxglove = tokio::spawn(close(foxglove));
    let (heard, watched) = (end(heard).await, within(watched).await);
    for ended in [heard, watched] {
        assert_eq!((ended.code(), ended.message()), (Code::Unauthenticated, told));
    }
    assert_eq!(rosbridge.await.unwrap(), (1008, told.to_owned()));
    assert_eq!(foxglove.await.unwrap(), (1008, told.to_owned()));
    let over = now();
    assert!(over > expires && over.0 < expires.0 + AT_ONCE.as_millis() as u64, "{over} {expires}");
    eventually(|| place.server.status().clients.is_empty()).await;
}

/// Returns a client's TLS connector, which shows a certificate if it has one.
fn connector(own: Option<&Identity>) -> TlsConnector {
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(Anyone));
    let config = match own {
        Some(own) => {
            let key = rustls::sign::SingleCertAndKey::from(own.certified_key());
            builder.with_client_cert_resolver(Arc::new(key))
        }
        None => builder.with_no_client_auth(),
    };
    TlsConnector::from(Arc::new(config))
}

/// A verifier that accepts any server, because the tests check the certificate themselves.
#[derive(Debug)]
struct Anyone;

impl rustls::client::danger::ServerCertVerifier for Anyone {
    fn verify_server_cert(
        &self,
        _: &rustls::pki_types::CertificateDer<'_>,
        _: &[rustls::pki_types::CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: rustls::pki_types::UnixTime,
    ) -> Result<rustls::client::danger::ServerCertVerified, rustls::Error> {
        Ok(rustls::client::danger::ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &rustls::pki_types::CertificateDer<'_>,
        _: &rustls::DigitallySignedStruct,
    ) -> Result<rustls::client::danger::HandshakeSignatureValid, rustls::Error> {
        Ok(rustls::client::danger::HandshakeSignatureValid::assertion())
    }

    fn verify_tls13_signature(
        &self,
        _: &[u8],
        _: &rustls::pki_types::CertificateDer<'_>,
        _: &rustls::DigitallySignedStruct,
    ) -> Result<rustls::client::danger::HandshakeSignatureValid, rustls::Error> {
        Ok(rustls::client::danger::HandshakeSignatureValid::assertion())
    }

    fn supported_verify_schemes(&self) -> Vec<rustls::SignatureScheme> {
        rustls::crypto::aws_lc_rs::default_provider().signature_verification_algorithms.supported_schemes()
    }
}

type Wss = WebSocketStream<tokio_rustls::client::TlsStream<TcpStream>>;

impl Place {
    async fn wss(&self, connector: &TlsConnector, token: Option<&str>) -> Wss {
        self.wss_named(connector, "robot", token).await
    }

    /// Asks for a certificate of this name.
    async fn wss_named(&self, connector: &TlsConnector, name: &'static str, token: Option<&str>) -> Wss {
        let stream = TcpStream::connect(self.addr(2)).await.unwrap();
        let name = ServerName::try_from(name).unwrap();
        let stream = within(connector.connect(name, stream)).await.unwrap();
        let target = token.map(|token| format!("?token={token}")).unwrap_or_default();
        let request = format!("wss://robot/{target}").into_client_request().unwrap();
        within(client_async(request, stream)).await.unwrap().0
    }
}

fn shown(socket: &Wss) -> Vec<rustls::pki_types::CertificateDer<'static>> {
    socket.get_ref().get_ref().1.peer_certificates().unwrap().to_vec()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_that_is_revoked_ends_its_session_at_once() {
    let mut place = Place::new().await;
    let mut socket = place.wss(&connector(Some(&place.desk)), None).await;
    say(&mut socket, &json!({"op": "call_service", "id": "1", "service": "/rosapi/topics"})).await;
    assert_eq!(hear(&mut socket).await["values"]["topics"], json!(["/odom"]));
    let at = now();
    place.fleet.revoke(&["desk".parse().unwrap()], at).unwrap();
    let crl = place.fleet.revocation_list(at).unwrap();
    let anchors = place.robot.anchors().with_crl(&crl, at).unwrap().unwrap();
    let began = Instant::now();
    place.server.set_anchors(anchors);
    assert_eq!(close(socket).await, (1008, "not admitted: the certificate was revoked".to_owned()));
    assert!(began.elapsed() < AT_ONCE);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_renewed_certificate_is_shown_to_new_connections_and_tokens_go_on() {
    let mut place = Place::new().await;
    let token = place.token(1, UnixMillis(now().0 + HOUR_MS));
    let connector = connector(None);
    let mut before = place.wss(&connector, Some(&token)).await;
    assert_eq!(shown(&before), place.robot.chain());
    let another = EnrollRequest::new("robot-2".parse().unwrap(), UnixMillis(now().0 - 1000));
    let another = place.fleet.enroll(&another, &mut place.rng).unwrap();
    assert!(place.server.show(another.certified_key().into()).is_ok());
    let after = place.wss(&connector, Some(&token)).await;
    assert_eq!(shown(&after), another.chain());
    // An existing client stays.
    say(&mut before, &json!({"op": "call_service", "id": "1", "service": "/rosapi/topics"})).await;
    assert_eq!(hear(&mut before).await["id"], "1");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn members_of_the_fleet_ask_for_the_certificate_of_the_node_and_programs_get_another() {
    let place = Place::new().await;
    let names = ["robot".parse().unwrap()].into();
    let own = ServerCertificate::generate(&names, now(), &mut ChaCha20Rng::seed_from_u64(2)).unwrap();
    let keys = TlsKeys { shown: own.certified_key().unwrap(), node: Some(place.robot.certified_key()) };
    place.server.show(keys).unwrap();
    let member = connector(Some(&place.desk));
    let mut socket = place.wss_named(&member, NODE_SERVER_NAME, None).await;
    assert_eq!(shown(&socket), place.robot.chain());
    let chain = shown(&socket);
    assert_eq!(place.desk.anchors().verify(&chain, now()).unwrap().node_id, place.robot.node_id());
    // The certificate of the client counts as ever.
    say(&mut socket, &json!({"op": "call_service", "id": "1", "service": "/rosapi/topics"})).await;
    assert_eq!(hear(&mut socket).await["values"]["topics"], json!(["/odom"]));
    for name in ["robot", "10.0.0.7", "other.invalid"] {
        let socket = place.wss_named(&member, name, None).await;
        assert_eq!(shown(&socket), [own.server().clone(), own.authority().clone()], "{name}");
    }
    let status = place.server.status().certificate.unwrap();
    assert_eq!(
        (status.pin, status.names),
        (certificate_pin(own.server()).unwrap(), vec!["robot".to_owned()])
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn types_of_what_a_client_does_not_see_are_not_told() {
    let place = Place::new().await;
    let talks =
        |topic: &str, of: &str| place.site.ros.create_writer(&spec(topic, of, Qos::default())).unwrap();
    let _talkers = [talks("/shown", "acme/msg/Shown"), talks("/secret", "acme/msg/Secret")];
    place.site.knows("/shown").await;
    place.site.knows("/secret").await;
    let token = place.token(1, UnixMillis(now().0 + HOUR_MS));
    let mut page = place.web_socket(&format!("/?token={token}"), None).await;
    let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{}", place.addr(1))).unwrap();
    let header: tonic::metadata::AsciiMetadataValue = format!("Bearer {token}").parse().unwrap();
    let bearer = move |mut request: Request<()>| {
        request.metadata_mut().insert("authorization", header.clone());
        Ok(request)
    };
    let mut client = GatewayClient::with_interceptor(within(endpoint.connect()).await.unwrap(), bearer);
    // The client may create a topic of that type, but does not learn the definition of the type.
    let mine = json!({"op": "advertise", "topic": "/mine", "type": "acme/msg/Secret"});
    say(&mut page, &mine).await;
    eventually(|| place.site.hub.graph().topics.contains_key("/mine")).await;
    for (of, is_told) in [
        ("std_msgs/msg/String", true),
        ("acme/msg/Shown", true),
        ("acme/msg/Part", true),
        ("acme/msg/Secret", false),
        ("acme/msg/None", false),
        ("acme/srv/Work", false),
    ] {
        let told = within(client.get_type(GetTypeRequest { r#type: of.into() })).await;
        let words = format!("nothing that this client may use has type {of}");
        match told {
            Ok(told) => assert!(is_told && !told.into_inner().definitions.is_empty(), "{of}"),
            Err(refused) => {
                assert!(!is_told, "{of}: {refused}");
                assert_eq!((refused.code(), refused.message()), (Code::NotFound, &*words));
            }
        }
        let api = if of.contains("/srv/") { "service_request_details" } else { "message_details" };
        let service = format!("/rosapi/{api}");
        say(&mut page, &json!({"op": "call_service", "id": of, "service": service, "args": {"type": of}}))
            .await;
        let answer = hear(&mut page).await;
        assert_eq!(answer["result"], is_told, "{answer}");
        assert!(is_told || answer["values"] == *words, "{answer}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_learns_neither_names_nor_types_out_of_its_scope_by_asking_for_them() {
    let place = Place::new().await;
    let program = place.site.session("program");
    let _service = program.serve("/hidden", Some("acme/srv/Work")).await.unwrap();
    let _action = program.serve_action("/secret", Some("example_interfaces/action/Fibonacci")).await.unwrap();
    let token = place.token(1, UnixMillis(now().0 + HOUR_MS));
    let mut page = place.web_socket(&format!("/?token={token}"), None).await;
    // Arguments as a list need the type for the names of its members.
    for service in ["/hidden", "/none"] {
        for of in [json!(null), json!("acme/srv/Work"), json!("acme/srv/None"), json!("std_srvs/srv/SetBool")]
        {
            let mut op = json!({"op": "call_service", "id": "call", "service": service, "args": [1]});
            if !of.is_null() {
                op["type"] = of;
            }
            say(&mut page, &op).await;
            let answer = hear(&mut page).await;
            let told = format!("token 1 may not call {service}: its scope does not have it");
            assert_eq!((&answer["values"], &answer["result"]), (&json!(told), &json!(false)), "{op}");
        }
    }
    for action in ["/secret", "/none"] {
        for of in ["example_interfaces/action/Fibonacci", "acme/action/None", "std_srvs/action/Other"] {
            let op = json!({"op": "send_action_goal", "id": "goal", "action": action, "action_type": of,
                "args": [1]});
            say(&mut page, &op).await;
            let answer = loop {
                let answer = hear(&mut page).await;
                if answer["op"] == "action_result" {
                    break answer;
                }
            };
            let told = format!("token 1 may not call {action}: its scope does not have it");
            assert!(answer["values"].as_str().unwrap().ends_with(&told), "{op}: {answer}");
            let op = json!({"op": "advertise_action", "id": "serve", "action": action, "type": of});
            say(&mut page, &op).await;
            let answer = loop {
                let answer = hear(&mut page).await;
                if answer["op"] == "status" && answer["id"] == "serve" {
                    break answer;
                }
            };
            let told = format!("token 1 may not serve {action}: its scope does not have it");
            assert!(answer["msg"].as_str().unwrap().ends_with(&told), "{op}: {answer}");
        }
    }
}
