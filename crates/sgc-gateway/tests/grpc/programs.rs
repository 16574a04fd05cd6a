//! Independent programs as clients: Python's grpcio with the client of `clients/python`, and Node's grpc-js with only
//! `gateway.proto`. `make peers` installs both.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use sgc_gateway::{
    Advertise, Anonymous, ClientRule, Content, ListenAt, Protocol, Scope, Server, ServerOptions,
    SessionLimits, certified_key,
};
use sgc_ros::{RosNetwork as _, RosWriter as _, Sample, SampleKind};
use sgc_trust::{Grantees, ServerCertificate, certificate_pin, pem_text};
use sgc_wire::{Durability, History, Qos, UnixMillis};
use tokio::process::Command;

use crate::gateway::{Gateway, now};
use crate::support::{spec, string};

/// Longest duration of a whole test, with much to spare.
const PATIENCE: Duration = Duration::from_secs(120);
/// Pause between two messages of the talker.
const TALK: Duration = Duration::from_millis(10);

/// The interfaces that the programs find on the network.
struct Scene {
    gateway: Gateway,
    token: String,
    talks: Arc<AtomicBool>,
    commands: mpsc::Receiver<Bytes>,
    _held: Box<dyn std::any::Any>,
}

impl Scene {
    async fn new() -> Self {
        let gateway = Gateway::new().await;
        let all = |but: &str| {
            vec!["/chatter".into(), "/camera".into(), "/echoed".into(), "/large".into(), but.into()]
        };
        let scope = Scope {
            subscribe: all("/py/**"),
            publish: all("/py/**"),
            call: vec!["/py/**".into(), "/js/**".into()],
            serve: vec!["/py/**".into(), "/js/**".into()],
        };
        let token = gateway.token("program", scope, UnixMillis(now().0 + 3_600_000));
        let site = &gateway.site;
        let secret = site.writer("/secret", Qos::default());
        let talker = site.writer("/chatter", Qos::default());
        let talks = Arc::new(AtomicBool::new(true));
        let goes_on = Arc::clone(&talks);
        std::thread::spawn(move || {
            for n in 0.. {
                if !goes_on.load(Ordering::Relaxed) {
                    return;
                }
                let stamp = now().0 as i64 * 1_000_000;
                talker.write(SampleKind::Write, stamp, string(&format!("hello {n}"))).unwrap();
                std::thread::sleep(TALK);
            }
        });
        // A picture of four pixels: blue, green, red, white.
        let latched =
            Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() };
        let camera = Advertise {
            topic: "/camera".into(),
            type_name: Some("sensor_msgs/msg/Image".into()),
            qos: latched,
        };
        let camera = site.session("camera").advertise(camera).await.unwrap();
        let image = r#"{"width":4,"height":1,"step":12,"encoding":"bgr8","data":"/wAAAP8AAAD/////"}"#;
        camera.publish(&Content::json(image)).await.unwrap();
        let (send, commands) = mpsc::channel();
        let heard = Box::new(move |sample: Sample| drop(send.send(sample.payload)));
        let wheels = spec("/cmd_vel", "geometry_msgs/msg/Twist", Qos::default());
        let wheels = site.ros.create_reader(&wheels, heard).unwrap();
        let _held = Box::new((secret, camera, wheels));
        Self { gateway, token, talks, commands, _held }
    }

    /// Runs a program and checks that it succeeds.
    async fn run(&self, command: Command) -> String {
        self.run_at(self.gateway.address.port(), command).await
    }

    /// Runs a program against another port of the same gateway.
    async fn run_at(&self, port: u16, mut command: Command) -> String {
        command.arg(port.to_string()).arg(&self.token);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).kill_on_drop(true);
        let program = format!("{command:?}");
        let child = command.spawn().unwrap_or_else(|why| panic!("{why}: run `make peers` first: {program}"));
        let output = tokio::time::timeout(PATIENCE, child.wait_with_output()).await;
        let output = output.expect("it should have ended by now").unwrap();
        let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        assert!(output.status.success(), "{}\n{}", said(&output.stdout), said(&output.stderr));
        said(&output.stdout)
    }
}

impl Drop for Scene {
    fn drop(&mut self) {
        self.talks.store(false, Ordering::Relaxed);
    }
}

fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../").join(file)
}

fn python() -> Command {
    Command::new(repository(".venv/bin/python"))
}

