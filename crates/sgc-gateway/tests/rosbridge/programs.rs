//! Independent programs as clients: npm's roslib, and PyPI's roslibpy with its own tests. `make peers` installs them.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::{Value as Json, json};
use sgc_gateway::rosbridge::{RosbridgeOptions, serve};
use sgc_gateway::{ActionEvent, ActionReplier, Content, Form, GoalId, GoalStatus};
use sgc_ros::{RosNetwork as _, RosWriter as _, SampleKind};
use sgc_websocket::WebSocket;
use sgc_wire::Qos;
use tokio::net::TcpListener;
use tokio::process::Command;

use crate::parameters::{Parameters, serve_parameters};
use crate::support::{Site, eventually, spec, string};

/// Longest duration of a whole test, with much to spare.
const PATIENCE: Duration = Duration::from_secs(180);
/// Pause between two messages of the talker.
const TALK: Duration = Duration::from_millis(10);
/// Goals of at least this order are executed until they are cancelled.
const ORDER_ENDLESS: i64 = 10;

/// A robot, and a listening gateway on its network.
struct Scene {
    port: u16,
    talks: Arc<AtomicBool>,
    _held: Box<dyn std::any::Any>,
}

impl Scene {
    async fn new() -> Self {
        let site = Arc::new(Site::new().await);
        let talks = Arc::new(AtomicBool::new(true));
        let rosout = spec("/rosout", "rcl_interfaces/msg/Log", Qos::default());
        let rosout = site.ros.create_writer(&rosout).unwrap();
        let talker = site.writer("/chatter", Qos::default());
        let goes_on = Arc::clone(&talks);
        std::thread::spawn(move || {
            for n in 0.. {
                if !goes_on.load(Ordering::Relaxed) {
                    return;
                }
                talker.write(SampleKind::Write, n, string(&format!("hello {n}"))).unwrap();
                std::thread::sleep(TALK);
            }
        });
        let parameters = Parameters::default();
        parameters.lock().unwrap().insert("speed".into(), json!({"type": 3, "double_value": 0.5}));
        serve_parameters(&site, "/arm", &parameters).await;
        serve_switch(&site).await;
        serve_fibonacci(&site).await;
        eventually(|| site.hub.graph().topics.contains_key("/chatter")).await;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let _held = Box::new((rosout, Arc::clone(&site)));
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                stream.set_nodelay(true).unwrap();
                let session = Arc::new(site.session("program"));
                tokio::spawn(async move {
                    let options = RosbridgeOptions::default();
                    let accepted = WebSocket::accept(stream, options.message_bytes_max).await;
                    let Ok(socket) = accepted else { return };
                    drop(serve(socket, session, options).await);
                });
            }
        });
        Self { port, talks, _held }
    }

    /// Runs a program and checks that it succeeds.
    async fn run(&self, command: &mut Command) -> String {
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

async fn serve_switch(site: &Site) {
    let mut serving = site.session("program").serve("/switch", Some("std_srvs/SetBool")).await.unwrap();
    tokio::spawn(async move {
        while let Some(request) = serving.next().await {
            let is_on = serving.write(&request, Form::Json).unwrap() == r#"{"data":true}"#;
            let reply = json!({"success": true, "message": if is_on { "on" } else { "off" }});
            serving.replier().reply(request.id, &Content::json(reply.to_string())).await.unwrap();
        }
    });
}

/// Serves Fibonacci as in the tutorial: an order of 4 is 0, 1, 1, 2, 3, reported number by number.
async fn serve_fibonacci(site: &Site) {
    let session = site.session("program");
    let of = "example_interfaces/action/Fibonacci";
    let mut serving = session.serve_action("/fibonacci", Some(of)).await.unwrap();
    let replier = serving.replier();
    tokio::spawn(async move {
        while let Some(event) = serving.next().await {
            match event {
                ActionEvent::Goal { id, goal } => {
                    let goal: Json =
                        serde_json::from_slice(&serving.write(&goal, Form::Json).unwrap()).unwrap();
                    replier.answer(&id, true).await.unwrap();
                    work(&replier, &id, goal["order"].as_i64().unwrap()).await;
                }
                ActionEvent::Cancel { id } => {
                    let result = Content::json(r#"{"sequence":[0]}"#);
                    // A goal that is cancelled twice has ended.
                    let _ = replier.finish(&id, GoalStatus::Canceled, &result).await;
                }
            }
        }
    });
}

async fn work(replier: &ActionReplier, id: &GoalId, order: i64) {
    let mut sequence = vec![0, 1];
    let content = |sequence: &[i64]| Content::json(json!({ "sequence": sequence }).to_string());
    while (sequence.len() as i64) <= order {
        sequence.push(sequence[sequence.len() - 1] + sequence[sequence.len() - 2]);
        replier.feedback(id, &content(&sequence)).await.unwrap();
    }
    if order < ORDER_ENDLESS {
        replier.finish(id, GoalStatus::Succeeded, &content(&sequence)).await.unwrap();
    }
}

fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../").join(file)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn roslib_of_npm_does_all_that_it_can() {
    let scene = Scene::new().await;
    let url = format!("ws://127.0.0.1:{}/", scene.port);
    let said = scene.run(Command::new("node").arg(repository("tests/js/roslib.js")).arg(url)).await;
    assert!(said.ends_with("all is well\n"), "{said}");
}

async fn roslibpy(transport: &str) {
    let scene = Scene::new().await;
    let mut python = Command::new(repository(".venv/bin/python"));
    python.arg("-B").arg(repository("tests/peers/py/rosbridge.py")).arg(scene.port.to_string());
    let said = scene.run(python.env("ROSLIBPY_TRANSPORT", transport)).await;
    assert!(said.ends_with("all is well\n"), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn roslibpy_does_all_that_it_can() {
    roslibpy("twisted").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn roslibpy_does_so_by_its_other_transport_too() {
    roslibpy("asyncio").await;
}

/// Runs roslibpy's own tests. They know one port, which is replaced in a copy of them.
async fn own_tests_of_roslibpy(transport: &str) {
    let scene = Scene::new().await;
    // The tests publish on the topic themselves.
    scene.talks.store(false, Ordering::Relaxed);
    let dir = tempfile::tempdir().unwrap();
    let from = repository(".peers/roslibpy/tests");
    std::fs::copy(from.join("conftest.py"), dir.path().join("conftest.py")).expect("run `make peers` first");
    let mut tests = 0;
    for entry in std::fs::read_dir(from.join("ros2")).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap();
        let here = text.replace("9090", &scene.port.to_string());
        tests += here.matches("\ndef test_").count();
        std::fs::write(dir.path().join(path.file_name().unwrap()), here).unwrap();
    }
    let mut python = Command::new(repository(".venv/bin/python"));
    python.args(["-B", "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]).current_dir(dir.path());
    let said = scene.run(python.env("ROSLIBPY_TRANSPORT", transport)).await;
    assert!(tests > 20 && said.contains(&format!("{tests} passed")), "{tests}: {said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn roslibpy_passes_its_own_tests() {
    own_tests_of_roslibpy("twisted").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn roslibpy_passes_them_by_its_other_transport_too() {
    own_tests_of_roslibpy("asyncio").await;
}
