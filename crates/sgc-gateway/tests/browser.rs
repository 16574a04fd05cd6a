//! A page in a browser: Chromium with npm's roslib shows a camera through a gateway's own sockets. `make deps-test
//! peers` installs both.
#![allow(clippy::unwrap_used)]

mod support;

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use serde_json::json;
use sgc_gateway::{
    Access, AccessGrant, AccessRules, Advertise, Client, Content, Hub, HubOptions, ListenAt, Protocol, Scope,
    Server, ServerOptions, Session, SessionLimits, ShippedDefinitions, TokenId, Types,
};
use sgc_trust::{EnrollRequest, Fleet, Identity, ServerCertificate, certificate_pin, pem_text};
use sgc_wire::{Qos, Reliability, UnixMillis};
use tokio::process::Command;
use tokio::task::JoinSet;

use crate::support::{Site, eventually};

/// Longest duration of the test, with much to spare.
const PATIENCE: Duration = Duration::from_secs(120);
/// Pause between two pictures of the camera.
const PICTURE: Duration = Duration::from_millis(20);
/// Width and height of a picture in pixels.
const WIDTH: usize = 64;
const HEIGHT: usize = 48;
/// Bytes of a row: those of its pixels, and padding.
const STEP: usize = 3 * WIDTH + 8;

/// A robot with a camera and wheels, as a separate program on the network of a site.
struct Robot {
    _hub: Hub,
    _talks: JoinSet<()>,
}

impl Robot {
    async fn new(site: &Site) -> Self {
        let own = Arc::new(site.domain.join(false));
        let hub = Hub::start(own, Types::new(ShippedDefinitions), HubOptions { node: "robot".into() })
            .await
            .unwrap();
        let session = Session::new(&hub, Client::own("robot"), SessionLimits::default());
        let advertise = |topic: &str, type_name: &str| {
            let qos = Qos { reliability: Reliability::BestEffort, ..Qos::default() };
            session.advertise(Advertise { topic: topic.into(), type_name: Some(type_name.into()), qos })
        };
        let camera = advertise("/camera/image", "sensor_msgs/msg/Image").await.unwrap();
        let wheels = advertise("/odom", "nav_msgs/msg/Odometry").await.unwrap();
        let odometry = json!({"pose": {"pose": {"position": {"x": 1.25, "y": -0.5}}}}).to_string();
        let mut talks = JoinSet::new();
        talks.spawn(async move {
            for number in 0.. {
                camera.publish(&Content::json(picture(number))).await.unwrap();
                wheels.publish(&Content::json(odometry.clone())).await.unwrap();
                tokio::time::sleep(PICTURE).await;
            }
        });
        eventually(|| {
            let topics = &site.hub.graph().topics;
            ["/camera/image", "/odom"].iter().all(|topic| topics.contains_key(*topic))
        })
        .await;
        Self { _hub: hub, _talks: talks }
    }
}

/// Returns a picture whose colours depend on its number. `tests/js/camera.js` knows them, too.
fn picture(number: usize) -> String {
    let mut data = vec![0xff; HEIGHT * STEP];
    for (y, row) in data.chunks_mut(STEP).enumerate() {
        for (at, byte) in row[..3 * WIDTH].iter_mut().enumerate() {
            let (x, colour) = (at / 3, at % 3);
            *byte = ((7 * x + 31 * y + 85 * colour + 3 * number) % 256) as u8;
        }
    }
    let header = json!({"stamp": {"sec": number, "nanosec": 7}, "frame_id": "lens"});
    let image = json!({
        "header": header,
        "height": HEIGHT,
        "width": WIDTH,
        "encoding": "rgb8",
        "step": STEP,
        "data": STANDARD.encode(data),
    });
    image.to_string()
}

fn now() -> UnixMillis {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    UnixMillis(since.as_millis() as u64)
}

fn identity() -> Identity {
    let mut rng = ChaCha20Rng::seed_from_u64(9);
    let began = UnixMillis(now().0 - 1000);
    let mut fleet = Fleet::create("lab".parse().unwrap(), began, &mut rng).unwrap();
    fleet.enroll(&EnrollRequest::new("arm-1".parse().unwrap(), began), &mut rng).unwrap()
}