/// Builds the wheel of the Python client in a directory, from the files that its users get.
async fn wheel(dir: &Path) -> PathBuf {
    let source = dir.join("source");
    let copied = Command::new("cp").arg("-r").args([&repository("clients/python"), &source]).status().await;
    assert!(copied.unwrap().success());
    let mut pip = python();
    pip.args([
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "--wheel-dir",
    ]);
    let built = pip.args([dir, &source]).output().await.expect("run `make peers` first");
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    let is_wheel = |path: &PathBuf| path.extension().is_some_and(|kind| kind == "whl");
    std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).find(is_wheel).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn python_does_all_that_there_is() {
    let scene = Scene::new().await;
    let dir = tempfile::tempdir().unwrap();
    let mut python = python();
    python.env("PYTHONPATH", wheel(dir.path()).await).arg("-B");
    python.arg(repository("clients/python/tests/against_gateway.py"));
    let said = scene.run(python).await;
    assert!(said.ends_with("all is well\n"), "{said}");
    // The wheels turned, and stand still now.
    let commands: Vec<_> = scene.commands.try_iter().collect();
    let speed = |payload: &Bytes| f64::from_le_bytes(payload[4..12].try_into().unwrap());
    assert!(commands.len() >= 3 && speed(&commands[0]) == 0.2, "{commands:?}");
    assert_eq!(commands.last().map(speed), Some(0.0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn node_needs_nothing_but_the_proto() {
    let scene = Scene::new().await;
    let mut node = Command::new("node");
    node.arg(repository("tests/js/grpc.cjs"));
    node.arg(repository("crates/sgc-gateway/proto/sgc/gateway/v1/gateway.proto"));
    let said = scene.run(node).await;
    assert!(said.ends_with("all is well\n"), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn python_comes_over_tls_with_the_certificate_of_a_node_or_a_token() {
    let scene = Scene::new().await;
    let dir = tempfile::tempdir().unwrap();
    let (ca, identity) = (dir.path().join("ca.pem"), dir.path().join("desk.identity"));
    let door = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    std::fs::write(&ca, door.cert.pem()).unwrap();
    let desk = scene.gateway.desk();
    std::fs::write(&identity, desk.to_text().as_bytes()).unwrap();
    let who = Grantees { nodes: [desk.node_id()].into(), ..Grantees::default() };
    let scope = Scope { subscribe: vec!["/chatter".into()], ..Scope::default() };
    let access = scene.gateway.access_of(Anonymous::None, vec![ClientRule { who, scope }]);
    let key = certified_key(door.cert.pem().as_bytes(), door.signing_key.serialize_pem().as_bytes()).unwrap();
    let at = ListenAt { protocol: Protocol::Grpc, is_encrypted: true, addr: ([127, 0, 0, 1], 0).into() };
    let options = ServerOptions {
        name: "robot".into(),
        listen: vec![at],
        access,
        keys: Some(key.into()),
        clients_max: 16,
        limits: SessionLimits::default(),
    };
    let server = Server::start(scene.gateway.site.hub.clone(), options).await.unwrap();
    let mut python = python();
    python.env("PYTHONPATH", wheel(dir.path()).await).arg("-B");
    python.arg(repository("clients/python/tests/over_tls.py"));
    python.args([&ca, &identity, &dir.path().join("partner.token")]);
    let said = scene.run_at(server.local()[0].addr.port(), python).await;
    assert!(said.ends_with("all is well\n"), "{said}");
}

/// A gateway with a certificate of its own, at a port for gRPC and one for WebSocket.
async fn own_gateway(scene: &Scene, certificate: &ServerCertificate) -> Server {
    let at = |protocol| ListenAt { protocol, is_encrypted: true, addr: ([127, 0, 0, 1], 0).into() };
    let options = ServerOptions {
        name: "robot".into(),
        listen: vec![at(Protocol::Grpc), at(Protocol::WebSocket)],
        access: scene.gateway.access_of(Anonymous::None, Vec::new()),
        keys: Some(certificate.certified_key().unwrap().into()),
        clients_max: 16,
        limits: SessionLimits::default(),
    };
    Server::start(scene.gateway.site.hub.clone(), options).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn python_verifies_a_gateway_by_its_certificate_or_its_pin_and_refuses_another() {
    let scene = Scene::new().await;
    let dir = tempfile::tempdir().unwrap();
    let names = ["localhost", "127.0.0.1", "robot.example"].map(|name| name.parse().unwrap()).into();
    let mut rng = ChaCha20Rng::seed_from_u64(3);
    let mut made = || ServerCertificate::generate(&names, now(), &mut rng).unwrap();
    let (own, another) = (made(), made());
    let (gateway, intruder) = (own_gateway(&scene, &own).await, own_gateway(&scene, &another).await);
    let ca = dir.path().join("gateway.pem");
    std::fs::write(&ca, pem_text("CERTIFICATE", own.authority())).unwrap();
    let port = |server: &Server, at: usize| server.local()[at].addr.port().to_string();
    let (library, pins) =
        (wheel(dir.path()).await, [&own, &another].map(|of| certificate_pin(of.server()).unwrap()));
    let ports = [port(&gateway, 1), port(&intruder, 0), port(&intruder, 1)];
    let program = || {
        let mut python = python();
        python.env("PYTHONPATH", &library).arg("-B");
        python.arg(repository("clients/python/tests/verify.py")).arg(&ca).args(&pins).args(&ports);
        python
    };
    let to = gateway.local()[0].addr.port();
    let said = scene.run_at(to, program()).await;
    assert!(said.ends_with("all is well\n"), "{said}");
    // The certificate is replaced, with another name, and clients go on with the file and the pin that they have.
    let names = ["localhost", "127.0.0.1"].map(|name| name.parse().unwrap()).into();
    let renewed = own.renewed(&names, now(), &mut rng).unwrap().unwrap();
    gateway.show(renewed.certified_key().unwrap().into()).unwrap();
    let said = scene.run_at(to, program()).await;
    assert!(said.ends_with("all is well\n"), "{said}");
}

#[test]
fn snippet_that_pins_is_the_one_in_the_documentation() {
    let read = |file| std::fs::read_to_string(repository(file)).unwrap();
    let program = read("clients/python/tests/verify.py");
    let (_, rest) = program.split_once("# snippet begin\n").unwrap();
    let (snippet, _) = rest.split_once("# snippet end\n").unwrap();
    let page = read("docs/how-to/verify-a-gateway.md");
    assert!(page.contains(snippet), "docs/how-to/verify-a-gateway.md has another snippet");
}