/// Returns a token for pictures only.
fn token(of: &Identity) -> String {
    let scope = Scope { subscribe: vec!["/camera/**".into()], ..Scope::default() };
    let grant = AccessGrant {
        id: TokenId([9; 16]),
        gateway: of.node_id(),
        label: "dashboard".into(),
        scope,
        issued: UnixMillis(now().0 - 1),
        expires: UnixMillis(now().0 + 3_600_000),
    };
    grant.sign(of).unwrap().to_text().to_string()
}

fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../").join(file)
}

/// Runs a program and checks that it succeeds.
async fn run(mut node: Command) {
    node.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).kill_on_drop(true);
    let child = node.spawn().unwrap_or_else(|why| panic!("{why}: run `make deps-test peers` first: node"));
    let output = tokio::time::timeout(PATIENCE, child.wait_with_output()).await;
    let output = output.expect("it should have ended by now").unwrap();
    let (said, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && said.ends_with("all is well\n"), "{said}\n{errors}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_page_shows_a_camera_if_it_is_of_this_host_or_has_a_token() {
    let site = Site::new().await;
    let _robot = Robot::new(&site).await;
    let identity = identity();
    let (gateway, anchors) = (Some(identity.as_peer().clone()), Some(identity.anchors().clone()));
    let at =
        ListenAt { protocol: Protocol::WebSocket, is_encrypted: false, addr: ([127, 0, 0, 1], 0).into() };
    let options = ServerOptions {
        name: "arm-1".into(),
        listen: vec![at],
        access: Access::new(AccessRules { gateway, anchors, ..AccessRules::default() }),
        keys: None,
        clients_max: 16,
        limits: SessionLimits::default(),
    };
    let server = Server::start(site.hub.clone(), options).await.unwrap();
    let dir = tempfile::tempdir().unwrap();
    let mut node = Command::new("node");
    node.arg(repository("tests/js/camera.js")).arg(format!("ws://{}/", server.local()[0].addr));
    node.arg(token(&identity))
        .arg(dir.path().join("browser"))
        .env("HOME", dir.path())
        .env("TMPDIR", dir.path());
    run(node).await;
    // Only the page from elsewhere without a token was refused.
    assert_eq!(server.status().refused.get("not admitted"), Some(&1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_verifies_a_gateway_that_makes_its_certificate_itself() {
    let site = Site::new().await;
    let names = ["localhost", "127.0.0.1", "robot.test"].map(|name| name.parse().unwrap()).into();
    let mut rng = ChaCha20Rng::seed_from_u64(4);
    let mut made = || ServerCertificate::generate(&names, now(), &mut rng).unwrap();
    let (own, another) = (made(), made());
    let bank = ["bank.test".parse().unwrap()].into();
    let stolen = own.renewed(&bank, now(), &mut rng).unwrap().unwrap();
    let mut servers = Vec::new();
    for certificate in [&own, &another, &stolen] {
        let at =
            ListenAt { protocol: Protocol::WebSocket, is_encrypted: true, addr: ([127, 0, 0, 1], 0).into() };
        let options = ServerOptions {
            name: "arm-1".into(),
            listen: vec![at],
            access: Access::default(),
            keys: Some(certificate.certified_key().unwrap().into()),
            clients_max: 16,
            limits: SessionLimits::default(),
        };
        servers.push(Server::start(site.hub.clone(), options).await.unwrap());
    }
    let dir = tempfile::tempdir().unwrap();
    let ca = dir.path().join("gateway.pem");
    std::fs::write(&ca, pem_text("CERTIFICATE", own.authority())).unwrap();
    let mut node = Command::new("node");
    node.arg(repository("tests/js/verify.js"));
    node.args(servers.iter().map(|server| server.local()[0].addr.port().to_string()));
    node.arg(certificate_pin(own.server()).unwrap()).arg(&ca).arg(dir.path()).env("TMPDIR", dir.path());
    run(node).await;
}

#[test]
fn the_page_is_the_one_in_the_documentation() {
    let read = |file| std::fs::read_to_string(repository(file)).unwrap();
    let page = format!("```html\n{}```\n", read("tests/js/camera.html"));
    let is_there = read("docs/tutorials/browser-dashboard.md").contains(&page);
    assert!(is_there, "docs/tutorials/browser-dashboard.md has another page than tests/js/camera.html");
}
